"""How blurred is a picture? For messages where a target was not found."""

from typing import Any

import numpy as np

from realsim.arrays import UInt8

LEVELS = 4
"""Halvings at which edges are looked at: blur up to about 16 px is measured."""
AGAIN_PX = 1.5
"""Blur that is added to see how much an edge loses."""
RESOLVED_PX = 1.2
"""From this blur on a level shows the edge itself, not its own pixels."""
STRONG = 0.3
"""Share of the steepest slopes (99.5 %) from which on a slope is an edge."""
MIN_SLOPE = 1.0
"""Least slope of an edge [levels/px]."""
MIN_EDGES = 30
"""Fewer pixels of edges tell nothing."""
BLURRED_PX = 1.5
"""From here on the edges are too soft: markers are lost from about 2 px on."""

BLURRED = "the picture is blurred"
"""How a reason begins that says so."""


def edge_blur_px(gray: UInt8) -> float:
    """Return the median blur of a picture's edges as one sigma [px]; NaN where it has none.

    An edge of blur s loses slope by sqrt(1 + a^2 / s^2) when blurred by a more (Zhuo and Sim,
    "Defocus map estimation from a single image", 2011). Coarse levels come first: there noise is
    small and a wide edge is narrow.
    """
    import cv2

    found = float("nan")
    for level in reversed(range(LEVELS)):
        size = (gray.shape[1] >> level, gray.shape[0] >> level)
        if min(size) < 16:
            continue
        small = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.float32)
        slope = _slope(small)
        edge = slope > max(STRONG * float(np.percentile(slope, 99.5)), MIN_SLOPE)
        edge &= slope >= cv2.dilate(slope, np.ones((3, 3), np.uint8))
        if np.count_nonzero(edge) < MIN_EDGES:
            continue
        again = _slope(cv2.GaussianBlur(small, (0, 0), AGAIN_PX))
        loss = float(np.median(slope[edge] / np.maximum(again[edge], 1e-6)))
        blur = AGAIN_PX / float(np.sqrt(max(loss**2 - 1, 1e-3)))
        found = blur * 2**level
        if blur > RESOLVED_PX:
            break
    return found


def _slope(image: Any) -> Any:
    """Return the steepness of an image [levels/px]."""
    import cv2

    return cv2.magnitude(
        cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8),
    )


def blur_reason(gray: UInt8) -> str:
    """Return what to say of a picture that is blurred; empty where it is sharp."""
    blur = edge_blur_px(gray)
    if not blur > BLURRED_PX:
        return ""
    return (
        f"{BLURRED}: its edges spread over {blur:.1f} px (1 sigma, at most "
        f"{BLURRED_PX:g}). Let the arm rest before the picture is taken, focus, expose shorter"
    )
