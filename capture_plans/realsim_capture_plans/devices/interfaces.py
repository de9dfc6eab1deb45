"""What a capture needs of an arm and of a depth camera, whoever made them.

Frames and units: joints in rad in the order of `kinematics.DhChain`; `T_base_ee` (4, 4) is the
bare flange in the controller's `base` [m], whatever tool offset is configured; images follow
`CameraIntrinsics`, integer pixel = pixel centre; depth is float32 metres along z, 0 = none, and
is aligned to the colour image pixel by pixel. Time stamps are seconds of one clock per device.

Every call blocks until it is done: `move` returns when the arm stands at its goal, `grab` returns
a frame exposed after the call began. Whatever stops a device is a DeviceError.
"""

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, UInt8
from realsim.errors import InputError, RealsimError
from realsim.records import CameraIntrinsics
from realsim.records.checked_arrays import rigid
from realsim.robots.limits import JointLimits

Stop = Literal["protective stop", "emergency stop", "connection lost", "not ready", "off goal"]
"""What keeps an arm from moving; a person clears it, then `Arm.recover` goes on."""


class DeviceError(RealsimError):
    """A device cannot go on: connection lost, no camera, no steady frame."""


class ArmStoppedError(DeviceError):
    """The arm stopped, and a person can clear the reason; `stop` says which kind it is."""

    def __init__(self, message: str, stop: Stop) -> None:
        """Keep what a person is to be told and the kind of stop."""
        super().__init__(message)
        self.stop: Stop = stop


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ArmState:
    """Where the arm says it is, at one moment."""

    joints: Array
    """(6,) measured joint angles [rad]."""
    T_base_ee: Array
    """(4, 4) the controller's own (factory-calibrated) flange pose in its base [m]."""
    time_s: float
    """Time stamp of the reading [s]."""
    T_ee_tcp: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) tool offset that the controller has set [m]: its own TCP pose is T_base_ee @ this."""

    def __post_init__(self) -> None:
        """Check shapes and freeze the arrays."""
        joints = np.array(self.joints, dtype=np.float64)
        if joints.ndim != 1 or not len(joints) or not np.all(np.isfinite(joints)):
            raise InputError(
                f"the arm's joints are {joints.tolist()}; one finite angle a joint is needed."
            )
        joints.setflags(write=False)
        object.__setattr__(self, "joints", joints)
        for name in ("T_base_ee", "T_ee_tcp"):
            object.__setattr__(self, name, rigid(getattr(self, name), f"the arm's {name}"))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Frame:
    """One colour image with its depth."""

    rgb: UInt8
    """(H, W, 3) colour."""
    depth_m: Array32
    """(H, W) depth along z [m], 0 = no measurement."""
    time_s: float
    """Time stamp of the exposure [s]."""

    def __post_init__(self) -> None:
        """Check that the images belong together and freeze them."""
        rgb = np.array(self.rgb)
        depth = np.array(self.depth_m)
        if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
            raise InputError(f"rgb is {rgb.dtype} {rgb.shape}; uint8 (H, W, 3) is needed.")
        if depth.dtype != np.float32 or depth.shape != rgb.shape[:2]:
            raise InputError(
                f"depth is {depth.dtype} {depth.shape}; float32 metres of the colour image's size "
                f"{rgb.shape[:2]} are needed."
            )
        for name, value in (("rgb", rgb), ("depth_m", depth)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)


def checked_goal(joints: ArrayLike, limits: JointLimits) -> Array:
    """Return the goal (6,) of a move [rad].

    Raises:
        InputError: it is not one finite angle a joint within the limits.
    """
    goal = np.array(joints, dtype=np.float64)
    if goal.shape != limits.lower.shape or not np.all(np.isfinite(goal)):
        raise InputError(
            f"the goal is {goal.tolist()}; {len(limits.lower)} finite angles are needed."
        )
    bad = np.flatnonzero((goal < limits.lower) | (goal > limits.upper))
    if len(bad):
        degrees = (
            " Are these degrees? Radians are needed: np.radians(goal)."
            if np.abs(goal).max() > 2 * np.pi
            else ""
        )
        raise InputError(
            f"the goal's joints {bad.tolist()} (counted from 0) are at "
            f"{goal[bad].round(4).tolist()} rad, outside the limits "
            f"{limits.lower[bad].round(4).tolist()} to {limits.upper[bad].round(4).tolist()} rad; "
            f"the arm stays.{degrees}"
        )
    return goal


class Arm(Protocol):
    """A six-joint arm that goes where it is told and says where it is."""

    @property
    def name(self) -> str:
        """Model name, a key of `kinematics.CHAINS` where the chain is known."""
        ...

    @property
    def limits(self) -> JointLimits:
        """Limits of the joints."""
        ...

    def move(self, joints: ArrayLike, speed: float = 1.05, acceleration: float = 1.4) -> None:
        """Go to joints (6,) [rad] on the straight line in joint space; return when standing still.

        Args:
            joints: the goal.
            speed: of the leading joint [rad/s].
            acceleration: of the leading joint [rad/s^2].

        Raises:
            InputError: the goal is not 6 finite angles within the limits; the arm has not moved.
            ArmStoppedError: the arm stopped on its way (protective or emergency stop, connection).
        """
        ...

    def recover(self) -> None:
        """Make ready to move again after a person has cleared a stop; the arm stays where it is.

        Raises:
            ArmStoppedError: the stop is still there; the message says what to do at the robot.
        """
        ...

    def state(self) -> ArmState:
        """Return where the arm is now.

        Raises:
            ArmStoppedError: the arm does not answer.
        """
        ...

    @property
    def description(self) -> dict[str, Any]:
        """Plain JSON values kept with the session: model, serial number, software, tool offset."""
        ...


class DepthCamera(Protocol):
    """A camera whose depth is aligned to its colour image."""

    @property
    def name(self) -> str:
        """Model and serial number."""
        ...

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The factory's camera model of the images that `grab` returns."""
        ...

    @property
    def depth_unit_m(self) -> float:
        """Metres per count of the sensor's own 16-bit depth."""
        ...

    @property
    def description(self) -> dict[str, Any]:
        """Plain JSON values kept with the session: model, serial, firmware, factory intrinsics."""
        ...

    def grab(self) -> Frame:
        """Return a frame whose exposure began after this call.

        Raises:
            DeviceError: no frame came.
        """
        ...

    def recover(self) -> None:
        """Make ready to deliver frames again after one did not come; no error if it already is.

        Raises:
            DeviceError: the camera is not there; the message names it and says what to do.
        """
        ...
