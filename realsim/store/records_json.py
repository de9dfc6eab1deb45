"""Names of before for `realsim.untrusted.own_json`; a room that declares its files needs none."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.records import Check, ObjectPose, SupportPlane
from realsim.untrusted.own_json import Real, from_json, to_json
from realsim.untrusted.values import need

__all__ = ["need"]
array_to_json = number_to_json = intrinsics_to_json = check_to_json = to_json
plane_to_json = scene_to_json = object_pose_to_json = to_json


def number_from_json(x: Any) -> float:
    """Return the float of `to_json`."""
    return from_json(x, Real, "a number")


def array_from_json(values: Any, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """Return the array of `to_json`."""
    array = np.array(values, dtype=np.float64)
    return array if shape is None else array.reshape(shape)


def check_from_json(data: Any) -> Check:
    """Return the check of `to_json`."""
    return from_json(data, Check, "a check")


def object_pose_from_json(data: Any) -> ObjectPose:
    """Return the pose of `to_json`."""
    return from_json(data, ObjectPose, "an object's pose")


def plane_from_json(data: Any) -> SupportPlane:
    """Return the plane of `to_json`."""
    return from_json(data, SupportPlane, "the support plane")
