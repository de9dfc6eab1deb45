"""The joint fit: camera in hand, board, lens and a small robot error per view, in one graph.

    T_cam_board,i = X^-1 E_i^-1 A_i^-1 Z         E_i = Exp(e_i)
    cost = sum_ij w_ij |pi_K(T_i P_j(s)) - u_ij|^2 / sigma^2 + sum_i |S^-1/2 e_i|^2 + priors
    S = (lambda sigma)^2 diag(1/f^2 I_rot, (d/f)^2 I_trans)

P_j(s) is the board scaled by s about its middle. The bound lambda on the robot's share keeps corner
errors that are correlated within a view (a warped print) from being blamed on the robot.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.camera import projection_jacobian
from realsim.records import CameraIntrinsics

Array = NDArray[np.float64]
CAMERA_TERMS = 12
"""fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6."""
HELD_SD = 1e-3
"""Prior of a term that is held: it has no derivative in any view, so this only fills the matrix."""


@dataclass(frozen=True, kw_only=True, slots=True)
class JointConfig:
    """Priors and steps of the joint fit."""

    robot_ratio: float = 0.3
    """lambda: the robot's share in the error of a view; 0.1 to 0.5 make no difference on data."""
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
    distortion_sd: tuple[float, ...] = (0.15, 0.25, 0.0015, 0.0015, 0.0, 0.0, 0.0, 0.0)
    """Priors of k1 k2 p1 p2 k3 k4 k5 k6 around the given ones; 0 holds a term. k3 and beyond run
    away (-10 was seen) when the corners do not reach the border of the image."""
    scale_sd: float = 0.01
    """Prior of the board's scale around 1 (printers are off by 0.1 to 1 %); 0 holds it."""
    max_iterations: int = 50
    """Levenberg-Marquardt steps per round; seven are typical."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewCorners:
    """What one view measured."""

    index: int
    T_base_ee: Array
    """(4, 4) [m]."""
    points: Array
    """(n, 3) corners in the board frame [m]."""
    uv: Array
    """(n, 2) corners in the image [px]."""
    middle: Array
    """(3,) middle of the board [m], the point that its scale leaves in place."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class JointState:
    """Everything that is estimated."""

    T_ee_cam: Array
    T_base_board: Array
    camera: Array
    """(12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6."""
    scale: float
    """Board size relative to the given one."""
    errors: Array
    """(views, 6) robot errors e_i, rotation first [rad, m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class JointFit:
    """The estimate and the linearised graph there, for uncertainty.

    The parameters theta are X (6), Z (6), camera (12), scale (1), in this order.
    """

    state: JointState
    sigma_px: float
    """Unit-weight standard deviation of a corner coordinate [px]."""
    informations: Array
    """(views, 25, 25) information of each view about theta, its robot error eliminated."""
    pulls: Array
    """(views, 25) negative gradient of each view's cost at the estimate."""
    prior: Array
    """(25, 25) information of the priors."""
    graph: Any
    """gtsam.NonlinearFactorGraph."""
    values: Any
    """gtsam.Values."""


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


def view_residuals(
    view: ViewCorners, X: Array, Z: Array, E: Array, camera: CameraIntrinsics, scale: float
) -> tuple[Array, dict[str, Array]]:
    """Return prediction minus measurement (2n,) [px] and its derivatives.

    Derivatives are with respect to right perturbations of X ("x"), Z ("z") and E ("e"), each
    (2n, 6); the camera ("k", (2n, 12)) and the scale ("s", (2n, 1)).
    """
    arm = view.points - view.middle
    board = view.middle + scale * arm
    in_hand = se3.transform(se3.invert(view.T_base_ee @ E) @ Z, board)
    in_cam = se3.transform(se3.invert(X), in_hand)
    uv, d_point, d_cam = projection_jacobian(camera, in_cam)
    eye = np.broadcast_to(np.eye(3), (len(board), 3, 3))
    to_hand = X[:3, :3].T
    to_board = (se3.invert(view.T_base_ee @ E @ X) @ Z)[:3, :3]
    moved = {
        "x": np.concatenate([se3.hat(in_cam), -eye], -1),
        "z": to_board @ np.concatenate([-se3.hat(board), eye], -1),
        "e": to_hand @ np.concatenate([se3.hat(in_hand), -eye], -1),
        "s": (arm @ to_board.T)[..., None],
    }
    J = {name: (d_point @ d).reshape(-1, d.shape[-1]) for name, d in moved.items()}
    J["k"] = d_cam.reshape(-1, CAMERA_TERMS)
    return (uv - view.uv).ravel(), J


