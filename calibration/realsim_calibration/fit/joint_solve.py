"""The joint fit: camera, target and its shape, lens, and the robot's errors, in one GTSAM graph.

    T_cam_board,i = X^-1 D_i^-1 A_i^-1 Z             (X^-1 A_i D_i Z for a camera that stands still)
    cost = sum_ij w_ij |pi_K(T_i P_j(b)) - u_ij|^2 / sigma^2
         + sum_i |S^-1/2 (log D_i - B_i w)|^2 + |w|^2 + priors of K and b
    S = sigma^2 diag(lambda_r^2 / f^2 I, lambda_t^2 d^2 / f^2 I)

One custom factor per view (compressed to 24 rows, `view_system`) on X, Z, K, b, D_i, and one small
factor per view that ties its robot error to the smooth part B_i w. lambda bounds the robot's share,
so that corner errors that are common to a view (a warped print) are not blamed on the robot.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim_calibration.fit.robot_error import ErrorBasis
from realsim_calibration.fit.view_system import (
    CAMERA_TERMS,
    COLUMNS,
    SHARED,
    residual_norm,
    view_equations,
    view_rows,
)

Array = NDArray[np.float64]
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
    """Levenberg-Marquardt steps per round; seven are typical."""
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
        """Return the state after a step (29 + p,); robot errors stay."""
        return JointState(
            X=self.X @ se3.exp(step[:6]),
            Z=self.Z @ se3.exp(step[6:12]),
            camera=self.camera + step[12:24],
            board=self.board + step[24:29],
            weights=self.weights + step[29:],
            errors=self.errors,
        )


def camera_vector(intrinsics: CameraIntrinsics) -> Array:
    """Return (12,) fx fy cx cy and the eight distortion terms."""
    i = intrinsics
    return np.concatenate([[i.fx, i.fy, i.cx, i.cy], i.distortion])


def camera_of(vector: Array, like: CameraIntrinsics) -> CameraIntrinsics:
    """Return the camera of a (12,) vector with the image size of another."""
    fx, fy, cx, cy = (float(v) for v in vector[:4])
    return CameraIntrinsics(
        width=like.width, height=like.height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=vector[4:]
    )


class JointProblem:
    """The graph of one calibration; sigma, lambda and the corner weights are fixed in one solve."""

    def __init__(self, setup: Setup, config: JointConfig) -> None:
        from gtsam import symbol

        self.setup, self.config = setup, config
        self.x, self.z, self.k, self.b, self.w = (symbol(c, 0) for c in "xzkbw")
        self.d = [symbol("d", n) for n in range(len(setup.views))]
        free = [config.focal_sd > 0] * 2 + [config.center_sd > 0] * 2
        free += [sd > 0 for sd in (*config.distortion_sd, *config.board_sd())]
        self.free = np.array(free)
        """(17,) camera and board terms that are estimated."""
        self._A = [np.ascontiguousarray(v.T_base_ee) for v in setup.views]

    def start(self, X: Array, Z: Array) -> JointState:
        """Return the state at a closed-form solution."""
        return JointState(
            X=X, Z=Z, camera=camera_vector(self.setup.intrinsics0), board=FLAT.copy(),
            weights=np.zeros(0), errors=np.zeros((len(self.setup.views), 6)),
        )  # fmt: skip

    def _arguments(self, n: int, X: Array, Z: Array, D: Array, camera: Array, board: Array,
                   root: Array) -> tuple[Any, ...]:  # fmt: skip
        s, v = self.setup, self.setup.views[n]
        return (X, Z, self._A[n], D, s.to_hand, camera, board, s.half_extent, s.middle, v.xy, v.uv,
                root)  # fmt: skip

    def unit_robot_sd(self, state: JointState) -> Array:
        """Return the 1-sigma (6,) of a robot error for lambda = 1 and sigma = 1 px."""
        A = np.stack(self._A)
        if self.setup.to_hand:
            T = se3.invert(state.X) @ A @ state.Z
        else:
            T = se3.invert(A @ state.X) @ state.Z
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

    def graph(
        self, start: JointState, sigma: float, ratio: Array, roots: list[Array],
        basis: ErrorBasis | None, *, robot: bool = True,
    ) -> tuple[Any, Any]:  # fmt: skip
        """Return the gtsam graph for fixed sigma, lambda (2,), corner weights, and its values."""
        import gtsam

        from realsim.interop import pose3_from_T

        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(self.x, pose3_from_T(start.X))
        values.insert(self.z, pose3_from_T(start.Z))
        values.insert(self.k, start.camera)
        values.insert(self.b, start.board)
        center, covariance = self.prior()
        for key, part in ((self.k, slice(0, CAMERA_TERMS)), (self.b, slice(CAMERA_TERMS, None))):
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance[part, part])
            graph.add(gtsam.PriorFactorVector(key, center[part], noise))
        pixel_noise = gtsam.noiseModel.Isotropic.Sigma(COLUMNS, sigma)
        robot_sd = np.repeat(ratio, 3) * sigma * self.unit_robot_sd(start)
        robot_noise = gtsam.noiseModel.Diagonal.Sigmas(robot_sd)
        if robot and basis is not None:
            p = basis.columns.shape[-1]
            values.insert(self.w, start.weights if len(start.weights) else np.zeros(p))
            one = gtsam.noiseModel.Isotropic.Sigma(p, 1.0)
            graph.add(gtsam.PriorFactorVector(self.w, np.zeros(p), one))
        for n in range(len(self.setup.views)):
            keys = [self.x, self.z, self.k, self.b]
            if robot:
                keys.append(self.d[n])
                values.insert(self.d[n], gtsam.Pose3.Expmap(start.errors[n]))
            graph.add(gtsam.CustomFactor(pixel_noise, keys, self._view_error(n, roots[n])))
            if robot and basis is None:
                graph.add(gtsam.PriorFactorPose3(self.d[n], gtsam.Pose3(), robot_noise))
            elif robot and basis is not None:
                error = _smooth_error(basis.columns[n])
                graph.add(gtsam.CustomFactor(robot_noise, [self.d[n], self.w], error))
        return graph, values

    def optimize(
        self, start: JointState, sigma: float, ratio: Array, roots: list[Array],
        basis: ErrorBasis | None, *, robot: bool = True,
    ) -> JointState:  # fmt: skip
        """Return the least-squares state for fixed sigma, lambda and roots of the corner weights.

        Raises:
            DegenerateError: the views do not determine the parameters.
        """
        import gtsam

        graph, values = self.graph(start, sigma, ratio, roots, basis, robot=robot)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self.config.max_iterations)
        parameters.setRelativeErrorTol(self.config.step_tolerance)
        try:
            values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        except RuntimeError as error:
            raise DegenerateError(
                "hand-eye: the joint fit is not determined by these views (the normal equations "
                "are singular). Add views that tilt the hand about two axes, roll it about the "
                "optical axis, and show points that are not all in one line."
            ) from error
        return self._state(values, robot, basis)

    def _view_error(self, n: int, root: Array) -> Any:
        """Return the error function of one view's factor."""
        held = np.concatenate([np.zeros(12, bool), ~self.free, np.zeros(7, bool)])
        eye = np.eye(4)

        def error(this: Any, values: Any, H: list[Any] | None) -> Array:
            keys = this.keys()
            X, Z = values.atPose3(keys[0]).matrix(), values.atPose3(keys[1]).matrix()
            D = values.atPose3(keys[4]).matrix() if len(keys) > 4 else eye
            camera, board = values.atVector(keys[2]), values.atVector(keys[3])
            X, Z, D = (np.ascontiguousarray(T) for T in (X, Z, D))
            arguments = self._arguments(n, X, Z, D, camera, board, root)
            if H is None:
                r = np.zeros(COLUMNS)
                r[0] = residual_norm(*arguments)
                return r
            J = view_equations(*arguments)
            J[:, held] = 0.0
            parts = (slice(0, 6), slice(6, 12), slice(12, 24), slice(24, 29), slice(29, 35))
            for k in range(len(keys)):
                H[k] = np.asfortranarray(J[:, parts[k]])
            return J[:, -1]

        return error

    def _state(self, values: Any, robot: bool, basis: ErrorBasis | None) -> JointState:
        import gtsam

        errors = np.zeros((len(self.d), 6))
        if robot:
            errors = np.array([gtsam.Pose3.Logmap(values.atPose3(k)) for k in self.d])
        smooth = robot and basis is not None
        return JointState(
            X=np.array(values.atPose3(self.x).matrix()),
            Z=np.array(values.atPose3(self.z).matrix()),
            camera=np.array(values.atVector(self.k)),
            board=np.array(values.atVector(self.b)),
            weights=np.array(values.atVector(self.w)) if smooth else np.zeros(0),
            errors=errors,
        )

    def ones(self) -> list[Array]:
        """Return unit corner weights of every view."""
        return [np.ones(len(v.uv)) for v in self.setup.views]

    def rows(self, state: JointState, n: int, error: Array | None = None) -> Array:
        """Return [xi | camera | board | residual] (2 points, 24) of view n, unweighted.

        Args:
            state: where.
            n: which view.
            error: (6,) robot error instead of the state's.
        """
        D = se3.exp(state.errors[n] if error is None else error)
        one = np.ones(len(self.setup.views[n].uv))
        return view_rows(*self._arguments(n, state.X, state.Z, D, state.camera, state.board, one))

    def residuals(self, state: JointState, n: int, error: Array | None = None) -> Array:
        """Return predicted minus measured (points, 2) [px] of view n, as `rows`."""
        return self.rows(state, n, error)[:, -1].reshape(-1, 2)

    def shaped_points(self, board: Array, xy: Array) -> Array:
        """Return points (n, 3) [m] of places (n, 2) from the middle on a board of a shape (5,)."""
        x, y = xy.T
        s, a = board[:2]
        lift = (board[2] * x * x + board[3] * x * y + board[4] * y * y) / self.setup.half_extent
        return self.setup.middle + s * np.stack([x, (1 + a) * y, lift], -1)

    def equations(self, state: JointState, roots: list[Array]) -> Array:
        """Return every view's compressed equations (views, 24, 36) at a state [px]."""
        held = np.concatenate([np.zeros(12, bool), ~self.free, np.zeros(7, bool)])
        rows = np.empty((len(self.d), COLUMNS, SHARED + 7))
        for n in range(len(self.d)):
            D = se3.exp(state.errors[n])
            rows[n] = view_equations(
                *self._arguments(n, state.X, state.Z, D, state.camera, state.board, roots[n])
            )
        rows[:, :, held] = 0.0
        return rows

    def spread(
        self, state: JointState, sigma: float, ratio: Array, basis: ErrorBasis | None
    ) -> tuple[float, list[Array]]:
        """Return the unit-weight sigma [px] and the roots of the Huber weights of every view.

        sigma^2 = (sum w |r|^2 + sum e^T S0^-1 e) / (2 N - dim theta), S0 = S / sigma^2, e = the
        robot error beyond its smooth part.
        """
        roots: list[Array] = []
        total, count = 0.0, 0
        for n in range(len(self.d)):
            r = np.linalg.norm(self.residuals(state, n), axis=-1)
            w = np.minimum(1.0, self.config.huber_sigmas * sigma / np.maximum(r, 1e-12))
            total += float(np.sum(w * r**2))
            count += 2 * len(r)
            roots.append(np.sqrt(w))
        rest = state.errors - smooth_errors(basis, state.weights, len(self.d))
        total += float(np.sum((rest / (np.repeat(ratio, 3) * self.unit_robot_sd(state))) ** 2))
        free = 12 + int(self.free.sum())
        return float(np.sqrt(total / max(count - free, 1))), roots


def smooth_errors(basis: ErrorBasis | None, weights: Array, views: int) -> Array:
    """Return B_i w (views, 6)."""
    return np.zeros((views, 6)) if basis is None else basis.columns @ weights


def _smooth_error(columns: Array) -> Any:
    """Return the error function log D - B w of the factor between a robot error and the map."""
    import gtsam

    minus = np.asfortranarray(-columns)

    def error(this: Any, values: Any, H: list[Any] | None) -> Array:
        keys = this.keys()
        twist = gtsam.Pose3.Logmap(values.atPose3(keys[0]))
        if H is not None:
            H[0] = np.asfortranarray(_right_jacobian_inverse(twist))
            H[1] = minus
        return twist - columns @ values.atVector(keys[1])

    return error


def _right_jacobian_inverse(twist: Array) -> Array:
    """Return d log(D Exp(d)) / d d (6, 6) to third order in the twist, which is milliradians."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = se3.hat(twist[:3])
    ad[3:, :3] = se3.hat(twist[3:])
    return np.eye(6) + ad / 2 + ad @ ad / 12
