"""The bundle adjustment of one camera: lens, board's shape and the board's pose in every view.

    r_ij = pi_K(T_i P_j(b)) - u_ij,   cost = sum rho(|r_ij|^2 w_ij / sigma^2) + |prior residuals|^2

The globals are theta = fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 a w1 w2 w3 (the board's scale cannot be
seen by a camera alone). Every pose touches one view only, so the normal equations are solved by
Schur complement (Triggs et al., Bundle adjustment: a modern synthesis, 2000):

    S_i = Hgg_i - Hgp_i Hpp_i^-1 Hpg_i,   (sum S_i + Lambda) d = -sum (g_i - Hgp_i Hpp_i^-1 p_i)

S_i and the reduced gradient of every view are kept: they are the views' information and their
pulls, which the covariance and the fits without a view need.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.compiled import njit
from realsim.errors import DegenerateError
from realsim.geometry import point_loops, se3

CAMERA_TERMS = 12
"""fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6."""
BOARD_TERMS = 4
"""a w1 w2 w3 of `results.BoardShape`."""
GLOBALS = CAMERA_TERMS + BOARD_TERMS
ROW = GLOBALS + 6
NEAREST_M = 1e-6
"""A point nearer to the camera's plane than this [m] is behind the camera."""
MAX_STEPS = 60
"""Steps of one fit; ten are typical, a start far off takes more."""
FIRST_DAMPING = 1e-4
"""Damping of the first step, relative to the diagonal: nearly Gauss-Newton."""
MOST_DAMPING = 1e8
"""Damping at which no step helps any more: the fit has converged."""
TOLERANCE = 1e-7
"""Stop at a predicted decrease of the cost below this [sigma^2]: 3e-4 sigmas of any term."""
HUBER_SIGMAS = 3.0
"""Corners further off than this many sigma lose weight; far enough out to cost 1 % of the
information of Gaussian corners."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Observations:
    """Corners of all views, one view after the other."""

    flat: Array
    """(N, 2) where the corner is on the drawing, from the board's middle [m]."""
    uv: Array
    """(N, 2) where it was seen [px]."""
    weight: Array
    """(N,) relative inverse variance, about 1."""
    offsets: Int64
    """(views + 1,) first corner of every view."""
    half_extent_m: float
    """L of the board's shape."""
    image_size: tuple[int, int]

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.offsets) - 1

    @property
    def view(self) -> Int64:
        """(N,) view of every corner."""
        return np.repeat(np.arange(self.views), np.diff(self.offsets))

    def per_view(self, values: Array) -> Array:
        """Return the sum of (N,) values over every view (views,)."""
        return np.bincount(self.view, weights=values, minlength=self.views).astype(np.float64)

    def only_corners(self, keep: Mask) -> "Observations":
        """Return the corners of a mask (N,); views may run empty but stay."""
        counts = np.bincount(self.view[keep], minlength=self.views)
        return replace(
            self,
            flat=self.flat[keep],
            uv=self.uv[keep],
            weight=self.weight[keep],
            offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        )

    def only_views(self, keep: Mask) -> "Observations":
        """Return the views of a mask (views,)."""
        cut = self.only_corners(keep[self.view])
        counts = np.diff(self.offsets)[keep]
        return replace(cut, offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class State:
    """Everything that is estimated."""

    camera: Array
    """(12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6."""
    board: Array
    """(4,) a w1 w2 w3."""
    poses: Array
    """(views, 4, 4) the board's middle in the camera [m]."""

    @property
    def theta(self) -> Array:
        """(16,) the globals."""
        return np.concatenate([self.camera, self.board])

    def moved(self, step: Array) -> "State":
        """Return the state after a step (16,) of the globals."""
        return replace(
            self, camera=self.camera + step[:CAMERA_TERMS], board=self.board + step[CAMERA_TERMS:]
        )

    def only_views(self, keep: Mask) -> "State":
        """Return the poses of a mask (views,)."""
        return replace(self, poses=self.poses[keep])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Prior:
    """Gaussian beliefs about the globals, and which of them are free."""

    mean: Array
    """(16,) where the terms are held, and the centre of their prior."""
    sd: Array
    """(16,) 1-sigma; infinite = none. fx and fy: relative."""
    aspect_sd: float
    """1-sigma of fx / fy, relative to the ratio of the means."""
    free: Mask
    """(16,) the terms that are estimated."""

    def residuals(self, theta: Array) -> tuple[Array, Array]:
        """Return r (17,) and d r / d theta (17, 16), in sigmas."""
        scale = np.where(np.arange(GLOBALS) < 2, self.mean, 1.0)
        J = np.zeros((GLOBALS + 1, GLOBALS))
        np.fill_diagonal(J[:GLOBALS], 1 / (self.sd * scale))
        fx, fy = theta[:2]
        ratio = self.mean[1] / self.mean[0] / self.aspect_sd
        J[GLOBALS, :2] = ratio / fy, -ratio * fx / fy**2
        r = J[:, :] @ np.where(np.isfinite(self.sd), theta - self.mean, 0.0)
        r[GLOBALS] = ratio * fx / fy - 1 / self.aspect_sd
        return r, J


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LensFit:
    """A fit, and the normal equations there."""

    state: State
    sigma_px: float
    """Unit-weight 1-sigma of a coordinate that the cost was scaled with [px]."""
    residuals: Array
    """(N, 2) predicted minus seen [px]."""
    informations: Array
    """(views, 16, 16) S_i of every view, its pose eliminated."""
    gradients: Array
    """(views, 16) reduced gradient of half of every view's cost."""
    prior: Prior
    cost: float

    @property
    def prior_information(self) -> Array:
        """(16, 16) Lambda."""
        _, J = self.prior.residuals(self.state.theta)
        return J.T @ J

    def only_views(self, keep: Mask, obs: Observations) -> "LensFit":
        """Return the views of a mask (views,): where they stand, not what they alone would say."""
        return replace(
            self,
            state=self.state.only_views(keep),
            residuals=self.residuals[keep[obs.view]],
            informations=self.informations[keep],
            gradients=self.gradients[keep],
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Normal:
    """Normal equations of all views at a state."""

    residuals: Array
    H: Array
    """(views, 22, 22)."""
    g: Array
    """(views, 22)."""
    costs: Array
    """(views,) robust cost; infinite where a corner is behind the camera."""


@njit
def _accumulate(
    offsets: Int64,
    camera: Array,
    poses: Array,
    board: tuple[Array, Array, float],
    seen: tuple[Array, Array, float],
    first: int,
    normal: tuple[Array, Array, Array, Array],
) -> None:
    """Write every corner's residual; add J^T w J, J^T w r and the robust cost to its view's.

    Corners are weighted by Huber. Of the unknowns the `first` ones are taken as known.
    """
    points, flat, extent = board
    measured, precision, huber = seen
    residuals, H, g, costs = normal
    J = np.zeros((2, 22))
    for i in range(len(offsets) - 1):
        T = poses[i]
        for n in range(offsets[i], offsets[i + 1]):
            px, py, pz = points[n, 0], points[n, 1], points[n, 2]
            cx, cy, cz = point_loops.move(T, px, py, pz)
            if cz < NEAREST_M:
                costs[i] = np.inf
                continue
            x, y = cx / cz, cy / cz
            bent_x, bent_y = point_loops.bent(camera, x, y)
            xx, xy, yy, radial, den = point_loops.bent_slopes(camera, x, y)
            residuals[n, 0] = camera[0] * bent_x + camera[2] - measured[n, 0]
            residuals[n, 1] = camera[1] * bent_y + camera[3] - measured[n, 1]
            square = (residuals[n, 0] ** 2 + residuals[n, 1] ** 2) * precision[n]
            if not np.isfinite(square):
                costs[i] = np.inf
                continue
            far = np.sqrt(max(square, huber * huber))
            costs[i] += 2 * huber * far - huber * huber if square > huber * huber else square
            w = precision[n] * huber / far
            r2, u, v = x * x + y * y, flat[n, 0] / extent, flat[n, 1] / extent
            for k in range(2):
                f = camera[k]
                ideal = f * (x if k == 0 else y) / den
                a = f * (xx if k == 0 else xy) / cz
                b = f * (xy if k == 0 else yy) / cz
                c = -(x * a + y * b)
                gx = a * T[0, 0] + b * T[1, 0] + c * T[2, 0]
                gy = a * T[0, 1] + b * T[1, 1] + c * T[2, 1]
                gz = a * T[0, 2] + b * T[1, 2] + c * T[2, 2]
                J[k, k], J[k, 2 + k] = bent_x if k == 0 else bent_y, 1.0
                J[k, 4], J[k, 5], J[k, 8] = ideal * r2, ideal * r2**2, ideal * r2**3
                J[k, 6] = f * (2 * x * y if k == 0 else r2 + 2 * y * y)
                J[k, 7] = f * (r2 + 2 * x * x if k == 0 else 2 * x * y)
                for m in range(3):
                    J[k, 9 + m] = -ideal * radial * r2 ** (m + 1)
                J[k, 12] = gy * flat[n, 1]
                J[k, 13] = gz * extent * u * u
                J[k, 14] = gz * extent * u * v
                J[k, 15] = gz * extent * v * v
                J[k, 16], J[k, 17] = py * gz - pz * gy, pz * gx - px * gz
                J[k, 18] = px * gy - py * gx
                J[k, 19], J[k, 20], J[k, 21] = gx, gy, gz
                for p in range(first, 22):
                    wj = w * J[k, p]
                    g[i, p] += wj * residuals[n, k]
                    for q in range(p, 22):
                        H[i, p, q] += wj * J[k, q]
        for p in range(first, 22):
            for q in range(first, p):
                H[i, p, q] = H[i, q, p]


def shaped_points(flat: Array, board: Array, half_extent_m: float) -> Array:
    """Return points (N, 3) [m] of a drawing (N, 2) whose print has the shape (4,) a w1 w2 w3."""
    u, v = flat[:, 0] / half_extent_m, flat[:, 1] / half_extent_m
    lift = half_extent_m * (board[1] * u * u + board[2] * u * v + board[3] * v * v)
    return np.stack([flat[:, 0], flat[:, 1] * (1 + board[0]), lift], -1)


def points_in_camera(state: State, obs: Observations) -> Array:
    """Return all corners (N, 3) in camera axes [m]."""
    points = shaped_points(obs.flat, state.board, obs.half_extent_m)
    T = state.poses[obs.view]
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def _normal(state: State, obs: Observations, sigma: float, huber: float, first: int = 0) -> _Normal:
    """Return the normal equations of all views, without the first unknowns if these are known."""
    n = obs.views
    H, g, costs = np.zeros((n, ROW, ROW)), np.zeros((n, ROW)), np.zeros(n)
    residuals = np.zeros((len(obs.uv), 2))
    if not (np.all(np.isfinite(state.camera)) and state.camera[0] > 0 and state.camera[1] > 0):
        return _Normal(residuals=residuals, H=H, g=g, costs=np.full(n, np.inf))
    _accumulate(
        obs.offsets,
        np.ascontiguousarray(state.camera),
        np.ascontiguousarray(state.poses),
        (shaped_points(obs.flat, state.board, obs.half_extent_m), obs.flat, obs.half_extent_m),
        (obs.uv, obs.weight / sigma**2, huber),
        first,
        (residuals, H, g, costs),
    )
    return _Normal(residuals=residuals, H=H, g=g, costs=costs)


def _damped(H: Array, damping: Any) -> Array:
    """Return pose blocks (views, 6, 6) with damped diagonals; never singular."""
    diagonal = np.einsum("nii->ni", H)
    floor = 1e-12 * np.maximum(diagonal.max(-1, keepdims=True), 1e-12)
    extra = np.broadcast_to(np.asarray(damping).reshape(-1, 1), (len(H), 1)) * diagonal + floor
    return H + extra[:, :, None] * np.eye(6)


def _reduce(normal: _Normal, damping: float) -> tuple[Array, Array, Array]:
    """Return S_i (views, 16, 16), reduced gradients (views, 16), Hpp^-1 [Hpg p] (views, 6, 17)."""
    pose = slice(GLOBALS, ROW)
    right = np.concatenate([normal.H[:, pose, :GLOBALS], normal.g[:, pose, None]], -1)
    solved = np.asarray(
        np.linalg.solve(_damped(normal.H[:, pose, pose], damping), right), dtype=np.float64
    )
    across = normal.H[:, :GLOBALS, pose] @ solved
    S = normal.H[:, :GLOBALS, :GLOBALS] - across[:, :, :GLOBALS]
    return S, normal.g[:, :GLOBALS] - across[:, :, GLOBALS], solved


def _step(
    normal: _Normal, prior: Prior, theta: Array, damping: float
) -> tuple[Array, Array, float]:
    """Return the steps of the globals (16,) and poses (views, 6), and the decrease they promise."""
    S, s, solved = _reduce(normal, damping)
    r, J = prior.residuals(theta)
    H = S.sum(0) + J.T @ J
    g = s.sum(0) + J.T @ r
    step = np.zeros(GLOBALS)
    f = prior.free
    if f.any():
        A = H[np.ix_(f, f)]
        # Terms differ by many orders of magnitude: solve with a unit diagonal.
        scale = 1 / np.sqrt(np.maximum(np.diag(A), 1e-300))
        A = A * scale[:, None] * scale + damping * np.eye(len(A))
        step[f] = -scale * np.linalg.solve(A, scale * g[f])
    poses = -(solved[:, :, GLOBALS] + solved[:, :, :GLOBALS] @ step)
    promised = float(-(g @ step) + np.sum(solved[:, :, GLOBALS] * normal.g[:, GLOBALS:]))
    return step, poses, promised


def adjust(
    state: State, obs: Observations, prior: Prior, sigma_px: float,
    *, tolerance: float = TOLERANCE, most_steps: int = MAX_STEPS,
) -> LensFit:  # fmt: skip
    """Return the fit of least cost near a state (Levenberg-Marquardt).

    Args:
        state: where to start; every corner must lie in front of the camera.
        obs: the corners.
        prior: beliefs, and the terms that are free.
        sigma_px: 1-sigma of a coordinate of weight 1 [px].
        tolerance: predicted decrease of the cost at which it stops [sigma^2].
        most_steps: steps at most.

    Raises:
        DegenerateError: the start is invalid, or the equations are singular.
    """

    def evaluate(trial: State) -> tuple[_Normal, float]:
        equations = _normal(trial, obs, sigma_px, HUBER_SIGMAS)
        beliefs, _ = prior.residuals(trial.theta)
        return equations, float(equations.costs.sum() + beliefs @ beliefs)

    normal, cost = evaluate(state)
    if not np.isfinite(cost):
        raise DegenerateError("camera fit: the start puts corners behind the camera.")
    damping = FIRST_DAMPING
    for _ in range(most_steps):
        try:
            step, poses, promised = _step(normal, prior, state.theta, damping)
        except np.linalg.LinAlgError as error:
            raise DegenerateError(
                "camera fit: the views do not determine the lens (the equations are singular). "
                "Add views that tilt the board by 30 deg about two axes."
            ) from error
        trial = replace(state.moved(step), poses=state.poses @ se3.exp(poses))
        equations, new = evaluate(trial)
        if new <= cost:
            state, normal, cost = trial, equations, new
            damping = max(damping * 0.1, 1e-12)
        else:
            damping = max(damping * 10, 1e-6)
        if promised < tolerance or damping > MOST_DAMPING:
            break
    S, s, _ = _reduce(normal, 0.0)
    return LensFit(
        state=state, sigma_px=sigma_px, residuals=normal.residuals, informations=S, gradients=s,
        prior=prior, cost=cost,
    )  # fmt: skip


def refine_poses(
    state: State, obs: Observations, sigma_px: float, tolerance: float, most_steps: int = MAX_STEPS
) -> tuple[State, Array]:
    """Return the state with every pose refined by itself, and the views' robust costs (views,).

    The cost of a view with a corner behind the camera is infinite.
    """
    pose = slice(GLOBALS, ROW)
    damping = np.full(obs.views, FIRST_DAMPING)
    normal = _normal(state, obs, sigma_px, HUBER_SIGMAS, GLOBALS)
    for _ in range(most_steps):
        block, g = normal.H[:, pose, pose], normal.g[:, pose]
        step = -np.linalg.solve(_damped(block, damping), g[..., None])[..., 0]
        promised = -np.sum(g * step, -1)
        trial = replace(state, poses=state.poses @ se3.exp(step))
        equations = _normal(trial, obs, sigma_px, HUBER_SIGMAS, GLOBALS)
        better = equations.costs <= normal.costs
        corner = better[obs.view]
        normal = _Normal(
            residuals=np.where(corner[:, None], equations.residuals, normal.residuals),
            H=np.where(better[:, None, None], equations.H, normal.H),
            g=np.where(better[:, None], equations.g, normal.g),
            costs=np.where(better, equations.costs, normal.costs),
        )
        state = replace(state, poses=np.where(better[:, None, None], trial.poses, state.poses))
        damping = np.where(better, np.maximum(damping * 0.1, 1e-12), np.maximum(damping * 10, 1e-6))
        if np.all((promised < tolerance) | (damping > MOST_DAMPING)):
            break
    return state, normal.costs
