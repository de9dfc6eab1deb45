"""A calibration for ROS 1 and 2: commands, launch file, URDF, easy_handeye, camera_info."""

import re
import shlex

from realsim import __version__
from realsim.arrays import Array
from realsim_calibration.exports.frames import (
    FrameNames,
    comments,
    fit_line,
    note_lines,
    published_transform,
    quaternion_xyzw,
    roll_pitch_yaw,
)
from realsim_calibration.lens.camera_files import number, ros_yaml
from realsim_calibration.results import HandEyeReport


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
