"""Where everything stands during a fit, and one step of it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence, ScanView

Array = NDArray[np.float64]
TABLE, BIAS, RIM, HAND_EYE, VIEWS = 7, 10, 11, 12, 18
"""Where the unknowns of the joint fit stand: object 0-6, table 3, bias, outline, hand-eye 6, then 6
of every view."""
LARGEST_SCALE_STEP = 0.2
"""No step changes the scale by more than this factor: without a bound far starts collapse."""
LARGEST_TURN_RAD = 0.35
"""Nor turns the object by more: the equations are linear."""
LEAST_SIGMA = (np.radians(1e-3), 1e-5)
"""Least prior 1-sigma of a camera's turn [rad] and shift [m]: none is perfect."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class State:
    """Scale and pose of the inner mesh, the cameras' errors, the table, and two biases."""

    s: float
    """Scale of the inner mesh."""
    R: Array
    """(3, 3) of the object."""
    t: Array
    """(3,) centre of the object's box in world [m]."""
    hand_eye: Array
    """(6,) twist of every camera [rad, m]."""
    views: Array
    """(V, 6) further twist of each camera."""
    T_world_table: Array
    """(4, 4)."""
    bias: float = 0.0
    """c of dz = c z^2 [1/m]."""
    rim: float = 0.0
    """By how much outlines lie outside of the true ones [px]."""

    @property
    def pose(self) -> tuple[float, Array, Array]:
        """Scale, rotation and centre."""
        return self.s, self.R, self.t

    def cameras(self, views: tuple[ScanView, ...]) -> Array:
        """Return the cameras (V, 4, 4) as they stand now."""
        T = np.stack([v.T_world_cam for v in views])
        return T @ se3.exp(self.hand_eye + self.views)

    def corrected(self, points: Array) -> Array:
        """Return points (N, 3) in camera axes without the depth's bias."""
        return points * (1.0 + self.bias * points[:, 2:])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Priors:
    """What the cameras' errors may be: 1-sigma of twists [rad, m]."""

    hand_eye: Array
    """(6,)."""
    arm: Array
    """(6,)."""


def priors_of(config: ScaleConfig) -> Priors:
    """Return the cameras' priors: the session's own, or the defaults."""
    p = config.prior

    def twist(deg: float | None, deg_else: float, mm: float | None, mm_else: float) -> Array:
        turn = np.radians(deg_else if deg is None else deg)
        shift = (mm_else if mm is None else mm) / 1e3
        return np.repeat([max(turn, LEAST_SIGMA[0]), max(shift, LEAST_SIGMA[1])], 3)

    return Priors(
        hand_eye=twist(
            config.hand_eye_sigma_deg, p.hand_eye_deg, config.hand_eye_sigma_mm, p.hand_eye_mm
        ),
        arm=twist(config.arm_sigma_deg, p.arm_deg, config.arm_sigma_mm, p.arm_mm),
    )


def first_state(evidence: ScanEvidence, s: float, R: Array, t: Array) -> State:
    """Return the state of an object pose with everything else as it is said to be."""
    return State(
        s=s, R=R, t=t, hand_eye=np.zeros(6), views=np.zeros((len(evidence.views), 6)),
        T_world_table=evidence.plane.T_world_table.copy(),
    )  # fmt: skip


def moved_object(state: State, x: Array) -> State:
    """Return the state after the step x = [omega, v, lambda] (7,) of the object, bounded."""
    turn = float(np.linalg.norm(x[:3]))
    share = min(
        1.0, LARGEST_SCALE_STEP / max(abs(x[6]), 1e-12), LARGEST_TURN_RAD / max(turn, 1e-12)
    )
    x = x * share
    return replace(
        state,
        s=state.s * float(np.exp(x[6])),
        R=state.R @ se3.exp_so3(x[:3]),
        t=state.t + state.R @ x[3:6],
    )


def moved_all(state: State, x: Array, pivot: Array) -> State:
    """Return the state after the step x (18 + 6 V,) of the joint fit.

    Args:
        state: before.
        x: the step.
        pivot: (3,) point of the table about which it is tilted, world.
    """
    after = moved_object(state, x[:7])
    T = state.T_world_table
    # n' = n + a e1 + b e2 is a turn by (-b, a) about e1, e2; the height moves along the normal.
    turn = T[:3, 1] * x[TABLE] - T[:3, 0] * x[TABLE + 1]
    R = se3.exp_so3(turn)
    T_new = T.copy()
    T_new[:3, :3] = R @ T[:3, :3]
    T_new[:3, 3] = pivot + R @ (T[:3, 3] - pivot) + T_new[:3, 2] * x[TABLE + 2]
    return replace(
        after,
        T_world_table=T_new,
        bias=state.bias + float(x[BIAS]),
        rim=state.rim + float(x[RIM]),
        hand_eye=state.hand_eye + x[HAND_EYE:VIEWS],
        views=state.views + x[VIEWS:].reshape(-1, 6),
    )


def symmetric(A: Array) -> Array:
    """Return the full matrix of an upper triangle."""
    return A + np.triu(A, 1).T


def camera_numbers(intrinsics: CameraIntrinsics) -> Array:
    """Return fx fy cx cy and the eight distortion terms (12,)."""
    i = intrinsics
    return np.concatenate([[i.fx, i.fy, i.cx, i.cy], i.distortion])


def all_points(views: tuple[ScanView, ...]) -> tuple[Array, NDArray[np.int64]]:
    """Return the object's points of all views in camera axes, and which view each is of."""
    points = np.concatenate([v.points for v in views])
    return points, np.repeat(np.arange(len(views)), [len(v.points) for v in views])


def table_points(views: tuple[ScanView, ...]) -> tuple[Array, NDArray[np.int64]]:
    """Return the table's points of all views likewise."""
    points = np.concatenate([v.table for v in views])
    return points, np.repeat(np.arange(len(views)), [len(v.table) for v in views])


def metre_per_px(evidence: ScanEvidence, T_world_cam: Array) -> float:
    """Return the size of a pixel at the object [m]."""
    low, high = evidence.footprint.box
    middle = se3.transform(evidence.plane.T_world_table, 0.5 * (low + high))[0]
    z = float((middle - T_world_cam[:3, 3]) @ T_world_cam[:3, 2])
    return max(z, 0.05) / evidence.intrinsics.fx
