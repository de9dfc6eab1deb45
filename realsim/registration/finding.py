"""From what is wanted to objects near their final poses, whatever was known of them before."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.models.symmetry import with_found_symmetries
from realsim.records import ObjectModel, ObjectPose, names_of
from realsim.registration.body import Body, make_body, moved_body
from realsim.registration.config import RegistrationConfig
from realsim.registration.few_views import begin, search_near
from realsim.registration.hint_regions import RoughPose, region_about
from realsim.registration.intake import Intake
from realsim.registration.judging.scene_checks import SceneFinding, unit_errors, with_swaps
from realsim.registration.many_views import ManyViews
from realsim.registration.odometry.cross_check import KinematicsCheck
from realsim.registration.refinement.refine import area_at
from realsim.registration.reports import search_report
from realsim.registration.search.find import find_objects
from realsim.registration.search.flat_search import (
    FLAT_HEIGHT_M,
    SAME_PLACE_M,
    FlatPose,
    cover,
    is_free,
    seek_flat,
    table_map,
)
from realsim.registration.search.records import NotPlaced, Placed, SearchResult, Wanted

Progress = Callable[[int, int], None]
NO_INSTANCE = -1
"""Number of what was not asked for by number."""


class Ticker:
    """Counts steps for the progress callback."""

    def __init__(
        self, progress: Progress | None, total: int, told: Callable[[str], None] | None = None
    ) -> None:
        self._progress, self._done, self._total = progress, 0, total
        self._told = told

    def say(self, words: str) -> None:
        """Tell what is being done; no step is done by it."""
        if self._told is not None:
            self._told(words)
        if self._progress is not None:
            self._progress(min(self._done, self._total), self._total)

    def __call__(self) -> None:
        """One more step is done."""
        self._done += 1
        if self._progress is not None:
            self._progress(min(self._done, self._total), self._total)

    def each(self, done: int, total: int) -> None:
        """One more step of an inner loop is done."""
        self()


@dataclass(frozen=True, eq=False, slots=True)
class SceneTask:
    """What every step of one registration needs."""

    name: str
    intake: Intake
    models: Mapping[int, ObjectModel]
    config: RegistrationConfig
    up: Array | None
    tick: Ticker
    kinematics: KinematicsCheck | None
    symmetry_words: dict[int, str]
    """Model -> what was found of symmetries that it does not declare."""

    def symmetric(self, obj_ids: Iterable[int]) -> "SceneTask":
        """Return the task with the symmetries of these models' shapes, where none are declared."""
        models = dict(self.models)
        for i in sorted(set(obj_ids) & set(models)):
            if i not in self.symmetry_words:
                models[i], words = with_found_symmetries(models[i], self.config.field_folder)
                self.symmetry_words[i] = words
        return replace(self, models=models)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FoundObjects:
    """What the search found."""

    bodies: list[Body]
    """At the poses that were found."""
    claimed: list[Array | None]
    """(4, 4) what somebody claimed of each."""
    contrasts: list[float | None]
    rivals: list[Array | None]
    """(4, 4) the best near-symmetric rival of each pose."""
    reports: list[dict[str, Any]]
    not_placed: tuple[NotPlaced, ...]
    report: dict[str, Any]
    findings: tuple[SceneFinding, ...] = ()
    """What is wrong with what was claimed."""


def wanted_objects(
    models: Mapping[int, ObjectModel], wanted: Sequence[ObjectPose] | Sequence[Wanted] | None
) -> list[Wanted] | None:
    """Return what is wanted, each checked against the models.

    Raises:
        InputError: nothing is wanted, an unknown model, or a number twice.
    """
    if not models:
        raise InputError("no object models were given; registration needs the objects' meshes.")
    if wanted is None:
        return None
    if not wanted:
        raise InputError("no start poses were given; give one per object instance.")
    if len({s.instance for s in wanted}) != len(wanted):
        raise InputError("two start poses have the same instance number.")
    asked: list[Wanted] = []
    for w in wanted:
        model = models.get(w.obj_id)
        if model is None:
            raise InputError(
                f"instance {w.instance} is of object {w.obj_id}, which is not among the "
                f"models: {names_of(list(models.values()))}."
            )
        if isinstance(w, ObjectPose):
            T = w.T_world_obj
            region = region_about(RoughPose(T_world_obj=T), model)
            w = Wanted(obj_id=w.obj_id, instance=w.instance, region=region, T_start=T)  # noqa: PLW2901
        asked.append(w)
    return asked


