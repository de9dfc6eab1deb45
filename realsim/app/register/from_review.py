"""A registration that starts from the reviewed scene: moved objects moved, rejected ones left out.

`registration/review.json` keeps from which lines of the journal the present registration was made
and where it started, so that a second run with nothing new computes nothing. Scenes that are
replaced stay in `registration/earlier/`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.app.register import results
from realsim.app.reviewed import damage_words, review_of
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose, Scene
from realsim.registration.search.records import Region, Wanted
from realsim.review import corrections
from realsim.review.journal import Entry, ReviewState
from realsim.store import SessionStore, load_scene
from realsim.untrusted.own_json import to_json

SCENE_FILE = "registration/scene.json"
REVIEW_FILE = "registration/review.json"
EARLIER = "registration/earlier"
UPGRADE_FILE = "stages/upgrade.json"
"""There in a scene that `realsim upgrade` made."""
FORMAT = 1
HELD_RADIUS_M, HELD_TURN_DEG = 0.005, 5.0
"""How far an object that a person accepted, or that nobody touched, is looked for."""
MOVED_RADIUS_M, MOVED_TURN_DEG = 0.015, 15.0
"""How far one that a person moved is looked for: a mouse is good to a centimetre."""
SAME_CAMERAS_M = 0.001
"""Cameras that see an object nearer than this to where they saw it are the same ones."""
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True, slots=True)
class ReviewStarts:
    """What the reviewed scene says of the objects."""

    rows: list[Row]
    """A row an object: obj_id, instance, T_world_obj, radius_m, turn_deg."""
    applied: tuple[str, ...]
    """The lines of the journal that they come from."""
    words: tuple[str, ...] = ()
    """What was made of them, object by object."""

    def wanted(self, models: Mapping[int, ObjectModel]) -> list[Wanted]:
        """Return the objects as the registration wants them.

        Raises:
            InputError: a model is missing.
        """
        return [_wanted(row, models) for row in self.rows]

    def to_json(self) -> Row:
        """Return what is kept of them."""
        return {
            "format_version": FORMAT, "applied": list(self.applied), "starts": self.rows,
            "words": list(self.words),
        }  # fmt: skip


def review_starts(store: SessionStore, models: Mapping[int, ObjectModel] | None) -> ReviewStarts:
    """Return where objects start from: those of the last such run if nothing has been said since.

    Args:
        store: the session.
        models: if given, that everything has a model is checked.

    Raises:
        InputError: nothing is registered, nobody has reviewed it, everything is rejected, or an
            object was said to be one that has no model.
    """
    if not store.has(SCENE_FILE):
        raise InputError(
            f"session '{store.folder}' is not registered yet, so there is nothing to review: run "
            f"`realsim register {store.folder}` first."
        )
    state, scene = review_of(store), load_scene(store)
    if not state.standing and damage_words(store):
        raise InputError(f"nothing of the review can be read: {damage_words(store)}")
    if not state.standing:
        raise InputError(
            f"no decision of a review stands in session '{store.folder}': its journal is empty, or "
            f"all was taken back. Run `realsim review {store.folder}`, or leave --from-review away."
        )
    lines = corrections.pending(scene, state)
    kept = store.read_json(REVIEW_FILE) if store.has(REVIEW_FILE) else None
    before = () if kept is None else tuple(kept["applied"])
    standing = {e.id for e in state.standing}
    if kept is not None and {e.id for e in lines} <= set(before) <= standing:
        return ReviewStarts(
            rows=kept["starts"], applied=tuple(kept["applied"]), words=tuple(kept["words"])
        )
    rows: list[Row] = []
    words = [
        f"the {e.action} of instance {e.instance} by {e.reviewer} was taken back after this scene "
        "was made with it: register without --from-review to begin without it."
        for e in state.entries
        if e.id in before and e.id not in standing and e.action in ("reject", "move", "swap")
    ]
    for placed in corrections.corrected_scene(scene, state).objects:
        decision = corrections.decision_on(placed, state)
        name = f"instance {placed.instance} (object {placed.obj_id})"
        if decision is not None and corrections.DECIDED[decision.action] == "rejected":
            why = f": {decision.comment}" if decision.comment else ""
            words.append(f"{name} was rejected by {decision.reviewer}{why}. It is left out.")
            continue
        if models is not None and placed.obj_id not in models:
            raise InputError(
                f"instance {placed.instance} was said to be object {placed.obj_id}, and there is "
                f"no model of it; there are {', '.join(map(str, sorted(models))) or 'none'}. "
                "Give the --library that has it."
            )
        is_moved = any(e.instance == placed.instance for e in lines)
        if is_moved:
            words.append(f"{name} starts from where it was put: {'; '.join(placed.reasons)}.")
        rows.append(_row(placed, is_moved))
    if not rows:
        raise InputError(
            f"the reviewers rejected every object of session '{store.folder}'; there is nothing to "
            "register. Move one to where it is, or say what is there with --object."
        )
    applied = (*(i for i in before if i in standing), *(e.id for e in lines if e.id not in before))
    return ReviewStarts(rows=rows, applied=applied, words=tuple(words))


def _row(placed: ObjectPose, is_moved: bool) -> Row:
    return {
        "obj_id": placed.obj_id,
        "instance": placed.instance,
        "T_world_obj": to_json(placed.T_world_obj),
        "radius_m": MOVED_RADIUS_M if is_moved else HELD_RADIUS_M,
        "turn_deg": MOVED_TURN_DEG if is_moved else HELD_TURN_DEG,
    }


def _wanted(row: Row, models: Mapping[int, ObjectModel]) -> Wanted:
    obj_id, T = row["obj_id"], np.array(row["T_world_obj"], dtype=np.float64)
    if obj_id not in models:
        raise InputError(
            f"there is no model of object {obj_id}, which the review placed. Give the --library "
            "that has it."
        )
    region = Region(
        center_world=T[:3, :3] @ models[obj_id].mesh.bounds.mean(0) + T[:3, 3],
        radius_m=row["radius_m"], R_world_obj=T[:3, :3].copy(), turn_deg=row["turn_deg"],
    )  # fmt: skip
    return Wanted(obj_id=obj_id, instance=row["instance"], region=region, T_start=T)


def stayed(
    store: SessionStore, starts: ReviewStarts, result: results.Registered
) -> tuple[results.Registered, list[str]]:
    """Return the registration with those objects where they stood that stay, and words on them.

    What a person accepted stays, and in an upgraded scene all that nobody moved: annotations that
    no fit bettered are among it. The table stays with them. Seen by other cameras than before, an
    object is where it is found.
    """
    before, record, state = load_scene(store), results.load_cameras(store), review_of(store)
    cameras = store.session.Ts_world_cam if record is None else record.session
    corrected = corrections.corrected_scene(before, state)
    fitted = {o.instance: o for o in result.scene.objects}
    words: list[str] = []
    stay = False
    for row in starts.rows:
        placed = corrected.object(row["instance"])
        decision = corrections.decision_on(placed, state)
        is_accepted = decision is not None and decision.action == "accept"
        if not is_accepted and not (store.has(UPGRADE_FILE) and _is_as_before(placed, before)):
            continue
        at, now = placed.T_world_obj[:, 3], result.cameras.refined
        steps = [(se3.invert(cameras[k]) - se3.invert(now[k])) @ at for k in now if k in cameras]
        if not steps or np.median(np.linalg.norm(steps, axis=1)) > SAME_CAMERAS_M:
            continue
        found, stay = fitted.get(placed.instance), True
        if found is None or not corrections.is_same_place(found.T_world_obj, placed.T_world_obj):
            fit = "finds it nowhere"
            if found is not None:
                mm, deg = corrections.apart(placed.T_world_obj, found.T_world_obj)
                fit = f"would put it {mm:.2g} mm and {deg:.2g} deg from there"
            who = "where it stood" if decision is None else f"where {decision.reviewer} accepted it"
            words.append(f"instance {placed.instance} stays {who}; the fit {fit}.")
        fitted[placed.instance] = placed
    result = results.with_objects(result, [fitted[k] for k in sorted(fitted)])
    if stay and before.plane is not None:  # grasps were tried at places on this table
        result = replace(result, scene=replace(result.scene, plane=before.plane))
    return result, words


def _is_as_before(placed: ObjectPose, scene: Scene) -> bool:
    """Return whether an object is the one of a scene, and at its place there."""
    old = scene.object(placed.instance)
    return old.obj_id == placed.obj_id and corrections.is_same_place(
        old.T_world_obj, placed.T_world_obj
    )


def accepted_in(store: SessionStore) -> list[int]:
    """Return the instances that a person accepted where they stand."""
    state = review_of(store)
    decided = [(o.instance, corrections.decision_on(o, state))
               for o in corrections.corrected_scene(load_scene(store), state).objects]  # fmt: skip
    return [k for k, e in decided if e is not None and e.action == "accept"]


def is_precious(store: SessionStore) -> bool:
    """Return whether the present scene was reviewed, or is not a registration's (a generated one).

    A registration can be made again.
    """
    # One that was ended after its scene was written has no stage yet.
    return bool(review_of(store).standing) or not any(
        map(store.has, (results.STAGE_FILE, results.VIEWS_FILE))
    )


def keep_earlier(store: SessionStore) -> str | None:
    """Keep the present scene beside those that were replaced before it; return where, if new."""
    if not store.has(SCENE_FILE):
        return None
    data = store.path(SCENE_FILE).read_bytes()
    kept = sorted(store.path(EARLIER).glob("scene_*.json"))
    if kept and kept[-1].read_bytes() == data:
        return None
    name = f"{EARLIER}/scene_{len(kept) + 1:03d}.json"
    store.write_bytes(name, data)
    return name


def instances_ever(store: SessionStore) -> set[int]:
    """Return the instances of the present scene and of those that reviews replaced."""
    files = [SCENE_FILE] if store.has(SCENE_FILE) else []
    files += [f"{EARLIER}/{p.name}" for p in store.path(EARLIER).glob("scene_*.json")]
    return {o.instance for name in files for o in load_scene(store, name).objects}


def moved_since_accepted(
    objects: Sequence[ObjectPose], state: ReviewState
) -> Iterator[tuple[ObjectPose, Entry, float, float]]:
    """Return the objects whose last acceptance was of another place, and how far [mm, deg]."""
    for placed in objects:
        last = [e for e in state.of(placed.instance) if e.action in corrections.DECIDED]
        if not last or last[-1].action != "accept" or last[-1].pose is None:
            continue
        if corrections.decision_on(placed, state) is None and last[-1].obj_id == placed.obj_id:
            yield (placed, last[-1], *corrections.apart(last[-1].pose, placed.T_world_obj))
