"""Pictures that another program has drawn on: corners, axes, text over the target."""

import numpy as np

from realsim.arrays import Array, UInt8

CHROMA = 120
"""Difference of the largest and the smallest channel from which a pixel is coloured: targets are
black and white, and lamps tint them by less."""
DRAWN_SHARE = (0.003, 0.35)
"""Share of coloured pixels within the target: below is noise, beyond the print is coloured."""
DRAWN = "coloured lines or dots are drawn over the target"
"""How a reason begins that says so."""


def drawing_reason(image: UInt8, uv: Array) -> str:
    """Return what to say of a picture with drawings on its target; empty where there are none.

    Args:
        image: (H, W, 3) RGB, or (H, W) gray, in which nothing can be told.
        uv: (n, 2) the target's points [px].
    """
    import cv2

    if image.ndim != 3 or len(uv) < 4:
        return ""
    hull = cv2.convexHull(np.rint(uv).astype(np.int32))
    u, v, w, h = cv2.boundingRect(hull)
    inside = np.zeros((h, w), np.uint8)
    cv2.fillConvexPoly(inside, np.asarray(hull) - [u, v], 1)
    part = image[v : v + h, u : u + w].astype(np.int16)
    inside = inside[: part.shape[0], : part.shape[1]]
    coloured = (np.ptp(part, axis=-1) > CHROMA) & (inside > 0)
    share = float(coloured.sum() / max(int(inside.sum()), 1))
    if not DRAWN_SHARE[0] < share < DRAWN_SHARE[1]:
        return ""
    return (
        f"{DRAWN} ({100 * share:.1f} % of it is coloured): corners below them are off. Use the "
        "pictures as the camera gave them"
    )
