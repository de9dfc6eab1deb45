"""Outlines in a depth image, edges in a colour image, and how often these fall on those."""

import numpy as np

from realsim.arrays import Array, Array32, UInt8
from realsim.compiled import njit

JUMP_M = 0.015
"""Depth differences beyond this are outlines [m]; plus `JUMP_SHARE` of the depth."""
JUMP_SHARE = 0.02
"""Noise and slopes grow with depth."""
GAP_PX = 12
"""Depth that is missing over less than this beside an outline is the stereo camera's shadow:
the nearer side of the gap is the outline."""
RUN_PX = 8
"""Outlines are at least so long."""
EDGE_SHARE = 0.08
"""The strongest edges of the colour image, so large a share of its pixels, are used."""


def outlines_of(depth_m: Array32) -> Array32:
    """Return outline points (N, 3): x, y, and 0 where depth jumps along x, 1 along y."""
    import cv2

    found: list[Array32] = []
    full = _without_pinholes(np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0))
    for axis, z in ((0, full), (1, full.T)):
        columns = np.arange(z.shape[1])
        # Column of the last measured pixel before each one: gaps are stepped over.
        last = np.maximum.accumulate(np.where(z > 0, columns, -1), axis=1)
        before = np.concatenate([np.full((len(z), 1), -1), last[:, :-1]], axis=1)
        i, j = np.nonzero((z > 0) & (before >= 0) & (columns - before <= GAP_PX))
        b = before[i, j]
        here, there = z[i, j], z[i, b]
        jump = np.abs(here - there)
        keep = jump > JUMP_M + JUMP_SHARE * np.minimum(here, there)
        i, j, b = i[keep], j[keep], b[keep]
        # The border of the nearer of the two, half a pixel outside of it.
        x = np.where(here[keep] < there[keep], j - 0.5, b + 0.5)
        mask = np.zeros(z.shape, np.uint8)
        mask[i, np.ceil(x).astype(np.int64)] = 1
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        # Noise jumps here and there, outlines run on.
        long = np.asarray(stats)[:, cv2.CC_STAT_HEIGHT] >= RUN_PX
        keep = long[np.asarray(labels, dtype=np.int64)[i, np.ceil(x).astype(np.int64)]]
        i, x = i[keep], x[keep]
        xy = (x, i) if axis == 0 else (i, x)
        found.append(np.stack([*xy, np.full(len(x), axis)], axis=1).astype(np.float32))
    return np.concatenate(found)


def _without_pinholes(depth_m: Array32) -> Array:
    """Return the depth (H, W) with holes of a pixel filled: depth mapped onto a larger image."""
    z = depth_m.astype(np.float64)
    for axis in (1, 0):
        a, b = np.roll(z, 1, axis), np.roll(z, -1, axis)
        z = np.where((z == 0) & (a > 0) & (b > 0), np.maximum(a, b), z)
    return z


def edge_distance(rgb: UInt8, factor: int) -> Array32:
    """Return the distance (2, H, W) to the nearest colour edge along x and along y [px]."""
    import cv2

    size = (-(-rgb.shape[1] // factor), -(-rgb.shape[0] // factor))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if factor > 1 else rgb
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float32)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    # Of the three colours the one that changes most.
    most = np.argmax(gx**2 + gy**2, axis=2)[..., None]
    gx = np.take_along_axis(gx, most, 2)[..., 0]
    gy = np.take_along_axis(gy, most, 2)[..., 0]
    out = np.empty((2, *gx.shape), np.float32)
    for axis, g in ((0, np.abs(gx)), (1, np.abs(gy))):
        a, b = np.roll(g, 1, axis=1 - axis), np.roll(g, -1, axis=1 - axis)
        crest = (g >= a) & (g > b)
        values = g[crest]
        n = int(0.5 * EDGE_SHARE * g.size)
        least = np.partition(values, -n)[-n] if n < len(values) else 0.0
        edges = crest & (g >= max(float(least), 1.0))
        out[axis] = cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 3)
    return out


def scores_of(
    distance: Array32, width_px: float, outlines: Array32, middle: Array, stretches: Array,
    reach: int, step: int,
) -> Array32:  # fmt: skip
    """Return (S, S, Y, X) the share of outlines on edges beyond chance per stretch and shift."""
    near = np.exp(-0.5 * np.square(distance / np.float32(width_px))).astype(np.float32)
    chance = near.reshape(2, -1).mean(1)
    raw = _sum_near(near, chance, outlines, middle, stretches, (reach // step, step))
    mean = float(np.mean(chance[outlines[:, 2].astype(np.int64)]))
    return ((raw / len(outlines) - mean) / (1.0 - mean)).astype(np.float32)


@njit
def _sum_near(
    near: Array32, chance: Array32, outlines: Array32, middle: Array, stretches: Array,
    shifts: tuple[int, int],
) -> Array:  # fmt: skip
    """Return (S, S, Y, X) the sum of closeness over outlines (N, 3); outside it is chance."""
    count, step = shifts
    size = 2 * count + 1
    _, height, width = near.shape
    out = np.zeros((len(stretches), len(stretches), size, size))
    for sx in range(len(stretches)):
        for sy in range(len(stretches)):
            for n in range(len(outlines)):
                axis = int(outlines[n, 2])
                x0 = middle[0] + stretches[sx] * (outlines[n, 0] - middle[0])
                y0 = middle[1] + stretches[sy] * (outlines[n, 1] - middle[1])
                j0, i0 = int(np.floor(x0 + 0.5)), int(np.floor(y0 + 0.5))
                for a in range(size):
                    i = i0 + (a - count) * step
                    for b in range(size):
                        j = j0 + (b - count) * step
                        if 0 <= i < height and 0 <= j < width:
                            out[sx, sy, a, b] += near[axis, i, j]
                        else:
                            out[sx, sy, a, b] += chance[axis]
    return out
