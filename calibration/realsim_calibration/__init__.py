"""Camera and hand-eye calibration: targets, lens, hand-eye, robot errors, depth bias, reports."""

from realsim_calibration.calibrate import (
    Calibration,
    CalibrationConfig,
    calibrate,
    calibrate_from_poses,
)
from realsim_calibration.clock.offset import ClockOffset, estimate_clock_offset
from realsim_calibration.depth.bias import estimate_depth_bias
from realsim_calibration.depth.board import DepthBoardView
from realsim_calibration.detect.find import find_target
from realsim_calibration.faults.diagnose import diagnose, prove_reading
from realsim_calibration.fit.closed_forms import (
    CLOSED_FORMS,
    check_observable,
    daniilidis,
    park,
    shah,
)
from realsim_calibration.fit.joint_solve import JointConfig
from realsim_calibration.fit.view_system import BoardPose, estimate_board_pose
from realsim_calibration.hand_eye import (
    HandEyeConfig,
    calibrate_hand_eye,
    calibrate_hand_eye_report,
)
from realsim_calibration.lens.fit import IntrinsicsConfig
from realsim_calibration.lens.intrinsics import calibrate_intrinsics
from realsim_calibration.pairs.solve import PosePairs, solve_pose_pairs
from realsim_calibration.planning.live_calibration import LiveCalibration
from realsim_calibration.planning.next_view import choose_next_views, rank_next_views
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import BoardView, TargetDetection, detection_of

__all__ = [
    "CLOSED_FORMS",
    "BoardPose",
    "BoardView",
    "Calibration",
    "CalibrationConfig",
    "ClockOffset",
    "DepthBoardView",
    "HandEyeConfig",
    "HandEyeReport",
    "IntrinsicsConfig",
    "JointConfig",
    "LiveCalibration",
    "PosePairs",
    "TargetDetection",
    "calibrate",
    "calibrate_from_poses",
    "calibrate_hand_eye",
    "calibrate_hand_eye_report",
    "calibrate_intrinsics",
    "check_observable",
    "choose_next_views",
    "daniilidis",
    "detection_of",
    "diagnose",
    "estimate_board_pose",
    "estimate_clock_offset",
    "estimate_depth_bias",
    "find_target",
    "park",
    "prove_reading",
    "rank_next_views",
    "shah",
    "solve_pose_pairs",
]
