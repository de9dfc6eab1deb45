"""The images of a view: where they are, and what they must be."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import images
from realsim.errors import InputError, RealsimError


def rgb_path(index: int) -> str:
    """Return where the colour image of a view is, relative to the session."""
    return f"rgb/{index:06d}.png"


def depth_path(index: int) -> str:
    """Return where the depth image of a view is, relative to the session."""
    return f"depth/{index:06d}.png"


def is_whole(path: Path) -> bool:
    """Return whether the file is there and can be decoded to its end."""
    try:
        images.read_image(path)
    except (OSError, RealsimError):
        return False
    return True


def check_sizes(
    index: int,
    size: tuple[int, int],
    rgb: NDArray[Any],
    depth_m: NDArray[Any] | None,
    depth_counts: NDArray[Any] | None,
) -> None:
    """Check that the images of view `index` are of the camera's size (height, width).

    Raises:
        InputError: they are not, or depth is given twice or as another type.
    """
    depth = depth_m if depth_counts is None else depth_counts
    if depth_m is not None and depth_counts is not None:
        raise InputError(f"view {index}: give depth_m or depth_counts, not both.")
    if depth_counts is not None and depth_counts.dtype != np.uint16:
        raise InputError(
            f"view {index}: depth_counts are {depth_counts.dtype}; uint16 is needed. Metres go "
            "into depth_m."
        )
    found = rgb.shape[:2] if depth is None else (*rgb.shape[:2], *depth.shape)
    if found not in (size, size + size) or rgb.ndim != 3:
        raise InputError(
            f"view {index}: colour {rgb.shape} and depth "
            f"{None if depth is None else depth.shape} do not have the camera's size {size} "
            "(height, width)."
        )
