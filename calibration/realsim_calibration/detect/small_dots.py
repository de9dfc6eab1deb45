"""Small dots: a blurred ellipse on a plane of paper, fitted to all pixels at once.

An outline of a few pixels has no stretch that profiles could measure one by one; with all pixels
in one fit the middle is twice as sharp. Integer pixels are pixel centres.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
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


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SmallDots:
    """Middles of dots."""

    uv: Array
    """(n, 2) [px]."""
    axes: Array
    """(n, 2, 2) A of the outline c + A (cos, sin) [px]."""
    sd_px: Array
    """(n,) predicted 1-sigma of a coordinate [px]."""


def fit_small_dots(
    image: Array, middles: Array, axes: Array, blur: Array, margin: Array
) -> SmallDots:
    """Return the ellipses of least squares.

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
        c = change[:, 2:5]
        A = A + np.stack([np.stack([c[:, 0], c[:, 1]], -1), np.stack([c[:, 1], c[:, 2]], -1)], 1)
        sigma = np.clip(sigma + change[:, 5], 0.3, 4.0)
        dark = dark + change[:, 6]
        plane = plane + change[:, 7:]
        scatter = (r**2).sum(-1) / np.maximum(weight.sum(-1) - 10, 1.0)
        covariance = scatter[:, None] * np.einsum("nii->ni", inverse)[:, :2]
    return SmallDots(uv=uv, axes=A, sd_px=np.sqrt(covariance.mean(-1)))


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
        [
            -bell[..., None] * outline,
            (-bell * z)[..., None],
            -inside[..., None],
            frame,
        ],
        -1,
    )
    model = (frame * plane[:, None]).sum(-1) - dark[:, None] * inside
    return J, model
