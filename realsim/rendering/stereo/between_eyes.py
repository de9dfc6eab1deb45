"""What a projector between the eyes reaches, from what the two eyes have met already.

All three stand on one line and are rectified, so a point stays in its row and moves by a share of
its disparity. What hides a point from the projector is seen by at least one of the eyes, except
behind things that both of them see from outside: a third cast would find little more.
"""

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit

Array32 = NDArray[np.float32]
SAME_SURFACE_PX = np.float32(1.0)
"""Neighbours whose disparities differ by more are not joined [px]."""


def depth_between(left_m: Array32, right_m: Array32, fB: float, share: float) -> Array32:
    """Return the nearest depth (H, W) [m] that either eye has met, as seen from between them.

    Args:
        left_m: (H, W) first hits of the left eye [m]; 0 = nothing.
        right_m: (H, W) of the right eye, rectified with it.
        fB: focal length times baseline [px m].
        share: where it stands, in baselines from the left eye.

    Returns:
        depth [m]; 0 where neither eye has met anything.
    """
    disparity = np.zeros_like(left_m)
    _carry(left_m, np.float32(fB), np.float32(share), disparity)
    _carry(right_m, np.float32(fB), np.float32(share - 1), disparity)
    out = np.zeros_like(left_m)
    np.divide(np.float32(fB), disparity, out=out, where=disparity > 0)
    return out


@njit
def _carry(depth: Array32, fB: np.float32, share: np.float32, out: Array32) -> None:
    """Raise `out` [px] to the disparities of an eye, moved by a share of themselves.

    Disparity is linear along a plane's row, so between two neighbours it is exact.
    """
    height, width = depth.shape
    zero = np.float32(0.0)
    for v in range(height):
        before, at = zero, zero
        for u in range(width):
            d = fB / depth[v, u] if depth[v, u] > zero else zero
            x = np.float32(u) - share * d
            if d > zero and before > zero and abs(d - before) <= SAME_SURFACE_PX and x > at:
                slope = (d - before) / (x - at)
                for column in range(max(int(np.ceil(at)), 0), min(int(np.floor(x)), width - 1) + 1):
                    value = before + slope * (np.float32(column) - at)
                    out[v, column] = max(out[v, column], value)
            before, at = d, x
