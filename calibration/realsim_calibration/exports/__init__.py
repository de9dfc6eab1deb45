"""A calibration as files: `calibration.json`, and the formats of ROS, OpenCV and numpy."""
