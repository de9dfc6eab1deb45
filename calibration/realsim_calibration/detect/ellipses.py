"""Dots: find dark ellipses, measure their outlines to a few hundredths of a pixel.

The middle of the ellipse is not where the dot's middle is seen: perspective and the lens move it.
`outline_bias` says by how much, for a given map of the board into the image.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Mask, UInt8
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim_calibration.detect.edges import bilinear, fit_blurred_steps

NO_PATTERN_PX = 1e3
"""Distance of the next edge behind a dot's edge: beyond any profile [px]."""
MIN_OUTLINE = 6
"""Least number of pixels around a dot."""
STEPS = 8
"""Gauss-Newton from the measured outline, which is within half a pixel: converged after six."""
MAX_STEP_PX = 0.5
"""Furthest that one step moves a middle or an axis."""
DAMPING = 1e-3
"""Relative damping: radius, blur and darkness of a tiny dot are hardly told apart."""
SLOPE_SD = 0.15
"""Prior 1-sigma of the paper's slope [gray levels per px]: light falls off by 10 levels over 70 px.
Without it the slope takes up what would tell the middle, and sigma doubles."""
FIRST_NOISE = 4.0
"""Noise for the prior's weight before it is measured [gray levels]."""


MIN_RADIUS_PX = 1.8
"""Shortest half axis of a dot [px]: below it the blur has eaten it."""
MAX_AREA_SHARE = 0.02
"""Largest dot as a share of the image."""
MAX_MISFIT = 0.12
"""How far area and second moments may depart from an ellipse's; small dots are ragged."""
MAX_FLATNESS = 4.5
"""Longest half axis in shortest ones: a dot seen at 77 deg."""
WINDOWS = (0.02, 0.06, 0.18)
"""Windows of the local threshold as shares of the longer image side, small dots to large."""
THRESHOLD = 8.0
"""A dot is darker than its window's mean by this [gray levels of 255]."""
PROFILES = 32
"""Gray profiles about a dot; a multiple of four."""
SAMPLES = 13
"""Samples per profile."""
HALF_WINDOW_PX = 3.5
"""Longest reach of a profile [px]."""
MIN_HALF_WINDOW_PX = 1.5
"""Shortest reach of a profile [px]."""
RADIUS_SHARE = 0.85
"""Reach of a profile in shortest half axes: the opposite edge stays out of view."""
PASSES = 3
"""Measure about the refined outline this often."""
OUTLIER_SIGMAS = 3.0
"""Edge points further than this off the ellipse are dropped."""
RESIDUAL_FLOOR_PX = 0.03
"""Least scatter for the outlier rule [px]."""
INDEPENDENT_PX = 1.3
"""Profiles closer than this share their noise [px]; enters the predicted error alone."""
MIN_CONTRAST = 15.0
"""Least step across the outline [gray levels of 255]."""
MAX_RESIDUAL_PX = 0.6
"""Largest scatter of the outline about the ellipse [px]: beyond it the dot is covered."""
SMALL_PX = 12.0
"""Dots up to this half axis are fitted to all their pixels, larger ones by their outline, where
the gain is small and the cost is not [px]."""
MAX_APART_PX = 0.7
"""Furthest that the two fits' middles may lie apart [px]: more, and the dot is covered."""
SMOOTHING_PX = 0.8
"""Sigma of the smoothing before dots are looked for [px]: noise makes specks otherwise."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Dots:
    """Ellipses c + A (cos, sin) with symmetric A, and how well they were seen."""

    uv: Array
    """(n, 2) middles of the ellipses [px]."""
    axes: Array
    """(n, 2, 2) A [px]."""
    sd_px: Array
    """(n,) predicted 1-sigma of a coordinate [px]."""
    faults: tuple[str, ...]
    """(n,) why a dot cannot be used, '' where it can."""

    @property
    def area(self) -> Array:
        """(n,) [px^2]."""
        return np.pi * np.abs(np.linalg.det(self.axes))


def find_blobs(gray: UInt8) -> tuple[Array, Array]:
    """Return middles (n, 2) and axes (n, 2, 2) of dark ellipses in an image, roughly [px]."""
    import cv2

    found: list[tuple[float, Array, Array]] = []
    gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), SMOOTHING_PX), dtype=np.uint8)
    for window in WINDOWS:
        block = max(5, 2 * round(window * max(gray.shape) / 2) + 1)
        dark = cv2.adaptiveThreshold(
            gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, THRESHOLD
        )
        # Two levels: outlines of dark regions have no parent, outlines of holes in them have one.
        contours, tree = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        most = MAX_AREA_SHARE * gray.size
        for k, contour in enumerate(contours):
            if tree[0][k][3] >= 0 or len(contour) < MIN_OUTLINE:
                continue
            blob = _ellipse_of(cv2.moments(contour), most)
            if blob is not None:
                found.append(blob)
    found.sort(key=lambda blob: blob[0])
    middles, axes = np.zeros((0, 2)), np.zeros((0, 2, 2))
    for _, middle, A in found:
        reach = np.sqrt(abs(np.linalg.det(A)))
        if not len(middles) or np.linalg.norm(middles - middle, axis=-1).min() > 0.7 * reach:
            middles, axes = np.vstack([middles, middle]), np.vstack([axes, A[None]])
    return middles, axes


def _ellipse_of(m: dict[str, float], most: float) -> tuple[float, Array, Array] | None:
    """Return (misfit, middle, A) of the ellipse with an outline's moments, None if it is none."""
    area = m["m00"]
    if not (0.5 * np.pi * MIN_RADIUS_PX**2 < area < most):
        return None
    C = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / area
    small, large = np.linalg.eigvalsh(C)
    if small <= 0 or large > MAX_FLATNESS**2 * small:
        return None
    misfit = abs(area / (4 * np.pi * np.sqrt(small * large)) - 1)
    # The outline runs through pixel centres, so that the dot is half a pixel larger.
    axes = 2 * np.sqrt([small, large]) + 0.5
    if misfit > MAX_MISFIT or axes[0] < MIN_RADIUS_PX:
        return None
    V = np.linalg.eigh(C)[1]
    return misfit, np.array([m["m10"], m["m01"]]) / area, (V * axes) @ V.T


