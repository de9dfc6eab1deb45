"""BOP's numbers and ours: millimetres and row-major lists there, metres and T_a_b here.

The only place, together with `models`, where BOP's units change.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.untrusted.values import number, numbers

MM_PER_M = 1000.0
NEAREST_MM = 10.0
"""An object whose origin is nearer than this to the camera is not seen by any depth camera: the
file holds metres."""
AT_THE_LENS = "origin_at_lens"
"""Key, ours, of an entry of scene_gt.json whose object's origin really is that near: a synthetic
camera can stand inside an object."""
FARTHEST_MM = 20_000.0
"""An object farther than 20 m is on no table: the file holds micrometres or was converted twice."""


def flat(value: Any) -> Any:
    """Return a matrix written as a list of rows as one list; all else as it is.

    BOP's own annotation tool writes rotations nested, its data sets write them flat.
    """
    rows: list[Any] = value if isinstance(value, list) else []
    if rows and all(isinstance(row, list) for row in rows):
        return [number for row in rows for number in row]
    return value


def rigid_from_lists(rotation: Any, translation_mm: Any, name: str) -> Array:
    """Return T (4, 4) [m] of a row-major rotation (9 numbers or nested) and a translation [mm].

    Raises:
        NotRigidError: the rotation is not one.
        InputError: the lists do not have 9 and 3 numbers.
    """
    try:
        R = numbers(flat(rotation), 9, "the rotation").reshape(3, 3)
        t = numbers(flat(translation_mm), 3, "the translation")
    except InputError as error:
        raise InputError(
            f"{name}: a rotation of 9 numbers (row by row) and a translation of 3 [mm] are "
            f"expected, found {rotation!r:.300} and {translation_mm!r:.100} ({error})"
        ) from error
    with np.errstate(over="ignore", invalid="ignore"):  # absurd numbers are refused, not warned of
        return se3.check_rigid(se3.from_rt(R, t / MM_PER_M), name)


def lists_from_rigid(T: ArrayLike) -> tuple[list[float], list[float]]:
    """Return the row-major rotation (9) and the translation (3) [mm] of T (4, 4) [m]."""
    T = np.asarray(T, dtype=np.float64)
    rotation: list[float] = T[:3, :3].ravel().tolist()
    translation_mm: list[float] = (T[:3, 3] * MM_PER_M).tolist()
    return rotation, translation_mm


def object_in_camera(
    rotation: Any, translation_mm: Any, name: str, *, may_touch: bool = False
) -> Array:
    """Return T_cam_obj (4, 4) [m] of BOP's cam_R_m2c and cam_t_m2c.

    Args:
        rotation: 9 numbers, row by row.
        translation_mm: 3 numbers [mm].
        name: for messages.
        may_touch: whether the object may be at the lens: the numbers are known to be millimetres
            and a synthetic camera may stand inside an object.

    Raises:
        UnitError: the object would be on the lens or beyond any table.
    """
    T_cam_obj = rigid_from_lists(rotation, translation_mm, name)
    distance_mm = float(np.linalg.norm(T_cam_obj[:3, 3])) * MM_PER_M
    if distance_mm < NEAREST_MM and not may_touch:
        raise UnitError(
            f"{name}: cam_t_m2c is {distance_mm:.4g} long; as millimetres the object would touch "
            f"the lens. This looks like metres in a millimetre file ({distance_mm:.4g} m). "
            "Multiply cam_t_m2c by 1000."
        )
    if distance_mm > FARTHEST_MM:
        raise UnitError(
            f"{name}: cam_t_m2c is {distance_mm:.4g} long; as millimetres the object would be "
            f"{distance_mm / MM_PER_M:.4g} m away, at most {FARTHEST_MM / MM_PER_M:g} m is "
            "accepted. Were millimetres multiplied by 1000 again? Divide cam_t_m2c by 1000."
        )
    return T_cam_obj


def camera_entry(
    intrinsics: CameraIntrinsics, depth_unit_m: float, T_world_cam: ArrayLike | None
) -> dict[str, Any]:
    """Return one image's entry of scene_camera.json.

    cam_distortion (OpenCV's k1 k2 p1 p2 k3 k4 k5 k6) is ours: BOP has no distortion, and leaving
    it out would make a distorted image look like an ideal one.
    """
    entry: dict[str, Any] = {
        "cam_K": intrinsics.K.ravel().tolist(),
        # Rounded at 1e-9 mm so that 0.0001 m reads 0.1 mm and not 0.09999999999999999.
        "depth_scale": round(depth_unit_m * MM_PER_M, 9),
    }
    if intrinsics.is_distorted:
        entry["cam_distortion"] = intrinsics.distortion.tolist()
    if T_world_cam is not None:
        rotation, translation = lists_from_rigid(se3.invert(T_world_cam))
        entry["cam_R_w2c"], entry["cam_t_w2c"] = rotation, translation
    return entry


def intrinsics_of(entry: dict[str, Any], width: int, height: int, name: str) -> CameraIntrinsics:
    """Return the camera of an entry of scene_camera.json.

    Raises:
        InputError: cam_K is missing or not a camera matrix.
    """
    if "cam_K" not in entry:
        raise InputError(
            f"{name} has no cam_K; it has: {', '.join(entry) or 'nothing'}. The 9 numbers of the "
            "camera matrix, row by row, are needed."
        )
    K = numbers(flat(entry["cam_K"]), 9, f"cam_K of {name}")
    distortion = entry.get("cam_distortion")
    if distortion is not None:
        distortion = numbers(distortion, None, f"cam_distortion of {name}")
    return CameraIntrinsics.from_K(K.reshape(3, 3), width, height, distortion)


def depth_unit_of(entry: dict[str, Any], name: str) -> float:
    """Return metres per count of the depth images of an entry of scene_camera.json.

    Raises:
        InputError: depth_scale is missing: guessing it would scale the world.
    """
    if "depth_scale" not in entry:
        raise InputError(
            f"{name} has no depth_scale, so the unit of its depth images is not known; it has: "
            f"{', '.join(entry) or 'nothing'}. Add depth_scale (1.0 if a count is 1 mm, 0.1 if it "
            "is 0.1 mm)."
        )
    scale = number(entry["depth_scale"], f"depth_scale of {name}")
    if scale <= 0:
        raise InputError(f"depth_scale of {name} is {scale:g}; a positive number is expected.")
    return scale / MM_PER_M


def T_world_cam_of(entry: dict[str, Any], name: str) -> Array | None:
    """Return T_world_cam (4, 4) [m] of an entry of scene_camera.json, None where it has none."""
    if ("cam_R_w2c" in entry) != ("cam_t_w2c" in entry):
        raise InputError(f"{name} has only one of cam_R_w2c and cam_t_w2c; both or none belong.")
    if "cam_R_w2c" not in entry:
        return None
    T_cam_world = rigid_from_lists(
        entry["cam_R_w2c"], entry["cam_t_w2c"], f"cam_R_w2c, cam_t_w2c of {name}"
    )
    return se3.invert(T_cam_world)
