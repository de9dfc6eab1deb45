"""What can be counted in a depth image: noise on small planes, holes, steps.

The same functions judge real and simulated images, so that a ratio of their results means
something. Inverse depth is linear in the pixel on every plane, so noise is measured there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.loss import require_same_size

WINDOW_PX = 9
"""Side of the small planes [px]."""
FLAT_PX = 1.5
"""A small plane whose disparities leave its own fit by more than this has an edge in it [px]."""
FARTHEST_M = 20.0
"""Depths beyond this are not metres."""


def require_metres(depth_m: ArrayLike, name: str = "the depth picture") -> Array32:
    """Return a depth picture (H, W) as float32, if its numbers can be metres.

    Raises:
        InputError: no two axes, nothing measured, or the values are of another unit.
    """
    depth = np.asarray(depth_m)
    if depth.ndim != 2:
        raise InputError(f"{name} has the shape {depth.shape}; one of rows and columns is taken.")
    if np.issubdtype(depth.dtype, np.integer):
        raise InputError(
            f"{name} holds whole numbers ({depth.dtype}): counts of a depth image. Multiply them "
            "by the unit (often 0.001 m) to give metres."
        )
    depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    measured = depth[depth > 0]
    if measured.size == 0:
        raise InputError(f"{name} holds no measurement: all of it is 0.")
    middle = float(np.median(measured))
    if middle > FARTHEST_M:
        raise InputError(
            f"{name} has a median depth of {middle:g} m; up to {FARTHEST_M:g} m is accepted. Were "
            "millimetres given? Multiply by 0.001."
        )
    return depth


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LocalNoise:
    """Noise on the small planes of one image."""

    rms_px: Array32
    """(H, W) residual of the plane around each pixel [px of disparity]; NaN = none there."""
    median_px: float
    """Median over the small planes that have no edge [px]."""
    windows: int
    """How many they are."""


def local_noise(
    depth_m: ArrayLike,
    intrinsics: CameraIntrinsics,
    baseline_m: float,
    region: Mask | None = None,
    window_px: int = WINDOW_PX,
) -> LocalNoise:
    """Return the residuals of planes fitted to small windows of inverse depth.

    A window counts where all its pixels are measured, lie in the region, and no pixel is further
    from the fit than an edge would put it. Sums over boxes give all least-squares fits at once:
    with coordinates about the middle, residual^2 = S_ww - S_w^2/n - S_uw^2/S_uu - S_vw^2/S_vv.

    Args:
        depth_m: (H, W) depth [m], 0 = no measurement.
        intrinsics: the camera.
        baseline_m: of the sensor [m]: turns inverse depth into pixels.
        region: (H, W) where; None = everywhere.
        window_px: side of a window [px], odd.
    """
    import cv2

    depth = np.asarray(depth_m, np.float32)
    require_same_size(depth, intrinsics)
    known = depth > 0
    inside = known if region is None else known & region
    kernel = np.ones((window_px, window_px), np.uint8)
    full = cv2.erode(inside.astype(np.uint8), kernel, borderValue=0) > 0
    fB = intrinsics.fx * baseline_m
    d = np.where(known, fB / np.where(known, depth, 1), 0).astype(np.float64)
    # About the middle value the squares of the sums lose no digits.
    d = np.where(known, d - (np.median(d[known]) if known.any() else 0), 0)
    residual, slope_u, slope_v = _plane_fits(d, window_px)
    rms = np.sqrt(np.maximum(residual, 0) / (window_px**2 - 3))
    highest, lowest = cv2.dilate(d, kernel), cv2.erode(d, kernel)
    span = (np.abs(slope_u) + np.abs(slope_v)) * (window_px - 1)
    flat = full & (highest - lowest - span < 2 * FLAT_PX) & (rms < FLAT_PX)
    median = float(np.median(rms[flat])) if flat.any() else float("nan")
    return LocalNoise(
        rms_px=np.where(flat, rms, np.nan).astype(np.float32),
        median_px=median,
        windows=int(flat.sum()),
    )


def _plane_fits(d: Array, n: int) -> tuple[Array, Array, Array]:
    """Return the sums of squares that planes leave in boxes of n x n, and their slopes in u, v."""
    import cv2

    ramp = np.arange(n, dtype=np.float64) - n // 2
    one = np.ones(n)
    border = cv2.BORDER_REPLICATE

    def sums(values: Array, along_u: Array, along_v: Array) -> Array:
        filtered = cv2.sepFilter2D(values, cv2.CV_64F, along_u, along_v, borderType=border)
        return np.asarray(filtered, np.float64)

    s, su, sv = sums(d, one, one), sums(d, ramp, one), sums(d, one, ramp)
    spread = n * float(np.square(ramp).sum())
    residual = sums(d * d, one, one) - s * s / n**2 - (su * su + sv * sv) / spread
    return residual, su / spread, sv / spread


def hole_share(depth_m: ArrayLike, region: Mask) -> float:
    """Return the share of a region (H, W) without a measurement; NaN of an empty region."""
    depth = np.asarray(depth_m)
    return float(np.mean(depth[region] <= 0)) if region.any() else float("nan")


@dataclass(frozen=True, kw_only=True, slots=True)
class Step:
    """The step of a sensor's disparity, as its depth counts show it."""

    quantum_px: float
    """The step [px]; 0 = none was found."""
    least_px: float
    """Smaller steps than this are hidden by the depth unit of the files [px]."""


