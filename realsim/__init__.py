"""realsim: real-to-sim-and-back calibration and registration for robot-grasping data.

The spine: what a scene is (records), where things are (geometry), and where they are kept (store).
The names below are loaded on first use: `import realsim` and `realsim --help` load not even numpy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from realsim.app.verbs import (
        Result,
        annotate,
        calibrate,
        demo,
        export,
        open,
        plan,
        register,
        render,
        review,
        scan,
        school,
    )
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
    "Result",
    "Scene",
    "SupportPlane",
    "TagBoard",
    "View",
    "annotate",
    "calibrate",
    "demo",
    "export",
    "open",
    "plan",
    "register",
    "render",
    "review",
    "scan",
    "school",
]


def __getattr__(name: str) -> Any:
    """Load a promised name from where it lives."""
    if name not in __all__:
        raise AttributeError(f"module 'realsim' has no attribute '{name}'")
    where = "realsim.errors" if name.endswith("Error") else "realsim.records"
    if name.islower() or name == "Result":
        where = "realsim.app.verbs"
    return getattr(import_module(where), name)


def __dir__() -> list[str]:
    """Return the promised names, loaded or not, for tab completion."""
    return [*__all__, "__version__"]
