"""How far the camera's place may be off.

Three things move it. (1) Noise: corners and the robot's repeatability, H^-1 of the fit, which also
holds the ridge of the robot's map. (2) Corner errors that are common to a view: then views, not
corners, are the independent observations, and the fits without one view each (jackknife, CR3)

    J = (n - 1) / n sum (theta_-i - theta)(theta_-i - theta)^T + H^-1 Lambda H^-1

say more than H^-1; from few views J itself is noisy and is averaged with H^-1 scaled to its size.
(3) Smooth errors of the arm that the fit does not model: an error that is the same in all tool
poses looks exactly like another place of the camera. They are considered (Schmidt): errors
e_i = B_i w, w ~ N(0, I), move the estimate by M w, M = d theta / d w, and add M M^T. B is the arm's
own basis where joints are known, its scales estimated from the views; else a generic one.
"""

import numpy as np
from numpy.typing import NDArray

from realsim_calibration.fit.linear_model import LinearFit
from realsim_calibration.fit.view_system import SHARED

Array = NDArray[np.float64]
X = slice(0, 6)


def noise_covariance(fit: LinearFit, *, independent: bool) -> Array:
    """Return the covariance (29 + p, ...) from noise, jackknifed unless corners are independent."""
    marginal: Array = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
    if independent:
        return marginal
    n = len(fit.away)
    data = np.einsum("nrc,nrd->cd", fit.view_rows, fit.view_rows)
    prior = fit.information - data
    jackknife = (n - 1) / n * fit.away.T @ fit.away + marginal @ prior @ marginal
    kappa = float(np.trace(np.linalg.solve(marginal[X, X], jackknife[X, X])) / 6)
    covariance = (jackknife + max(kappa, 1.0) * marginal) / 2
    return (covariance + covariance.T) / 2


def with_arm(covariance: Array, influence: Array) -> Array:
    """Return the covariance (29 + p, ...) with unmodelled errors of the arm considered.

    Args:
        covariance: from noise.
        influence: (29 + p, q) d theta / d w of errors with unit variance.
    """
    return covariance + influence @ influence.T


def shared(covariance: Array) -> Array:
    """Return the block (29, 29) of the shared parameters."""
    return covariance[:SHARED, :SHARED]
