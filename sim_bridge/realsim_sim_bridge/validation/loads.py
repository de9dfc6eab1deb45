"""A body between two pads under a constant load: how far does it move?"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.robots.hand import Hand
from realsim_sim_bridge.slip.motion import min_jerk
from realsim_sim_bridge.slip.slip_test import SlipConfig, batches
from realsim_sim_bridge.slip.world import Engine, Grips, Meeting, SlipBody
from realsim_sim_bridge.validation.specimens import SIDE_M

# --- Coulomb's limit for a rigid object held at points: the load at which it slips ---------------
# Each point carries a normal load n_i, given and fixed, and at most the friction mu n_i, against
# the direction in which it slides. A load that acts in the pad's plane, wrench w = (torque about
# the pad's normal, force in the plane), is carried up to the factor (the upper bound theorem of
# plasticity; Goyal, Ruina & Papadopoulos 1991, "Planar sliding with dry friction")
#
#     lambda = min over planar twists t with w . t = 1 of  sum_i mu n_i |v + omega J p_i|
#
# that is the friction's power against the load's, at the easiest motion. For a pure force through
# the centre it is mu sum n_i / |force|, for a pure torque mu sum n_i |p_i| / |torque|; loads beside
# the centre turn the object about an instantaneous centre between the two, and that is what is
# searched.


SWEEPS = 400
"""Steps of the reweighted least squares; 60 reach 1e-6 away from a corner of the limit surface."""
STILL = 1e-13
"""Relative change of the twist at which the search ends."""
SMALLEST_M_S = 1e-9
"""Slower points weigh no more than at this speed, in units of the fastest: no division by 0."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrictionPatch:
    """Points that hold an object by friction, in the plane of the pads."""

    points_m: Array
    """(P, 2) [m]."""
    friction_n: Array
    """(P,) largest friction of each, mu n_i [N]."""

    def slip_load(self, load: ArrayLike) -> float:
        """Return the factor by which a load can grow until the object slips; inf for no load.

        Args:
            load: (3,) torque about the plane's normal, at the origin [N m], and force (2,) [N]. The
                torque is positive from the first axis to the second.
        """
        w = np.asarray(load, dtype=np.float64)
        if not np.any(w):
            return float("inf")
        # In units of the pad, so that turning and sliding weigh alike.
        length = float(np.linalg.norm(self.points_m, axis=1).max()) or 1.0
        w = w / [length, 1.0, 1.0]
        rows = self._sliding(length)
        twists = [self._easiest(rows, w), *_turns_about(rows, w)]
        return min(self._power(rows, t) / float(w @ t) for t in twists)

    def _sliding(self, length: float) -> Array:
        """Return S (P, 2, 3): the velocity of each point is S_i (omega length, v)."""
        x, z = self.points_m.T / length
        one, zero = np.ones_like(x), np.zeros_like(x)
        return np.stack(
            [np.stack([-z, one, zero], axis=-1), np.stack([x, zero, one], axis=-1)], axis=1
        )

    def _power(self, rows: Array, twist: Array) -> float:
        """Return the power of friction [W] at a twist (3,)."""
        return float(self.friction_n @ np.linalg.norm(rows @ twist, axis=1))

    def _easiest(self, rows: Array, w: Array) -> Array:
        """Return the twist (3,) of least power among those with w . t = 1.

        Reweighted least squares (Weiszfeld 1937): with weights mu n_i / |v_i| of the last twist the
        sum is a quadratic form t^T Q t, whose least value has t parallel to Q^-1 w.
        """
        twist = w / (w @ w)
        for _ in range(SWEEPS):
            speeds = np.linalg.norm(rows @ twist, axis=1)
            if not np.any(speeds):
                return twist
            weights = self.friction_n / np.maximum(speeds, SMALLEST_M_S * speeds.max())
            Q = np.einsum("p,pij,pik->jk", weights, rows, rows)
            # A patch on a line or in a point does not resist every twist.
            before, twist = twist, np.linalg.pinv(Q) @ w
            twist /= w @ twist
            if np.abs(twist - before).max() <= STILL * np.abs(twist).max():
                break
        return twist


def _turns_about(rows: Array, w: Array) -> Iterator[Array]:
    """Yield the twists (3,) with w . t = 1 about each point: corners, which descent is slow at."""
    for S in rows:
        turn = np.cross(S[0], S[1])
        power = float(w @ turn)
        if abs(power) > 1e-12 * np.linalg.norm(w):
            yield turn / power


def hand_patch(points_m: Array, force_n: float, friction: float) -> FrictionPatch:
    """Return the patch of two facing fingers whose points (P, 2) [m] share the force evenly."""
    count = len(points_m)
    return FrictionPatch(
        points_m=points_m, friction_n=np.full(count, 2.0 * friction * force_n / count)
    )


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
    hand: Hand,
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
        hand: what holds.
        body: 5 cm wide where the hand closes, about its centre.
        loads: (K, 6) wrench on each: torque about the centre and force, grasp axes.
        ramp_s: time in which the loads grow [s].
        hold_s: time for which they then stand [s].
    """
    if len(loads) > engine.pairs_per_world:
        parts = [
            hold(engine, config, hand, body, loads[rows], ramp_s=ramp_s, hold_s=hold_s)
            for rows in batches(len(loads), engine.pairs_per_world)
        ]
        return Held(
            **{
                name: np.concatenate([getattr(p, name) for p in parts])
                for name in ("shift_m", "turn_rad", "creep_m", "creep_rad", "finger_n")
            }
        )
    n = len(loads)
    upright = np.tile(np.eye(4), (n, 1, 1))
    grips = Grips(
        Ts_table_grasp=upright,
        Ts_obj_grasp=hand.grasps_of_pads(upright, SIDE_M),
        openings_m=np.full(n, SIDE_M + 0.006),
    )
    with engine.world(Meeting(body, config.physics, hand), grips) as world:
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
