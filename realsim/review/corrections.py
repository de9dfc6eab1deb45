"""What the journal makes of a registered scene: objects where the reviewers left them, verdicts.

A line counts for the very pose that it was about. Moves and swaps so form a chain from the
registered pose to the present one, and a later registration, whose poses are others, starts afresh:
`realsim register --from-review` has taken the corrections in. A decision outlives that by being
about the same place still: see `SAME_PLACE_M`.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import ObjectPose, Scene, Verdict
from realsim.review.journal import Entry, ReviewState, subject_of

DECIDED: dict[str, Verdict] = {"accept": "accepted", "reject": "rejected"}
SAME_PLACE_M, SAME_PLACE_DEG = 0.0005, 0.5
"""A pose nearer than this to one that a person judged is the one that was judged: no eye sees the
difference over a cloud whose points are 2 mm apart."""


def corrected_scene(scene: Scene, state: ReviewState) -> Scene:
    """Return the scene with every object where the reviewers left it.

    An object that was moved or swapped has no covariance and no verdict but `unchecked`: what was
    computed of the old pose says nothing about the new one.
    """
    return replace(scene, objects=tuple(_corrected(o, state) for o in scene.objects))


def reviewed_scene(scene: Scene, state: ReviewState) -> Scene:
    """Return the corrected scene with the reviewers' verdicts in place of the computed ones."""
    corrected = corrected_scene(scene, state)
    return replace(corrected, objects=tuple(_judged(o, state) for o in corrected.objects))


def check_is_current(scene: Scene, placed: ObjectPose) -> Callable[[ReviewState], None]:
    """Return a check for `journal.append`: that nobody has moved this object meanwhile.

    Args:
        scene: as it was registered.
        placed: the object as the reviewer sees it.
    """

    def check(state: ReviewState) -> None:
        now = _corrected(scene.object(placed.instance), state)
        if subject_of(now) != subject_of(placed):
            last = _chain(scene.object(placed.instance), state)
            who = (
                f"{last[-1].reviewer} at {last[-1].time[11:19]} UTC" if last else "another reviewer"
            )
            raise InputError(
                f"instance {placed.instance} was changed by {who} while you looked at it; "
                "look at it as it stands there, then decide."
            )

    return check


def decision_on(placed: ObjectPose, state: ReviewState) -> Entry | None:
    """Return the last standing accept or reject of this object where it stands, or None."""
    latest = reversed(state.of(placed.instance))
    return next((e for e in latest if e.action in DECIDED and _is_about(e, placed)), None)


def pending(scene: Scene, state: ReviewState) -> tuple[Entry, ...]:
    """Return the lines that make another scene of this one: moves, swaps, views, rejections."""
    lines: list[Entry] = [e for o in scene.objects for e in _chain(o, state)]
    lines += state.excluded_views().values()
    lines += state.marks().values()
    decided = (decision_on(o, state) for o in corrected_scene(scene, state).objects)
    return (*lines, *(d for d in decided if d is not None and d.action == "reject"))


def _chain(placed: ObjectPose, state: ReviewState) -> list[Entry]:
    """Return the moves and swaps that lead from the registered pose to the present one."""
    chain: list[Entry] = []
    subject = subject_of(placed)
    for entry in state.of(placed.instance):
        if entry.action in ("move", "swap") and entry.subject == subject:
            placed = _after(placed, entry)
            subject = subject_of(placed)
            chain.append(entry)
    return chain


def _after(placed: ObjectPose, entry: Entry) -> ObjectPose:
    """Return the object after one move or swap."""
    assert entry.pose is not None
    obj_id = placed.obj_id if entry.obj_id is None else entry.obj_id
    return ObjectPose(obj_id=obj_id, instance=placed.instance, T_world_obj=entry.pose)


def _corrected(placed: ObjectPose, state: ReviewState) -> ObjectPose:
    chain = _chain(placed, state)
    if not chain:
        return placed
    last = chain[-1]
    assert last.pose is not None
    mm, turned = apart(placed.T_world_obj, last.pose)
    words = f"moved by {last.reviewer}" + (f" ({last.how})" if last.how else "")
    words += f": {mm:.2g} mm, {turned:.2g} deg from where it was registered"
    now = _after(placed, last)
    obj_id = next((e.obj_id for e in reversed(chain) if e.obj_id is not None), placed.obj_id)
    if obj_id != placed.obj_id:
        words = f"object {placed.obj_id} was said to be object {obj_id}; {words}"
    return replace(now, obj_id=obj_id, checks=dict(last.checks), reasons=(words,))


def _judged(placed: ObjectPose, state: ReviewState) -> ObjectPose:
    decision = decision_on(placed, state)
    if decision is None:
        return placed
    why = f": {decision.comment}" if decision.comment else ""
    reason = f"{decision.action}ed by {decision.reviewer}{why}"
    return replace(placed, verdict=DECIDED[decision.action], reasons=(*placed.reasons, reason))


def _is_about(entry: Entry, placed: ObjectPose) -> bool:
    """Return whether a decision was made about this object at this place."""
    if entry.subject == subject_of(placed):
        return True
    if entry.pose is None or entry.obj_id != placed.obj_id:
        return False
    return is_same_place(entry.pose, placed.T_world_obj)


def apart(a: Array, b: Array) -> tuple[float, float]:
    """Return how far two poses (4, 4) are from each other [mm, deg]."""
    turn = se3.angle(se3.invert(a)[:3, :3] @ b[:3, :3])
    return 1e3 * float(np.linalg.norm(b[:3, 3] - a[:3, 3])), float(np.rad2deg(turn))


def is_same_place(a: Array, b: Array) -> bool:
    """Return whether no eye sees two poses (4, 4) [m] apart."""
    mm, deg = apart(a, b)
    return mm < 1e3 * SAME_PLACE_M and deg < SAME_PLACE_DEG
