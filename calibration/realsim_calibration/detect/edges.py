"""Sub-pixel corners of dark squares: fit the four edges, then intersect neighbouring lines.

A tag corner is an L, not a saddle, so that corner operators are pulled inwards on it. Its edges are
long and straight: each is measured in a few dozen gray profiles, and the corner is where the lines
meet. Integer pixels are pixel centres throughout; nothing is shifted by half a pixel.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Mask, UInt8
from realsim.geometry.camera import distort, undistort
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim.records import CameraIntrinsics

GAUSS_NEWTON_STEPS = 3
"""The profile fit starts from the gradient centroid, within 0.2 px; it converges in three."""
INNER_PRIOR = 0.0025
"""Weight of the prior on the pattern's brightness: (noise / step)^2 for a noise of 5 %."""
LINE_STEPS = 4
"""Reweighted line fits; the inliers of straight edges no longer change after three."""


PASSES = 3
"""Resample about the refined lines this often; the first start is up to 1 px off."""
PROFILES = 28
"""Gray profiles per side; closer than 1.3 px they share their noise."""
SAMPLES = 15
"""Samples per profile, about every half pixel."""
HALF_WINDOW_PX = 3.5
"""Longest reach of a profile to either side [px]: 2 sigma of a strong blur (1.7 px)."""
MIN_HALF_WINDOW_PX = 1.8
"""Shortest reach [px]; below it the start's own error leaves the window."""
INNER_SHARE = 1.0
"""Reach of a profile in widths of the black border: what lies behind is modelled, not clean."""
CLEAR_SHARE = 0.7
"""Reach of a profile in widths of the white gap, behind which the next tag begins."""
CORNER_CUT_PX = 2.5
"""Stretch at the ends of a side that is not sampled [px]: blur rounds the corner there."""
CORNER_CUT_SHARE = 0.06
"""The same as a share of the side; the larger of the two counts."""
OUTLIER_SIGMAS = 3.0
"""Edge points further than this many robust standard deviations off the line are dropped."""
RESIDUAL_FLOOR_PX = 0.02
"""Least robust standard deviation [px]; keeps perfect images from dropping good points."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RefinedQuads:
    """Corners from edges, and how well the edges were seen."""

    corners_px: Array
    """(n, 4, 2) [px]."""
    residual_px: Array
    """(n,) RMS distance of the edge points that carry the lines [px]."""
    inlier_share: Array
    """(n,) share of the profiles that carry a line, worst side."""
    contrast: Array
    """(n,) median step of the profiles [gray levels of 255]."""
    sharpness_px: Array
    """(n,) median sigma of the Gaussian-blurred edge [px]; small is sharp."""
    corner_sd_px: Array
    """(n,) predicted 1-sigma of a corner, both axes together [px]."""


def refine_quads(
    gray: UInt8,
    quads: Array,
    clear: tuple[float, float],
    intrinsics: CameraIntrinsics | None = None,
    corner_cut_px: float = CORNER_CUT_PX,
) -> RefinedQuads:
    """Return the corners of dark quadrilaterals on white, to a few hundredths of a pixel.

    Args:
        gray: (H, W) image.
        quads: (n, 4, 2) rough corners, clockwise as seen [px].
        clear: widths of the uniform band inside and outside the edge, in units of the edge.
        intrinsics: with them, lines are fitted in undistorted coordinates. Without, an edge bent
            by the lens is taken for straight: 60 px long at the border of a k1 = -0.1 lens it
            sags by about 0.05 px.
        corner_cut_px: least stretch at the ends of a side that is not sampled [px].
    """
    image = gray.astype(np.float64)
    corners = np.array(quads, dtype=np.float64)
    how = (intrinsics, corner_cut_px)
    measured = _measure(image, corners, None, clear, PROFILES // 2, how)
    for k in range(1, PASSES):
        profiles, blur = PROFILES if k == PASSES - 1 else PROFILES // 2, measured.sharpness_px
        measured = _measure(image, measured.corners_px, blur, clear, profiles, how)
    return measured


def _measure(
    image: Array,
    corners: Array,
    blur: Array | None,
    clear: tuple[float, float],
    profiles: int,
    how: tuple[CameraIntrinsics | None, float],
) -> RefinedQuads:
    """Run one pass: profiles across the sides of `corners`, edge points, lines, intersections."""
    intrinsics, corner_cut_px = how
    start, along, outward, s, depth = _sides(corners, profiles, corner_cut_px)
    reach = np.minimum(INNER_SHARE * clear[0], CLEAR_SHARE * clear[1]) * depth
    reach = np.clip(reach, MIN_HALF_WINDOW_PX, HALF_WINDOW_PX)
    t = np.linspace(-1.0, 1.0, SAMPLES) * reach[..., None]
    foot = start[..., None, :] + s[..., None] * along[..., None, :]
    where = foot[..., None, :] + t[..., None, :, None] * outward[..., None, None, :]
    shift, step, blur = fit_blurred_steps(t, bilinear(image, where), clear[0] * depth, blur)
    seen = (np.abs(shift) < 0.9 * reach[..., None]) & (step > 0.3 * np.median(step, -1)[..., None])
    points = foot + shift[..., None] * outward[..., None, :]
    ideal = straighten(intrinsics, points)
    center, normal, weight, rms = fit_lines(ideal, seen)
    met, sine = line_intersections(np.roll(center, 1, 1), np.roll(normal, 1, 1), center, normal)
    met = bend(intrinsics, met)
    return RefinedQuads(
        corners_px=met,
        residual_px=np.sqrt(np.mean(rms**2, -1)),
        inlier_share=weight.mean(-1).min(-1),
        contrast=np.median(step, axis=(1, 2)),
        sharpness_px=blur,
        corner_sd_px=_corner_sd(s, weight, rms, sine),
    )


def _sides(
    corners: Array, profiles: int, corner_cut_px: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Return start, direction, outward normal, profile feet (n, 4, m) and depth (n, 4) of sides."""
    start, end = corners, np.roll(corners, -1, axis=1)
    length = np.maximum(np.linalg.norm(end - start, axis=-1), 1e-9)
    along = (end - start) / length[..., None]
    outward = np.stack([along[..., 1], -along[..., 0]], -1)
    opposite = (np.roll(corners, -2, axis=1) + np.roll(corners, -3, axis=1)) / 2
    depth = np.abs(np.sum((opposite - start) * outward, -1))
    cut = np.maximum(corner_cut_px, CORNER_CUT_SHARE * length)
    cut = np.minimum(cut, 0.35 * length)
    share = np.linspace(0.0, 1.0, profiles)
    s = cut[..., None] + (length - 2 * cut)[..., None] * share
    return start, along, outward, s, depth


