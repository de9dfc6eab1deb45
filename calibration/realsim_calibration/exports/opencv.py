"""A calibration for OpenCV: what cv2.FileStorage reads, under the names of cv2.calibrateHandEye."""

import numpy as np
from numpy.typing import NDArray

from realsim_calibration.exports.frames import FrameNames, comments, fit_line, note_lines, number
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
        + "".join(_opencv_matrix(name, M) for name, M in matrices.items())
        + f"image_width: {i.width}\nimage_height: {i.height}\n"
    )
