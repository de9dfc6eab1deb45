"""A calibration in the formats of other programs: ROS 1 and 2, easy_handeye, URDF, OpenCV, numpy.

What other programs get is `X_alone`, see `export_frames`; X with the robot's error map is in
`calibration.json` only (`calibration_file`).
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.store import atomic
from realsim_calibration import ros_exports
from realsim_calibration.calibration_file import write_calibration
from realsim_calibration.export_frames import (
    FrameNames,
    comments,
    note_lines,
    number,
    parent_frame,
)
from realsim_calibration.results import HandEyeReport

Array = NDArray[np.float64]


def _opencv_matrix(name: str, M: Array) -> str:
    """Return a matrix of doubles as OpenCV's FileStorage writes it."""
    values = ", ".join(number(v) for v in np.asarray(M, dtype=np.float64).ravel())
    rows, columns = M.shape
    return (
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n"
        f"   data: [ {values} ]\n"
    )


def opencv_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return a YAML file for cv2.FileStorage with the names of cv2.calibrateHandEye.

    R_cam2gripper, t_cam2gripper [m] (eye in hand) or R_cam2base, t_cam2base; R_target2base,
    t_target2base or R_target2gripper, t_target2gripper; camera_matrix [px], dist_coeffs (1, 8).
    """
    X, Z, i = report.X_alone, report.Z, report.intrinsics
    at, target = ("gripper", "base") if report.mode == "eye_in_hand" else ("base", "gripper")
    matrices = {
        f"R_cam2{at}": X[:3, :3],
        f"t_cam2{at}": X[:3, 3:],
        f"R_target2{target}": Z[:3, :3],
        f"t_target2{target}": Z[:3, 3:],
        "camera_matrix": i.K,
        "dist_coeffs": i.distortion[None],
    }
    return (
        "%YAML:1.0\n---\n"
        + comments(note_lines(report, frames))
        + "# dist_coeffs: k1 k2 p1 p2 k3 k4 k5 k6. Integer pixels are pixel centres.\n"
        + "".join(_opencv_matrix(name, M) for name, M in matrices.items())
        + f"image_width: {i.width}\nimage_height: {i.height}\n"
    )


def npz_arrays(report: HandEyeReport, frames: FrameNames) -> dict[str, Array | NDArray[np.str_]]:
    """Return the arrays of `calibration.npz`: transforms [m], covariances rotation first [rad, m].

    `T_parent_cam` is X_alone; `parent`, `cam` and `target_parent` are the names of the frames.
    """
    target_parent = frames.robot_base if report.mode == "eye_in_hand" else frames.hand
    return {
        "T_parent_cam": np.asarray(report.X_alone),
        "T_parent_cam_covariance": np.asarray(report.X_alone_covariance),
        "T_target_parent_board": np.asarray(report.Z),
        "K": report.intrinsics.K,
        "distortion": np.asarray(report.intrinsics.distortion),
        "intrinsics_covariance": np.asarray(report.intrinsics_covariance),
        "image_size": np.array([report.intrinsics.width, report.intrinsics.height], dtype=float),
        "mode": np.array(report.mode),
        "parent": np.array(parent_frame(report, frames)),
        "cam": np.array(frames.camera_optical),
        "target_parent": np.array(target_parent),
        "notes": np.array(note_lines(report, frames)),
    }


def write_exports(report: HandEyeReport, folder: Path | str, *, frames: FrameNames) -> list[Path]:
    """Write the calibration in every format and return the files; each is whole or not there.

    Args:
        report: the calibration.
        folder: where to write; made where needed, files of the same names are replaced.
        frames: how the frames are called in the programs that will read it.
    """
    folder = Path(folder)
    texts: dict[str, Callable[[HandEyeReport, FrameNames], str]] = {
        f"easy_handeye2/{frames.name}.calib": ros_exports.easy_handeye2_text,
        f"easy_handeye/{frames.name}.yaml": ros_exports.easy_handeye_text,
        "ros2_static_transform.sh": ros_exports.ros2_script,
        "ros1_static_transform.sh": ros_exports.ros1_script,
        "camera_pose.launch.py": ros_exports.ros2_launch_text,
        "camera.urdf": ros_exports.urdf_text,
        "camera_info.yaml": ros_exports.camera_info_text,
        "opencv.yml": opencv_text,
    }
    written = [write_calibration(report, folder / "calibration.json", frames=frames)]
    for name, text in texts.items():
        atomic.write_text(folder / name, text(report, frames))
        written.append(folder / name)
    atomic.write_npz(folder / "calibration.npz", **npz_arrays(report, frames))
    return [*written, folder / "calibration.npz"]
