"""What the objects feel in each stage of the slip test."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from realsim.records import STAGES
from realsim_sim_bridge.slip import motion as motions
from realsim_sim_bridge.slip.motion import SlipMotion

if TYPE_CHECKING:
    from realsim_sim_bridge.slip.slip_test import SlipTrial

Array = NDArray[np.float64]


def stage_wrenches(
    stage: int, trial: "SlipTrial", Ts_world_body: Array, motion: SlipMotion, dt: float
) -> Array:
    """Return the true wrenches (K, T, 6) of a stage, one every `dt` of the hand's motion.

    Args:
        stage: number in STAGES, not 0.
        trial: the K grasps.
        Ts_world_body: (K, 4, 4) where the objects are when the stage starts.
        motion: amplitudes and durations.
        dt: [s]; an engine that steps k times finer than this plays k times too slowly.
    """
    mass = trial.body.mass_kg
    name = STAGES[stage]
    if name == "lift":
        lift = motions.lift_acceleration(motion, dt)
        return motions.field_wrenches(lift, mass, motion.gravity, len(trial))
    if name == "oscillate":
        shake = motions.oscillation_acceleration(motion, dt)
        return motions.field_wrenches(shake, mass, motion.gravity, len(trial))
    sweep = np.radians(motion.pendulum_deg)
    low, high = np.clip(trial.joint5_ranges, -sweep, sweep).T
    angles = np.stack(
        [
            motions.pendulum_angle(motion, dt, a, b)
            for a, b in zip(low.tolist(), high.tolist(), strict=True)
        ]
    )
    R = trial.Ts_table_grasp[:, :3, :3]
    axes = np.einsum("kij,kj->ki", R, trial.joint5_axes)
    points = np.einsum("kij,kj->ki", R, trial.joint5_points)
    moments = trial.body.principal_frame()[1]
    turned = Ts_world_body[:, :3, :3]
    inertias = np.einsum("kij,j,klj->kil", turned, moments, turned)
    return motions.pendulum_wrenches(
        angles, axes, Ts_world_body[:, :3, 3] - points, inertias, mass, motion.gravity
    )
