"""What every importer gives: one camera, and frames in the order of time, one at a time.

A source reads lazily, so that a recording of any size passes through bounded memory, and it joins
what belongs together (colour, depth, joints, poses) by time stamp or by name, never by order.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from realsim.arrays import Array, UInt8, UInt16
from realsim.records import CameraIntrinsics


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SourceFrame:
    """One frame as it was found."""

    name: str
    """What messages call it: a file name, or topic and time."""
    time_s: float
    """Time stamp [s] of the source's clock; its number where the source has no clock."""
    rgb: UInt8
    """(H, W, 3) colour."""
    depth_counts: UInt16 | None = None
    """(H, W) counts of the source's depth unit on the colour image's pixels, 0 = none."""
    joints: Array | None = None
    """(n,) joint angles [rad] at the time of the frame."""
    T_base_ee: Array | None = None
    """(4, 4) flange in the robot's base [m]."""
    T_world_cam: Array | None = None
    """(4, 4) camera in world [m], where the source knows it."""


class FrameSource(Protocol):
    """A recording, a folder or a data set, opened and checked."""

    @property
    def name(self) -> str:
        """What the session is to be called."""
        ...

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera of all frames."""
        ...

    @property
    def depth_unit_m(self) -> float | None:
        """Metres per count of depth; None where the source has no depth at all."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know: what was left out, what was assumed and why."""
        ...

    @property
    def extra(self) -> dict[str, Any]:
        """Plain JSON values kept with the session: where it came from, clocks, topics."""
        ...

    def __len__(self) -> int:
        """Return the number of frames."""
        ...

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the frames from number `start` on, in the order of time.

        Raises:
            InputError: a frame cannot be read; the message names it.
        """
        ...
