"""Which annotations of several images are the same thing, and where it starts from in world."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose

LEAST_APART_M = 0.02
"""Two things of one model stand at least so far apart, however flat they are [m]."""
TOLD_APART_M = 0.01
"""Annotations of one standing thing that differ by more between images are named [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Seen:
    """One thing as one image's annotation has it."""

    obj_id: int
    instance: int
    """The same number in all images is the same thing."""
    T_cam_obj: Array
    """(4, 4) [m]."""


def told_apart(
    poses: Mapping[int, Sequence[tuple[int, int | None, Array]]],
    Ts_world_cam: Mapping[int, Array],
    models: Mapping[int, ObjectModel],
) -> tuple[dict[int, list[Seen]], list[str]]:
    """Return the annotations with instances, counted from 0 in the order of appearance.

    A source that has instances is believed. Else a model of which no image shows two is one thing;
    of others, annotations that lie nearer to a known thing than its smallest extent are that thing:
    two solid things of one model cannot stand there.

    Args:
        poses: image -> (object id, instance or None, T_cam_obj).
        Ts_world_cam: image -> (4, 4) camera in world [m].
        models: object id -> model.

    Returns:
        Annotations by image, and what a person should know.
    """
    most = _most_at_once(poses)
    known: list[tuple[int, int | None, Array]] = []
    out: dict[int, list[Seen]] = {}
    off: dict[int, float] = {}
    for index, rows in poses.items():
        out[index] = []
        taken: set[int] = set()
        for obj_id, given, T_cam_obj in rows:
            T = Ts_world_cam[index] @ T_cam_obj
            free = [
                k for k, (o, g, _) in enumerate(known) if o == obj_id and g == given
                and k not in taken
            ]  # fmt: skip
            apart = [float(np.linalg.norm(known[k][2][:3, 3] - T[:3, 3])) for k in free]
            reach = max(LEAST_APART_M, float(models[obj_id].mesh.extent.min()))
            sure = given is not None or most[obj_id] == 1
            if free and (sure or min(apart) < reach):
                instance = free[int(np.argmin(apart))]
                off[instance] = max(off.get(instance, 0.0), min(apart))
            else:
                instance = len(known)
                known.append((obj_id, given, T))
            taken.add(instance)
            out[index].append(Seen(obj_id=obj_id, instance=instance, T_cam_obj=T_cam_obj))
    notes = [
        f"the annotations of object {known[k][0]} (instance {k}) lie up to {1e3 * d:.0f} mm apart "
        "between images, by the cameras' poses; the first image's was started from."
        for k, d in sorted(off.items()) if d > TOLD_APART_M
    ]  # fmt: skip
    return out, notes


def _most_at_once(poses: Mapping[int, Sequence[tuple[int, int | None, Array]]]) -> dict[int, int]:
    """Return how many of a model an image shows at most."""
    most: dict[int, int] = {}
    for rows in poses.values():
        ids = [obj_id for obj_id, _, _ in rows]
        for obj_id in ids:
            most[obj_id] = max(most.get(obj_id, 0), ids.count(obj_id))
    return most


def world_starts(
    seen: Mapping[int, Sequence[Seen]], Ts_world_cam: Mapping[int, Array]
) -> list[ObjectPose]:
    """Return one start per thing, from the first image that shows it, by instance."""
    starts: dict[int, ObjectPose] = {}
    for index, rows in seen.items():
        for s in rows:
            if s.instance not in starts:
                T = Ts_world_cam[index] @ s.T_cam_obj
                starts[s.instance] = ObjectPose(obj_id=s.obj_id, instance=s.instance, T_world_obj=T)
    return [starts[k] for k in sorted(starts)]


def moved_from_start(
    pose: ObjectPose, starts: Sequence[ObjectPose], models: Mapping[int, ObjectModel]
) -> tuple[float, float]:
    """Return how far an object moved from its start: [mm] and [deg], nearest symmetry."""
    start = next(s for s in starts if s.instance == pose.instance)
    model = models[pose.obj_id]
    ends = pose.T_world_obj @ model.symmetries
    angles = se3.angle(se3.invert(start.T_world_obj) @ ends)
    k = int(np.argmin(angles))
    # At the middle of the box: a mesh's origin may lie beside it and swing with every turn.
    middle = model.mesh.bounds.mean(0)[None]
    step = se3.transform(ends[k], middle) - se3.transform(start.T_world_obj, middle)
    return 1e3 * float(np.linalg.norm(step)), float(np.degrees(angles[k]))
