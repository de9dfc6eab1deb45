"""Sub-pixel corners of chessboards: four squares meet, two straight lines cross.

A corner operator looks at the few pixels about the corner, where the blur has rounded everything.
Here the edges do the work: each of the four arms is measured in gray profiles, a line is fitted
through the edge points of two opposite arms, and the two lines meet in the corner. Under
perspective the lines stay straight, and what the blur and the neighbouring squares do to one arm
they do to its opposite the other way round, so the crossing is unbiased. Integer pixels are pixel
centres.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Mask, UInt8
from realsim.records import CameraIntrinsics
from realsim_calibration.detect import edges

NO_PATTERN_PX = 1e3
"""Distance of the next edge behind a chessboard's edge: beyond any profile [px]."""
OUTSIDE = "outside the image"
"""The fault of a corner that is not in view: nothing is wrong with it."""
PASSES = 3
"""Resample about the refined lines this often; the first start is up to 2 px off."""
PROFILES = 14
"""Gray profiles per arm."""
SAMPLES = 15
"""Samples per profile, about every half pixel."""
HALF_WINDOW_PX = 3.5
"""Longest reach of a profile to either side [px]: 2 sigma of a strong blur."""
MIN_HALF_WINDOW_PX = 1.5
"""Shortest reach [px]; below it the start's own error leaves the window."""
CLEAR_SHARE = 0.8
"""Reach of a profile in widths of the uniform band beside the edge."""
ARM_SHARE = 0.45
"""Length of an arm in squares: beyond the middle the neighbour's blur comes closer."""
MAX_ARM_PX = 24.0
"""Longest arm [px]: over 48 px a line bends by 0.01 px under a usual lens, not more."""
CUT_BLURS = 1.2
"""Distance of the first profile's end from the other line, in blurs."""
MIN_CUT_PX = 1.0
"""Least distance of the first profile from the corner [px]."""
INDEPENDENT_PX = 1.3
"""Profiles closer than this share their noise [px]; enters the predicted error alone."""
MIN_CONTRAST = 15.0
"""Least step across every arm [gray levels of 255]: three times a strong noise."""
MAX_RESIDUAL_PX = 0.5
"""Largest scatter of edge points about the lines [px]."""
MIN_INLIER_SHARE = 0.45
"""Least share of the profiles of a line that must carry it."""
MAX_MOVE_SHARE = 0.2
"""Furthest from the start, in squares: a corner further off belongs to something else."""
MIN_SINE = 0.17
"""Least sine of the angle at which the lines cross: 10 deg."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Saddles:
    """Refined corners and how well they were seen."""

    uv: Array
    """(n, 2) [px]."""
    sd_px: Array
    """(n,) predicted 1-sigma of a coordinate [px]."""
    faults: tuple[str, ...]
    """(n,) why a corner cannot be used, '' where it can."""

    @property
    def good(self) -> Mask:
        """(n,) whether the corner can be used."""
        return np.array([not f for f in self.faults], dtype=bool)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Pass:
    """One measurement of all corners."""

    uv: Array
    toward: Array
    blur: Array
    contrast: Array
    share: Array
    rms: Array
    sd: Array
    sine: Array


def refine_saddles(
    gray: UInt8,
    start: Array,
    arms: Array,
    dark: Mask,
    clear: float = 1.0,
    intrinsics: CameraIntrinsics | None = None,
) -> Saddles:
    """Return the corners where four squares meet, to a few hundredths of a pixel.

    Args:
        gray: (H, W) image.
        start: (n, 2) rough corners [px].
        arms: (n, 4, 2) vectors from the corner to its neighbours along +x, +y, -x, -y of the board
            [px].
        dark: (n,) whether the square between +x and +y is the dark one.
        clear: width of the uniform band beside an edge, in squares (less where markers sit in the
            white squares).
        intrinsics: with them, lines are fitted in undistorted coordinates.
    """
    start = np.asarray(start, dtype=np.float64).reshape(-1, 2)
    if not len(start):
        return Saddles(uv=start, sd_px=np.zeros(0), faults=())
    image = gray.astype(np.float64)
    arms = np.asarray(arms, dtype=np.float64)
    length = np.linalg.norm(arms, axis=-1)
    toward = arms / np.maximum(length, 1e-9)[..., None]
    # The band beside an arm is as wide as the neighbouring arms reach across it.
    across = np.abs(_cross(toward, np.roll(arms, -1, axis=1)))
    band = clear * np.minimum(across, np.roll(across, 2, axis=1))
    reach = np.clip(CLEAR_SHARE * band, MIN_HALF_WINDOW_PX, HALF_WINDOW_PX)
    length = np.minimum(ARM_SHARE * length, MAX_ARM_PX)
    uv, blur = start, None
    measured = None
    for _ in range(PASSES):
        measured = _measure(image, (uv, toward, length, reach), dark, blur, intrinsics)
        uv, toward, blur = measured.uv, measured.toward, measured.blur
    assert measured is not None
    square = np.linalg.norm(arms, axis=-1).min(-1)
    faults = tuple(_faults(measured, start, square, gray.shape))
    return Saddles(uv=measured.uv, sd_px=measured.sd, faults=faults)


def _measure(
    image: Array,
    where: tuple[Array, Array, Array, Array],
    dark: Mask,
    blur: Array | None,
    intrinsics: CameraIntrinsics | None,
) -> _Pass:
    """Run one pass: profiles across the arms, edge points, two lines, their crossing."""
    uv, toward, length, reach = where
    s, foot = _feet(uv, toward, length, reach, blur)
    # From dark to bright: away from the next arm where the square up to it is the dark one.
    side = np.stack([-toward[..., 1], toward[..., 0]], -1)
    side = side * np.sign(_cross(toward, np.roll(toward, -1, axis=1)))[..., None]
    flip = dark[:, None] ^ (np.arange(4) % 2 == 1)
    side = np.where(flip[..., None], -side, side)
    t = np.linspace(-1.0, 1.0, SAMPLES) * reach[..., None]
    profiles = edges.bilinear(
        image, foot[..., None, :] + t[..., None, :, None] * side[..., None, None, :]
    )
    shift, step, blur = edges.fit_blurred_steps(
        t, profiles, np.full(length.shape, NO_PATTERN_PX), blur
    )
    seen = (np.abs(shift) < 0.9 * reach[..., None]) & (
        step > 0.3 * np.median(step, axis=(1, 2))[:, None, None]
    )
    points = foot + shift[..., None] * side[..., None, :]
    # Arms 0 and 2 make one line, 1 and 3 the other: (n, 2 lines, 2 m points).
    points = np.concatenate([points[:, :2], points[:, 2:]], axis=2)
    seen = np.concatenate([seen[:, :2], seen[:, 2:]], axis=2)
    s = np.concatenate([s[:, :2], -s[:, 2:]], axis=2)
    center, normal, weight, rms = edges.fit_lines(edges.straighten(intrinsics, points), seen)
    met, sine = edges.line_intersections(center[:, 0], normal[:, 0], center[:, 1], normal[:, 1])
    met = np.clip(met, uv - 2 * HALF_WINDOW_PX, uv + 2 * HALF_WINDOW_PX)
    variance = _variance(s, weight, rms)
    return _Pass(
        uv=edges.bend(intrinsics, met),
        toward=_turned(toward, met, normal, length, intrinsics),
        blur=blur,
        contrast=np.median(step, axis=-1).min(-1),
        share=weight.mean(-1).min(-1),
        rms=np.sqrt(np.mean(rms**2, -1)),
        sd=np.sqrt(0.5 * variance.sum(-1)) / sine,
        sine=sine,
    )


def _feet(
    uv: Array, toward: Array, length: Array, reach: Array, blur: Array | None
) -> tuple[Array, Array]:
    """Return positions along the arms (n, 4, m) and the profiles' feet (n, 4, m, 2) [px]."""
    sine = np.maximum(np.abs(_cross(toward, np.roll(toward, -1, axis=1))), MIN_SINE)
    cosine = np.sqrt(np.maximum(1 - sine**2, 0.0))
    blurred = np.ones(len(uv)) if blur is None else blur
    cut = (reach * cosine + CUT_BLURS * blurred[:, None]) / sine
    cut = np.minimum(np.maximum(cut, MIN_CUT_PX), 0.5 * length)
    share = np.linspace(0.0, 1.0, PROFILES)
    s = cut[..., None] + (length - cut)[..., None] * share
    return s, uv[:, None, None, :] + s[..., None] * toward[:, :, None, :]


