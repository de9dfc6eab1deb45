"""How sure measured poses are: sizes of the errors of camera, robot and clock, from the pairs.

With m the target's origin, a camera measures T_cam_board up to eta = (turn, shift of m), both in
the camera's axes. Two shapes of its covariance are tried:

    axes    turn about x, y / about z, shift across / along the optical axis: four sizes
    board   that of corners seen with one error in the image: a flat 3x3 grid of unknown size

A robot error d (right twist of T_base_ee) shows as E d. Its parts: white noise of turn and shift,
noise of the joint angles, errors of the arm's Denavit-Hartenberg numbers, which all pairs share,
and jitter of the time stamps, which is an error along the hand's velocity. All sizes maximise the
restricted likelihood (Patterson & Thompson 1971) under wide priors of their logarithms.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3

Kind = Literal["axes", "board"]
KINDS: tuple[Kind, ...] = ("axes", "board")
GRID = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [0.0]), -1).reshape(-1, 3)
RIDGE = 1e-9
"""Share of the mean information that a grid seen from straight above has of every direction."""
CAMERA_SIZES: dict[Kind, tuple[float, ...]] = {
    "axes": (2.5e-3, 2.5e-3, 1e-3, 2.5e-3),
    "board": (1e-3, 0.08),
}
"""Where the sizes start: rad, rad, m, m; or angle of a corner's error [rad], half the grid [m]."""
CAMERA_LOG_SD = 3.0
"""1-sigma of their logarithms: cameras differ by a factor of twenty either way."""
ROBOT_SIZES = (3e-4, 2e-4)
"""White error of the robot: turn [rad], shift [m]."""
ARM_SIZES = (3e-4, 2e-4, 1e-4)
"""Errors of an arm's angles [rad] and lengths [m], noise of its joints [rad]."""
JITTER_S = 1e-3
"""Jitter of the time stamps [s]."""
ROBOT_LOG_SD = 2.0
"""1-sigma of the robot's logarithms: a factor of seven either way."""
LOG_BOUNDS = (-15.0, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Linear:
    """Pairs linearised at X and Z."""

    residuals: Array
    """(n, 6) eta."""
    J: Array
    """(n, 6, 12) by X and Z (right twists, rotation first)."""
    E: Array
    """(n, 6, 6) by a robot error (right twist of T_base_ee)."""
    Ts: Array
    """(n, 4, 4) predicted T_cam_board."""


def linearise(A: Array, C: Array, X: Array, Z: Array, *, to_hand: bool) -> Linear:
    """Return the pairs' residuals and derivatives.

    Args:
        A: (n, 4, 4) T_base_ee [m].
        C: (n, 4, 4) T_cam_board [m].
        X: (4, 4) the camera in the hand, or in the base where `to_hand`.
        Z: (4, 4) the board in the base, or in the hand where `to_hand`.
        to_hand: whether the camera stands still.
    """
    P = se3.invert(X) @ A @ Z if to_hand else se3.invert(A @ X) @ Z
    turn = se3.log_so3(P[:, :3, :3] @ np.swapaxes(C[:, :3, :3], 1, 2))
    residuals = np.concatenate([turn, P[:, :3, 3] - C[:, :3, 3]], -1)
    at_board = np.zeros((len(A), 6, 6))
    at_board[:, :3, :3] = at_board[:, 3:, 3:] = np.eye(3)
    at_board[:, 3:, :3] = -se3.hat(P[:, :3, 3])
    ahead = se3.adjoint(se3.invert(X) @ A) if to_hand else -se3.adjoint(se3.invert(X))
    J = np.concatenate([-at_board, at_board @ se3.adjoint(P)], -1)
    return Linear(residuals=residuals, J=J, E=at_board @ ahead, Ts=P)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RobotParts:
    """What a robot error may be made of, beside white noise."""

    joints: Array | None = None
    """(n, 6, q) twist per joint angle."""
    arm: Array | None = None
    """(n, 6, 4 q) twist per Denavit-Hartenberg number, angles before lengths."""
    velocity: Array | None = None
    """(n, 6) twist per second: the hand's velocity."""

    @property
    def sizes(self) -> tuple[float, ...]:
        """Where the sizes start."""
        arm = ARM_SIZES if self.arm is not None else ()
        return (*ROBOT_SIZES, *arm, *((JITTER_S,) if self.velocity is not None else ()))

    def covariances(self, sizes: Array) -> Array:
        """Return the covariance (n or 1, 6, 6) of the robot's error that pairs do not share."""
        S = np.diag(np.repeat(sizes[:2], 3) ** 2)[None]
        if self.joints is not None:
            S = S + sizes[4] ** 2 * (self.joints @ np.swapaxes(self.joints, 1, 2))
        if self.velocity is not None:
            S = S + sizes[-1] ** 2 * self.velocity[:, :, None] * self.velocity[:, None]
        return S

    def shared(self, sizes: Array) -> Array | None:
        """Return the shared errors (n, 6, 4 q) per standard deviation."""
        if self.arm is None:
            return None
        return self.arm * np.repeat(sizes[2:4], self.arm.shape[-1] // 2)

    def at(self, rows: Any) -> "RobotParts":
        """Return the parts of some pairs."""
        parts = (self.joints, self.arm, self.velocity)
        joints, arm, velocity = (None if p is None else p[rows] for p in parts)
        return RobotParts(joints=joints, arm=arm, velocity=velocity)


def camera_covariances(kind: Kind, sizes: Array, Ts: Array) -> Array:
    """Return the covariance (n or 1, 6, 6) of eta for boards at Ts (n, 4, 4)."""
    if kind == "axes":
        return np.diag(sizes[[0, 0, 1, 2, 2, 3]] ** 2)[None]
    local = np.einsum("nij,kj->nki", Ts[:, :3, :3], GRID * sizes[1])
    x, y, z = np.moveaxis(local + Ts[:, None, :3, 3], -1, 0)
    D = np.zeros((*z.shape, 2, 3))
    D[..., 0, 0] = D[..., 1, 1] = 1 / z
    D[..., 0, 2], D[..., 1, 2] = -x / z**2, -y / z**2
    J = np.concatenate([-D @ se3.hat(local), D], -1).reshape(len(Ts), -1, 6)
    H = np.swapaxes(J, 1, 2) @ J
    H += RIDGE / 6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(6)
    return sizes[0] ** 2 * np.linalg.inv(H)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Noise:
    """Sizes of all errors."""

    kind: Kind
    sizes: Array
    """Those of the camera (`CAMERA_SIZES`), then the robot's (`RobotParts.sizes`)."""

    @classmethod
    def start(cls, kind: Kind, parts: RobotParts) -> "Noise":
        """Return the sizes before the pairs are looked at."""
        return cls(kind=kind, sizes=np.array([*CAMERA_SIZES[kind], *parts.sizes]))

    @property
    def camera(self) -> Array:
        """The camera's sizes."""
        return self.sizes[: len(CAMERA_SIZES[self.kind])]

    @property
    def robot(self) -> Array:
        """The robot's sizes."""
        return self.sizes[len(CAMERA_SIZES[self.kind]) :]

    def covariances(self, linear: Linear, parts: RobotParts) -> Array:
        """Return the covariance (n, 6, 6) of every pair's eta, without what the pairs share."""
        E = linear.E
        robot = E @ parts.covariances(self.robot) @ np.swapaxes(E, 1, 2)
        return camera_covariances(self.kind, self.camera, linear.Ts) + robot


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Solved:
    """The generalised least-squares step at one linearisation."""

    step: Array
    """(12 + extra + shared,)"""
    information: Array
    rows: Array
    """(n, 6, 12 + extra + shared) whitened derivatives: information = sum of squares + priors."""
    left: Array
    """(n, 6) whitened residuals at the solution."""
    deviance: float
    """-2 log restricted likelihood, up to a constant."""

    @property
    def covariance(self) -> Array:
        """Inverse of the information."""
        return np.asarray(np.linalg.inv(self.information), dtype=np.float64)

    @property
    def scores(self) -> Array:
        """Each pair's part (n, ...) of the gradient at the solution."""
        return np.einsum("nrc,nr->nc", self.rows, self.left)

    def without(self) -> Array:
        """Return how far (n, ...) the solution moves without each pair."""
        U, H = self.rows, self.information
        V = np.linalg.solve(H, np.swapaxes(U, 1, 2))
        return (V @ np.linalg.solve(np.eye(6) - U @ V, self.left[..., None]))[..., 0]


def solve(linear: Linear, noise: Noise, parts: RobotParts, extra: Array | None = None) -> Solved:
    """Return the step of X, Z, extra parameters and shared robot errors.

    Args:
        linear: the pairs.
        noise: the sizes.
        parts: the robot's errors.
        extra: (n, 6, e) derivatives of eta by further parameters.
    """
    factors = np.linalg.cholesky(noise.covariances(linear, parts))
    columns = [linear.J] if extra is None else [linear.J, extra]
    free = sum(c.shape[-1] for c in columns)
    shared = parts.shared(noise.robot)
    if shared is not None:
        columns.append(linear.E @ shared)
    rows = np.concatenate([*columns, linear.residuals[..., None]], -1)
    white = np.linalg.inv(factors) @ rows
    G, r = white[..., :-1], white[..., -1]
    flat = G.reshape(-1, G.shape[-1])
    H = flat.T @ flat
    H[free:, free:] += np.eye(len(H) - free)
    g = flat.T @ r.ravel()
    step = -np.linalg.solve(H, g)
    left = r + (G @ step[:, None])[..., 0]
    log_det = 2 * float(np.sum(np.log(np.diagonal(factors, axis1=1, axis2=2))))
    deviance = log_det + float(r.ravel() @ r.ravel() + g @ step)
    deviance += float(np.linalg.slogdet(H)[1])
    return Solved(
        step=np.asarray(step, dtype=np.float64), information=H,
        rows=G, left=left, deviance=deviance,
    )  # fmt: skip


def estimate_noise(
    linear: Linear, start: Noise, parts: RobotParts, extra: Array | None = None
) -> tuple[Noise, float]:
    """Return the sizes of largest restricted likelihood, and the deviance with their priors."""
    from scipy.optimize import minimize

    center = np.log(Noise.start(start.kind, parts).sizes)
    cameras = len(CAMERA_SIZES[start.kind])
    sd = np.repeat([CAMERA_LOG_SD, ROBOT_LOG_SD], [cameras, len(center) - cameras])

    def deviance(logs: Array) -> float:
        noise = Noise(kind=start.kind, sizes=np.exp(logs))
        price = float(np.sum(((logs - center) / sd) ** 2))
        return solve(linear, noise, parts, extra).deviance + price

    found = minimize(
        deviance, np.log(start.sizes), method="L-BFGS-B", bounds=[LOG_BOUNDS] * len(center),
        options={"maxiter": 40},
    )  # fmt: skip
    return Noise(kind=start.kind, sizes=np.exp(found.x)), float(found.fun)


def distances(linear: Linear, noise: Noise, parts: RobotParts) -> Array:
    """Return the squared Mahalanobis distance (n,) of every pair's residual."""
    V = noise.covariances(linear, parts)
    shared = parts.shared(noise.robot)
    if shared is not None:
        spread = linear.E @ shared
        V = V + spread @ np.swapaxes(spread, 1, 2)
    r = linear.residuals
    return np.einsum("ni,ni->n", r, np.linalg.solve(V, r[..., None])[..., 0])
