"""How well the lens is known: the covariance of its terms, and what it means in pixels.

Corner errors inside a view are correlated (a warped print, a blurred image, a lens the model does
not quite fit), so views and not corners are the independent observations. With H = sum S_i + Lambda
the information, S_i and g_i those of view i (its pose eliminated):

    theta_-i = theta + (H - S_i)^-1 g_i
    J   = (n - 1) / n sum (theta_-i - theta)(theta_-i - theta)^T + H^-1 Lambda H^-1
    Cov = alpha J + (1 - alpha) max(kappa, 1) H^-1,   alpha = n / (n + 4 d),   kappa = tr(H J) / d

J is the jackknife (cluster-robust, CR3). From few views it is noisy, so it is blended with the
marginal covariance of the same size; d is the number of free terms.

In pixels: a lens error that a rotation of the camera makes up for is no error of the lens (any pose
found with it absorbs the rotation), so the best-fitting rotation is taken out, as mrcal does
(mrcal.secretsauces.net, projection uncertainty).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry.camera import projection_jacobian, undistort
from realsim.records import CameraIntrinsics
from realsim_calibration.lens.bundle import CAMERA_TERMS, GLOBALS, LensFit

BLEND = 4.0
"""Views per free term at which jackknife and marginal weigh the same. Simulated joint 95 % regions
of 12 to 40 views hold 92 to 99 %; with 1 they hold 80 to 96 %, with the jackknife alone 27 to 79 %:
its inverse is too noisy."""
REFERENCE_CELLS = (16, 12)
"""Pixels across and down over which the rotation is fitted."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GlobalCovariance:
    """Covariance of the lens and the board's shape."""

    covariance: Array
    """(16, 16) of fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 a w1 w2 w3; zero rows = held."""
    inflation: float
    """kappa: the views' scatter relative to what independent corners would give, a variance."""

    @property
    def camera(self) -> Array:
        """(12, 12) the lens alone."""
        return self.covariance[:CAMERA_TERMS, :CAMERA_TERMS]

    @property
    def sd(self) -> Array:
        """(16,) 1-sigma of every global."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def global_covariance(fit: LensFit) -> GlobalCovariance:
    """Return the honest covariance of a fit's globals.

    Raises:
        DegenerateError: without one of the views the fit is not determined.
    """
    f = fit.prior.free
    block = np.ix_(f, f)
    beliefs = fit.prior_information
    H = (fit.informations.sum(0) + beliefs)[block]
    # Terms differ by many orders of magnitude: work with a unit diagonal.
    scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    each = scale[:, None] * scale
    H, beliefs = H * each, beliefs[block] * each
    S = fit.informations[:, f][:, :, f] * each
    g = fit.gradients[:, f] * scale
    n, d = len(S), int(f.sum())
    try:
        marginal = np.linalg.inv(H)
        away = np.linalg.solve(H - S, g[..., None])[..., 0]
    except np.linalg.LinAlgError as error:
        raise DegenerateError(
            "camera fit: without one of the views the lens is no longer determined. Add views that "
            "tilt the board by 30 deg about two axes."
        ) from error
    jackknife = (n - 1) / n * away.T @ away + marginal @ beliefs @ marginal
    kappa = float(np.trace(H @ jackknife) / d)
    alpha = n / (n + BLEND * d)
    cov = alpha * jackknife + (1 - alpha) * max(kappa, 1.0) * marginal
    full = np.zeros((GLOBALS, GLOBALS))
    full[block] = (cov + cov.T) / 2 * each
    return GlobalCovariance(covariance=full, inflation=kappa)


def lens_sensitivity(intrinsics: CameraIntrinsics, uv: ArrayLike) -> Array:
    """Return how pixels move with the lens, the best-fitting rotation taken out.

    Args:
        intrinsics: the lens.
        uv: (N, 2) pixels.

    Returns:
        (N, 2, 12) derivatives by fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6; NaN where the lens model
        reaches no ray.
    """
    uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    u = (np.arange(REFERENCE_CELLS[0]) + 0.5) / REFERENCE_CELLS[0] * intrinsics.width - 0.5
    v = (np.arange(REFERENCE_CELLS[1]) + 0.5) / REFERENCE_CELLS[1] * intrinsics.height - 0.5
    reference = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    turn, lens = _derivatives(intrinsics, reference)
    seen = np.isfinite(lens).all((1, 2))
    rotation, *_ = np.linalg.lstsq(
        turn[seen].reshape(-1, 3), lens[seen].reshape(-1, CAMERA_TERMS), rcond=None
    )
    turn, lens = _derivatives(intrinsics, uv)
    return lens - turn @ rotation


def _derivatives(intrinsics: CameraIntrinsics, uv: Array) -> tuple[Array, Array]:
    """Return d uv / d rotation (N, 2, 3) and d uv / d lens (N, 2, 12) of pixels (N, 2)."""
    xy, valid = undistort(intrinsics, uv)
    ray = np.concatenate([np.where(valid[:, None], xy, 0.0), np.ones((len(xy), 1))], -1)
    _, d_point, d_camera = projection_jacobian(intrinsics, ray)
    turn = np.cross(ray[:, None, :], d_point)
    d_camera[~valid] = np.nan
    return turn, d_camera


def projection_sd(intrinsics: CameraIntrinsics, covariance: Array, uv: ArrayLike) -> Array:
    """Return the 1-sigma (N,) of a pixel's coordinate [px] due to the lens, rotation removed."""
    J = lens_sensitivity(intrinsics, uv)
    variance = np.einsum("nik,kl,nil->n", J, covariance, J) / 2
    return np.sqrt(np.maximum(variance, 0.0))


def border_pixels(intrinsics: CameraIntrinsics, per_side: int = 12) -> Array:
    """Return pixels (4 per_side, 2) along the image's border, its corners among them."""
    s = np.arange(per_side) / per_side
    w, h = intrinsics.width - 1.0, intrinsics.height - 1.0
    zero, one = np.zeros(per_side), np.ones(per_side)
    sides = [(s, zero), (one, s), (1 - s, one), (zero, 1 - s)]
    return np.concatenate([np.stack([x * w, y * h], -1) for x, y in sides])


def border_effect(intrinsics: CameraIntrinsics, covariance: Array, term: int) -> float:
    """Return how far one sigma of a term moves the image's border, the others following [px].

    The others move as they co-vary with it: k1 and k2 undo what k3 does wherever there are corners,
    so what is left is what k3 does where there are none. Infinite where the lens model folds back
    inside the image.
    """
    sd = np.sqrt(covariance[term, term])
    if sd == 0:
        return 0.0
    J = lens_sensitivity(intrinsics, border_pixels(intrinsics))
    moved = np.linalg.norm(J @ (covariance[:, term] / sd), axis=-1)
    return float(moved.max()) if np.all(np.isfinite(moved)) else float("inf")
