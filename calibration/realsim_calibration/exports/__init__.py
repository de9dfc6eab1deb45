"""A calibration as files: `calibration.json`, and the formats of ROS, OpenCV and numpy."""

from realsim_calibration.exports.calibration_file import (
    calibration_text,
    read_calibration,
    write_calibration,
)
from realsim_calibration.exports.frames import FrameNames, note_lines, published_transform
from realsim_calibration.exports.ros import (
    camera_info_text,
    easy_handeye2_text,
    easy_handeye_text,
    ros1_command,
    ros1_script,
    ros2_command,
    ros2_launch_text,
    ros2_script,
    urdf_text,
)
from realsim_calibration.exports.write import npz_arrays, opencv_text, write_exports

__all__ = [
    "FrameNames",
    "calibration_text",
    "camera_info_text",
    "easy_handeye2_text",
    "easy_handeye_text",
    "note_lines",
    "npz_arrays",
    "opencv_text",
    "published_transform",
    "read_calibration",
    "ros1_command",
    "ros1_script",
    "ros2_command",
    "ros2_launch_text",
    "ros2_script",
    "urdf_text",
    "write_calibration",
    "write_exports",
]
