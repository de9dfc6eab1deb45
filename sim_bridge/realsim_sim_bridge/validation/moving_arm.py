"""A Panda with a hand as a URDF, and the joint angles that move the hand as each stage does."""

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.records import STAGES
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.slip.motion import SlipMotion, min_jerk, pendulum_angle

Array = NDArray[np.float64]

LINK_KG = (4.97, 0.65, 3.23, 3.59, 1.23, 1.67, 0.74)
"""Masses of the Panda's links [kg] (Gaz, Cognetti, Oliva, Robuffo Giordano & De Luca 2019)."""
LINK_RADIUS_M = 0.08
"""The links' inertia is that of spheres of this radius: the joints' control outweighs it."""
TORQUES_NM = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""What the Panda's joints can exert [N m]."""


def arm_urdf(hand: str) -> str:
    """Return the Panda with a hand (a URDF with root `palm`), without the arm's shapes.

    A joint's frame is Rx(alpha) Tx(a) Tz(d) Rz(q) from the one before (Craig).
    """
    links = '<link name="base"><inertial><mass value="1"/>' + _UNIT_INERTIA + "</inertial></link>"
    for i in range(panda.JOINTS):
        alpha, d = float(panda.ALPHA[i]), float(panda.D_M[i])
        y, z = -d * np.sin(alpha), d * np.cos(alpha)
        moment = 0.4 * LINK_KG[i] * LINK_RADIUS_M**2
        links += (
            f'<link name="link{i + 1}"><inertial><mass value="{LINK_KG[i]}"/><inertia '
            f'ixx="{moment}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/></inertial>'
            f'</link><joint name="joint{i + 1}" type="revolute">'
            f'<parent link="{f"link{i}" if i else "base"}"/><child link="link{i + 1}"/>'
            f'<origin xyz="{panda.A_M[i]} {y} {z}" rpy="{alpha} 0 0"/><axis xyz="0 0 1"/>'
            f'<limit lower="{panda.LOWER[i]}" upper="{panda.UPPER[i]}" '
            f'effort="{TORQUES_NM[i]}" velocity="10"/></joint>'
        )
    links += (
        '<joint name="flange" type="fixed"><parent link="link7"/><child link="palm"/>'
        f'<origin xyz="0 0 {panda.FLANGE_M + panda.TCP_M}" rpy="0 0 {panda.HAND_TURN}"/></joint>'
    )
    inner = hand[hand.index(">") + 1 : hand.rindex("</robot>")]
    return f'<robot name="arm">{links}{inner}</robot>'


_UNIT_INERTIA = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
"""Of the base, which does not move; without one the engine warns."""


def stage_joints(stage: int, q: Array, motion: SlipMotion, dt: float) -> Array:
    """Return the joints' path (T, 7) [rad] of a stage, from q (7,) on."""
    if STAGES[stage] == "pendulum":
        sweep = np.radians(motion.pendulum_deg)
        low, high = np.clip([panda.LOWER[4] - q[4], panda.UPPER[4] - q[4]], -sweep, sweep)
        path = np.tile(q, (round(motion.pendulum_s / dt), 1))
        angle = pendulum_angle(motion, dt, float(low), float(high))[0]
        path[: len(angle), 4] += angle[: len(path)]
        return path
    return _follow(q, _hand_path(stage, motion, dt))


def _hand_path(stage: int, motion: SlipMotion, dt: float) -> Array:
    """Return where the hand is (T, 3) [m], since the start of the stage, table axes."""
    if STAGES[stage] == "lift":
        t = dt * np.arange(1.0, round((motion.lift_s + motion.lift_hold_s) / dt) + 1)
        up = min_jerk(motion.lift_height_m, motion.lift_s, t)[0]
        return np.stack([0 * up, 0 * up, up], axis=-1)
    count = round(motion.oscillation_cycles / motion.oscillation_hz / dt)
    phase = 2 * np.pi * motion.oscillation_hz * dt * np.arange(1, count + 1)
    wave = motion.oscillation_m * (1.0 - np.cos(phase))
    rest = np.zeros(count)
    along_x, along_y = (wave, rest, rest), (rest, wave, rest)
    return np.concatenate([np.stack(along_x, axis=-1), np.stack(along_y, axis=-1)])


def _follow(q: Array, positions: Array) -> Array:
    """Return joint angles (T, 7) that carry the hand along positions (T, 3) without turning it."""
    start = panda.forward(q)
    path = np.empty((len(positions), panda.JOINTS))
    for t, position in enumerate(positions):
        frames = panda.link_frames(q)
        error = np.empty(6)
        error[:3] = se3.log_so3(start[:3, :3] @ frames[-1, :3, :3].T)
        error[3:] = start[:3, 3] + position - frames[-1, :3, 3]
        q = q + np.linalg.pinv(panda.jacobian(frames)) @ error
        path[t] = q
    return path