def refine_dots(gray: UInt8, middles: Array, axes: Array, gap: Array) -> Dots:
    """Return the dots' outlines, to a few hundredths of a pixel.

    Args:
        gray: (H, W) image.
        middles: (n, 2) rough middles [px].
        axes: (n, 2, 2) rough A of c + A (cos, sin) [px].
        gap: (n,) white space to the next dot [px].
    """
    image = gray.astype(np.float64)
    n, m = len(middles), PROFILES // 4
    uv, A = middles.copy(), axes.copy()
    angle = np.linspace(0, 2 * np.pi, 4 * m, endpoint=False)
    u = np.stack([np.cos(angle), np.sin(angle)], -1)
    blur = None
    rms, share, sd, contrast = (np.zeros(n) for _ in range(4))
    for _ in range(PASSES):
        normal = u @ np.linalg.inv(A)
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        foot = uv[:, None] + u @ A
        radius = np.linalg.eigvalsh(A)[:, 0]
        reach = np.minimum(RADIUS_SHARE * radius, 0.5 * gap)
        reach = np.clip(reach, MIN_HALF_WINDOW_PX, HALF_WINDOW_PX)
        t = np.linspace(-1.0, 1.0, SAMPLES) * reach[:, None]
        profiles = bilinear(image, foot[:, :, None] + t[:, None, :, None] * normal[:, :, None])
        t4 = np.repeat(t[:, None], 4, axis=1)
        far = np.full((n, 4), NO_PATTERN_PX)
        shift, step, blur = fit_blurred_steps(t4, profiles.reshape(n, 4, m, SAMPLES), far, blur)
        shift, step = shift.reshape(n, 4 * m), step.reshape(n, 4 * m)
        contrast = np.median(step, axis=-1)
        usable = (np.abs(shift) < 0.9 * reach[:, None]) & (step > 0.3 * contrast[:, None])
        change, weight, rms = _fit_change(u, normal, shift, usable)
        uv = uv + change[:, :2]
        A = A + _symmetric(change[:, 2:])
        share = weight.mean(-1)
        independent = np.minimum(weight.sum(-1), 2 * np.pi * radius / INDEPENDENT_PX)
        sd = rms * np.sqrt(2.0 / np.maximum(independent, 1.0))
    assert blur is not None
    faults = list(_faults(uv, middles, A, (rms, share, contrast), gray.shape))
    small = np.array([not f for f in faults], dtype=bool)
    small &= np.linalg.eigvalsh(A)[:, 1] <= SMALL_PX
    if small.any():
        k = np.flatnonzero(small)
        margin = np.clip(0.5 * gap[k], MIN_HALF_WINDOW_PX, HALF_WINDOW_PX)
        middle, outline, spread = fit_small_dots(image, uv[k], A[k], blur[k], margin)
        apart = np.linalg.norm(middle - uv[k], axis=-1)
        for i in np.flatnonzero(~(apart <= MAX_APART_PX)):
            faults[k[i]] = f"outline and inside disagree by {apart[i]:.1f} px: covered?"
        kept = apart <= MAX_APART_PX
        uv[k[kept]], A[k[kept]], sd[k[kept]] = middle[kept], outline[kept], spread[kept]
    return Dots(uv=uv, axes=A, sd_px=sd, faults=tuple(faults))


