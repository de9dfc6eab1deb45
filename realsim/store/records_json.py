"""Records as plain JSON values and back, bit for bit.

Python writes a float as the shortest text that reads as the same float, so JSON loses nothing. NaN
is null inside arrays and numbers, infinity is "inf" or "-inf": JSON has neither.
"""

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry.dh import DhArm
from realsim.records import (
    ArmErrorMap,
    CameraIntrinsics,
    Check,
    HandEye,
    ObjectPose,
    RobotErrorMap,
    Scene,
    SupportPlane,
    TagBoard,
    View,
)

Array = NDArray[np.float64]
Json = dict[str, Any]
Record = TypeVar("Record")

ARM_NUMBERS = ("a", "d", "alpha", "theta", "delta_a", "delta_d", "delta_alpha", "delta_theta")
"""The fields of a DhArm that hold six numbers."""
CHECK_TEXTS = ("name", "verdict", "sentence", "advice", "unit")
"""The fields of a Check that are text."""
SAME = 1e-9
"""A stored transform that is rigid to this is restored bit for bit; one that was edited by hand
keeps the orthonormal rotation that the record's constructor made of it."""


# --- numbers and arrays -----------------------------------------------------------------------


def number_to_json(x: float) -> float | str | None:
    """Return a float as JSON: null for NaN, "inf" and "-inf" for the infinities."""
    if math.isfinite(x):
        return float(x)
    return None if math.isnan(x) else ("inf" if x > 0 else "-inf")


def number_from_json(x: float | str | None) -> float:
    """Return the float of `number_to_json`."""
    return math.nan if x is None else float(x)


def array_to_json(values: ArrayLike) -> Any:
    """Return an array as nested lists of JSON numbers."""
    array = np.asarray(values, dtype=np.float64)
    if np.all(np.isfinite(array)):
        return array.tolist()
    if array.ndim == 0:
        return number_to_json(float(array))
    return [array_to_json(row) for row in array]


def array_from_json(values: Any, shape: tuple[int, ...] | None = None) -> Array:
    """Return the float array of nested lists of JSON numbers."""
    # None becomes NaN by itself, and numpy reads the strings "inf" and "-inf" as numbers.
    array = np.array(values, dtype=object)
    flat = np.array([number_from_json(x) for x in array.ravel().tolist()], dtype=np.float64)
    return flat.reshape(array.shape if shape is None else shape)


def exactly(record: Record, **values: Any) -> Record:
    """Return the record with the named arrays restored to the very bits that were stored.

    Constructing a record makes its rotations orthonormal, and doing that twice can change the last
    bit; then reading a file would not give back what was written.
    """
    for name, value in values.items():
        built = getattr(record, name)
        if value is None or built is None:
            continue
        stored = np.array(value, dtype=np.float64)
        if stored.shape == built.shape and np.allclose(stored, built, rtol=0, atol=SAME):
            stored.setflags(write=False)
            object.__setattr__(record, name, stored)
    return record


def need(data: Any, keys: tuple[str, ...], what: str) -> Json:
    """Return data as an object that has the keys.

    Raises:
        InputError: it is not one; the message names what is missing.
    """
    if not isinstance(data, dict):
        raise InputError(f"{what}: an object is expected, found {type(data).__name__}.")
    record: Json = {str(k): v for k, v in data.items()}  # pyright: ignore[reportUnknownVariableType]
    missing = [key for key in keys if key not in record]
    if missing:
        raise InputError(
            f"{what} lacks {', '.join(missing)}; it has: {', '.join(record) or 'nothing'}."
        )
    return record


def _optional(values: Any) -> Any:
    return None if values is None else array_to_json(values)


# --- camera, view, board ----------------------------------------------------------------------


def intrinsics_to_json(camera: CameraIntrinsics) -> Json:
    """Return a camera as JSON values [px]."""
    numbers = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    size = {"width": int(camera.width), "height": int(camera.height)}
    return {**size, **numbers, "distortion": camera.distortion.tolist()}


def intrinsics_from_json(data: Any) -> CameraIntrinsics:
    """Return the camera of `intrinsics_to_json`."""
    d = need(data, ("width", "height", "fx", "fy", "cx", "cy", "distortion"), "the camera")
    return CameraIntrinsics(
        width=int(d["width"]),
        height=int(d["height"]),
        fx=float(d["fx"]),
        fy=float(d["fy"]),
        cx=float(d["cx"]),
        cy=float(d["cy"]),
        distortion=np.asarray(d["distortion"], dtype=np.float64),
    )


def view_to_json(view: View) -> Json:
    """Return a view as JSON values [m, rad, s]."""
    return {
        "index": int(view.index),
        "time_s": float(view.time_s),
        "T_base_ee": _optional(view.T_base_ee),
        "joints": _optional(view.joints),
        "T_world_cam": _optional(view.T_world_cam),
    }