def _turned(
    toward: Array, met: Array, normal: Array, length: Array, intrinsics: CameraIntrinsics | None
) -> Array:
    """Return the arms' directions (n, 4, 2) along the fitted lines."""
    tangent = np.stack([normal[..., 1], -normal[..., 0]], -1)
    tangent = np.concatenate([tangent, tangent], axis=1)
    tangent = tangent * np.where((tangent * toward).sum(-1) < 0, -1.0, 1.0)[..., None]
    tip = edges.bend(intrinsics, met[:, None] + tangent * length[..., None])
    out = tip - edges.bend(intrinsics, met)[:, None]
    out = out / np.maximum(np.linalg.norm(out, axis=-1), 1e-9)[..., None]
    # A line that turned by more than 30 deg has found something else: keep the old direction.
    return np.where(((out * toward).sum(-1) > np.cos(np.pi / 6))[..., None], out, toward)


def _variance(s: Array, weight: Array, rms: Array) -> Array:
    """Return the variance (n, 2) of the two lines' offsets at the corner [px^2].

    r^2 (1/k + mean^2 / sum (s - mean)^2) for k independent points with scatter r; profiles closer
    than `independent_px` count as less than one.
    """
    spacing = np.abs(s[..., 1] - s[..., 0])
    k = weight.sum(-1) * np.minimum(1.0, spacing / INDEPENDENT_PX)
    k = np.maximum(k, 1.0)
    mean = (weight * s).sum(-1) / np.maximum(weight.sum(-1), 1.0)
    spread = (weight * (s - mean[..., None]) ** 2).sum(-1) / np.maximum(weight.sum(-1), 1.0)
    return rms**2 / k * (1 + mean**2 / np.maximum(spread, 1e-9))


