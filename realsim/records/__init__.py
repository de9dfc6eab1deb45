"""The records in which the stages meet: what a camera, a session, a scene and a grasp are.

Records are frozen; their arrays are private read-only copies; shapes and ranges are checked once,
here, at construction. All units are SI (m, rad, s, kg, N) unless the name says otherwise.
"""

from realsim.records.calibration import ArmErrorMap, Check, HandEye, RobotErrorMap
from realsim.records.capture import DISTORTION_TERMS, CameraIntrinsics, CaptureSession, View
from realsim.records.grasps import MEASURES, PHASES, STAGES, GraspSet, GraspTrajectories, Measure
from realsim.records.objects import (
    Mesh,
    ObjectModel,
    ObjectPose,
    Scene,
    SupportPlane,
    Verdict,
    names_of,
)
from realsim.records.targets import (
    TAG_CELLS,
    CharucoBoard,
    Chessboard,
    CircleGrid,
    TagBoard,
    Target,
)

__all__ = [
    "DISTORTION_TERMS",
    "MEASURES",
    "PHASES",
    "STAGES",
    "TAG_CELLS",
    "ArmErrorMap",
    "CameraIntrinsics",
    "CaptureSession",
    "CharucoBoard",
    "Check",
    "Chessboard",
    "CircleGrid",
    "GraspSet",
    "GraspTrajectories",
    "HandEye",
    "Measure",
    "Mesh",
    "ObjectModel",
    "ObjectPose",
    "RobotErrorMap",
    "Scene",
    "SupportPlane",
    "TagBoard",
    "Target",
    "Verdict",
    "View",
    "names_of",
]
