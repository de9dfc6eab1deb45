"""How much of the error is the robot's: estimated from the views, and bounded where they mislead.

lambda, the robot's share, maximises the marginal likelihood of the linear model. That takes corner
errors for independent. Where they are not (a print bent in a way the board's shape does not cover,
a lens model that is too simple), the likelihood blames the robot for them and unseen views are
predicted worse. Whether they are can be seen inside each view, whatever the robot did: residuals
left by a free pose are split into smooth ones (polynomials of the place on the board) and rough
ones. F = their ratio of variances is 1 for independent errors; the excess bounds lambda,

    lambda <= bound / max(F - 1 - 2 sd(F), 0),      but at least bound.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim_calibration.fit.joint_solve import JointProblem, JointState
from realsim_calibration.fit.linear_model import LinearModel
from realsim_calibration.fit.robot_error import ErrorBasis

CURVATURE_STEP = 0.3
"""Step of a logarithm for the likelihood's curvature: a third of a factor e is about its sigma."""
HIDDEN_FACTOR = 3.0
"""Constant error of an unknown arm over its errors that are linear in the pose: 2.7 for the
rotation and 1.3 for the translation of a UR with random errors of its joints and links."""
SCALE_LOG_SD = 0.7
"""1-sigma of the logarithm of the re-estimated scales: a factor of 2 either way. Of an arm's
24 or more errors a capture shows a dozen, too few to tell the size of the hidden ones alone."""
LEAST = 0.05
"""Smallest lambda: below, a robot error is invisible beside a single corner's."""
BOUND = 0.3
"""lambda where corner errors are correlated; 0.1 to 0.5 predict real unseen views alike, 1 and more
worse."""
MOST = 50.0
"""Largest lambda: a robot that is 50 times worse than the corners."""
APART_LOG_SD = 1.0
"""1-sigma of log(lambda of rotation / lambda of translation) before the views are seen."""
EVALUATIONS = 50
"""Likelihoods in one search for two numbers."""
DEGREE = 2
"""Degree of the smooth residuals' polynomials: what lenses and warped boards leave."""
MIN_SPARE = 6
"""Views with fewer coordinates left than this do not say whether corner errors are smooth."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Whiteness:
    """Whether the corner errors of a view are independent."""

    ratio: float
    """F: variance of the smooth residuals over that of the rough ones; NaN = too few corners."""
    sd: float
    """1-sigma of F for independent errors."""

    @property
    def excess(self) -> float:
        """F - 1 beyond two sigma; infinite where nothing is known."""
        if not np.isfinite(self.ratio):
            return float("inf")
        return max(self.ratio - 1.0 - 2.0 * self.sd, 0.0)


def whiteness(problem: JointProblem, state: JointState) -> Whiteness:
    """Return how far the residuals left by a free pose per view are from independent."""
    smooth = rough = 0.0
    smooth_count = rough_count = 0
    per_view = np.split(problem.rows(state), 2 * problem.starts[1:-1])
    for rows, view in zip(per_view, problem.setup.views, strict=True):
        free_pose, _ = np.linalg.qr(rows[:, :6])
        r = rows[:, -1] - free_pose @ (free_pose.T @ rows[:, -1])
        x, y = (view.xy / problem.setup.half_extent).T
        powers = [(a, b) for a in range(DEGREE + 1) for b in range(DEGREE + 1 - a)]
        terms = np.stack([x**a * y**b for a, b in powers], -1)
        S = (terms[:, None, :, None] * np.eye(2)[:, None]).reshape(len(r), -1)  # Kronecker's
        S = S - free_pose @ (free_pose.T @ S)
        u, s, _ = np.linalg.svd(S, full_matrices=False)
        u = u[:, s > 1e-6 * max(float(s[0]), 1e-12)]
        spare = len(r) - 6 - u.shape[1]
        if spare < MIN_SPARE:
            continue
        inside = float(np.sum((u.T @ r) ** 2))
        smooth, smooth_count = smooth + inside, smooth_count + u.shape[1]
        rough, rough_count = rough + float(r @ r) - inside, rough_count + spare
    if not smooth_count or rough <= 0:
        return Whiteness(ratio=float("nan"), sd=float("nan"))
    ratio = (smooth / smooth_count) / (rough / rough_count)
    return Whiteness(ratio=ratio, sd=float(np.sqrt(2 / smooth_count + 2 / rough_count)))


def largest_ratio(white: Whiteness) -> float:
    """Return the largest lambda that the corner errors allow."""
    if white.excess <= 0:
        return MOST
    return float(np.clip(BOUND / white.excess, BOUND, MOST))


def _search(deviance: Callable[[Array], float], start: Array, evaluations: int) -> Array:
    """Return the minimum by Nelder-Mead; a tenth of a logarithm is all that the views can tell."""
    from scipy.optimize import minimize

    simplex = np.vstack([start, start + np.eye(len(start))])
    options = {"xatol": 0.1, "fatol": 0.1, "maxfev": evaluations, "initial_simplex": simplex}
    return minimize(deviance, start, method="Nelder-Mead", options=options).x


def _ratio_prior(x: Array, least: float, most: float) -> tuple[Array, float]:
    """Return lambda (2,) of logarithms inside the limits, and the price of the logarithms."""
    low, high = float(np.log(least)), float(np.log(max(most, least * 1.01)))
    inside = np.clip(x, low, high)
    apart = float(x[0] - x[1]) / APART_LOG_SD
    return np.exp(inside), apart**2 + 100.0 * float(np.sum((x - inside) ** 2))


def estimate_ratio(
    model: LinearModel, basis: ErrorBasis | None, sigma: float, most: float
) -> Array:
    """Return lambda (2,) for rotation and translation of largest marginal likelihood."""

    def deviance(x: Array) -> float:
        ratio, price = _ratio_prior(x, LEAST, most)
        return model.deviance(basis, ratio, sigma) + price

    start = np.full(2, float(np.log(min(BOUND, most))))
    return _ratio_prior(_search(deviance, start, EVALUATIONS), LEAST, most)[0]


def estimate_arm(
    model: LinearModel, basis: ErrorBasis, sigma: float, fixed: float | None
) -> tuple[Array, ErrorBasis]:
    """Return lambda (2,) and the arm's basis with its angles and lengths scaled to the views.

    Four logarithms: lambda for rotation and translation, angles, lengths. The scales have a prior
    of a factor of two, so that few views leave them where arms usually are. A given lambda is held.
    """
    least, most = (fixed, fixed) if fixed else (LEAST, MOST)

    def factors(x: Array) -> Array:
        return np.repeat(np.exp(np.clip(x[2:], -7.0, 7.0)), len(basis.unit) // 2)

    def deviance(x: Array) -> float:
        ratio, price = _ratio_prior(x[:2], least, most)
        prior = float(np.sum((x[2:] / SCALE_LOG_SD) ** 2))
        return model.deviance(basis.scaled(factors(x)), ratio, sigma) + prior + price

    start = np.array([*[float(np.log(BOUND))] * 2, 0.0, 0.0])
    x = _search(deviance, start, 2 * EVALUATIONS)
    # So few errors tell their own size only roughly: E[scale^2] is above the likeliest one.
    x[2:] += [_log_variance(deviance, x, k, SCALE_LOG_SD) for k in (2, 3)]
    return _ratio_prior(x[:2], least, most)[0], basis.scaled(factors(x))


def _log_variance(deviance: Callable[[Array], float], x: Array, k: int, prior_sd: float) -> float:
    """Return the variance of logarithm k from the curvature of -2 log L there."""
    step = np.zeros(len(x))
    step[k] = CURVATURE_STEP
    bend = deviance(x + step) - 2 * deviance(x) + deviance(x - step)
    return float(min(2 * CURVATURE_STEP**2 / max(bend, 1e-6), prior_sd**2))


def estimate_scale(model: LinearModel, basis: ErrorBasis, ratio: Array, sigma: float) -> ErrorBasis:
    """Return a basis scaled to the views: the factor of largest marginal likelihood."""
    from scipy.optimize import minimize_scalar

    one = np.ones(len(basis.unit))

    def deviance(x: float) -> float:
        return model.deviance(basis.scaled(one * float(np.exp(x))), ratio, sigma)

    found = minimize_scalar(deviance, bounds=(-4.0, 4.0), method="bounded", options={"xatol": 0.1})
    return basis.scaled(one * float(np.exp(found.x)))


def _sizes(twists: Array) -> Array:
    """Return the RMS per axis of twists (..., 6): rotation [rad], translation [m]."""
    halves = (twists[..., :3], twists[..., 3:])
    return np.array([float(np.sqrt(np.mean(half**2))) for half in halves])


def unknown_arm_columns(linear: ErrorBasis, weights: Array, spread: Array) -> Array:
    """Return errors (views, 6, 78) that an unknown arm may have: what no joints can tell.

    Errors linear in the pose (72 columns), of the size that the views show, and a constant error in
    the tool's axes (6 columns), which no camera tells from another place of the camera:
    HIDDEN_FACTOR times as large.

    Args:
        linear: a basis of linear errors.
        weights: (72,) what the views say of its weights: shrunken by the ridge, so that their
            own size is too small ...
        spread: (72, 72) ... by what their covariance says.
    """
    doubt = np.einsum("nrc,cd,nrd->nr", linear.columns, spread, linear.columns)
    shown = _sizes(np.sqrt((linear.columns @ weights) ** 2 + np.maximum(doubt, 0.0)))
    prior = _sizes(np.sqrt(np.sum(linear.columns**2, -1)))
    share = np.repeat(np.minimum(shown / np.maximum(prior, 1e-15), 1.0), 3)
    constant = np.diag(HIDDEN_FACTOR * np.repeat(shown, 3))
    constant = np.broadcast_to(constant, (len(linear.columns), 6, 6))
    return np.concatenate([constant, linear.columns * share[:, None]], -1)
