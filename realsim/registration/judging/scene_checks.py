"""What is wrong with a scene as a whole, each finding in words.

All objects shifted alike (the camera poses or the starts are another frame's), all sunk alike (the
depth or the models have another scale), two ids swapped, a model that is not there.

Lengths that are off by a factor of 1000: millimetres taken for metres, or metres for them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import UnitError
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose, SupportPlane
from realsim.registration.body import Body
from realsim.registration.compare import Comparer
from realsim.registration.evidence import Cloud
from realsim.registration.search.records import Placed, SearchResult, Wanted
from realsim.registration.solver import COARSE, solve_pose
from realsim.registration.verify import common_offset, common_sinking

FindingKind = Literal["common shift", "common sinking", "swapped ids", "not in the scene", "unit"]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SceneFinding:
    """One thing that is wrong with a scene."""

    kind: FindingKind
    words: str
    """What was found, with its numbers, and what to do."""
    instances: tuple[int, ...]
    """The objects it concerns."""
    numbers: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Plain JSON values."""


SIMILAR_SIDES = 1.35
"""Greatest ratio of the sorted sides of the two boxes: nobody mistakes a cup for a nut."""
OWN_GAIN = 0.5
"""Objects that gain this much per pixel at their own place are not suspected: right ones gain
0.6 or more over the bare table."""
BETTER_GAIN = 0.1
"""Share of its gain that the other model must gain more at either place."""
MARGIN_M = 0.01
"""Points this far beyond a model's bounding sphere are fitted too [m]."""
QUARTER_TURNS = 4
"""Quarter turns about the vertical that are tried, for each of the six sides up."""
FINALISTS = 4
"""Fitted turns that are rendered."""
FIT_POINTS = 1500
"""Points that fit a turn."""
ABSENT_GAIN = 0.15
"""A model whose best pose explains its pixels by less than this each better than the bare table
is not in the scene."""
ABSENT_PROBABILITY = 0.1
"""Probability below which the pose of such a model counts as absent."""
GOOD_PROBABILITY = 0.5
"""Objects of this probability or more count for what all have in common."""


def scene_findings(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    probabilities: Sequence[float],
    cloud: Cloud,
    comparer: Comparer,
    with_starts: bool = True,
    usable: Sequence[bool] | None = None,
) -> list[SceneFinding]:
    """Return what is wrong with the scene.

    Args:
        bodies: the objects at their starts.
        poses: T_world_obj (4, 4) where they were found.
        probabilities: that each is right.
        cloud: the scene's measured points, averaged on voxels of 2 or 3 mm, the table's left out.
        comparer: frames, noise and table.
        with_starts: whether the starts were given by someone; else no common shift is looked for.
        usable: which objects count for what all have in common; None = the likely.
    """
    use = [p >= GOOD_PROBABILITY for p in probabilities] if usable is None else list(usable)
    findings: list[SceneFinding] = []
    if with_starts:
        findings += shift_findings(bodies, poses, use)
    findings += sinking_findings(bodies, poses, use, comparer.plane)
    gains = [comparer.gain(b, T, comparer.stride_of(b, T))
             for b, T in zip(bodies, poses, strict=True)]  # fmt: skip
    swaps = swap_findings(bodies, poses, gains, cloud, comparer)
    swapped = {i for f in swaps for i in f.instances}
    findings += swaps
    for body, (_, gain), p in zip(bodies, gains, probabilities, strict=True):
        absent = gain < ABSENT_GAIN and p < ABSENT_PROBABILITY
        if absent and body.start.instance not in swapped:
            findings.append(
                SceneFinding(
                    kind="not in the scene",
                    words=f"{_name_of(body)} seems not to be in the scene: its best pose explains "
                    f"the depth by {gain:.2f} per pixel better than the bare table does (0.6 or "
                    "more is usual). Remove it from the list, or check that its model is the "
                    "object's.",
                    instances=(body.start.instance,),
                    numbers={"gain_per_pixel": gain, "probability": p},
                )
            )
    return findings


