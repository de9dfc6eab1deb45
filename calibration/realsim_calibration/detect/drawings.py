"""Pictures that another program has drawn on: corners, axes, text over the target."""

import numpy as np

from realsim.arrays import Array, Mask, UInt8

CHROMA = 120
"""Difference of the largest and the smallest channel from which a pixel is coloured."""
NEUTRAL = 80
"""Chroma up to which a pixel shows the target itself, tinted by the lamp or the camera."""
AROUND_PX = 7
"""Width of the square about a pixel in which the target's own shades are looked for."""
BEYOND = 50
"""Levels by which a drawn pixel's channel lies outside of the shades around it. The soft edges of
a lens with colour fringes lie between dark and bright in every channel, however blue they are.
NEUTRAL and BEYOND were chosen on two real sets and three rendered boards, untouched and
with corners and axes drawn, before and after JPEG."""
GREEN = 60
"""Levels by which green exceeds red and blue where it was drawn: a lens bends green less than blue
and more than red, so that it never stands out alone."""
DRAWN_SHARE = (0.003, 0.35)
"""Share of drawn pixels within the target: below is noise, beyond the print is coloured."""
DRAWN = "coloured lines or dots are drawn over the target"
"""How a reason begins that says so."""


MIN_HULL = 4
"""Fewer points do not say where in the picture the target is."""
PURE, PURE_SHARE = 200, 0.002
"""Chroma of colours as programs draw them, and the share of a picture from which they are named
where no target is found. Chosen on three real sets: untouched 0.01 %, every point of a board
covered by a disc 0.7 % and more."""
COVERED = "pure colours cover"
"""How a reason begins that says so."""


def drawing_reason(image: UInt8, uv: Array) -> str:
    """Return what to say of a picture with drawings on its target; empty where there are none.

    Args:
        image: (H, W, 3) RGB, or (H, W) gray, in which nothing can be told.
        uv: (n, 2) the target's points [px]; of fewer than four the whole picture is judged.
    """
    import cv2

    if image.ndim != 3:
        return ""
    if len(uv) < MIN_HULL:
        share = float((np.ptp(image.astype(np.int16), axis=-1) > PURE).mean())
        if share <= PURE_SHARE:
            return ""
        return (
            f"{COVERED} {100 * share:.1f} % of the picture, as programs draw them: are lines or "
            "dots drawn over the target? Use the pictures as the camera gave them"
        )
    hull = cv2.convexHull(np.rint(uv).astype(np.int32))
    u, v, w, h = cv2.boundingRect(hull)
    inside = np.zeros((h, w), np.uint8)
    cv2.fillConvexPoly(inside, np.asarray(hull) - [u, v], 1)
    part = image[v : v + h, u : u + w]
    inside = inside[: part.shape[0], : part.shape[1]]
    share = float((_drawn(part) & (inside > 0)).sum() / max(int(inside.sum()), 1))
    if not DRAWN_SHARE[0] < share < DRAWN_SHARE[1]:
        return ""
    return (
        f"{DRAWN} ({100 * share:.1f} % of it): corners below them are off. Use the "
        "pictures as the camera gave them"
    )


def _drawn(part: UInt8) -> Mask:
    """Return (H, W) which pixels are coloured as nothing of the target around them can be."""
    import cv2

    levels = part.astype(np.int16)
    chroma = np.ptp(levels, axis=-1)
    box = np.ones((AROUND_PX, AROUND_PX), np.uint8)
    own = chroma <= NEUTRAL
    low = cv2.erode(np.where(own[..., None], part, 255).astype(np.uint8), box).astype(np.int16)
    high = cv2.dilate(np.where(own[..., None], part, 0).astype(np.uint8), box).astype(np.int16)
    known = cv2.dilate(own.astype(np.uint8), box) > 0
    beyond = np.maximum(low - levels, levels - high).max(axis=-1)
    green = levels[..., 1] - np.maximum(levels[..., 0], levels[..., 2]) > GREEN
    return np.asarray((chroma > CHROMA) & (known & (beyond > BEYOND) | green))
