"""The joint fit: camera, target and its shape, lens, and the robot's errors, by Gauss-Newton.

    T_cam_board,i = X^-1 D_i^-1 A_i^-1 Z             (X^-1 A_i D_i Z for a camera that stands still)
    cost = sum_ij w_ij |pi_K(T_i P_j(b)) - u_ij|^2 / sigma^2
         + sum_i |S^-1/2 (log D_i - B_i w)|^2 + |w|^2 + priors of K and b
    S = sigma^2 diag(lambda_r^2 / f^2 I, lambda_t^2 d^2 / f^2 I)

A view's points are compressed to 24 rows r_i + J_i dtheta + E_i e_i (`view_system`). With the robot
error e_i = B_i w + n_i the noise n_i of a view meets only its own rows and is eliminated,

    G_i = [J_i | E_i B_i],    H = sum_i G_i^T (1 - E_i (E_i^T E_i + S^-1)^-1 E_i^T) G_i    (sigma 1)

so that a step solves for X, Z, K, b and w alone, and each n_i follows from it. lambda bounds the
robot's share, so that corner errors that are common to a view (a warped print) are not blamed on
the robot.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim_calibration.fit.robot_error import ErrorBasis
from realsim_calibration.fit.view_system import SHARED, all_equations, all_rows, camera_vector

MOST_DAMPING = 1e6
"""A step that is still no gain with this much of the curvature added is none: the fit has ended."""
HELD_SD = 1e-3
"""Prior of a term that is held: it has no derivative in any view, so this only fills the matrix."""
FLAT = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
"""The board as drawn: scale 1, aspect 0, no warp."""


@dataclass(frozen=True, kw_only=True, slots=True)
class JointConfig:
    """Priors and steps of the joint fit."""

    robot_ratio: float | None = None
    """lambda, the robot's share in the error of a view; None = estimated (`noise_scale`)."""
    huber_sigmas: float = 4.0
    """Corners further off than this many sigma lose weight; between 2 and none: within 1 %."""
    rounds: int = 3
    """Rounds of re-estimating sigma and the corner weights."""
    start_sigma_px: float = 2.0
    """Sigma of the first fit, which has no robot errors [px]: the misfit of a closed form."""
    focal_sd: float = 0.02
    """Prior of the focal length around the given one, relative."""
    aspect_sd: float = 0.004
    """Prior of fx / fy around the given ratio, relative: sensors have square pixels."""
    center_sd: float = 0.015
    """Prior of the principal point around the given one, in image widths."""
    distortion_sd: tuple[float, ...] = (0.15, 0.25, 0.0015, 0.0015, 0.25, 0.0, 0.0, 0.0)
    """Priors of k1 k2 p1 p2 k3 k4 k5 k6 around the given ones; 0 holds a term. Wide ones let k3
    run away (-10 was seen) where the corners do not reach the border of the image."""
    scale_sd: float = 0.01
    """Prior of the board's scale around 1 (printers are off by 0.1 to 1 %); 0 holds it."""
    board_aspect_sd: float = 0.003
    """Prior of the board's aspect: a printer's two axes differ by up to 0.5 %; 0 holds it."""
    warp_sd: float = 0.01
    """Prior of a warp coefficient: 1 % of the half extent, 1.5 mm on an A4 sheet; 0 holds them."""
    max_iterations: int = 30
    """Gauss-Newton steps per round; three are typical."""
    step_tolerance: float = 1e-6
    """Relative decrease of the cost at which a round ends: the parameters move by 1e-3 sigma."""

    def board_sd(self) -> Array:
        """Return the priors (5,) of the board's shape; 0 = held."""
        return np.array([self.scale_sd, self.board_aspect_sd, *[self.warp_sd] * 3])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewCorners:
    """What one view measured."""

    index: int
    T_base_ee: Array
    """(4, 4) [m]."""
    xy: Array
    """(n, 2) points from the board's middle [m]."""
    uv: Array
    """(n, 2) points in the image [px]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Setup:
    """What does not change during the fit."""

    views: tuple[ViewCorners, ...]
    to_hand: bool
    """Whether the camera stands still and the target is in the hand."""
    middle: Array
    """(3,) middle of the board [m]: scale, aspect and warp leave it in place."""
    half_extent: float
    """L, half the board's longer side [m]."""
    intrinsics0: CameraIntrinsics
    """The lens as known before: centre of the priors."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class JointState:
    """Everything that is estimated."""

    X: Array
    Z: Array
    camera: Array
    """(12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6."""
    board: Array
    """(5,) scale, aspect, warps."""
    weights: Array
    """(p,) of the smooth robot error, in prior standard deviations."""
    errors: Array
    """(views, 6) robot errors log D_i, smooth part included, rotation first [rad, m]."""

    def moved(self, step: Array) -> "JointState":
        """Return the state after a step (29 + p,), or after several; robot errors stay."""
        return JointState(
            X=self.X @ se3.exp(step[..., :6]),
            Z=self.Z @ se3.exp(step[..., 6:12]),
            camera=self.camera + step[..., 12:24],
            board=self.board + step[..., 24:29],
            weights=self.weights + step[..., 29:],
            errors=self.errors,
        )


class JointProblem:
    """The least-squares fit of one setup; sigma, lambda and weights are arguments."""

    def __init__(self, setup: Setup, config: JointConfig) -> None:
        self.setup, self.config = setup, config
        free = [config.focal_sd > 0] * 2 + [config.center_sd > 0] * 2
        free += [sd > 0 for sd in (*config.distortion_sd, *config.board_sd())]
        self.free = np.array(free)
        """(17,) camera and board terms that are estimated."""
        self._A = np.stack([v.T_base_ee for v in setup.views])
        self._xy = np.concatenate([v.xy for v in setup.views])
        self._uv = np.concatenate([v.uv for v in setup.views])
        self.starts = np.cumsum([0, *(len(v.uv) for v in setup.views)])
        """(views + 1,) first point of every view among all points."""

    def start(self, X: Array, Z: Array) -> JointState:
        """Return the state at a closed-form solution."""
        return JointState(
            X=X, Z=Z, camera=camera_vector(self.setup.intrinsics0), board=FLAT.copy(),
            weights=np.zeros(0), errors=np.zeros((len(self.setup.views), 6)),
        )  # fmt: skip

    def _arguments(self, state: JointState, errors: Array) -> tuple[Any, ...]:
        s = self.setup
        X, Z = np.ascontiguousarray(state.X), np.ascontiguousarray(state.Z)
        return (X, Z, self._A, se3.exp(errors), s.to_hand, state.camera, state.board,
                s.half_extent, s.middle, self._xy, self._uv, self.starts)  # fmt: skip

    def poses(self, state: JointState, errors: Array) -> Array:
        """Return T_cam_board (views, 4, 4) of every view with robot errors (views, 6)."""
        AD = self._A @ se3.exp(errors)
        if self.setup.to_hand:
            return se3.invert(state.X) @ AD @ state.Z
        return se3.invert(AD @ state.X) @ state.Z

    def unit_robot_sd(self, state: JointState) -> Array:
        """Return the 1-sigma (6,) of a robot error for lambda = 1 and sigma = 1 px."""
        T = self.poses(state, np.zeros((len(self._A), 6)))
        middle = se3.transform(T, self.setup.middle[None])[..., 0, :]
        distance = float(np.median(np.linalg.norm(middle, axis=-1)))
        return np.array([1.0] * 3 + [distance] * 3) / float(state.camera[:2].mean())

    def prior(self) -> tuple[Array, Array]:
        """Return centre (17,) and covariance (17, 17) of the prior of camera and board."""
        c = self.config
        center = np.concatenate([camera_vector(self.setup.intrinsics0), FLAT])
        sd = np.concatenate([[1.0, 1.0], np.full(2, c.center_sd * self.setup.intrinsics0.width),
                             c.distortion_sd, c.board_sd()])  # fmt: skip
        covariance = np.diag(np.where(self.free, sd, HELD_SD) ** 2)
        # A common relative error of both focal lengths and an independent one of their ratio.
        if c.focal_sd > 0:
            both, ratio = c.focal_sd**2, (c.aspect_sd / 2) ** 2
            relative = np.array([[both + ratio, both - ratio], [both - ratio, both + ratio]])
            covariance[:2, :2] = relative * np.outer(center[:2], center[:2])
        return center, covariance

    def optimize(
        self, start: JointState, sigma: float, ratio: Array, roots: Array,
        basis: ErrorBasis | None,
    ) -> JointState:  # fmt: skip
        """Return the least-squares state for fixed sigma, lambda (2,), and roots of the weights.

        lambda 0 is a robot without errors.

        Raises:
            DegenerateError: the views do not determine the parameters.
        """
        noise = sigma * np.repeat(ratio, 3) * self.unit_robot_sd(start)
        p = 0 if basis is None else basis.columns.shape[-1]
        state = replace(start, weights=start.weights if len(start.weights) == p else np.zeros(p))
        if not ratio.any():
            state = replace(state, errors=np.zeros_like(state.errors))
        normal = _Normal.at(self, state, sigma, noise, roots, basis)
        damping = 0.0
        for _ in range(self.config.max_iterations):
            trial = normal.step(damping)
            moved = _Normal.at(self, trial, sigma, noise, roots, basis)
            if not moved.cost < normal.cost:
                damping = max(10 * damping, 1e-4)
                if damping > MOST_DAMPING:
                    break
                continue
            gain = (normal.cost - moved.cost) / max(normal.cost, 1e-12)
            state, normal, damping = trial, moved, damping / 10
            if gain < self.config.step_tolerance:
                break
        return state

    def ones(self) -> Array:
        """Return unit corner weights of all points."""
        return np.ones(len(self._uv))

    def rows(self, state: JointState, errors: Array | None = None) -> Array:
        """Return [xi | camera | board | residual] (2 points, 24) of all views, unweighted.

        Args:
            state: where.
            errors: (views, 6) robot errors instead of the state's.
        """
        return all_rows(*self._arguments(state, state.errors if errors is None else errors))

    def residuals(self, state: JointState, errors: Array | None = None) -> Array:
        """Return predicted minus measured (points, 2) [px] of all views, as `rows`."""
        return self.rows(state, errors)[:, -1].reshape(-1, 2)

    def equations(self, state: JointState, roots: Array) -> Array:
        """Return every view's compressed equations (views, 24, 36) at a state [px]."""
        arguments: list[Any] = [*self._arguments(state, state.errors), roots]
        rows = all_equations(*arguments)
        rows[:, :, 12:SHARED][:, :, ~self.free] = 0.0
        return rows

    def spread(
        self, state: JointState, sigma: float, ratio: Array, basis: ErrorBasis | None
    ) -> tuple[float, Array]:
        """Return the unit-weight sigma [px] and the roots (points,) of the Huber weights.

        sigma^2 = (sum w |r|^2 + sum e^T S0^-1 e) / (2 N - dim theta), S0 = S / sigma^2, e = the
        robot error beyond its smooth part.
        """
        r = np.linalg.norm(self.residuals(state), axis=-1)
        w = np.minimum(1.0, self.config.huber_sigmas * sigma / np.maximum(r, 1e-12))
        rest = state.errors - smooth_errors(basis, state.weights, len(self._A))
        robot = rest / (np.repeat(ratio, 3) * self.unit_robot_sd(state))
        freedom = max(2 * len(r) - 12 - int(self.free.sum()), 1)
        return float(np.sqrt((np.sum(w * r**2) + np.sum(robot**2)) / freedom)), np.sqrt(w)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Normal:
    """The normal equations of one state, robot noise eliminated."""

    state: JointState
    cost: float
    """Twice the negative logarithm of the density, robot errors as they are."""
    H: Array
    """(29 + p, 29 + p)."""
    g: Array
    """(29 + p,) gradient where every view's robot noise follows the rest."""
    noise_gain: Array
    """(views, 6, 24) robot noise per residual."""
    G: Array
    """(views, 24, 29 + p) derivatives of the residuals."""
    r: Array
    """(views, 24) residuals without robot noise."""
    basis: ErrorBasis | None

    @classmethod
    def at(
        cls, problem: JointProblem, state: JointState, sigma: float, noise: Array, roots: Array,
        basis: ErrorBasis | None,
    ) -> "_Normal":  # fmt: skip
        """Return the equations at a state for robot noise of 1-sigma (6,); 0 = none."""
        rows = problem.equations(state, roots) / sigma
        J, E, r = rows[..., :SHARED], rows[..., SHARED:-1], rows[..., -1]
        G = J if basis is None else np.concatenate([J, E @ basis.columns], -1)
        rest = state.errors - smooth_errors(basis, state.weights, len(E))
        robot = rest / np.where(noise > 0, noise, np.inf)
        Et = np.swapaxes(E, 1, 2)
        scaled = noise[:, None] * Et
        inner = np.eye(6) + scaled @ (E * noise)
        gain = -noise[:, None] * np.linalg.solve(inner, scaled)
        free = r - (E @ rest[..., None])[..., 0]
        pulled = np.concatenate([G, free[..., None]], -1)
        reduced = pulled + E @ (gain @ pulled)
        p = G.shape[-1]
        gram = pulled.reshape(-1, p + 1).T @ reduced.reshape(-1, p + 1)
        center, covariance = problem.prior()
        prior = np.eye(p)
        prior[:12, :12] = 0.0
        prior[12:SHARED, 12:SHARED] = np.linalg.inv(covariance)
        off = np.concatenate([np.zeros(12), state.camera, state.board, state.weights])
        off[12:SHARED] -= center
        cost = float(np.sum(r**2) + np.sum(robot**2) + off @ prior @ off)
        return cls(
            state=state, cost=cost, H=gram[:-1, :-1] + prior, g=gram[:-1, -1] + prior @ off,
            noise_gain=gain, G=G, r=free, basis=basis,
        )  # fmt: skip

    def step(self, damping: float) -> JointState:
        """Return the state after a Gauss-Newton step, its curvature raised by a share.

        Raises:
            DegenerateError: the views do not determine the parameters.
        """
        from scipy.linalg import cho_factor, cho_solve

        scale = np.sqrt(np.maximum(np.diag(self.H), 1e-300))
        H = self.H / np.outer(scale, scale) + damping * np.eye(len(scale))
        try:
            move = -cho_solve(cho_factor(H), self.g / scale) / scale
        except (np.linalg.LinAlgError, ValueError) as error:
            raise DegenerateError(
                "hand-eye: the joint fit is not determined by these views (the normal equations "
                "are singular). Add views that tilt the hand about two axes, roll it about the "
                "optical axis, and show points that are not all in one line."
            ) from error
        state = self.state.moved(move)
        noise = (self.noise_gain @ (self.r + self.G @ move)[..., None])[..., 0]
        smooth = smooth_errors(self.basis, state.weights, len(noise))
        return replace(state, errors=smooth + noise)


def smooth_errors(basis: ErrorBasis | None, weights: Array, views: int) -> Array:
    """Return B_i w (views, 6)."""
    return np.zeros((views, 6)) if basis is None else basis.columns @ weights


def shaped_points(board: Array, xy: Array, middle: Array, half_extent: float) -> Array:
    """Return points (n, 3) [m] of places (n, 2) from the middle on a board of a shape (5,)."""
    x, y = xy.T
    lift = (board[2] * x * x + board[3] * x * y + board[4] * y * y) / half_extent
    return middle + board[0] * np.stack([x, (1 + board[1]) * y, lift], -1)
