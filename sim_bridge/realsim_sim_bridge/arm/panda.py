"""Franka Panda: forward kinematics, inverse kinematics and limits.

Modified (Craig) Denavit-Hartenberg parameters and limits from Franka's control interface
documentation. Frame `base` is panda_link0; frame `grasp` is the hand's (z approach, y closing),
with its origin at the tool centre point.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.geometry import se3
from realsim.robots.hand import Hand, find_hand

Array = NDArray[np.float64]

JOINTS = 7
A_M = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])
ALPHA = np.array([0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2])
D_M = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])
FLANGE_M = 0.107
"""Distance of the flange from joint 7's frame [m]."""
_FRANKA = find_hand()
TCP_M = -_FRANKA.mount_z_m
"""Distance of the tool centre point from the flange [m]."""
HAND_TURN = float(np.radians(_FRANKA.mount_turn_deg))
"""The hand is mounted turned by this about the flange's axis [rad]."""
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""Joint limits of the Panda [rad]; those shipped with PyBullet are wider than the robot's."""
VELOCITY = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
"""Greatest speeds of the joints [rad/s] (Franka's control interface documentation, Panda)."""
ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
"""Greatest accelerations of the joints [rad/s^2] (ibid.)."""
TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
"""Greatest torques of the joints [N m] (ibid.)."""

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


def inverse_all(
    Ts_base_grasp: Array, samples: int, margin: float
) -> tuple[NDArray[np.int64], Array]:
    """Return joint angles that reach each of the poses (N, 4, 4) exactly, within limits.

    Joint 7 is held at each of `samples` values; the other six have up to 8 closed-form solutions
    (Ostermeier, Kuelz & Althoff 2024, EAIK).

    Args:
        Ts_base_grasp: (N, 4, 4) [m].
        samples: how many values of joint 7 are tried.
        margin: distance kept from the joint limits [rad].

    Returns:
        owner (S,), the row of each solution's pose, not decreasing, and joints (S, 7) [rad].
    """
    # EAIK's frame has the base's axes at the zero configuration.
    R_zero = link_frames(np.zeros(JOINTS))[-1, :3, :3]
    targets = np.array(Ts_base_grasp, dtype=np.float64)
    targets[:, :3, :3] = targets[:, :3, :3] @ R_zero.T
    poses = list(targets)
    owners: list[NDArray[np.int64]] = [np.zeros(0, dtype=np.int64)]
    found: list[Array] = [np.zeros((0, JOINTS))]
    for angle, solver in _solvers(samples):
        # One thread: the objects of a scene are spread over the cores.
        solutions = solver.IK_batched(poses, 1) if poses else []
        exact = [
            (row, q)
            for row, solution in enumerate(solutions)
            for q, least_squares in zip(solution.Q, solution.is_LS, strict=True)
            if not least_squares
        ]
        if exact:
            q = np.array([q for _, q in exact], dtype=np.float64)
            q[:, 6] = angle
            found.append(q)
            owners.append(np.array([row for row, _ in exact], dtype=np.int64))
    owner, q = np.concatenate(owners), np.concatenate(found)
    q[:, :6] = (q[:, :6] + np.pi) % (2 * np.pi) - np.pi
    # Joint 6 reaches beyond pi: the same pose a turn further.
    beyond = q[:, 5] + 2 * np.pi <= UPPER[5]
    further = q[beyond] + np.array([0, 0, 0, 0, 0, 2 * np.pi, 0])
    owner, q = np.concatenate([owner, owner[beyond]]), np.concatenate([q, further])
    inside = np.nonzero(within_limits(q, margin))[0]
    order = inside[np.argsort(owner[inside], kind="stable")]
    return owner[order], q[order]


def inverse(T_base_grasp: Array, samples: int, margin: float) -> Array:
    """Return joint angles (S, 7) [rad] that reach T_base_grasp (4, 4); as `inverse_all`."""
    return inverse_all(T_base_grasp[None], samples, margin)[1]


def joint5_in_grasp(q: Array) -> tuple[Array, Array]:
    """Return axis (N, 3) and a point on it (N, 3) [m] of joint 5, grasp frame, at q (N, 7)."""
    frames = link_frames(q)
    T_grasp_5 = se3.invert(frames[..., -1, :, :]) @ frames[..., 5, :, :]
    return T_grasp_5[..., :3, 2], T_grasp_5[..., :3, 3]


SHOULDER_M = float(D_M[0])
"""Height of the shoulder (the axes of joints 1 and 2 meet there) over the base [m]."""
WRIST_REACH_M = float(np.hypot(D_M[2], A_M[3]) + np.hypot(D_M[4], A_M[4]))
"""Greatest distance of the wrist, where the axes of joints 5 and 6 meet, from the shoulder [m]."""


def wrist_distance(T_base_grasp: Array) -> Array:
    """Return the least distance (N,) [m] from the shoulder to the wrist at poses (N, 4, 4).

    The wrist lies on a circle of radius a_7 about joint 7's axis, whatever that joint's angle. No
    inverse kinematics exists where this is more than `WRIST_REACH_M`.
    """
    T_base_7 = T_base_grasp @ JOINT7_GRASP
    out = T_base_7[:, :3, 3] - [0.0, 0.0, SHOULDER_M]
    along = np.sum(out * T_base_7[:, :3, 2], axis=1)
    across = np.sqrt(np.maximum(np.sum(out * out, axis=1) - along**2, 0.0))
    return np.hypot(along, across - A_M[6])


