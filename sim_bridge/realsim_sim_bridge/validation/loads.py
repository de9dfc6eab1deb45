"""A body between two pads under a constant load: how far does it move?"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim_sim_bridge.grasping.hand import HandGeometry
from realsim_sim_bridge.slip.body import SlipBody
from realsim_sim_bridge.slip.motion import min_jerk
from realsim_sim_bridge.slip.slip_test import SlipConfig, batches
from realsim_sim_bridge.slip.world import Engine, Grips
from realsim_sim_bridge.validation.specimens import SIDE_M

Array = NDArray[np.float64]

LOST_M = 0.02
"""A body that moved so far need not be looked at further [m]: a pad's size."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Held:
    """What K copies did under K loads; inf where one was lost."""

    shift_m: Array
    """(K,) greatest motion of the centre since before the load [m]."""
    turn_rad: Array
    """(K,) greatest turn since before the load [rad]."""
    creep_m: Array
    """(K,) motion from the end of the ramp to the end [m]."""
    creep_rad: Array
    """(K,) turn from the end of the ramp to the end [rad]."""
    finger_n: Array
    """(K, 2) normal force of each finger before the load [N]."""


def hold(
    engine: Engine,
    config: SlipConfig,
    body: SlipBody,
    loads: Array,
    *,
    ramp_s: float,
    hold_s: float,
) -> Held:
    """Close on copies, let a load on each grow and stand, and return how they moved.

    Args:
        engine: the engine.
        config: the physics and the closing.
        body: 5 cm wide where the hand closes, about its centre.
        loads: (K, 6) wrench on each: torque about the centre and force, grasp axes.
        ramp_s: time in which the loads grow [s].
        hold_s: time for which they then stand [s].
    """
    parts = [
        _hold(engine, config, body, loads[rows], ramp_s, hold_s)
        for rows in batches(len(loads), engine.pairs_per_world)
    ]
    return Held(
        **{
            name: np.concatenate([getattr(p, name) for p in parts])
            for name in ("shift_m", "turn_rad", "creep_m", "creep_rad", "finger_n")
        }
    )


def _hold(
    engine: Engine, config: SlipConfig, body: SlipBody, loads: Array, ramp_s: float, hold_s: float
) -> Held:
    """Return the same of the pairs of one world."""
    n = len(loads)
    upright = np.tile(np.eye(4), (n, 1, 1))
    grips = Grips(
        Ts_table_grasp=upright,
        Ts_obj_grasp=upright,
        openings_m=np.full(n, SIDE_M + 0.006),
    )
    with engine.world(body, grips, config.physics, HandGeometry()) as world:
        closed = world.close(config.closing)
        start = world.states().Ts_world_body
        steps, ramp = round((ramp_s + hold_s) / world.dt), round(ramp_s / world.dt)
        growth = min_jerk(1.0, ramp_s, world.dt * np.arange(1, steps + 1, dtype=np.float64))[0]
        sample = max(1, round(0.025 / world.dt))
        motion = world.play(loads[:, None, :] * growth[:, None], sample, LOST_M)
    Ts = motion.Ts_world_body
    ramped = min(int(np.searchsorted(motion.times_s, ramp * world.dt)), Ts.shape[1] - 1)
    shift, turn = _since(start, Ts)
    creep, creep_turn = _since(Ts[:, ramped], Ts)
    return Held(
        shift_m=shift.max(axis=1),
        turn_rad=turn.max(axis=1),
        creep_m=creep[:, -1],
        creep_rad=creep_turn[:, -1],
        finger_n=closed.finger_n[:, -1],
    )


def _since(start: Array, Ts: Array) -> tuple[Array, Array]:
    """Return shift [m] and turn [rad] (K, S) of poses (K, S, 4, 4) since a start (K, 4, 4)."""
    lost = np.isnan(Ts[..., 0, 3]) | np.isnan(start[:, None, 0, 3])
    shift = np.linalg.norm(Ts[..., :3, 3] - start[:, None, :3, 3], axis=-1)
    R = np.swapaxes(start[:, None, :3, :3], -1, -2) @ Ts[..., :3, :3]
    turn = se3.angle(np.where(lost[..., None, None], np.eye(3), R))
    return np.where(lost, np.inf, shift), np.where(lost, np.inf, turn)


def with_hand(config: SlipConfig, force_n: float, friction: float) -> SlipConfig:
    """Return a slip test's configuration with another force [N] and friction."""
    return replace(config, physics=replace(config.physics, force_n=force_n, friction=friction))