def shift_findings(
    bodies: Sequence[Body], poses: Sequence[Array], use: Sequence[bool]
) -> list[SceneFinding]:
    """Return the finding that all objects stand off their starts by one vector, if they do."""
    found = common_offset(bodies, poses, use)
    if not found["consistent"]:
        return []
    offset = np.array(found["offset_mm"], dtype=np.float64)
    words = (
        f"all {found['objects']} objects were found {np.linalg.norm(offset):.1f} mm from their "
        f"starts in one direction (x {offset[0]:.1f}, y {offset[1]:.1f}, z {offset[2]:.1f} mm, "
        f"spread {found['spread_mm']:.1f} mm): the camera poses or the given poses are another "
        "frame's or another calibration's. Check which camera pose they were made with."
    )
    instances = tuple(b.start.instance for b, u in zip(bodies, use, strict=True) if u)
    return [SceneFinding(kind="common shift", words=words, instances=instances, numbers=found)]


def sinking_findings(
    bodies: Sequence[Body], poses: Sequence[Array], use: Sequence[bool], plane: SupportPlane | None
) -> list[SceneFinding]:
    """Return the finding that all objects sink or float by one share of their height, if so."""
    found = common_sinking(bodies, poses, use, plane)
    if not found["consistent"]:
        return []
    share = float(np.array(found["share_of_height"]))
    does = "sink into the table" if share < 0 else "float over the table"
    reason = ("the depth reads short, or the models are too large" if share < 0
              else "the depth reads long, or the models are too small")  # fmt: skip
    words = (
        f"all {found['objects']} objects {does} by {100 * abs(share):.1f} % of their height (rest "
        f"{found['rest_mm']:.1f} mm): {reason}. Check the depth scale against a tag board and "
        "one model against a ruler."
    )
    instances = tuple(b.start.instance for b, u in zip(bodies, use, strict=True) if u)
    return [SceneFinding(kind="common sinking", words=words, instances=instances, numbers=found)]


def swap_findings(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    gains: Sequence[tuple[float, float]],
    cloud: Cloud,
    comparer: Comparer,
) -> list[SceneFinding]:
    """Return the pairs of objects that explain each other's place better than their own.

    Args:
        bodies: the objects.
        poses: where they were found.
        gains: of each there, over the bare table: in all and per pixel.
        cloud: the scene's measured points, the table's left out.
        comparer: frames, noise and table.
    """
    pairs: list[tuple[float, int, int, float, float]] = []
    for i, a in enumerate(bodies):
        for j in range(i + 1, len(bodies)):
            b = bodies[j]
            suspected = (
                a.start.obj_id != b.start.obj_id and min(gains[i][1], gains[j][1]) <= OWN_GAIN
            )
            if not (suspected and _similar(a, b)):
                continue
            there = _gain_at(a, b.center(poses[j]), cloud, comparer)
            here = _gain_at(b, a.center(poses[i]), cloud, comparer)
            # Both places must be explained better, by all pixels together: per pixel a small model
            # within a large object is as good. One wrong object makes no swap.
            more = min(there - gains[j][0], here - gains[i][0])
            if more >= BETTER_GAIN * max(there, here, 1.0):
                pairs.append((more, i, j, here, there))
    findings: list[SceneFinding] = []
    taken: set[int] = set()
    for _, i, j, here, there in sorted(pairs, reverse=True):
        if {i, j} & taken:
            continue
        taken |= {i, j}
        a, b = bodies[i], bodies[j]
        words = (
            f"{_name_of(a)} and {_name_of(b)} seem to be swapped: at each other's place they "
            f"explain {there:.0f} and {here:.0f} pixels better than the bare table does, at their "
            f"own {gains[i][0]:.0f} and {gains[j][0]:.0f}. Swap the two ids."
        )
        findings.append(
            SceneFinding(
                kind="swapped ids",
                words=words,
                instances=(a.start.instance, b.start.instance),
                numbers={"own": [gains[i][0], gains[j][0]], "swapped": [there, here]},
            )
        )
    return findings


def _name_of(body: Body) -> str:
    """Return how a finding calls an object."""
    return f"{body.model.name} (id {body.start.obj_id}, instance {body.start.instance})"