def bilinear(image: Array, where: Array) -> Array:
    """Return the image at pixels (..., 2) between pixel centres; the border is repeated.

    Written out because the fixed-point remap of image libraries rounds positions to 1/32 px.
    """
    height, width = image.shape
    x = np.clip(where[..., 0], 0, width - 1.000001)
    y = np.clip(where[..., 1], 0, height - 1.000001)
    column, row = x.astype(np.intp), y.astype(np.intp)
    a, b = x - column, y - row
    flat, k = image.ravel(), row * width + column
    top = flat[k] * (1 - a) + flat[k + 1] * a
    bottom = flat[k + width] * (1 - a) + flat[k + width + 1] * a
    return top * (1 - b) + bottom * b


def fit_blurred_steps(
    t: Array, gray: Array, border: Array, blur: Array | None
) -> tuple[Array, Array, Array]:
    """Return where each profile steps from the black border to the white gap.

    The model is `low + step * Phi(z) + inner * Phi(-z - border / blur)`, z = (t - shift) / blur:
    the third term is the tag's pattern, which shines through where the border is only a few pixels
    wide (without it a 3 px border moves the edge outwards by 0.08 px). One blur is used for the
    whole tag, the median of a first fit with a free one: that halves the noise of the shift.

    Args:
        t: (n, 4, l) positions along the profiles [px].
        gray: (n, 4, m, l) gray levels there.
        border: (n, 4) width of the black border [px].
        blur: (n,) blur [px] of an earlier fit, None to find it.

    Returns:
        shift (n, 4, m) [px], step (n, 4, m) [gray levels], blur (n,) [px].
    """
    gradient = np.maximum(np.diff(gray, axis=-1), 0.0)
    middle = ((t[..., 1:] + t[..., :-1]) / 2)[..., None, :]
    shift = (gradient * middle).sum(-1) / np.maximum(gradient.sum(-1), 1e-9)
    low, high = gray[..., :2].mean(-1), gray[..., -2:].mean(-1)
    p = np.stack([shift, low, high - low, np.zeros_like(low), np.ones_like(low)], -1)
    if blur is None:
        p = _gauss_newton(t, gray, border, p, free_blur=True)
        return p[..., 0], p[..., 2], np.median(p[..., 4], axis=(1, 2))
    p[..., 4] = blur[:, None, None]
    p = _gauss_newton(t, gray, border, p, free_blur=False)
    return p[..., 0], p[..., 2], blur


