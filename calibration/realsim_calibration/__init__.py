"""Camera and hand-eye calibration from AprilTag views."""

from realsim_calibration.board_pose import BoardPose, estimate_board_pose
from realsim_calibration.closed_forms import (
    CLOSED_FORMS,
    MotionConfig,
    check_observable,
    daniilidis,
    park,
    shah,
)
from realsim_calibration.detection import DetectionConfig, TagDetections, detect_tags
from realsim_calibration.edges import EdgeConfig
from realsim_calibration.gates import GateConfig
from realsim_calibration.views import BoardView
from realsim_calibration.joint_solve import JointConfig

__all__ = [
    "CLOSED_FORMS",
    "BoardPose",
    "BoardView",
    "DetectionConfig",
    "EdgeConfig",
    "GateConfig",
    "JointConfig",
    "MotionConfig",
    "TagDetections",
    "check_observable",
    "daniilidis",
    "detect_tags",
    "estimate_board_pose",
    "park",
    "shah",
]