def in_units(
    models: Mapping[int, ObjectModel], asked: list[Wanted] | None, intake: Intake
) -> tuple[list[Wanted] | None, list[NotPlaced]]:
    """Return what can be sought, and what is off by a factor of a thousand."""
    depths = [np.median(v.points[:, 2]) for v in intake.views if len(v.points)]
    if asked is None or not depths:
        return asked, []
    eyes = intake.cameras[:, :3, 3]
    starts = [
        ObjectPose(
            obj_id=w.obj_id, instance=w.instance,
            T_world_obj=_middle_pose(intake) if w.T_start is None else w.T_start,
        )
        for w in asked
    ]  # fmt: skip
    errors = unit_errors(models, starts, eyes, float(np.median(depths)))
    refused = [
        NotPlaced(obj_id=w.obj_id, instance=w.instance, reason=str(errors[w.instance]))
        for w in asked if w.instance in errors
    ]  # fmt: skip
    return [w for w in asked if w.instance not in errors], refused


def models_in_units(
    models: Mapping[int, ObjectModel], intake: Intake
) -> tuple[Mapping[int, ObjectModel], list[NotPlaced]]:
    """Return the models that are sought if nothing is named, and those off by a thousand.

    A model of a hundred metres would not only not be found: its hypotheses fill the memory.

    Raises:
        InputError: no model is left.
    """
    all_ = [Wanted(obj_id=i, instance=i) for i in models]
    kept, refused = in_units(models, all_, intake)
    if not kept:
        raise InputError(f"none of the {len(models)} models can be sought: {refused[0].reason}")
    left = {w.obj_id: models[w.obj_id] for w in kept or ()}
    return left, [replace(n, instance=NO_INSTANCE) for n in refused]


def _middle_pose(intake: Intake) -> Array:
    """Return a pose (4, 4) in front of the first camera, for objects of which nothing is said."""
    view = next(v for v in intake.views if len(v.points))
    return se3.from_translation(np.median(view.world(), axis=0))


def seek_objects(task: SceneTask, asked: list[Wanted] | None) -> FoundObjects:
    """Return the objects near their final poses, whatever was known of them before."""
    intake, config = task.intake, task.config
    near_only = asked is not None and all(w.T_start is not None for w in asked)
    few = len(intake.frames) < config.refine_from
    if asked is not None and not asked:
        return _objects_near(task, [])
    if config.method == "top-down" and asked is None:
        raise InputError(
            "method 'top-down' fits objects from rough poses and none were given; give one per "
            "object, or use method 'joint'."
        )
    if config.method == "top-down" or (near_only and (few or intake.plane is None)):
        return _objects_near(task, asked or [])
    if intake.plane is None:
        lost = [w for w in asked or () if w.T_start is None]
        reason = (
            f"no table was found ({intake.no_plane}), so it can be anywhere; give a rough pose "
            "(30 mm, 20 deg)."
        )
        missing = [NotPlaced(obj_id=w.obj_id, instance=w.instance, reason=reason) for w in lost]
        near = [w for w in asked or () if w.T_start is not None]
        if asked is None:
            raise DegenerateError(
                f"no table was found: {intake.no_plane.rstrip('.')}. Without one, objects can only "
                "be registered from rough poses; name them with their poses."
            )
        found = _objects_near(task, near)
        return replace(found, not_placed=(*found.not_placed, *missing))
    plane = intake.plane

    def search(these: Sequence[Wanted] | None) -> SearchResult:
        return find_objects(
            intake.intrinsics, intake.frames, intake.views, plane, intake.noise, task.models,
            these, config.find, field_folder=config.field_folder, progress=task.tick.each,
            told=task.tick.say,
        )  # fmt: skip

    result, findings = search(asked), []
    if asked is None:  # only of what is there: it takes half a second each
        task = task.symmetric(p.obj_id for p in result.placed)
    if asked is not None:
        result, findings = with_swaps(result, asked, dict(task.models), search)
    wrong = {i for f in findings for i in f.instances}
    claims = [w for w in asked or () if w.instance not in wrong]
    return replace(_found_objects(task, result, claims), findings=tuple(findings))


