"""How sure a pose is: covariance from the information matrix, and the axes nothing determines."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.registration.body import Body
from realsim.registration.solver import Fit

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class CovarianceConfig:
    """The parts of the uncertainty that the residuals do not show."""

    systematic_translation_m: float = 0.0002
    """1-sigma common to all points: camera poses and depth bias do not average out."""
    systematic_rotation_deg: float = 0.03
    """Likewise for the rotation."""
    correlation_area_px: float = 50.0
    """Pixels that share one matching window's noise: 12 200 px of a D405 hold 243 independent
    samples. 1 for independent pixels."""
    unobservable_sensitivity: float = 0.04
    """An axis along which the surface moves along its normal by less than this share of the motion
    (root mean square) is not determined: it is the facets of a round body, not its shape."""
    prior_m: float = 0.03
    """1-sigma given to such an axis, as motion of the surface: about any turn of a small body."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Uncertainty:
    """Covariance and unobservable axes of one pose."""

    covariance: Array
    """(6, 6) of the right perturbation of T_world_obj, rotation first [rad, m]."""
    unobservable: tuple[str, ...]
    """Axes that the points do not determine, in words."""
    sensitivities: tuple[float, ...]
    """(6,) root mean square cosine along each principal axis, least first."""


def uncertainty(body: Body, fit: Fit, stride: int, config: CovarianceConfig) -> Uncertainty:
    """Return how sure a fitted pose is.

    With H the information about the box centre, in units where the rotation is times the radius:
        C = k s^2 H^-1 + C_systematic,   s^2 = max(1, weighted mean of (r / sigma)^2),
        k = max(1, correlation_area / stride^2)  (points per independent sample).
    Along eigenvectors of H whose sensitivity sqrt(lambda / sum w) is too small, the prior replaces
    k s^2 / lambda. Mapped to the object's origin by the adjoint.
    """
    values, vectors, scale = _principal_axes(body, fit)
    sensitivity = _sensitivities(values, fit)
    blind = sensitivity < config.unobservable_sensitivity
    inflation = max(1.0, config.correlation_area_px / stride**2) * max(1.0, fit.variance)
    if not np.isfinite(inflation):
        inflation = 1.0
    variances = np.where(blind, config.prior_m**2, inflation / np.where(blind, 1.0, values))
    C = (vectors * variances) @ vectors.T / np.outer(scale, scale)
    floor = [np.radians(config.systematic_rotation_deg)] * 3 + [config.systematic_translation_m] * 3
    C = C + np.diag(np.square(floor))
    # T exp(xi_origin) = T c exp(xi_center) c^-1, hence xi_origin = Ad(c) xi_center.
    Ad = se3.adjoint(se3.from_translation(body.center_obj))
    C = Ad @ C @ Ad.T
    return Uncertainty(
        covariance=0.5 * (C + C.T),
        unobservable=tuple(_axis_name(vectors[:, i]) for i in np.flatnonzero(blind)),
        sensitivities=tuple(float(s) for s in sensitivity),
    )


def blind_motions(body: Body, fit: Fit, config: CovarianceConfig) -> Array:
    """Return the motions (6, K) that the points do not determine.

    They are orthonormal, about the box centre, rotation first, turns times the body's radius [m].
    """
    values, vectors, _ = _principal_axes(body, fit)
    return vectors[:, _sensitivities(values, fit) < config.unobservable_sensitivity]


def _principal_axes(body: Body, fit: Fit) -> tuple[Array, Array, Array]:
    """Return eigenvalues (6,) and vectors (6, 6) of the scaled information, and the scale (6,)."""
    radius = body.radius_m
    scale = np.array([radius, radius, radius, 1.0, 1.0, 1.0])
    values, vectors = np.linalg.eigh(fit.information / np.outer(scale, scale))
    return np.maximum(values, 0.0), vectors, scale


def _sensitivities(values: Array, fit: Fit) -> Array:
    """Return the root mean square cosine (6,) along each principal axis; 0 without points."""
    return np.sqrt(values / fit.weight) if fit.weight > 0 else np.zeros(6)


def _axis_name(vector: Array) -> str:
    """Return the principal axis (6,) in words: what moves, along which axis of the object."""
    turn, shift = vector[:3], vector[3:]
    kind, part = ("turn about", turn) if turn @ turn > 0.5 else ("shift along", shift)
    axis = part / np.linalg.norm(part)
    axis = axis * np.sign(axis[int(np.argmax(np.abs(axis)))])
    return f"{kind} ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}) of the object"