def _symmetric(c: Array) -> Array:
    """Return symmetric matrices (n, 2, 2) of xx, xy, yy (n, 3)."""
    return np.stack([np.stack([c[:, 0], c[:, 1]], -1), np.stack([c[:, 1], c[:, 2]], -1)], 1)


def _fit_change(u: Array, normal: Array, shift: Array, usable: Mask) -> tuple[Array, Array, Array]:
    """Return the change (n, 5) of middle and A that moves the outline by `shift`.

    And the weights (n, m), 0 or 1, and the RMS that remains (n,) [px].
    """
    nx, ny = normal[..., 0], normal[..., 1]
    J = np.stack([nx, ny, nx * u[:, 0], nx * u[:, 1] + ny * u[:, 0], ny * u[:, 1]], -1)
    weight = usable.astype(np.float64)
    change, residual = np.zeros((len(shift), 5)), shift
    for _ in range(3):
        Jw = J * weight[..., None]
        H = np.swapaxes(Jw, 1, 2) @ J + 1e-9 * np.eye(5)
        change = np.linalg.solve(H, np.swapaxes(Jw, 1, 2) @ shift[..., None])[..., 0]
        residual = shift - (J @ change[..., None])[..., 0]
        scale = MAD_TO_SIGMA * np.median(np.abs(residual), axis=-1, keepdims=True)
        scale = np.maximum(scale, RESIDUAL_FLOOR_PX)
        weight = (usable & (np.abs(residual) <= OUTLIER_SIGMAS * scale)).astype(np.float64)
    rms = np.sqrt((weight * residual**2).sum(-1) / np.maximum(weight.sum(-1) - 5, 1.0))
    limited = np.clip(change, -2.0, 2.0).astype(np.float64)
    return limited, weight, np.asarray(rms, dtype=np.float64)


def _faults(
    uv: Array, start: Array, A: Array, seen: tuple[Array, Array, Array], shape: tuple[int, ...]
) -> Iterator[str]:
    """Yield why each dot cannot be used, '' where it can."""
    rms, share, contrast = seen
    small, large = np.linalg.eigvalsh(A).T
    limit = np.array([shape[1] - 1, shape[0] - 1])
    for k in range(len(uv)):
        x_reach = np.linalg.norm(A[k], axis=-1)
        inside = bool(np.all(uv[k] - x_reach >= 0) and np.all(uv[k] + x_reach <= limit))
        moved = float(np.linalg.norm(uv[k] - start[k]))
        # Written as "is it good", so that a NaN is a fault.
        checks = (
            (inside, "cut by the image border"),
            (contrast[k] >= MIN_CONTRAST,
             f"low contrast: {contrast[k]:.0f} levels (at least {MIN_CONTRAST:g})"),
            (small[k] >= 0.7 * MIN_RADIUS_PX, "too small"),
            (share[k] >= 0.6, f"covered or broken: {share[k]:.0%} of its outline fits"),
            (rms[k] <= MAX_RESIDUAL_PX,
             f"outline scatters by {rms[k]:.2f} px (at most {MAX_RESIDUAL_PX:g})"),
            (moved <= 0.5 * large[k], f"outline lies {moved:.1f} px from the blob"),
        )  # fmt: skip
        yield next((reason for good, reason in checks if not good), "")


def outline_bias(to_image: Callable[[Array], Array], middles: Array, radius: Array) -> Array:
    """Return (n, 2) by how much the fitted ellipse's middle is off the image of the dot's [px].

    Args:
        to_image: the map of board points (..., 2) into pixels, lens and all.
        middles: (n, 2) the dots' middles on the board [m].
        radius: (n,) their radii [m].
    """
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    seen = to_image(middles[:, None] + radius[:, None, None] * ring)
    true = to_image(middles)
    return _conic_middles(seen - true[:, None])


def _conic_middles(points: Array) -> Array:
    """Return the middles (n, 2) of the conics that fit points (n, m, 2) about the origin.

    Least squares of a x^2 + b xy + c y^2 + d x + e y = 1.
    """
    scale = np.abs(points).max(axis=(1, 2), keepdims=True)
    x, y = np.moveaxis(points / scale, -1, 0)
    J = np.stack([x * x, x * y, y * y, x, y], -1)
    Jt = np.swapaxes(J, 1, 2)
    a, b, c, d, e = np.linalg.solve(Jt @ J, Jt.sum(-1)[..., None])[..., 0].T
    det = 4 * a * c - b * b
    return np.stack([b * e - 2 * c * d, b * d - 2 * a * e], -1) / det[:, None] * scale[:, 0]


# --- small dots ----------------------------------------------------------------------------------
#
# A blurred ellipse on a plane of paper, fitted to all pixels at once.
#
# An outline of a few pixels has no stretch that profiles could measure one by one; with all pixels
# in one fit the middle is twice as sharp. Integer pixels are pixel centres.