# --- The Panda as a URDF, from the same Denavit-Hartenberg numbers as its kinematics -------------
# Joints, limits, torques and masses are the real robot's; there is no collision geometry, because
# what is moved by this arm in a simulation is watched at the hand. PyBullet reads the offsets and
# angles of a URDF in single precision, so that its link frames are right to 1e-7 and not to the
# last digit.


_LINKS = (
    (0.629769, (-0.041018, -0.00014, 0.049974),
     (0.00315, 8.2904e-07, 0.00015, 0.00388, 8.2299e-06, 0.004285)),
    (4.970684, (0.003875, 0.002081, -0.04762),
     (0.70337, -0.000139, 0.006772, 0.70661, 0.019169, 0.009117)),
    (0.646926, (-0.003141, -0.02872, 0.003495),
     (0.007962, -0.003925, 0.010254, 0.02811, 0.000704, 0.025995)),
    (3.228604, (0.027518, 0.039252, -0.066502),
     (0.037242, -0.004761, -0.011396, 0.036155, -0.012805, 0.01083)),
    (3.587895, (-0.05317, 0.104419, 0.027454),
     (0.025853, 0.007796, -0.001332, 0.019552, 0.008641, 0.028323)),
    (1.225946, (-0.011953, 0.041065, -0.038437),
     (0.035549, -0.002117, -0.004037, 0.029474, 0.000229, 0.008627)),
    (1.666555, (0.060149, -0.014117, -0.010517),
     (0.001964, 0.000109, -0.001158, 0.004354, 0.000341, 0.005433)),
    (0.735522, (0.010517, -0.004252, 0.061597),
     (0.012516, -0.000428, -0.001196, 0.010027, -0.000741, 0.004815)),
)  # fmt: skip
"""Mass [kg], centre of mass [m] and inertia ixx ixy ixz iyy iyz izz [kg m^2] of links 0 to 7:
franka_description, after Gaz et al., Dynamic identification of the Franka Emika Panda robot with
retrieval of feasible parameters using penalty-based optimization, 2019."""


FLANGE_KG = 0.001
"""Mass of the link `flange` [kg]: a mere frame, but PyBullet gives a link without mass a kilogram;
the flange's own mass is in link 7."""


def panda_urdf(geometry: Hand, hand: str = "") -> str:
    """Return the URDF of the arm: links link0 to link7, joints joint1 to joint7, and link `flange`.

    Args:
        geometry: the hand, whose mounting face lies on the flange.
        hand: URDF of a hand whose first link is `palm` with the grasp frame as its own
            (`slip.hand_urdf`); its links and joints are taken over, fixed to the flange. '' = none.
    """
    links = "".join(_massive(f"link{i}", *matter) for i, matter in enumerate(_LINKS))
    joints = "".join(_joint(i) for i in range(JOINTS))
    flange = _massive("flange", FLANGE_KG, (0.0, 0.0, 0.0), (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6))
    flange += _fixed("link7", "flange", (0, 0, FLANGE_M), 0.0)
    mounted = ""
    if hand:
        start, end = hand.index(">", hand.index("<robot")) + 1, hand.rindex("</robot>")
        turn = HAND_TURN
        mounted = hand[start:end] + _fixed("flange", "palm", (0, 0, -geometry.mount_z_m), turn)
    return f'<robot name="panda">{links}{joints}{flange}{mounted}</robot>'


def _massive(name: str, mass: float, center: tuple[float, ...], inertia: tuple[float, ...]) -> str:
    """Return the element of a link with a mass [kg] and inertia ixx ixy ixz iyy iyz izz."""
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = " ".join(f'{name}="{value!r}"' for name, value in zip(names, inertia, strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="{_numbers(center)}"/>'
        f'<mass value="{mass!r}"/><inertia {moments}/></inertial></link>'
    )


def _joint(number: int) -> str:
    """Return the element of the joint after link `number`: Rot_x(alpha) Trans_x(a) Trans_z(d)."""
    a, alpha, d = (float(x[number]) for x in (A_M, ALPHA, D_M))
    # The offset along the joint's own axis, in the link before.
    at = (a, -d * float(np.sin(alpha)), d * float(np.cos(alpha)))
    limits = {
        "lower": LOWER,
        "upper": UPPER,
        "effort": TORQUE,
        "velocity": VELOCITY,
    }
    limit = " ".join(f'{name}="{float(value[number])!r}"' for name, value in limits.items())
    return (
        f'<joint name="joint{number + 1}" type="revolute"><parent link="link{number}"/>'
        f'<child link="link{number + 1}"/>'
        f'<origin xyz="{_numbers(at)}" rpy="{_numbers((alpha, 0.0, 0.0))}"/>'
        f'<axis xyz="0 0 1"/><limit {limit}/></joint>'
    )


def _fixed(parent: str, child: str, at: tuple[float, float, float], turn: float) -> str:
    """Return a fixed joint with an offset [m] and a turn about z [rad]."""
    return (
        f'<joint name="{parent}_{child}" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{_numbers(at)}" '
        f'rpy="{_numbers((0.0, 0.0, turn))}"/></joint>'
    )


def _numbers(values: tuple[float, ...]) -> str:
    """Return numbers as a URDF has them, with all their digits."""
    return " ".join(repr(float(value)) for value in values)