def _similar(a: Body, b: Body) -> bool:
    """Return whether two boxes have about the same sides."""
    sides = np.sort(a.model.mesh.extent) / np.sort(b.model.mesh.extent)
    return bool(np.all((sides < SIMILAR_SIDES) & (sides > 1 / SIMILAR_SIDES)))


def _gain_at(body: Body, center_world: Array, cloud: Cloud, comparer: Comparer) -> float:
    """Return the best gain of a body at a place, in pixels, over its turns, each fitted."""
    away = np.linalg.norm(cloud.points - center_world, axis=1)
    near = cloud.select(away < body.radius_m + MARGIN_M)
    every = max(1, len(near.points) // FIT_POINTS)
    few = near.select(np.arange(len(near.points)) % every == 0)
    found: list[tuple[float, Array]] = []
    for R in _turns(QUARTER_TURNS):
        T = se3.from_rt(R, center_world - R @ body.center_obj)
        fit = solve_pose(body, few, T, COARSE)
        # The mean residual alone would reward models that lie on few points.
        found.append((fit.points / max(fit.offered, 1) / max(fit.variance, 1.0), fit.T_world_obj))
    found.sort(key=lambda f: -f[0])
    best = found[:FINALISTS]
    return max(comparer.gain(body, T, comparer.stride_of(body, T))[0] for _, T in best)


def _turns(yaws: int) -> list[Array]:
    """Return rotations (3, 3): each of the six sides up, turned about the vertical."""
    quarter = np.pi / 2
    sides = [[0, 0, 0], [quarter, 0, 0], [-quarter, 0, 0], [2 * quarter, 0, 0], [0, quarter, 0],
             [0, -quarter, 0]]  # fmt: skip
    around = [se3.exp_so3([0.0, 0.0, 2 * np.pi * k / yaws]) for k in range(yaws)]
    return [Z @ se3.exp_so3(s) for Z in around for s in sides]


FAILED_GAIN = 0.9
"""An object that gains less than this per pixel was not surely found at its place: right ones
gain 1.1 to 1.25 over the bare table."""
FAILED_AGREE = 0.94
"""An object with a smaller share of agreeing pixels was not surely found either; right ones
reach 0.95."""
FOUND_GAIN = 1.0
"""One that explains this much elsewhere is there."""


def with_swaps(
    result: SearchResult,
    asked: Sequence[Wanted],
    models: dict[int, ObjectModel],
    search: Callable[[Sequence[Wanted]], SearchResult],
) -> tuple[SearchResult, list[SceneFinding]]:
    """Return the search's result with objects that stand in each other's places, and who they are.

    Args:
        result: of the search at the claimed places.
        asked: what was sought.
        models: by id.
        search: seeks objects.
    """
    good = {
        p.instance
        for p in result.placed
        if p.gain_per_pixel >= FAILED_GAIN and p.agree >= FAILED_AGREE
    }
    failed = [w for w in asked if w.T_start is not None and w.instance not in good]
    if len(failed) < 2:
        return result, []
    lost = {w.instance for w in failed}
    freed = [replace(w, region=None, T_start=None) if w.instance in lost else w for w in asked]
    second = {p.instance: p for p in search(freed).placed}
    moved: dict[int, Placed] = {}
    findings: list[SceneFinding] = []
    for w in failed:
        there = second.get(w.instance)
        if there is None or there.gain_per_pixel < FOUND_GAIN:
            continue
        other = _claimed_there(there, w, failed, models)
        if other is not None:
            moved[w.instance] = there
            findings.append(_finding(w, other, models))
    if not moved:
        return result, []
    placed = [p for p in result.placed if p.instance not in moved]
    return replace(
        result, placed=(*placed, *moved.values()),
        not_placed=tuple(n for n in result.not_placed if n.instance not in moved),
    ), findings  # fmt: skip


def _claimed_there(
    placed: Placed, w: Wanted, failed: Sequence[Wanted], models: dict[int, ObjectModel]
) -> Wanted | None:
    """Return the other failed object that was claimed where this one was found."""
    center = _center(placed.T_world_obj, models[placed.obj_id])
    for other in failed:
        if other.obj_id == w.obj_id or other.T_start is None or other.region is None:
            continue
        gap = np.linalg.norm(center - _center(other.T_start, models[other.obj_id]))
        if gap < other.region.radius_m:
            return other
    return None


def _center(T: Array, model: ObjectModel) -> Array:
    """Return the centre of the model's box (3,) at a pose."""
    return T[:3, :3] @ model.mesh.bounds.mean(0) + T[:3, 3]


def _finding(w: Wanted, other: Wanted, models: dict[int, ObjectModel]) -> SceneFinding:
    """Return the finding of one object in another's place."""
    mine, theirs = models[w.obj_id].name, models[other.obj_id].name
    return SceneFinding(
        kind="swapped ids",
        words=f"{mine} (id {w.obj_id}, instance {w.instance}) was not found at its given pose but "
        f"where {theirs} (id {other.obj_id}, instance {other.instance}) was said to be: their ids "
        "are swapped. It was registered where it stands; correct the starts.",
        instances=(w.instance,),
        numbers={"other": other.instance},
    )


OBJECT_M = (0.003, 2.0)
"""Least and greatest diagonal of an object's box [m]: a screw, a chair."""
SHARE_OF_DEPTH = (0.003, 3.0)
"""Least and greatest diagonal as a share of the median distance at which it would be seen: 2 px
wide, or wider than the image."""
FAR_DEPTHS = 20.0
"""A start further from all cameras than this many times the depth they measure is no start."""
UNIT_FACTOR = 1000.0
"""The factor that is suspected."""


def unit_errors(
    models: Mapping[int, ObjectModel],
    starts: Sequence[ObjectPose],
    cameras_m: Array,
    depth_m: float,
) -> dict[int, UnitError]:
    """Return per instance whose mesh or start is off by a factor of 1000 an error that says so.

    They are returned, not raised: the other objects of the scene can still be registered.

    Args:
        models: known objects by id.
        starts: the instances at their start poses.
        cameras_m: (F, 3) camera positions in world [m].
        depth_m: median depth that the cameras measure [m].
    """
    errors: dict[int, UnitError] = {}
    for start in starts:
        model = models[start.obj_id]
        words = _mesh_words(model, depth_m)
        if words is None:
            words = _start_words(model, start, np.asarray(cameras_m, np.float64), depth_m)
        if words is not None:
            errors[start.instance] = UnitError(words)
    return errors


def _mesh_words(model: ObjectModel, depth_m: float) -> str | None:
    """Return what is wrong with a mesh's size, or None."""
    size = float(np.linalg.norm(model.mesh.extent))
    low = max(OBJECT_M[0], SHARE_OF_DEPTH[0] * depth_m)
    high = min(OBJECT_M[1], SHARE_OF_DEPTH[1] * depth_m)
    if low <= size <= high:
        return None
    guess = size / UNIT_FACTOR if size > high else size * UNIT_FACTOR
    would = f" {guess:.3g} m would fit: millimetres and metres were mixed up." if (
        low <= guess <= high) else ""  # fmt: skip
    return (
        f"the mesh of object {model.obj_id} '{model.name}' is {size:.4g} m from corner to corner; "
        f"{low:.3g} to {high:.3g} m is accepted for what is seen at {depth_m:.2f} m.{would} "
        "Give the model in its true unit."
    )


def _start_words(
    model: ObjectModel, start: ObjectPose, cameras: Array, depth_m: float
) -> str | None:
    """Return what is wrong with a start's distance from the cameras, or None."""
    t = start.T_world_obj[:3, 3]
    away = float(np.linalg.norm(cameras - t, axis=1).min())
    if away <= FAR_DEPTHS * depth_m:
        return None
    guess = float(np.linalg.norm(cameras - t / UNIT_FACTOR, axis=1).min())
    would = " Divided by 1000 it would be among what they see: it is in millimetres." if (
        guess <= FAR_DEPTHS * depth_m) else ""  # fmt: skip
    return (
        f"the start of object {model.obj_id} '{model.name}' (instance {start.instance}) is at "
        f"{', '.join(f'{v:.4g}' for v in t)} m, {away:.4g} m from the nearest camera, and the "
        f"cameras measure depths of {depth_m:.2f} m.{would} Give starts in metres, in the frame "
        "of the camera poses."
    )