def disparity_step(
    depths_m: ArrayLike, intrinsics: CameraIntrinsics, baseline_m: float, unit_m: float
) -> Step:
    """Return the step of the disparity behind measured depths.

    The disparities of a chip that interpolates to q lie on a comb of pitch q (moved by any bias),
    so the mean of exp(2 pi i d / q) has nearly unit length there, as it has at q / 2, q / 3: the
    greatest such q is the step. Rounding depth to a unit moves a disparity by up to
    f B unit / (2 z^2), which hides steps of less than twice that spacing.

    Args:
        depths_m: measured depths, of any shape [m]; 0 = none.
        intrinsics: the camera.
        baseline_m: of the sensor [m].
        unit_m: of the depth files [m].
    """
    z = np.asarray(depths_m, np.float64).ravel()
    z = z[z > 0]
    fB = intrinsics.fx * baseline_m
    nearest = float(np.percentile(z, 10)) if z.size else 1.0
    least = 2 * fB * unit_m / nearest**2
    values, counts = np.unique(np.round(z / unit_m), return_counts=True)
    if len(values) < MIN_LEVELS:
        return Step(quantum_px=0.0, least_px=least)
    common = np.argsort(counts)[-MOST_LEVELS:]
    d = fB / (values[common] * unit_m)
    weight = counts[common] / counts[common].sum()
    blur = fB * unit_m / np.square(values[common] * unit_m)
    span = float(d.max() - d.min())
    if span <= 0:
        return Step(quantum_px=0.0, least_px=least)
    top = min(1 / least, MOST_STEPS_PER_PX)
    # A comb seen over fewer than three of its teeth cannot be told from chance.
    frequency = np.arange(3 / span, top, 0.1 / span)
    if len(frequency) == 0:
        return Step(quantum_px=0.0, least_px=least)
    found = np.empty(len(frequency))
    for a in range(0, len(frequency), 512):
        f = frequency[a : a + 512]
        expected = (weight * np.sinc(blur * f[:, None])).sum(1)
        found[a : a + 512] = np.abs(np.exp(2j * np.pi * f[:, None] * d) @ weight) / expected
    k = int(np.argmax(found >= COMB * found.max()))
    while k + 1 < len(found) and found[k + 1] > found[k]:
        k += 1
    coherence = float(min(found[k], 1.0))
    step = 1 / float(frequency[k]) if coherence > LEAST_COHERENCE else 0.0
    return Step(quantum_px=step, least_px=least)


MIN_LEVELS, MOST_LEVELS = 12, 1200
"""Different depth counts that a comb needs, and that are looked at."""
MOST_STEPS_PER_PX = 300.0
"""No sensor interpolates finer."""
COMB, LEAST_COHERENCE = 0.85, 0.7
"""The first frequency that reaches this share of the best is the comb's own, not a multiple; and
what coherence is no chance."""