def solve_joint(
    views: list[ViewCorners], start: JointState, intrinsics0: CameraIntrinsics, config: JointConfig
) -> JointFit:
    """Return the joint fit: one fit without robot errors, then rounds that re-estimate sigma.

    Raises:
        DegenerateError: the views do not determine the parameters.
    """
    problem = _Problem(views, intrinsics0, config)
    weights = [np.ones(len(v.points)) for v in views]
    state, _, _ = problem.optimize(start, config.start_sigma_px, weights, robot=False)
    sigma, weights = problem.spread(state, config.start_sigma_px)
    state, graph, values = problem.optimize(state, sigma, weights, robot=True)
    for _ in range(config.rounds - 1):
        sigma, weights = problem.spread(state, sigma)
        state, graph, values = problem.optimize(state, sigma, weights, robot=True)
    sigma, _ = problem.spread(state, sigma)
    return problem.linearised(state, sigma, graph, values)


class _Problem:
    """The graph of one calibration; sigma and the corner weights are fixed during one solve."""

    def __init__(
        self, views: list[ViewCorners], intrinsics0: CameraIntrinsics, config: JointConfig
    ) -> None:
        from gtsam import symbol

        self.views, self.intrinsics0, self.config = views, intrinsics0, config
        self.x, self.z, self.k, self.s = (symbol(c, 0) for c in "xzks")
        self.e = [symbol("e", v.index) for v in views]
        self.free = np.array([True] * 4 + [sd > 0 for sd in config.distortion_sd])

    def robot_sd(self, state: JointState) -> Array:
        """Return the 1-sigma (6,) of a robot error for sigma = 1 px: lambda (1/f, d/f)."""
        Z = state.T_base_board
        places = [
            Z[:3, :3] @ v.middle + Z[:3, 3] - (v.T_base_ee @ state.T_ee_cam)[:3, 3]
            for v in self.views
        ]
        distance = float(np.median(np.linalg.norm(places, axis=-1)))
        f = float(state.camera[:2].mean())
        return self.config.robot_ratio / f * np.array([1.0] * 3 + [distance] * 3)

    def camera_prior(self) -> tuple[Array, Array]:
        """Return centre (12,) and covariance (12, 12) of the camera's prior."""
        c, center = self.config, camera_vector(self.intrinsics0)
        sd = np.ones(CAMERA_TERMS)
        sd[2:4] = c.center_sd * self.intrinsics0.width
        sd[4:] = c.distortion_sd
        sd = np.where(self.free, sd, HELD_SD)
        covariance = np.diag(sd**2)
        # A common relative error of both focal lengths and an independent one of their ratio.
        both, ratio = c.focal_sd**2, (c.aspect_sd / 2) ** 2
        relative = np.array([[both + ratio, both - ratio], [both - ratio, both + ratio]])
        covariance[:2, :2] = relative * np.outer(center[:2], center[:2])
        return center, covariance

    def optimize(
        self, start: JointState, sigma: float, weights: list[Array], *, robot: bool
    ) -> tuple[JointState, Any, Any]:
        """Return the least-squares state for fixed sigma and weights, the graph and its values."""
        import gtsam

        from realsim.interop import pose3_from_T

        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(self.x, pose3_from_T(start.T_ee_cam))
        values.insert(self.z, pose3_from_T(start.T_base_board))
        values.insert(self.k, start.camera)
        values.insert(self.s, np.array([start.scale]))
        robot_noise = gtsam.noiseModel.Diagonal.Sigmas(sigma * self.robot_sd(start))
        for n, view in enumerate(self.views):
            keys = [self.x, self.z, self.k, self.s]
            if robot:
                keys.append(self.e[n])
                values.insert(self.e[n], pose3_from_T(se3.exp(start.errors[n])))
            noise = gtsam.noiseModel.Isotropic.Sigma(2 * len(view.points), sigma)
            graph.add(gtsam.CustomFactor(noise, keys, self._error(view, weights[n])))
        center, covariance = self.camera_prior()
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorVector(self.k, center, noise))
        scale_sd = self.config.scale_sd if self.config.scale_sd > 0 else HELD_SD
        noise = gtsam.noiseModel.Isotropic.Sigma(1, scale_sd)
        graph.add(gtsam.PriorFactorVector(self.s, np.ones(1), noise))
        if robot:
            for key in self.e:
                graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(), robot_noise))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self.config.max_iterations)
        try:
            values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        except RuntimeError as error:
            raise DegenerateError(
                "hand-eye: the joint fit is not determined by these views (the normal equations "
                "are singular). Add views that tilt the hand about two axes, roll it about the "
                "optical axis, and show tags that are not all in one line."
            ) from error
        return self._state(values, robot), graph, values

    def _error(self, view: ViewCorners, weights: Array) -> Any:
        """Return the error function of one view's factor, corner weights inside."""
        from realsim.interop import T_from_pose3

        root = np.repeat(np.sqrt(weights), 2)

        def error(this: Any, values: Any, H: list[Any] | None) -> Array:
            keys = this.keys()
            X, Z = (T_from_pose3(values.atPose3(k)) for k in keys[:2])
            E = T_from_pose3(values.atPose3(keys[4])) if len(keys) > 4 else np.eye(4)
            camera = camera_of(values.atVector(keys[2]), self.intrinsics0)
            scale = float(values.atVector(keys[3])[0])
            r, J = view_residuals(view, X, Z, E, camera, scale)
            if H is not None:
                J["k"][:, ~self.free] = 0.0
                if self.config.scale_sd <= 0:
                    J["s"][:] = 0.0
                for n, name in enumerate("xzkse"[: len(keys)]):
                    H[n] = np.asfortranarray(root[:, None] * J[name])
            return root * r

        return error

    def _state(self, values: Any, robot: bool) -> JointState:
        from realsim.interop import T_from_pose3

        n = len(self.views)
        errors = np.zeros((n, 6))
        if robot:
            errors = np.array([se3.log(T_from_pose3(values.atPose3(k))) for k in self.e])
        return JointState(
            T_ee_cam=T_from_pose3(values.atPose3(self.x)),
            T_base_board=T_from_pose3(values.atPose3(self.z)),
            camera=np.array(values.atVector(self.k)),
            scale=float(values.atVector(self.s)[0]),
            errors=errors,
        )

    def residuals(self, state: JointState, view: int, *, robot: bool) -> Array:
        """Return the 2-D residuals (n, 2) of one view [px], with or without its robot error."""
        E = se3.exp(state.errors[view]) if robot else np.eye(4)
        camera = camera_of(state.camera, self.intrinsics0)
        X, Z = state.T_ee_cam, state.T_base_board
        r, _ = view_residuals(self.views[view], X, Z, E, camera, state.scale)
        return r.reshape(-1, 2)

    def spread(self, state: JointState, sigma: float) -> tuple[float, list[Array]]:
        """Return the unit-weight sigma [px] and the Huber weights (n,) of every view's corners.

        sigma^2 = (sum w |r|^2 + sum e^T S0^-1 e) / (2 N - dim theta), S0 = S / sigma^2.
        """
        weights: list[Array] = []
        total, count = 0.0, 0
        for n in range(len(self.views)):
            r = np.linalg.norm(self.residuals(state, n, robot=True), axis=-1)
            w = np.minimum(1.0, self.config.huber_sigmas * sigma / np.maximum(r, 1e-12))
            total += float(np.sum(w * r**2))
            count += 2 * len(r)
            weights.append(w)
        total += float(np.sum((state.errors / self.robot_sd(state)) ** 2))
        free = 12 + int(self.free.sum()) + int(self.config.scale_sd > 0)
        return float(np.sqrt(total / max(count - free, 1))), weights

    def linearised(self, state: JointState, sigma: float, graph: Any, values: Any) -> JointFit:
        """Return the fit with each view's information about theta, its robot error eliminated."""
        linear = graph.linearize(values)
        n, slots = len(self.views), {}
        for key, size in ((self.x, 6), (self.z, 6), (self.k, CAMERA_TERMS), (self.s, 1)):
            begin = sum(s.stop - s.start for s in slots.values())
            slots[key] = slice(begin, begin + size)
        dim = 13 + CAMERA_TERMS
        informations, pulls = np.zeros((n, dim, dim)), np.zeros((n, dim))
        prior = np.zeros((dim, dim))
        for p in (n, n + 1):
            A, _ = _dense(linear.at(p), slots, dim, None)
            prior += A.T @ A
        for v, key in enumerate(self.e):
            parts = [_dense(linear.at(f), slots, dim, key) for f in (v, n + 2 + v)]
            A = np.concatenate([part[0] for part in parts])
            b = np.concatenate([part[1] for part in parts])
            H, g = A.T @ A, A.T @ b
            out = np.linalg.solve(H[dim:, dim:], H[dim:, :dim]).T
            informations[v] = H[:dim, :dim] - out @ H[dim:, :dim]
            pulls[v] = g[:dim] - out @ g[dim:]
        return JointFit(
            state=state, sigma_px=sigma, informations=informations, pulls=pulls, prior=prior,
            graph=graph, values=values,
        )  # fmt: skip


def _dense(
    factor: Any, slots: dict[int, slice], dim: int, error_key: int | None
) -> tuple[Array, Array]:
    """Return a linear factor as a (rows, dim [+ 6]) matrix and its right side."""
    A, b = factor.jacobian()
    full = np.zeros((len(b), dim + (6 if error_key is not None else 0)))
    begin = 0
    for key in factor.keys():
        where = slice(dim, dim + 6) if key == error_key else slots[key]
        size = where.stop - where.start
        full[:, where] = A[:, begin : begin + size]
        begin += size
    return full, np.asarray(b, dtype=np.float64)
