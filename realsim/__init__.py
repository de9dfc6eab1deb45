"""realsim: real-to-sim-and-back calibration and registration for robot-grasping data.

The spine: what a scene is (records), where things are (geometry), and where they are kept (store).
Importing it loads numpy and nothing heavier.
"""

from realsim.errors import InputError, RealsimError
from realsim.records import (
    CameraIntrinsics,
    CaptureSession,
    GraspSet,
    HandEye,
    Mesh,
    ObjectModel,
    ObjectPose,
    Scene,
    SupportPlane,
    TagBoard,
    View,
)

__version__ = "0.1.0"
__all__ = [
    "CameraIntrinsics",
    "CaptureSession",
    "GraspSet",
    "HandEye",
    "InputError",
    "Mesh",
    "ObjectModel",
    "ObjectPose",
    "RealsimError",
    "Scene",
    "SupportPlane",
    "TagBoard",
    "View",
]
