"""What every importer gives: one camera, and frames in the order of time, one at a time.

A source reads lazily, so that a recording of any size passes through bounded memory, and it joins
what belongs together (colour, depth, joints, poses) by time stamp or by name, never by order.

Whether a camera out of a file of others can be one: of its image's size, and in pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from realsim.arrays import Array, UInt8, UInt16
from realsim.errors import InputError
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


SHORTEST, LONGEST = 0.1, 50.0
"""Focal length over the longer side of the image: 157 deg and 1.1 deg of view. Numbers outside are
of another size of the image, normalised, or damaged."""
MOST_ASPECT = 2.0
"""fx over fy, or the reverse: pixels of cameras are square, or twice as wide in half-size modes."""
MOST_SIDE_PX = 100_000
"""Side of an image: beyond it the file is damaged."""


def require_plausible(camera: CameraIntrinsics, where: str) -> None:
    """Raise if a camera cannot be one.

    Raises:
        InputError: says what was found and what would be accepted.
    """
    side = max(camera.width, camera.height)
    if side > MOST_SIDE_PX:
        raise InputError(f"{where}: an image of {camera.width}x{camera.height} px is none.")
    for name, f in (("fx", camera.fx), ("fy", camera.fy)):
        if not SHORTEST * side <= f <= LONGEST * side:
            raise InputError(
                f"{where}: the focal length {name} is {f:.6g} px for images of {camera.width}x"
                f"{camera.height} px; {SHORTEST * side:.6g} to {LONGEST * side:.6g} is expected. "
                "Is it of another image size, or in another unit than pixels?"
            )
    if max(camera.fx / camera.fy, camera.fy / camera.fx) > MOST_ASPECT:
        raise InputError(
            f"{where}: the focal lengths {camera.fx:.6g} and {camera.fy:.6g} px differ more than "
            f"{MOST_ASPECT:g} times; pixels are square or nearly so."
        )
    for name, c, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if not -size <= c <= 2 * size:
            raise InputError(
                f"{where}: the principal point {name} is {c:.6g} px in an image of {size} px; even "
                f"of a crop it lies between {-size} and {2 * size}."
            )
