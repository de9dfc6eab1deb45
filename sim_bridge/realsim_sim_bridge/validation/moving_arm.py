"""The joint angles of a Panda that move its hand as each stage of the slip test does."""

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.records import STAGES
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.slip.motion import SlipMotion, min_jerk, pendulum_angle

Array = NDArray[np.float64]


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
