"""Bundle adjustment with pose priors: cameras start at the robot's poses and are drawn to them.

Minimised over cameras T_i, points X_p and one hand-eye correction xi (all right perturbations):

    sum_k rho(|project(T_i^-1 X_p) - uv_k|^2 / s^2)
  + sum_i rho(|log(exp(-xi) P_i^-1 T_i)|^2 over the robot's sigmas) + |xi|^2 over the hand-eye's

rho is Cauchy's loss, by re-weighting; the points are eliminated (Schur complement), as in Triggs et
al., "Bundle Adjustment - A Modern Synthesis", section 6. COLMAP's own adjuster knows priors of
positions only, and no error that all cameras share.

How much the pictures really know: correlated observations, and two halves of the scene compared.

The residuals of a bundle adjustment are smaller than the errors, because cameras and points were
fitted to them, and neighbours on one texture err alike: a thousand matches on wood are not a
thousand measurements. Both are inflated from the residuals themselves. What they cannot show (a
lens that is wrong everywhere, features that slide with the direction of view) shows up where two
halves of the scene, each by itself, move the cameras differently.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim.geometry.camera import project, projection_jacobian
from realsim.geometry.robust import mad_sigma
from realsim.scanning.sfm.config import MappingConfig, RobotNoise
from realsim.scanning.sfm.result import Geometry

LEAST_SIGMA_PX = 0.1
"""No photograph is measured better than this [px]."""
DAMPING = 1e-6
"""Levenberg-Marquardt damping relative to the diagonal."""
LARGEST_DAMPING = 1e3
"""Beyond it no step lowers the cost any more."""
TOLERANCE = 1e-7
"""Relative change of the cost at which the adjustment ends."""
CAUCHY = 3.0
"""Sigmas at which Cauchy's loss gives a prior half of its weight."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Bundle:
    """An adjusted geometry and what is known of it."""

    geometry: Geometry
    hand_eye_twist: Array
    """(6,) shared correction right of the robot's camera poses [rad, m]."""
    covariance: Array
    """(6 V + 6, 6 V + 6) of the cameras' right perturbations, then of the hand-eye's."""
    sigma_px: float
    """Robust 1-sigma of the reprojection errors along each axis, raised for what was fitted and for
    neighbours that err alike."""
    prior_factor: float
    """By how much the robot's sigmas were raised, 1 or more."""


def adjust(geometry: Geometry, priors: Array, noise: RobotNoise, config: MappingConfig) -> Bundle:
    """Adjust cameras and points with the robot's poses as priors; the scale is theirs.

    Args:
        geometry: cameras, points and observations; points seen once or behind a camera are not
            expected.
        priors: (V, 4, 4) the robot's camera poses P_i [m].
        noise: their sigmas; raised by the robust spread where the views disagree more.
        config: loss and iterations.
    """
    state, twist = geometry, np.zeros(6)
    damping, factor = DAMPING, 1.0
    weights = _weights(state, priors, twist, noise, config)
    cost = _cost(state, priors, twist, noise, weights)
    system: tuple[Any, ...] | None = None
    for _ in range(config.iterations):
        weights = _weights(state, priors, twist, noise, config)
        factor = weights[3]
        cost = _cost(state, priors, twist, noise, weights)
        system = _system(state, priors, twist, noise, weights)
        improved, change = False, 0.0
        while not improved and damping < LARGEST_DAMPING:
            step = _solve(system, damping)
            trial, trial_twist = _moved(state, step), twist + step[0][-6:]
            new = _cost(trial, priors, trial_twist, noise, weights)
            improved = bool(np.isfinite(new) and new <= cost)
            damping = max(DAMPING, damping / 10) if improved else damping * 10
            if improved:
                state, twist = trial, trial_twist
                change = (cost - new) / max(cost, 1e-300)
        if not improved or change < TOLERANCE:
            break
    weights = _weights(state, priors, twist, noise, config)
    S = _schur(_system(state, priors, twist, noise, weights), 0.0)[0]
    return Bundle(
        geometry=state,
        hand_eye_twist=twist,
        covariance=np.linalg.inv(S).astype(np.float64),
        sigma_px=weights[2],
        prior_factor=factor,
    )


