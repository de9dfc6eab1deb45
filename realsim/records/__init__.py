"""The records in which the stages meet: what a camera, a session, a scene and a grasp are.

Records are frozen; their arrays are private read-only copies; shapes and ranges are checked once,
here, at construction. All units are SI (m, rad, s, kg, N) unless the name says otherwise.
"""

from realsim.records.capture import (
    DISTORTION_TERMS,
    CameraIntrinsics,
    CaptureSession,
    HandEye,
    TagBoard,
    View,
)
from realsim.records.grasps import STAGES, GraspSet
from realsim.records.objects import (
    Mesh,
    ObjectModel,
    ObjectPose,
    Scene,
    SupportPlane,
    Verdict,
    names_of,
)

__all__ = [
    "DISTORTION_TERMS",
    "STAGES",
    "CameraIntrinsics",
    "CaptureSession",
    "GraspSet",
    "HandEye",
    "Mesh",
    "ObjectModel",
    "ObjectPose",
    "Scene",
    "SupportPlane",
    "TagBoard",
    "Verdict",
    "View",
    "names_of",
]