def _faults(found: _Pass, start: Array, square: Array, shape: tuple[int, ...]) -> Iterator[str]:
    """Yield why each corner cannot be used, '' where it can."""
    moved = np.linalg.norm(found.uv - start, axis=-1)
    for k in range(len(start)):
        u, v = found.uv[k]
        inside = 0 <= u <= shape[1] - 1 and 0 <= v <= shape[0] - 1
        # Written as "is it good", so that a NaN is a fault.
        checks = (
            (inside, OUTSIDE),
            (found.contrast[k] >= MIN_CONTRAST,
             f"low contrast: {found.contrast[k]:.0f} levels (at least {MIN_CONTRAST:g})"),
            (found.sine[k] >= MIN_SINE, "seen too obliquely"),
            (found.share[k] >= MIN_INLIER_SHARE,
             f"covered or broken: {found.share[k]:.0%} of its edges fit"),
            (found.rms[k] <= MAX_RESIDUAL_PX,
             f"edges scatter by {found.rms[k]:.2f} px (at most {MAX_RESIDUAL_PX:g})"),
            (moved[k] <= MAX_MOVE_SHARE * square[k],
             f"lies {moved[k]:.1f} px from where the board expects it"),
        )  # fmt: skip
        yield next((reason for good, reason in checks if not good), "")


def grid_arms(grid: Array) -> Array:
    """Return the vectors (r, c, 4, 2) to the neighbours along +x, +y, -x, -y of a grid (r, c, 2).

    At the rim it is the opposite one, turned about.
    """
    dx, dy = np.diff(grid, axis=1), np.diff(grid, axis=0)
    right = np.concatenate([dx, dx[:, -1:]], axis=1)
    left = -np.concatenate([dx[:, :1], dx], axis=1)
    down = np.concatenate([dy, dy[-1:]], axis=0)
    up = -np.concatenate([dy[:1], dy], axis=0)
    return np.stack([right, down, left, up], axis=2)


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
