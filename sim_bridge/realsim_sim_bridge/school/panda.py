"""Franka Panda: forward kinematics, inverse kinematics, limits and the arm's capsules.

Modified (Craig) Denavit-Hartenberg parameters and limits from Franka's control interface
documentation. Frame `base` is panda_link0; frame `grasp` is the hand's (z approach, y closing),
with its origin at the tool centre point.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.geometry import se3

Array = NDArray[np.float64]

JOINTS = 7
A_M = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])
ALPHA = np.array([0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2])
D_M = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])
FLANGE_M = 0.107
"""Distance of the flange from joint 7's frame [m]."""
TCP_M = 0.1034
"""Distance of the tool centre point from the flange [m]."""
HAND_TURN = -np.pi / 4
"""The hand is mounted turned by this about the flange's axis [rad]."""
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""Joint limits of the Panda [rad]; those shipped with PyBullet are wider than the robot's."""

JOINT7_GRASP = se3.invert(
    se3.from_translation([0, 0, FLANGE_M + TCP_M])
    @ se3.from_rt(se3.exp_so3([0, 0, HAND_TURN]), np.zeros(3))
)
"""(4, 4) joint 7's frame in the grasp frame."""


def link_frames(q: ArrayLike) -> Array:
    """Return T_base_link (..., 9, 4, 4): the base, joints 1 to 7 and the grasp frame.

    Args:
        q: (..., 7) joint angles [rad].
    """
    q = np.asarray(q, dtype=np.float64)
    frames = np.empty((*q.shape[:-1], JOINTS + 2, 4, 4))
    frames[..., 0, :, :] = np.eye(4)
    cos, sin = np.cos(q), np.sin(q)
    for i in range(JOINTS):
        ca, sa = np.cos(ALPHA[i]), np.sin(ALPHA[i])
        T = np.zeros((*q.shape[:-1], 4, 4))
        T[..., 0, 0], T[..., 0, 1], T[..., 0, 3] = cos[..., i], -sin[..., i], A_M[i]
        T[..., 1, 0], T[..., 1, 1] = sin[..., i] * ca, cos[..., i] * ca
        T[..., 2, 0], T[..., 2, 1] = sin[..., i] * sa, cos[..., i] * sa
        T[..., 1, 2], T[..., 1, 3] = -sa, -D_M[i] * sa
        T[..., 2, 2], T[..., 2, 3] = ca, D_M[i] * ca
        T[..., 3, 3] = 1.0
        frames[..., i + 1, :, :] = frames[..., i, :, :] @ T
    frames[..., JOINTS + 1, :, :] = frames[..., JOINTS, :, :] @ se3.invert(JOINT7_GRASP)
    return frames


def forward(q: ArrayLike) -> Array:
    """Return T_base_grasp (..., 4, 4) at joint angles q (..., 7) [rad]."""
    return link_frames(q)[..., -1, :, :]


def jacobian(frames: Array) -> Array:
    """Return the Jacobian (..., 6, 7), rotation first, base axes, at the grasp's origin.

    Args:
        frames: (..., 9, 4, 4) of `link_frames`.
    """
    axes = frames[..., 1 : JOINTS + 1, :3, 2]
    arms = frames[..., -1:, :3, 3] - frames[..., 1 : JOINTS + 1, :3, 3]
    return np.swapaxes(np.concatenate([axes, np.cross(axes, arms)], axis=-1), -1, -2)


def within_limits(q: Array, margin: float = 0.0) -> NDArray[np.bool_]:
    """Return whether all joints (..., 7) keep the margin [rad] from their limits."""
    return np.all((q >= LOWER + margin) & (q <= UPPER - margin), axis=-1)


@lru_cache(maxsize=8)
def _solvers(samples: int) -> tuple[tuple[float, Any], ...]:
    """Return (q7, EAIK's solver with joint 7 held there) for evenly spread q7."""
    from eaik.IK_HP import HPRobot

    frames = link_frames(np.zeros(JOINTS))
    axes = frames[1 : JOINTS + 1, :3, 2]
    points = np.concatenate([frames[:, :3, 3][[0]], frames[1:, :3, 3]])
    steps = np.diff(points, axis=0)
    spread = (np.arange(samples) + 0.5) / samples
    angles = LOWER[6] + (UPPER[6] - LOWER[6]) * spread
    return tuple((float(a), HPRobot(axes, steps, fixed_axes=[(6, float(a))])) for a in angles)


