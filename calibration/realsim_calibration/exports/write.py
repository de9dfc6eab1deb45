"""All files of a calibration at once.

What other programs get is `X_alone` with the camera and the target's place that belong to it, see
`frames`; X with the robot's error map is in `calibration.json` only (`calibration_file`).
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.store import atomic
from realsim_calibration.exports import ros
from realsim_calibration.exports.calibration_file import calibration_text
from realsim_calibration.exports.frames import (
    FrameNames,
    comments,
    fit_line,
    note_lines,
    parent_frame,
)
from realsim_calibration.exports.replaced import replace_files
from realsim_calibration.lens.camera_files import yaml_matrix
from realsim_calibration.results import HandEyeReport


def opencv_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return a YAML file for cv2.FileStorage with the names of cv2.calibrateHandEye.

    R_cam2gripper, t_cam2gripper [m] (eye in hand) or R_cam2base, t_cam2base; R_target2base,
    t_target2base or R_target2gripper, t_target2gripper; camera_matrix [px], dist_coeffs (1, 8).
    All of them are those of the fit without an error map: X_alone, Z_alone, intrinsics_alone.
    """
    X, Z, i = report.X_alone, report.Z_alone, report.intrinsics_alone
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
        + comments((*note_lines(report, frames), fit_line(report)))
        + "# dist_coeffs: k1 k2 p1 p2 k3 k4 k5 k6. Integer pixels are pixel centres.\n"
        + "".join(yaml_matrix(name, M, opencv=True) for name, M in matrices.items())
        + f"image_width: {i.width}\nimage_height: {i.height}\n"
    )


# --- OpenCV --------------------------------------------------------------------------------------
#
# A calibration for OpenCV: what cv2.FileStorage reads, under the names of cv2.calibrateHandEye.


def npz_arrays(report: HandEyeReport, frames: FrameNames) -> dict[str, Array | NDArray[np.str_]]:
    """Return the arrays of `calibration.npz`: transforms [m], covariances rotation first [rad, m].

    `T_parent_cam` is X_alone; `T_parent_cam_covariance` is absolute (another arm, a new mount, a
    drawing), `T_parent_cam_here_covariance` for this arm as it moves here. `T_target_parent_board`
    is Z_alone, `K` and `distortion` those of intrinsics_alone: one fit, without an error map.
    `parent`, `cam` and `target_parent` are the names of the frames.
    """
    camera = report.intrinsics_alone
    target_parent = frames.robot_base if report.mode == "eye_in_hand" else frames.hand
    known = report.X_alone_here_covariance
    here = {} if known is None else {"T_parent_cam_here_covariance": np.asarray(known)}
    return {
        "T_parent_cam": np.asarray(report.X_alone),
        "T_parent_cam_covariance": np.asarray(report.X_alone_covariance),
        **here,
        "T_target_parent_board": np.asarray(report.Z_alone),
        "K": camera.K,
        "distortion": np.asarray(camera.distortion),
        "image_size": np.array([camera.width, camera.height], dtype=float),
        "mode": np.array(report.mode),
        "parent": np.array(parent_frame(report, frames)),
        "cam": np.array(frames.camera_optical),
        "target_parent": np.array(target_parent),
        "notes": np.array((*note_lines(report, frames), fit_line(report))),
    }


def write_exports(
    report: HandEyeReport, folder: Path | str, *, frames: FrameNames,
    tell: Callable[[str], None] | None = None,
) -> list[Path]:  # fmt: skip
    """Write the calibration in every format and return the files; each is whole or not there.

    Where the lens is not known (`nominal_lens`) no file that states one is written.

    Args:
        report: the calibration.
        folder: where to write; made where needed. Files of the same names are replaced; edited
            ones are kept beside the new ones.
        frames: how the frames are called in the programs that will read it.
        tell: told of files that were kept.
    """
    folder = Path(folder)
    texts: dict[str, Callable[[HandEyeReport, FrameNames], str]] = {
        "calibration.json": calibration_text,
        f"easy_handeye2/{frames.name}.calib": ros.easy_handeye2_text,
        f"easy_handeye/{frames.name}.yaml": ros.easy_handeye_text,
        "ros2_static_transform.sh": ros.ros2_script,
        "ros1_static_transform.sh": ros.ros1_script,
        "camera_pose.launch.py": ros.ros2_launch_text,
        "camera.urdf": ros.urdf_text,
        "camera_info.yaml": ros.camera_info_text,
        "opencv.yml": opencv_text,
    }
    if report.nominal_lens:
        for name in ("camera_info.yaml", "opencv.yml"):
            del texts[name]
    contents = {name: text(report, frames).encode() for name, text in texts.items()}
    if not report.nominal_lens:
        contents["calibration.npz"] = atomic.npz_bytes(**npz_arrays(report, frames))
    for kept in replace_files(folder, contents):
        if tell is not None:
            tell(f"'{kept}' is a file of an earlier run that was edited; the new one is beside it.")
    return [folder / name for name in contents]
