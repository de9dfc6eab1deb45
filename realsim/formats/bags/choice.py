"""What a person can say about a recording where it leaves more than one reading open."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.records.checked_arrays import Array

Clock = Literal["header", "receive"]
"""The stamp that the sender put into the message, or the time at which the recorder got it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BagChoice:
    """Which topics and frames of a recording to use; None takes the only one that fits."""

    colour: str | None = None
    """Topic of the colour images; needed where two cameras were recorded."""
    depth: str | None = None
    """Topic of the depth images; needed where no single one belongs to the colour topic."""
    without_depth: bool = False
    """Import colour alone, because the depth of the recording cannot or shall not be used."""
    camera_info: str | None = None
    """Topic of the colour camera's CameraInfo, where its name does not follow from the images'."""
    depth_camera_info: str | None = None
    """Topic of the depth camera's CameraInfo, likewise."""
    intrinsics: CameraIntrinsics | None = None
    """The colour camera, for a recording without CameraInfo (or one that is wrong)."""
    T_colour_depth: Array | None = None
    """(4, 4) depth camera in the colour camera [m], where the recording does not say it."""
    depth_unit_m: float | None = None
    """Metres per count of 16-bit depth, where the recording does not say it."""
    joints: str | None = None
    """Topic of the JointState messages; needed where several hold a UR's six joints."""
    joint_prefix: str | None = None
    """What stands before `shoulder_pan_joint` and the others, where there are two arms."""
    base_frame: str | None = None
    """Frame of tf that is the robot's base; else `base`, else `base_link`."""
    ee_frame: str | None = None
    """Frame of tf that is the bare flange; else `tool0`."""
    world_frame: str | None = None
    """Frame of tf to give camera poses in, for rigs whose camera is tracked; else none is given."""
    clock: Clock = "header"
    """`receive` joins by the recorder's clock: less exact, but one clock for all topics."""
    max_pair_gap_s: float | None = None
    """Greatest time between colour and its depth [s]; else half a frame period, 0.1 s at most."""
    max_arm_gap_s: float = 0.25
    """Greatest time between two arm readings to interpolate between [s]: a 10 Hz publisher may
    lose a message, but a gap of seconds says nothing about where a moving arm was."""
    still_speed: float = 0.01
    """Leading joint's speed up to which the arm stands [rad/s] (with tf alone: flange, rad/s and
    m/s): what a 30 ms time stamp error makes of it is 0.3 mm at 1 m."""
    only_still: bool = False
    """Leave out the frames at which the arm moved (or its speed is not known)."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.clock not in ("header", "receive"):
            raise InputError(f"clock is {self.clock!r}; 'header' or 'receive' is accepted.")
        for name in ("depth_unit_m", "max_pair_gap_s", "max_arm_gap_s", "still_speed"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}; a positive number is needed.")
        if self.without_depth and self.depth is not None:
            raise InputError(
                f"depth={self.depth} and without_depth were both given; leave one of them out."
            )
        if self.T_colour_depth is not None:
            T = se3.check_rigid(self.T_colour_depth, "T_colour_depth")
            object.__setattr__(self, "T_colour_depth", T)