def _gauss_newton(t: Array, gray: Array, border: Array, p: Array, *, free_blur: bool) -> Array:
    """Return (shift, low, step, inner, blur) (..., 5) after Gauss-Newton on every profile."""
    from scipy.special import ndtr

    n = 5 if free_blur else 4
    p = p.copy()
    reach, t, border = t[..., -1:], t[..., None, :], border[..., None, None]
    for _ in range(GAUSS_NEWTON_STEPS):
        shift, low, step, inner, blur = (p[..., k : k + 1] for k in range(5))
        z = (t - shift) / blur
        behind = -(t - shift + border) / blur
        edge, pattern = ndtr(z), ndtr(behind)
        d_edge = step * np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
        d_pattern = inner * np.exp(-0.5 * behind * behind) / np.sqrt(2 * np.pi)
        r = gray - low - step * edge - inner * pattern
        columns = [(d_pattern - d_edge) / blur, np.ones_like(z), edge, pattern]
        if free_blur:
            columns.append(-(d_edge * z + d_pattern * behind) / blur)
        J = np.stack(columns, -1)
        Jt = np.swapaxes(J, -1, -2)
        H, g = Jt @ J, (Jt @ r[..., None])[..., 0]
        # The pattern is seldom in view: a weak prior (0 +- the step, noise of 5 %) holds it then.
        H[..., 3, 3] += INNER_PRIOR
        g[..., 3] -= INNER_PRIOR * p[..., 3]
        # A relative damping keeps profiles without an edge finite; on real edges it is nothing.
        H += (1e-6 * np.trace(H, axis1=-2, axis2=-1)[..., None, None] + 1e-9) * np.eye(n)
        change = np.linalg.solve(H, g[..., None])[..., 0]
        p[..., 0] = np.clip(p[..., 0] + np.clip(change[..., 0], -1.0, 1.0), -reach, reach)
        p[..., 1:4] += change[..., 1:4]
        if free_blur:
            p[..., 4] = np.clip(p[..., 4] + np.clip(change[..., 4], -0.5, 0.5), 0.3, 4.0)
    return p


def fit_lines(points: Array, usable: Mask) -> tuple[Array, Array, Array, Array]:
    """Return total-least-squares lines through edge points, outliers dropped.

    Args:
        points: (..., m, 2) edge points [px].
        usable: (..., m) points that may carry the line.

    Returns:
        A point (..., 2) on the line, its unit normal (..., 2), weights (..., m) 0 or 1, and the
        RMS distance (...) of the points that carry it [px].
    """
    weight = usable.astype(np.float64)
    center, normal = points.mean(-2), np.zeros((*points.shape[:-2], 2))
    distance = np.zeros(points.shape[:-1])
    for _ in range(LINE_STEPS):
        total = np.maximum(weight.sum(-1), 1e-9)[..., None]
        center = (weight[..., None] * points).sum(-2) / total
        d = points - center[..., None, :]
        C = np.swapaxes(d, -1, -2) @ (weight[..., None] * d)
        normal = np.linalg.eigh(C)[1][..., 0]
        distance = (d * normal[..., None, :]).sum(-1)
        # The median over the usable points; a side without any gets infinity and keeps none.
        ranked = np.sort(np.where(usable, np.abs(distance), np.inf), axis=-1)
        half = (usable.sum(-1, keepdims=True) // 2).clip(max=usable.shape[-1] - 1)
        median = np.take_along_axis(ranked, half, axis=-1)[..., 0]
        scale = np.maximum(MAD_TO_SIGMA * median, RESIDUAL_FLOOR_PX)
        inside = np.abs(distance) <= OUTLIER_SIGMAS * scale[..., None]
        weight = (usable & inside).astype(np.float64)
    rms = np.sqrt((weight * distance**2).sum(-1) / np.maximum(weight.sum(-1) - 2, 1.0))
    return center, normal, weight, rms


def line_intersections(
    center1: Array, normal1: Array, center2: Array, normal2: Array
) -> tuple[Array, Array]:
    """Return where lines (point, unit normal) meet (..., 2), and the sine of their angle (...)."""
    c1, c2 = (normal1 * center1).sum(-1), (normal2 * center2).sum(-1)
    det = normal1[..., 0] * normal2[..., 1] - normal1[..., 1] * normal2[..., 0]
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)
    x = (c1 * normal2[..., 1] - c2 * normal1[..., 1]) / det
    y = (normal1[..., 0] * c2 - normal2[..., 0] * c1) / det
    return np.stack([x, y], -1), np.abs(det)


def _corner_sd(s: Array, weight: Array, rms: Array, sine: Array) -> Array:
    """Return the predicted corner error (n,) [px], both axes together.

    A line through k points with scatter r has at its end, a distance l from their mean, the
    variance r^2 (1/k + l^2 / sum (s - mean)^2); two lines meet at an angle with the given sine.
    """
    k = np.maximum(weight.sum(-1), 1.0)
    mean = (weight * s).sum(-1) / k
    spread = np.maximum((weight * (s - mean[..., None]) ** 2).sum(-1), 1e-9)
    variance = rms**2 * (1 / k + mean**2 / spread)
    both = variance + np.roll(variance, 1, axis=1)
    return np.sqrt(np.mean(both / sine**2, -1))


def straighten(intrinsics: CameraIntrinsics | None, uv: Array) -> Array:
    """Return undistorted pixels (..., 2); as they are where the lens has no model or inverse."""
    if intrinsics is None:
        return uv
    xy, valid = undistort(intrinsics, uv)
    ideal = xy * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]
    return np.where(valid[..., None], ideal, uv)


def bend(intrinsics: CameraIntrinsics | None, uv: Array) -> Array:
    """Return the pixels (..., 2) at which the lens shows undistorted ones."""
    if intrinsics is None:
        return uv
    f, c = np.array([intrinsics.fx, intrinsics.fy]), np.array([intrinsics.cx, intrinsics.cy])
    return distort(intrinsics.distortion, (uv - c) / f) * f + c
