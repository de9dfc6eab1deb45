"""Lengths that are off by a factor of 1000: millimetres taken for metres, or metres for them."""

from collections.abc import Mapping, Sequence

import numpy as np

from realsim.arrays import Array
from realsim.errors import UnitError
from realsim.records import ObjectModel, ObjectPose

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