def view_from_json(data: Any) -> View:
    """Return the view of `view_to_json`."""
    d = need(data, ("index", "time_s"), "a view")
    poses = {name: d.get(name) for name in ("T_base_ee", "T_world_cam")}
    arrays = {n: None if v is None else np.asarray(v, np.float64) for n, v in poses.items()}
    joints = d.get("joints")
    view = View(
        index=int(d["index"]),
        time_s=float(d["time_s"]),
        joints=None if joints is None else array_from_json(joints),
        **arrays,
    )
    return exactly(view, **poses)


def tag_board_to_json(board: TagBoard) -> Json:
    """Return a tag board as JSON values [m]."""
    counts = {name: int(getattr(board, name)) for name in ("rows", "columns", "first_id")}
    sizes = {name: float(getattr(board, name)) for name in ("tag_size_m", "gap_m")}
    return {
        **counts,
        **sizes,
        "family": board.family,
        "ids_from": board.ids_from,
        "corner_squares": board.corner_squares,
    }


def tag_board_from_json(data: Any) -> TagBoard:
    """Return the tag board of `tag_board_to_json`."""
    d = need(data, ("rows", "columns", "tag_size_m", "gap_m", "family", "first_id"), "the board")
    return TagBoard(
        rows=int(d["rows"]),
        columns=int(d["columns"]),
        tag_size_m=float(d["tag_size_m"]),
        gap_m=float(d["gap_m"]),
        family=d["family"],
        first_id=int(d["first_id"]),
        ids_from=d.get("ids_from", "top"),
        corner_squares=bool(d.get("corner_squares", False)),
    )


# --- calibration ------------------------------------------------------------------------------


def robot_map_to_json(error: RobotErrorMap | ArmErrorMap | None) -> Json | None:
    """Return a robot's error map as JSON values; None where there is none."""
    if error is None:
        return None
    if isinstance(error, RobotErrorMap):
        return {
            "kind": "pose map",
            "frame": error.frame,
            "sd_m": number_to_json(error.sd_m),
            **{name: array_to_json(getattr(error, name)) for name in ("mean", "weights", "reach")},
        }
    arm = {name: array_to_json(getattr(error.arm, name)) for name in ARM_NUMBERS}
    return {
        "kind": "arm",
        "arm": {"name": error.arm.name, **arm},
        "errors": array_to_json(error.errors),
        "T_flange_tool": array_to_json(error.T_flange_tool),
    }


def robot_map_from_json(data: Any) -> RobotErrorMap | ArmErrorMap | None:
    """Return the map of `robot_map_to_json`."""
    if data is None:
        return None
    kind = need(data, ("kind",), "the robot's error map")["kind"]
    if kind == "pose map":
        d = need(data, ("frame", "sd_m", "mean", "weights", "reach"), "the robot's error map")
        return RobotErrorMap(
            frame=d["frame"],
            mean=array_from_json(d["mean"]),
            sd_m=number_from_json(d["sd_m"]),
            weights=array_from_json(d["weights"]),
            reach=array_from_json(d["reach"]),
        )
    if kind != "arm":
        raise InputError(
            f"the robot's error map is of kind '{kind}'; 'pose map' or 'arm' is known."
        )
    d = need(data, ("arm", "errors", "T_flange_tool"), "the robot's error map")
    arm = need(d["arm"], ("name", *ARM_NUMBERS), "the arm of the robot's error map")
    numbers = {name: array_from_json(arm[name]) for name in ARM_NUMBERS}
    return ArmErrorMap(
        arm=DhArm(name=str(arm["name"]), **numbers),
        errors=array_from_json(d["errors"]),
        T_flange_tool=array_from_json(d["T_flange_tool"]),
    )


def check_to_json(check: Check) -> Json:
    """Return a check as JSON values."""
    texts = {name: getattr(check, name) for name in CHECK_TEXTS}
    return {**texts, "value": number_to_json(check.value), "views": [int(v) for v in check.views]}


def check_from_json(data: Any) -> Check:
    """Return the check of `check_to_json`."""
    d = need(data, (*CHECK_TEXTS, "value", "views"), "a check")
    texts = {name: d[name] for name in CHECK_TEXTS}
    return Check(
        **texts, value=number_from_json(d["value"]), views=tuple(int(v) for v in d["views"])
    )


