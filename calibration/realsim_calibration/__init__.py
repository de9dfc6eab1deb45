"""Camera and hand-eye calibration from AprilTag views."""