def inverse(T_base_grasp: Array, samples: int, margin: float) -> Array:
    """Return joint angles (S, 7) [rad] that reach T_base_grasp (4, 4) exactly, within limits.

    Joint 7 is held at each of `samples` values; the other six have up to 8 closed-form solutions
    (Ostermeier, Kuelz & Althoff 2024, EAIK).

    Args:
        T_base_grasp: (4, 4) [m].
        samples: how many values of joint 7 are tried.
        margin: distance kept from the joint limits [rad].
    """
    # EAIK's frame has the base's axes at the zero configuration.
    R_zero = forward(np.zeros(JOINTS))[:3, :3]
    target = T_base_grasp.copy()
    target[:3, :3] = target[:3, :3] @ R_zero.T
    found: list[Array] = []
    for angle, solver in _solvers(samples):
        solution = solver.IK(target)
        for q, least_squares in zip(solution.Q, solution.is_LS, strict=True):
            if not least_squares:
                found.append(np.append(np.asarray(q, dtype=np.float64)[:6], angle))
    if not found:
        return np.zeros((0, JOINTS))
    q = np.stack(found)
    q = (q + np.pi) % (2 * np.pi) - np.pi
    # Joint 6 reaches beyond pi: the same pose a turn further.
    further = q[q[:, 5] + 2 * np.pi <= UPPER[5]] + np.array([0, 0, 0, 0, 0, 2 * np.pi, 0])
    q = np.concatenate([q, further])
    return q[within_limits(q, margin)]


def joint5_in_grasp(q: Array) -> tuple[Array, Array]:
    """Return axis (N, 3) and a point on it (N, 3) [m] of joint 5, grasp frame, at q (N, 7)."""
    frames = link_frames(q)
    T_grasp_5 = se3.invert(frames[..., -1, :, :]) @ frames[..., 5, :, :]
    return T_grasp_5[..., :3, 2], T_grasp_5[..., :3, 3]


# --- shape --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class Capsule:
    """A cylinder with round ends, fixed to a link."""

    link: int
    """0 = base, 1 to 7 = the joints' frames, 8 = the grasp frame."""
    start: tuple[float, float, float]
    """[m], link frame."""
    end: tuple[float, float, float]
    radius_m: float


def _capsule(link: int, radius_m: float, *ends: tuple[float, float, float]) -> Capsule:
    return Capsule(link=link, start=ends[0], end=ends[-1], radius_m=radius_m)


_PALM, _TIPS = 0.04 - TCP_M, 0.10 - TCP_M
ARM_CAPSULES = (
    _capsule(0, 0.06, (-0.09, 0, 0.06), (-0.06, 0, 0.06)),
    _capsule(1, 0.06, (0, 0, -0.333), (0, 0, -0.05)),
    _capsule(2, 0.06, (0, 0, -0.06), (0, 0, 0.06)),
    _capsule(3, 0.06, (0, 0, -0.22), (0, 0, -0.07)),
    _capsule(4, 0.06, (0, 0, -0.06), (0, 0, 0.06)),
    _capsule(5, 0.06, (0, 0, -0.31), (0, 0, -0.21)),
    _capsule(5, 0.025, (0, 0.08, -0.20), (0, 0.08, -0.06)),
    _capsule(6, 0.05, (0, 0, -0.07), (0, 0, 0.01)),
    _capsule(7, 0.04, (0, 0, -0.06), (0, 0, 0.08)),
)
"""The arm's coarse collision geometry of franka_description."""
HAND_CAPSULES = (
    _capsule(8, 0.04, (0, -0.05, _PALM), (0, 0.05, _PALM)),
    _capsule(8, 0.02, (0, -0.05, _TIPS), (0, 0.05, _TIPS)),
)
"""The hand's, which contains the fingers at any opening; for moves far from objects only."""


@dataclass(frozen=True, eq=False, slots=True)
class Spheres:
    """Spheres that contain capsules."""

    links: NDArray[np.int64]
    """(S,) link of each."""
    centers: Array
    """(S, 3) link frame [m]."""
    radii: Array
    """(S,) [m]."""


def spheres_of(capsules: tuple[Capsule, ...]) -> Spheres:
    """Return spheres that contain the capsules: at most one radius apart, and grown to meet."""
    links: list[int] = []
    centers: list[Array] = []
    radii: list[float] = []
    for c in capsules:
        start, end = np.array(c.start), np.array(c.end)
        length = float(np.linalg.norm(end - start))
        count = int(np.ceil(length / c.radius_m)) + 1
        step = length / max(count - 1, 1)
        centers += list(start + np.linspace(0, 1, count)[:, None] * (end - start))
        radii += [float(np.hypot(c.radius_m, step / 2))] * count
        links += [c.link] * count
    return Spheres(np.array(links), np.stack(centers), np.array(radii))


def sphere_centers(spheres: Spheres, frames: Array) -> Array:
    """Return the centres (..., S, 3) in base [m] at link frames (..., 9, 4, 4)."""
    T = frames[..., spheres.links, :, :]
    return (T[..., :3, :3] @ spheres.centers[:, :, None])[..., 0] + T[..., :3, 3]