def hand_eye_to_json(result: HandEye) -> Json:
    """Return a hand-eye calibration as JSON values; sigma_deg and sigma_mm are for the reader."""
    return {
        "T_ee_cam": array_to_json(result.T_ee_cam),
        "sigma_deg": number_to_json(result.sigma_deg),
        "sigma_mm": number_to_json(result.sigma_mm),
        "held_out_px": number_to_json(result.held_out_px),
        "method": result.method,
        "covariance": array_to_json(result.covariance),
        "T_base_board": array_to_json(result.T_base_board),
        "intrinsics": intrinsics_to_json(result.intrinsics),
        "intrinsics_sd": array_to_json(result.intrinsics_sd),
        "view_indices": [int(i) for i in result.view_indices],
        "view_rms_px": array_to_json(result.view_rms_px),
        "rejected": [[int(index), reason] for index, reason in result.rejected],
        "starts": [[name, number_to_json(rms)] for name, rms in result.starts],
        "robot_map": robot_map_to_json(result.robot_map),
        "checks": [check_to_json(check) for check in result.checks],
    }


def hand_eye_from_json(data: Any) -> HandEye:
    """Return the calibration of `hand_eye_to_json`."""
    keys = ("T_ee_cam", "covariance", "T_base_board", "intrinsics", "intrinsics_sd")
    more = ("view_indices", "view_rms_px", "held_out_px", "rejected", "starts", "method")
    d = need(data, keys + more, "the hand-eye calibration")
    result = HandEye(
        T_ee_cam=array_from_json(d["T_ee_cam"]),
        covariance=array_from_json(d["covariance"]),
        T_base_board=array_from_json(d["T_base_board"]),
        intrinsics=intrinsics_from_json(d["intrinsics"]),
        intrinsics_sd=array_from_json(d["intrinsics_sd"]),
        view_indices=tuple(int(i) for i in d["view_indices"]),
        view_rms_px=array_from_json(d["view_rms_px"]),
        held_out_px=number_from_json(d["held_out_px"]),
        rejected=tuple((int(i), str(why)) for i, why in d["rejected"]),
        method=str(d["method"]),
        starts=tuple((str(name), number_from_json(rms)) for name, rms in d["starts"]),
        robot_map=robot_map_from_json(d.get("robot_map")),
        checks=tuple(check_from_json(check) for check in d.get("checks", ())),
    )
    return exactly(result, T_ee_cam=d["T_ee_cam"], T_base_board=d["T_base_board"])


# --- scene ------------------------------------------------------------------------------------


def object_pose_to_json(pose: ObjectPose) -> Json:
    """Return the pose of an object as JSON values [m, rad]."""
    return {
        "obj_id": int(pose.obj_id),
        "instance": int(pose.instance),
        "verdict": pose.verdict,
        "reasons": list(pose.reasons),
        "checks": {name: number_to_json(value) for name, value in pose.checks.items()},
        "T_world_obj": array_to_json(pose.T_world_obj),
        "covariance": _optional(pose.covariance),
    }


def object_pose_from_json(data: Any) -> ObjectPose:
    """Return the pose of `object_pose_to_json`."""
    d = need(data, ("obj_id", "instance", "T_world_obj"), "an object's pose")
    covariance = d.get("covariance")
    pose = ObjectPose(
        obj_id=int(d["obj_id"]),
        instance=int(d["instance"]),
        T_world_obj=array_from_json(d["T_world_obj"]),
        covariance=None if covariance is None else array_from_json(covariance),
        checks={str(k): number_from_json(v) for k, v in d.get("checks", {}).items()},
        verdict=d.get("verdict", "unchecked"),
        reasons=tuple(str(r) for r in d.get("reasons", ())),
    )
    return exactly(pose, T_world_obj=d["T_world_obj"])


def plane_to_json(plane: SupportPlane) -> Json:
    """Return a support plane as JSON values [m]."""
    return {
        "T_world_table": array_to_json(plane.T_world_table),
        "rms_m": number_to_json(plane.rms_m),
        "inliers": int(plane.inliers),
    }


def plane_from_json(data: Any) -> SupportPlane:
    """Return the plane of `plane_to_json`."""
    d = need(data, ("T_world_table", "rms_m", "inliers"), "the support plane")
    plane = SupportPlane(
        T_world_table=array_from_json(d["T_world_table"]),
        rms_m=number_from_json(d["rms_m"]),
        inliers=int(d["inliers"]),
    )
    return exactly(plane, T_world_table=d["T_world_table"])


def scene_to_json(scene: Scene) -> Json:
    """Return a scene as JSON values."""
    return {
        "name": scene.name,
        "objects": [object_pose_to_json(o) for o in scene.objects],
        "plane": None if scene.plane is None else plane_to_json(scene.plane),
    }


def scene_from_json(data: Any) -> Scene:
    """Return the scene of `scene_to_json`."""
    d = need(data, ("name", "objects"), "the scene")
    plane = d.get("plane")
    return Scene(
        name=str(d["name"]),
        objects=tuple(object_pose_from_json(o) for o in d["objects"]),
        plane=None if plane is None else plane_from_json(plane),
    )