def picture_information(geometry: Geometry, config: MappingConfig) -> Array:
    """Return what the pictures alone say of the cameras (6 V, 6 V), the points eliminated.

    Args:
        geometry: cameras, points and observations at their best fit.
        config: loss.
    """
    priors, twist, noise = geometry.Ts_world_cam, np.zeros(6), RobotNoise()
    w_obs, w_prior, sigma, factor = _weights(geometry, priors, twist, noise, config)
    weights = (w_obs, np.zeros_like(w_prior), sigma, factor)
    return _schur(_system(geometry, priors, twist, noise, weights), 0.0)[0][:-6, :-6]


def reprojection_errors(geometry: Geometry) -> Array:
    """Return projection minus observation (K, 2) [px]; NaN behind the camera."""
    local = _local(geometry)
    return project(geometry.intrinsics, local) - geometry.uv_px


def point_covariances(geometry: Geometry, sigma_px: float) -> Array:
    """Return the covariance (P, 3, 3) of each point [m^2], cameras taken as right."""
    _, J_point = _jacobians(geometry)
    H = np.zeros((len(geometry.points), 3, 3))
    np.add.at(H, geometry.points_of, np.einsum("kai,kaj->kij", J_point, J_point))
    return (np.linalg.pinv(H, hermitian=True) * sigma_px**2).astype(np.float64)


def robust_sigma(residuals_px: Array) -> float:
    """Return the robust 1-sigma of reprojection errors (K, 2) along each axis [px]."""
    finite = residuals_px[np.isfinite(residuals_px)]
    return max(LEAST_SIGMA_PX, mad_sigma(finite))


def _local(geometry: Geometry) -> Array:
    """Return every observed point (K, 3) in its camera."""
    T = geometry.Ts_world_cam[geometry.cameras_of]
    away = geometry.points[geometry.points_of] - T[:, :3, 3]
    return np.einsum("kji,kj->ki", T[:, :3, :3], away)


def _jacobians(geometry: Geometry) -> tuple[Array, Array]:
    """Return d uv / d camera (K, 2, 6) and d uv / d point (K, 2, 3)."""
    local = _local(geometry)
    safe = np.where(local[:, 2:] > 1e-6, local, [0.0, 0.0, 1.0])
    _, d_local, _ = projection_jacobian(geometry.intrinsics, safe)
    # T exp([w v]): the point in the camera moves by -v - w x p = hat(p) w - v.
    d_twist = np.concatenate([se3.hat(safe), -np.broadcast_to(np.eye(3), (len(safe), 3, 3))], -1)
    R = geometry.Ts_world_cam[geometry.cameras_of, :3, :3]
    return d_local @ d_twist, d_local @ np.swapaxes(R, 1, 2)


def _prior_residuals(geometry: Geometry, priors: Array, twist: Array, noise: RobotNoise) -> Array:
    """Return log(exp(-xi) P^-1 T) (V, 6) in the robot's sigmas."""
    e = se3.log(se3.exp(-twist) @ se3.invert(priors) @ geometry.Ts_world_cam)
    return e / prior_sigmas(noise)


def prior_sigmas(noise: RobotNoise) -> Array:
    """Return the sigmas (6,) of a robot's camera pose, rotation first [rad, m]."""
    return np.repeat([np.radians(noise.rotation_deg), noise.position_mm / 1e3], 3)


def hand_eye_sigmas(noise: RobotNoise) -> Array:
    """Return the sigmas (6,) of the constant hand-eye error, rotation first [rad, m]."""
    return np.repeat([np.radians(noise.hand_eye_deg), noise.hand_eye_mm / 1e3], 3)


def _weights(
    geometry: Geometry, priors: Array, twist: Array, noise: RobotNoise, config: MappingConfig
) -> tuple[Array, Array, float, float]:
    """Return the weights of observations (K,) and priors (V,), sigma [px], and prior factor."""
    r = reprojection_errors(geometry)
    sigma = robust_sigma(r)
    square = np.square(np.nan_to_num(r, nan=1e3)).sum(-1)
    robust = 1 / (1 + square / max(config.robust_px, sigma) ** 2)
    # Fitted and correlated residuals count for less than their number says.
    sigma *= float(np.sqrt(variance_inflation(geometry, r, robust)))
    w_obs = robust / sigma**2
    e = _prior_residuals(geometry, priors, twist, noise)
    factor = max(1.0, mad_sigma(e))
    w_prior = 1 / (1 + np.square(e / factor).mean(-1) / CAUCHY**2) / factor**2
    return w_obs, w_prior, sigma, factor


