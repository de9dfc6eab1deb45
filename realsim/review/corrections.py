"""What the journal makes of a registered scene: objects where the reviewers left them, verdicts.

A line counts for the very pose that it was about. Moves and swaps so form a chain from the
registered pose to the present one, and a later registration, whose poses are others, starts afresh:
`realsim register --from-review` has taken the corrections in. A decision outlives that by being
about the same place still: see `SAME_PLACE_M`.

How a reviewer says that a model is symmetric, and the models with it.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import Mesh, ObjectModel, ObjectPose, Scene, Verdict
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


Axes = tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
MOST_FOLD = 36
"""Turns of a regular shape; beyond that it is one of revolution."""
GRAMMAR = (
    "accepted are none, an axis of the model for a shape of revolution (z), an axis with its order "
    "(z:4 looks the same after a quarter turn), and several of them (x:2 z:2)"
)


def symmetry_of(text: str, mesh: Mesh) -> tuple[Array, Axes]:
    """Return what a mark says of a mesh.

    Args:
        text: `none`, `z`, `z:4`, or several separated by blanks. Axes are those of the model's
            frame, through the middle of its box.
        mesh: the model's.

    Returns:
        symmetries (S, 4, 4) T_obj_obj, the identity first, and the axes of revolution with a point
        on each [m]: as in `ObjectModel`.

    Raises:
        InputError: the text is not understood, or the turns it names make no finite group.
    """
    from realsim.models.symmetry_search import closed, turn

    middle = mesh.bounds.mean(0)
    words = text.split()
    if not words or (len(words) > 1 and "none" in words):
        raise InputError(f"'{text}' is no symmetry: {GRAMMAR}.")
    axes: list[tuple[tuple[float, float, float], tuple[float, float, float]]] = []
    turns: list[Array] = []
    for word in words:
        found = re.fullmatch(r"none|([xyz])(?::(\d{1,3}))?", word)
        if found is None:
            raise InputError(f"'{text}' is no symmetry: '{word}' is not understood; {GRAMMAR}.")
        if word == "none":
            continue
        axis = AXES[found[1]]
        if found[2] is None:
            axes.append((axis, (float(middle[0]), float(middle[1]), float(middle[2]))))
            continue
        order = int(found[2])
        if not 2 <= order <= MOST_FOLD:
            raise InputError(
                f"'{text}' is no symmetry: an order of {order}; 2 to {MOST_FOLD} are accepted, and "
                f"{found[1]} alone for a shape of revolution."
            )
        turns.append(turn(axis, 2 * np.pi / order))
    rotations = closed([np.eye(3), *turns])
    return np.array([se3.from_rt(R, middle - R @ middle) for R in rotations]), tuple(axes)


def marked_models(models: Mapping[int, ObjectModel], state: ReviewState) -> dict[int, ObjectModel]:
    """Return the models, symmetric as the reviewers marked them.

    Marks of models that are not there are left out: the session may have lost an object since.

    Raises:
        InputError: a mark is not understood.
    """
    marked = dict(models)
    for obj_id, entry in state.marks().items():
        if obj_id in marked:
            symmetries, axes = symmetry_of(entry.symmetry, marked[obj_id].mesh)
            marked[obj_id] = replace(marked[obj_id], symmetries=symmetries, symmetry_axes=axes)
    return marked