def fit_small_dots(
    image: Array, middles: Array, axes: Array, blur: Array, margin: Array
) -> tuple[Array, Array, Array]:
    """Return middles, axes A and predicted sigmas [px] of the ellipses of least squares.

    The model is I = p + q x + r y - D Phi(-s / blur) with s the distance from the outline, to
    first order s = (|Bd| - 1) |Bd| / |B B d|, B = A^-1, d = pixel - middle.

    Args:
        image: (H, W) gray levels.
        middles: (n, 2) middles to half a pixel [px].
        axes: (n, 2, 2) symmetric A of the outline [px].
        blur: (n,) sigma of the blurred outline [px].
        margin: (n,) how far about the outline pixels take part [px].
    """
    half = int(np.ceil(np.linalg.norm(axes, axis=-1).max() + margin.max())) + 1
    offset = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2), -1).reshape(-1, 2)
    pixel = np.rint(middles).astype(np.intp)[:, None] + offset
    x = np.clip(pixel[..., 0], 0, image.shape[1] - 1)
    y = np.clip(pixel[..., 1], 0, image.shape[0] - 1)
    level = image[y, x]
    value, V = np.linalg.eigh(axes)
    wide = (V / (value + margin[:, None])[:, None]) @ np.swapaxes(V, 1, 2)
    used = (np.linalg.norm((pixel - middles[:, None]) @ wide, axis=-1) < 1) & (x == pixel[..., 0])
    weight = (used & (y == pixel[..., 1])).astype(np.float64)
    uv, A, sigma = middles.copy(), axes.copy(), blur.copy()
    paper = np.max(level * weight, axis=-1)
    dark = paper - np.min(np.where(weight > 0, level, 255.0), axis=-1)
    # Of the plane, slopes per pixel; p at the first middle.
    plane = np.stack([paper, 0 * paper, 0 * paper], -1)
    frame = np.concatenate(
        [np.ones((*pixel.shape[:2], 1)), 1.0 * pixel - np.rint(middles)[:, None]], -1
    )
    frame = frame.astype(np.float64)
    covariance, scatter = np.zeros((len(uv), 2)), np.full(len(uv), FIRST_NOISE**2)
    for _ in range(STEPS):
        J, model = _linearised(pixel - uv[:, None], A, sigma, dark, frame, plane)
        r = (level - model) * weight
        Jt = np.swapaxes(J * weight[..., None], 1, 2)
        H = Jt @ J
        diagonal = np.einsum("nii->ni", H)
        H = H + np.eye(10) * (DAMPING * diagonal + 1e-9)[:, None]
        g = (Jt @ r[..., None])[..., 0]
        prior = scatter / SLOPE_SD**2
        H[:, [8, 9], [8, 9]] += prior[:, None]
        g[:, 8:] -= prior[:, None] * plane[:, 1:]
        inverse = np.linalg.inv(H)
        change = (inverse @ g[..., None])[..., 0]
        change[:, :6] = np.clip(change[:, :6], -MAX_STEP_PX, MAX_STEP_PX)
        uv = uv + change[:, :2]
        A = A + _symmetric(change[:, 2:5])
        sigma = np.clip(sigma + change[:, 5], 0.3, 4.0)
        dark = dark + change[:, 6]
        plane = plane + change[:, 7:]
        scatter = (r**2).sum(-1) / np.maximum(weight.sum(-1) - 10, 1.0)
        covariance = scatter[:, None] * np.einsum("nii->ni", inverse)[:, :2]
    return uv, A, np.sqrt(covariance.mean(-1))


def _linearised(
    d: Array, A: Array, sigma: Array, dark: Array, frame: Array, plane: Array
) -> tuple[Array, Array]:
    """Return the model's derivatives (n, m, 10), and the model (n, m).

    With respect to middle, A (xx, xy, yy), blur, darkness and plane.
    """
    from scipy.special import ndtr

    B = np.linalg.inv(A)
    Bd = d @ B
    q = np.maximum(np.linalg.norm(Bd, axis=-1), 1e-6)
    normal = Bd @ B
    steep = np.maximum(np.linalg.norm(normal, axis=-1), 1e-9)
    s = (q - 1) * q / steep
    normal, u = normal / steep[..., None], Bd / q[..., None]
    z = s / sigma[:, None]
    inside = ndtr(-z)
    bell = dark[:, None] * np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) / sigma[:, None]
    nx, ny, ux, uy = normal[..., 0], normal[..., 1], u[..., 0], u[..., 1]
    outline = np.stack([nx, ny, nx * ux, nx * uy + ny * ux, ny * uy], -1)
    J = np.concatenate(
        [-bell[..., None] * outline, (-bell * z)[..., None], -inside[..., None], frame], -1
    )
    model = (frame * plane[:, None]).sum(-1) - dark[:, None] * inside
    return J, model