def _cost(
    geometry: Geometry,
    priors: Array,
    twist: Array,
    noise: RobotNoise,
    weights: tuple[Array, Array, float, float],
) -> float:
    """Return the weighted sum of squares."""
    r = np.nan_to_num(reprojection_errors(geometry), nan=1e3)
    e = _prior_residuals(geometry, priors, twist, noise)
    shared = twist / hand_eye_sigmas(noise)
    return float(weights[0] @ np.square(r).sum(-1) + weights[1] @ np.square(e).sum(-1)
                 + shared @ shared)  # fmt: skip


def _system(
    geometry: Geometry,
    priors: Array,
    twist: Array,
    noise: RobotNoise,
    weights: tuple[Array, Array, float, float],
) -> tuple[Any, ...]:
    """Return the normal equations: U (n, n), V (P, 3, 3), W (sparse n x 3P), and both gradients."""
    from scipy.sparse import coo_matrix

    w_obs, w_prior, _, _ = weights
    views, count = len(geometry.names), len(geometry.points)
    n = 6 * views + 6
    cam, pt = geometry.cameras_of, geometry.points_of
    J, Jp = _jacobians(geometry)
    r = np.nan_to_num(reprojection_errors(geometry), nan=0.0)
    blocks = np.zeros((views, 6, 6))
    g_cam = np.zeros((views, 6))
    np.add.at(blocks, cam, np.einsum("k,kai,kaj->kij", w_obs, J, J))
    np.add.at(g_cam, cam, np.einsum("k,kai,ka->ki", w_obs, J, r))
    V, g_pt = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(V, pt, np.einsum("k,kai,kaj->kij", w_obs, Jp, Jp))
    np.add.at(g_pt, pt, np.einsum("k,kai,ka->ki", w_obs, Jp, r))
    cross = np.einsum("k,kai,kaj->kij", w_obs, J, Jp)
    rows = (6 * cam[:, None, None] + np.arange(6)[:, None]).repeat(3, axis=2)
    columns = (3 * pt[:, None, None] + np.arange(3)[None, :]).repeat(6, axis=1)
    W = coo_matrix((cross.ravel(), (rows.ravel(), columns.ravel())), shape=(n, 3 * count)).tocsr()

    e = _prior_residuals(geometry, priors, twist, noise)
    s = prior_sigmas(noise)
    U, g = np.zeros((n, n)), np.zeros(n)
    shared = slice(6 * views, n)
    for i in range(views):
        own = slice(6 * i, 6 * i + 6)
        # exp(-xi) P^-1 T is near the identity, where the derivatives are I and -I.
        A = np.diag(w_prior[i] / s**2)
        U[own, own] = blocks[i] + A
        U[own, shared] = U[shared, own] = -A
        U[shared, shared] += A
        g[own] = g_cam[i] + w_prior[i] * e[i] / s
        g[shared] -= w_prior[i] * e[i] / s
    h = hand_eye_sigmas(noise)
    U[shared, shared] += np.diag(1 / h**2)
    g[shared] += twist / h**2
    return U, V, W, g, g_pt


def _schur(system: tuple[Any, ...], damping: float) -> tuple[Array, Array, Any, Array]:
    """Return S = U - W V^-1 W^T, its right side, W V^-1 (sparse), and V^-1."""
    from scipy.sparse import bsr_matrix

    U, V, W, g, g_pt = system
    diagonal = np.einsum("pii->pi", V)
    V = V + np.einsum(
        "pi,ij->pij", damping * diagonal + 1e-9 * diagonal.max(initial=1.0), np.eye(3)
    )
    inverse = np.linalg.inv(V)
    count = len(V)
    block = bsr_matrix(
        (inverse, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)
    )
    WV = W @ block
    S = U + damping * np.diag(np.diag(U)) - (WV @ W.T).toarray()
    return S, g - WV @ g_pt.ravel(), WV, inverse


def _solve(system: tuple[Any, ...], damping: float) -> tuple[Array, Array]:
    """Return the step of the cameras and the hand-eye (n,) and of the points (P, 3)."""
    S, right, _, inverse = _schur(system, damping)
    cameras: Array = -np.linalg.solve(S, right).astype(np.float64)
    _, _, W, _, g_pt = system
    points = -np.einsum("pij,pj->pi", inverse, g_pt + (W.T @ cameras).reshape(-1, 3))
    return cameras, points