def with_flat(
    task: SceneTask, found: FoundObjects, many: ManyViews, asked: Sequence[Wanted]
) -> FoundObjects | None:
    """Return the objects with those flat ones that only refined views show; None = no more.

    Objects of which nothing was claimed are sought: those that were not placed, and those that lie
    elsewhere than a search of single images said.
    """
    plane = many.plane
    free = {w.instance: w.obj_id for w in asked if w.region is None and w.T_start is None}
    placed = {b.start.instance: (b, T) for b, T in zip(found.bodies, many.poses, strict=True)}
    sought = [
        placed[i][0] if i in placed else _body(task, obj_id, i, np.eye(4))
        for i, obj_id in free.items()
        if min(task.models[obj_id].mesh.extent) < FLAT_HEIGHT_M
    ]
    if plane is None or not sought:
        return None
    middle = plane.T_world_table[:3, 3]
    if placed:
        middle = np.mean([body.center(T) for body, T in placed.values()], axis=0)
    area_px = area_at(task.intake.intrinsics.width)
    map_ = table_map(many.hand_views, plane, task.intake.noise, middle, area_px)
    flat = {b.start.instance for b in sought}
    for instance, (body, T) in placed.items():
        if instance not in flat:
            map_ = cover(map_, body, T)
    changed = False
    poses = [(seek_flat(body, map_), body) for body in sought]
    while left := [(p, b) for p, b in poses if p is not None]:
        pose, body = max(left, key=lambda one: one[0].explained)
        map_ = cover(map_, body, pose.T_world_obj)
        # What the best one covers is no place for another.
        poses = [
            (p if is_free(map_, b, p.T_world_obj) else seek_flat(b, map_), b)
            for p, b in left
            if b is not body
        ]
        if body.start.instance in placed:
            T = placed[body.start.instance][1]
            if mssd_symmetric(T, pose.T_world_obj, body.model) < SAME_PLACE_M:
                continue
        changed = True
        found = _with_body(found, moved_body(body, pose.T_world_obj), pose)
    return found if changed else None


def without_objects(found: FoundObjects, instances: AbstractSet[int]) -> FoundObjects:
    """Return the objects without some of them."""
    left = [n for n, b in enumerate(found.bodies) if b.start.instance not in instances]
    return replace(
        found,
        bodies=[found.bodies[n] for n in left],
        claimed=[found.claimed[n] for n in left],
        contrasts=[found.contrasts[n] for n in left],
        rivals=[found.rivals[n] for n in left],
        reports=[found.reports[n] for n in left],
    )


def _with_body(found: FoundObjects, body: Body, pose: FlatPose) -> FoundObjects:
    """Return the objects with one more, or with one elsewhere."""
    rest = without_objects(found, {body.start.instance})
    report = {"source": "mean heights", "explained": pose.explained, "contrast": pose.contrast}
    return replace(
        rest,
        bodies=[*rest.bodies, body],
        claimed=[*rest.claimed, None],
        contrasts=[*rest.contrasts, pose.contrast],
        rivals=[*rest.rivals, None],
        reports=[*rest.reports, report],
        not_placed=tuple(m for m in found.not_placed if m.instance != body.start.instance),
    )


def _found_objects(task: SceneTask, result: SearchResult, asked: Sequence[Wanted]) -> FoundObjects:
    """Return what a search placed as bodies, with what was rightly claimed of them."""
    claims = {w.instance: w.T_start for w in asked}
    placed: list[Placed] = sorted(result.placed, key=lambda p: p.instance)
    return FoundObjects(
        bodies=[_body(task, p.obj_id, p.instance, p.T_world_obj) for p in placed],
        claimed=[claims.get(p.instance) for p in placed],
        contrasts=[p.contrast for p in placed],
        rivals=[p.T_rival for p in placed],
        reports=[search_report(p) for p in placed],
        not_placed=result.not_placed, report=dict(result.report),
    )  # fmt: skip


def _objects_near(task: SceneTask, asked: list[Wanted]) -> FoundObjects:
    """Return the objects at their claimed starts; where there are few views the fit searches."""
    T_starts = [w.T_start for w in asked if w.T_start is not None]
    missing = [
        NotPlaced(
            obj_id=w.obj_id, instance=w.instance,
            reason=f"method '{task.config.method}' fits from rough poses only, and it has none.",
        )
        for w in asked if w.T_start is None
    ]  # fmt: skip
    bodies = [_body(task, w.obj_id, w.instance, w.T_start) for w in asked if w.T_start is not None]
    reports: list[dict[str, Any]] = [{} for _ in bodies]
    many = len(task.intake.frames) >= task.config.refine_from and task.config.refine_cameras
    if many and bodies and task.config.method == "joint":
        started = begin(task.intake, bodies, task.config, task.up)
        found = search_near(started, bodies, task.tick)
        reports = [f.report for f in found]
        bodies = [moved_body(b, f.fit.T_world_obj) for b, f in zip(bodies, found, strict=True)]
    return FoundObjects(
        bodies=bodies, claimed=list(T_starts), contrasts=[None] * len(bodies),
        rivals=[None] * len(bodies), reports=reports, not_placed=tuple(missing), report={},
    )  # fmt: skip


def _body(task: SceneTask, obj_id: int, instance: int, T: Array) -> Body:
    """Return the body of an instance at a pose."""
    c = task.config
    start = ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T)
    return make_body(start, task.models[obj_id], c.field_cells, c.samples, c.field_folder)


def claimed_bodies(found: FoundObjects) -> list[Body]:
    """Return the bodies with the starts that somebody claimed, where somebody did."""
    return [
        b if T is None else moved_body(b, T)
        for b, T in zip(found.bodies, found.claimed, strict=True)
    ]
