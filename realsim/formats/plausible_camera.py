"""Whether a camera out of a file of others can be one: of its image's size, and in pixels."""

from realsim.errors import InputError
from realsim.records import CameraIntrinsics

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