def _moved(geometry: Geometry, step: tuple[Array, Array]) -> Geometry:
    """Return the geometry after a step."""
    cameras, points = step
    Ts = geometry.Ts_world_cam @ se3.exp(cameras[:-6].reshape(-1, 6))
    return replace(geometry, Ts_world_cam=Ts, points=geometry.points + points)


# --- what the pictures really know ---------------------------------------------------------------


CELLS_ACROSS = 8
"""Cells along the longer side of an image within which errors count as one texture's."""
LEAST_FREEDOM = 0.1
"""Observations less unknowns, over observations, at least: below it the residuals say nothing."""
BLOCKS = 3
"""The scene is halved so often into blocks of equal numbers of points: 8 blocks, 4 to each half."""


def variance_inflation(geometry: Geometry, residuals_px: Array, weights: Array) -> float:
    """Return by what factor the variance of independent, unfitted errors is to be raised, >= 1.

    The first part is n / (n - u) of n numbers and u unknowns; the second is the design effect of
    clusters (Kish 1965), sum_g |sum_k w r|^2 / sum_k |w r|^2 over the cells g of every image.

    Args:
        geometry: what was adjusted.
        residuals_px: (K, 2) of the adjusted geometry [px].
        weights: (K,) robust weights.
    """
    use = np.isfinite(residuals_px[:, 0]) & np.isfinite(residuals_px[:, 1])
    numbers = 2 * int(use.sum())
    unknowns = 3 * len(np.unique(geometry.points_of[use])) + 6 * len(geometry.names)
    freedom = max(1 - unknowns / max(numbers, 1), LEAST_FREEDOM)
    size = max(geometry.intrinsics.width, geometry.intrinsics.height) / CELLS_ACROSS
    cell = np.floor(np.clip(geometry.uv_px / size, 0, CELLS_ACROSS - 1)).astype(np.int64)
    group = (geometry.cameras_of * CELLS_ACROSS + cell[:, 0]) * CELLS_ACROSS + cell[:, 1]
    pulls = np.where(use, weights, 0.0)[:, None] * np.where(use[:, None], residuals_px, 0.0)
    sums = np.stack([np.bincount(group, pulls[:, a]) for a in (0, 1)])
    single = float(np.square(pulls).sum())
    effect = float(np.square(sums).sum()) / single if single > 0 else 1.0
    return max(1.0, effect) / freedom


def halves(geometry: Geometry) -> tuple[Geometry, Geometry]:
    """Return the geometry with one half of its points and with the other, block by block in space.

    Neighbouring points share their errors, so a random half would agree with the other one.
    """
    count = len(geometry.points)
    block, parity = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    for _ in range(BLOCKS):
        block = _split(geometry.points, block)
        # Blocks that touch across any of the cuts go to different halves.
        parity = (parity + block) % 2
    odd: Mask = parity.astype(np.bool_)
    return _with_points(geometry, np.logical_not(odd)), _with_points(geometry, odd)


def reliability(first: Array, second: Array) -> float:
    """Return the share of signal in the mean of two estimates (V, n) of one thing, 0 to 1.

    With d = s + e of either half: <d1 d2> = <s s>, <|d1 - d2|^2> / 2 = <e e>, and the mean of both
    has half of that (the split-half reliability of Spearman and Brown).
    """
    signal = float((first * second).sum())
    noise = float(np.square(first - second).sum()) / 4
    return max(signal, 0.0) / max(max(signal, 0.0) + noise, 1e-300)


def _split(points: Array, block: Int64) -> Int64:
    """Return block numbers after halving each block along its longest side."""
    finer = 2 * block
    for b in np.unique(block):
        own = np.flatnonzero(block == b)
        axis = int(np.argmax(np.ptp(points[own], axis=0)))
        order = np.argsort(points[own, axis], kind="stable")
        finer[own[order[len(own) // 2 :]]] += 1
    return finer


def _with_points(geometry: Geometry, keep: Mask) -> Geometry:
    """Return the geometry with some of its points; all cameras stay."""
    place = np.cumsum(keep) - 1
    use = keep[geometry.points_of]
    return replace(
        geometry, points=geometry.points[keep], colors=geometry.colors[keep],
        point_ids=geometry.point_ids[keep], cameras_of=geometry.cameras_of[use],
        points_of=place[geometry.points_of[use]], uv_px=geometry.uv_px[use],
    )  # fmt: skip
