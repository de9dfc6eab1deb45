"""Outlines in a depth image, edges in a colour image, and how often these fall on those."""

from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array, Array32, UInt8
from realsim.compiled import njit


def _stretches() -> tuple[float, ...]:
    """Return the factors that depth is stretched by: about +-2 % apart, from 0.7 to 1.45."""
    return tuple(float(s) for s in np.exp(np.arange(-18, 19) * 0.02))


@dataclass(frozen=True, kw_only=True, slots=True)
class AlignmentConfig:
    """How outlines are compared with edges. Pixels are those of an image `work_width_px` wide."""

    work_width_px: int = 640
    """Images are reduced to about this width: finer edges are noise."""
    jump_m: float = 0.015
    """Depth differences beyond this are outlines [m]; plus `jump_share` of the depth."""
    jump_share: float = 0.02
    """Noise and slopes grow with depth."""
    gap_px: int = 12
    """Depth that is missing over less than this beside an outline is the stereo camera's shadow:
    the nearer side of the gap is the outline."""
    run_px: int = 8
    """Outlines are at least so long."""
    reach_px: int = 24
    """Shifts up to this are tried, along both axes."""
    step_px: int = 3
    """Steps of the shifts while stretches are tried, too."""
    stretches: tuple[float, ...] = field(default_factory=_stretches)
    """Factors that depth is stretched by about the middle, along each axis: a colour lens of 69
    deg against a depth lens of 87 deg is 0.72."""
    near_px: float = 1.5
    """An outline counts exp(-d^2 / 2 near^2) at distance d from an edge."""
    wide_px: float = 3.0
    """The same while stretches are tried, in coarser steps."""
    edge_share: float = 0.08
    """The strongest edges of the colour image, so large a share of its pixels, are used."""
    points: int = 1200
    """Outline pixels used at most; a third of them while stretches are tried."""
    least_points: int = 150
    """With fewer outlines nothing is said: an empty table has none."""
    confidence: float = 5.0
    """The best shift stands out by at least so many robust standard deviations of all shifts."""
    vote_px: float = 3.0
    """Views whose own best shifts lie within this of the common one vote for it; by chance one in
    70 does."""
    vote_share: float = 0.5
    """With the votes of this share of the views, and three at least, a shift is sure."""
    stretch_confidence: float = 7.0
    """The same of the best stretch: a thousand times more are tried."""
    aligned_px: float = 5.5
    """A best shift up to this is aligned: published, aligned data lies up to 5 px off (YCB-Video
    2.5 px along y, GraspNet's Kinect 2.3 px, an F200 mapped onto its colour image 4.9 px)."""
    wrong_px: float = 6.0
    """Outlines this far off, in the mean over the image, are said to be not aligned."""
    stretch_gain: float = 1.15
    """A stretch is believed if it is so many times better than the best shift without one."""
    agree_share: float = 0.75
    """A view agrees with all of them if their best is worth this share of its own best."""
    gain: float = 1.3
    """A stretch or shift is believed if outlines lie on edges so many times as often beyond chance
    as they do unmoved."""
    few_confidence: float = 3.4
    """Least confidence of the best shift in one or two views, which cannot vote. The values from
    here to `few_resized_gain` were set on five frames of YCB-Video (aligned, shifted, stretched),
    15 of an F200 and ten resized ones of a UR5e's camera."""
    few_stretch_confidence: float = 3.9
    """Least confidence of the best stretch: misaligned frames 4.0 to 7.7, an aligned one 3.3."""
    few_share: float = 0.3
    """Least share of outlines that lie on edges beyond chance."""
    few_gain: float = 2.0
    """Least ratio of that share to the unmoved one: 2.2 to 5 where depth was moved or stretched,
    1.05 to 1.41 where it was not."""
    few_stretch_gain: float = 1.5
    """Least ratio of a stretch to the best shift: 1.7 to 12; aligned frames have up to 1.17."""
    few_resized_gain: float = 1.2
    """The same ratio for a stretch that is a resize from 4:3 to 16:9 or back: 1.2 to 2."""
    seed: int = 0
    """Seed of the choice of outline pixels."""


def outlines_of(depth_m: Array32, config: AlignmentConfig) -> Array32:
    """Return outline points (N, 3): x, y, and 0 where depth jumps along x, 1 along y."""
    import cv2

    found: list[Array32] = []
    full = _without_pinholes(np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0))
    for axis, z in ((0, full), (1, full.T)):
        columns = np.arange(z.shape[1])
        # Column of the last measured pixel before each one: gaps are stepped over.
        last = np.maximum.accumulate(np.where(z > 0, columns, -1), axis=1)
        before = np.concatenate([np.full((len(z), 1), -1), last[:, :-1]], axis=1)
        i, j = np.nonzero((z > 0) & (before >= 0) & (columns - before <= config.gap_px))
        b = before[i, j]
        here, there = z[i, j], z[i, b]
        jump = np.abs(here - there)
        keep = jump > config.jump_m + config.jump_share * np.minimum(here, there)
        i, j, b = i[keep], j[keep], b[keep]
        # The border of the nearer of the two, half a pixel outside of it.
        x = np.where(here[keep] < there[keep], j - 0.5, b + 0.5)
        mask = np.zeros(z.shape, np.uint8)
        mask[i, np.ceil(x).astype(np.int64)] = 1
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        # Noise jumps here and there, outlines run on.
        long = np.asarray(stats)[:, cv2.CC_STAT_HEIGHT] >= config.run_px
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


def edge_distance(rgb: UInt8, factor: int, config: AlignmentConfig) -> Array32:
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
        n = int(0.5 * config.edge_share * g.size)
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
