"""All files of a calibration at once.

What other programs get is `X_alone` with the camera and the target's place that belong to it, see
`frames`; X with the robot's error map is in `calibration.json` only (`calibration_file`).

A calibration for ROS 1 and 2: commands, launch file, URDF, easy_handeye, camera_info.

Files that a calibration writes anew, and what a person has edited in them: it is kept.
"""

import hashlib
import itertools
import re
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim import __version__
from realsim.arrays import Array
from realsim.formats.export_folder import SUMS_FILE
from realsim.store import atomic
from realsim_calibration.exports.calibration_file import calibration_text
from realsim_calibration.exports.frames import (
    FrameNames,
    comments,
    fit_line,
    note_lines,
    parent_frame,
    published_transform,
    quaternion_xyzw,
    roll_pitch_yaw,
)
from realsim_calibration.lens.camera_files import number, ros_yaml, yaml_matrix
from realsim_calibration.results import HandEyeReport


def replace_files(folder: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write files and the list of their checksums.

    Args:
        folder: where to; made where needed.
        contents: path in it -> bytes.

    Returns:
        Where files are now that were not as the list says: NAME.kept beside the new one.
    """
    sums = folder / SUMS_FILE
    listed = sums.read_text(errors="replace").splitlines() if sums.is_file() else []
    written = {name: digest for digest, _, name in (line.partition("  ") for line in listed)}
    kept: list[Path] = []
    for name, data in contents.items():
        path = folder / name
        there = path.read_bytes() if name in written and path.is_file() else data
        if there != data and _digest(there) != written[name]:
            kept.append(_free_name(path))
            path.rename(kept[-1])
        atomic.write_bytes(path, data)
    lines = (f"{_digest(data)}  {name}\n" for name, data in contents.items())
    atomic.write_text(sums, "".join(lines))
    return kept


def _free_name(path: Path) -> Path:
    """Return NAME.kept, or NAME.kept2 and so on where that is there."""
    names = (path.with_name(f"{path.name}.kept{k if k > 1 else ''}") for k in itertools.count(1))
    return next(name for name in names if not name.exists())


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def ros2_command(report: HandEyeReport, frames: FrameNames) -> str:
    """Return the command that publishes the camera in ROS 2 (named arguments, since Humble)."""
    T, parent, child = published_transform(report, frames)
    values = zip(
        ("x", "y", "z", "qx", "qy", "qz", "qw"), [*T[:3, 3], *quaternion_xyzw(T)], strict=True
    )
    words = [word for key, value in values for word in (f"--{key}", number(value))]
    words += ["--frame-id", parent, "--child-frame-id", child]
    return shlex.join(["ros2", "run", "tf2_ros", "static_transform_publisher", *words])


def ros1_command(report: HandEyeReport, frames: FrameNames) -> str:
    """Return the command that publishes the camera in ROS 1: x y z qx qy qz qw parent child."""
    T, parent, child = published_transform(report, frames)
    words = [number(v) for v in (*T[:3, 3], *quaternion_xyzw(T))]
    return shlex.join(
        ["rosrun", "tf2_ros", "static_transform_publisher", *words, parent, child]
    )  # fmt: skip


def _script(report: HandEyeReport, frames: FrameNames, command: str) -> str:
    """Return a shell script of one command."""
    _, _, child = published_transform(report, frames)
    notes = note_lines(report, frames, child=child)
    if child == frames.camera_optical:
        notes = (
            *notes,
            "If the camera's driver publishes this frame too, export `camera_link` instead: a frame"
            " of tf has one parent only.",
        )
    return f"#!/bin/sh\n{comments(notes)}{command}\n"


def ros1_script(report: HandEyeReport, frames: FrameNames) -> str:
    """Return `ros1_command` as a shell script that says what it holds."""
    return _script(report, frames, ros1_command(report, frames))


def ros2_script(report: HandEyeReport, frames: FrameNames) -> str:
    """Return `ros2_command` as a shell script that says what it holds."""
    return _script(report, frames, ros2_command(report, frames))


def easy_handeye2_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return easy_handeye2's `.calib` file: the YAML of its HandeyeCalibration message.

    It belongs into ~/.ros2/easy_handeye2/calibrations/<name>.calib. The optical frame is its
    tracking base: X is exported as it is, whatever `camera_link` says.
    """
    T = report.X_alone
    kind = "eye_in_hand" if report.mode == "eye_in_hand" else "eye_on_base"
    keys = ("x", "y", "z", "w")
    translation = [f"    {k}: {number(v)}" for k, v in zip(keys[:3], T[:3, 3], strict=True)]
    rotation = [f"    {k}: {number(v)}" for k, v in zip(keys, quaternion_xyzw(T), strict=True)]
    lines = [
        "parameters:",
        f'  name: "{frames.name}"',
        f"  calibration_type: {kind}",
        *_easy_frames(frames),
        "  freehand_robot_movement: true",
        '  move_group_namespace: "/"',
        '  move_group: "manipulator"',
        "transform:",
        "  translation:",
        *translation,
        "  rotation:",
        *rotation,
    ]
    return comments(note_lines(report, frames)) + "\n".join(lines) + "\n"


def _easy_frames(frames: FrameNames) -> list[str]:
    """Return the four frames as easy_handeye names them."""
    return [
        f'  robot_base_frame: "{frames.robot_base}"',
        f'  robot_effector_frame: "{frames.hand}"',
        f'  tracking_base_frame: "{frames.camera_optical}"',
        f'  tracking_marker_frame: "{frames.target}"',
    ]


def easy_handeye_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return the YAML of easy_handeye for ROS 1: ~/.ros/easy_handeye/<name>.yaml."""
    T = report.X_alone
    keys = ("x", "y", "z", "qx", "qy", "qz", "qw")
    values = zip(keys, [*T[:3, 3], *quaternion_xyzw(T)], strict=True)
    lines = [
        "parameters:",
        f"  eye_on_hand: {'true' if report.mode == 'eye_in_hand' else 'false'}",
        "  freehand_robot_movement: true",
        '  move_group: "manipulator"',
        '  move_group_namespace: "/"',
        f'  namespace: "/{frames.name}/"',
        *_easy_frames(frames),
        "transformation:",
        *[f"  {k}: {number(v)}" for k, v in values],
    ]
    return comments(note_lines(report, frames)) + "\n".join(lines) + "\n"


def _xml_comment(lines: tuple[str, ...]) -> str:
    """Return lines as one XML comment, in which two hyphens must not follow one another."""
    safe = [re.sub(r"-(?=-)", "- ", line).rstrip("-") for line in lines]
    return "<!--\n" + "".join(f"  {line}\n" for line in safe) + "-->\n"


def urdf_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return a URDF snippet: the camera's link and a fixed joint, xyz [m], rpy [rad] fixed axes.

    With a `camera_link` the optical frame hangs below it by a joint of its own.
    """
    T, parent, child = published_transform(report, frames)
    parts = [
        "<!-- Copy the links and joints into your robot's description. -->\n",
        _xml_comment(note_lines(report, frames, child=child)),
        f'<robot name="{frames.name}">\n',
        _joint(T, parent, child),
    ]
    if frames.camera_link:
        parts.append(_joint(frames.T_link_optical, child, frames.camera_optical))
    return "".join([*parts, "</robot>\n"])


def _joint(T: Array, parent: str, child: str) -> str:
    """Return a link and the fixed joint that carries it."""
    xyz = " ".join(number(v) for v in T[:3, 3])
    rpy = " ".join(number(v) for v in roll_pitch_yaw(T[:3, :3]))
    return (
        f'  <link name="{child}"/>\n'
        f'  <joint name="{child}_calibrated_joint" type="fixed">\n'
        f'    <parent link="{parent}"/>\n'
        f'    <child link="{child}"/>\n'
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        "  </joint>\n"
    )


def ros2_launch_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return a ROS 2 launch file that publishes the camera, as MoveIt's calibration saves one."""
    _, _, child = published_transform(report, frames)
    arguments = shlex.split(ros2_command(report, frames))[4:]
    pairs = [
        f"                {arguments[k]!r}, {arguments[k + 1]!r},\n"
        for k in range(0, len(arguments), 2)
    ]
    return (
        comments(note_lines(report, frames, child=child))
        + "from launch import LaunchDescription\n"
        + "from launch_ros.actions import Node\n\n\n"
        + "def generate_launch_description():\n"
        + "    return LaunchDescription([\n"
        + "        Node(\n"
        + '            package="tf2_ros",\n'
        + '            executable="static_transform_publisher",\n'
        + "            arguments=[\n"
        + "".join(pairs)
        + "            ],\n        ),\n    ])\n"
    )


def camera_info_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return the camera as ROS's camera_info_manager reads it (raw image, rectification = 1).

    It is intrinsics_alone: the published transform is X_alone, and the two were fitted together.
    """
    notes = (
        f"Camera of a hand-eye calibration by realsim {__version__}. Pixels; integer pixels are "
        "pixel centres.",
        f"The image's frame is {frames.camera_optical}.",
        fit_line(report),
    )
    return comments(notes) + ros_yaml(report.intrinsics_alone, frames.name)


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
        f"easy_handeye2/{frames.name}.calib": easy_handeye2_text,
        f"easy_handeye/{frames.name}.yaml": easy_handeye_text,
        "ros2_static_transform.sh": ros2_script,
        "ros1_static_transform.sh": ros1_script,
        "camera_pose.launch.py": ros2_launch_text,
        "camera.urdf": urdf_text,
        "camera_info.yaml": camera_info_text,
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
