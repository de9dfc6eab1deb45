"""MuJoCo's state vector of a pair, and poses and speeds in the frame `world` of the pair.

A row is [time, qpos, qvel] (`mjSTATE_FULLPHYSICS` of a model without activations):

    time |
    finger 0, finger 1, body position, body quaternion w x y z, carriage |
    finger 0, finger 1, linear velocity of the body, angular velocity in its own axes, carriage

all in the hand's frame `grasp`, because one model, whose hand does not turn, serves all pairs.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim_sim_bridge.slip.mujoco_model import (
    FINGER_NAMES,
    HAND_SIDE,
    OBJECT,
    OBJECT_SIDE,
    STAND,
    TABLE_SIDE,
    load_mujoco,
)
from realsim_sim_bridge.slip.mujoco_pads import pad_stiffness
from realsim_sim_bridge.slip.world import Motion, PairStates

TIME = 0
FINGERS = slice(1, 3)
POSITION = slice(3, 6)
QUATERNION_WXYZ = slice(6, 10)
CARRIAGE = 10
FINGER_SPEEDS = slice(11, 13)
VELOCITY = slice(13, 16)
SPIN = slice(16, 19)
CARRIAGE_SPEED = 19
WIDTH = 20
"""Numbers in a row."""


def rows_at(Ts_grasp_body: Array, fingers_m: Array) -> Array:
    """Return rows (K, 20) of pairs at rest.

    Args:
        Ts_grasp_body: (K, 4, 4) principal frame of the object in the hand's [m].
        fingers_m: (K,) distance of each finger's face from the middle [m].
    """
    rows = np.zeros((len(fingers_m), WIDTH))
    rows[:, FINGERS] = fingers_m[:, None]
    rows[:, POSITION] = Ts_grasp_body[:, :3, 3]
    rows[:, QUATERNION_WXYZ] = se3.quaternion_wxyz(Ts_grasp_body[:, :3, :3])
    return rows


def poses(rows: Array, Rs_world_hand: Array) -> Array:
    """Return Ts_world_body (..., 4, 4) [m] of rows (..., 20)."""
    R = Rs_world_hand @ se3.from_quaternion_wxyz(rows[..., QUATERNION_WXYZ])
    return se3.from_rt(R, _turned(Rs_world_hand, rows[..., POSITION]))


def pair_states(rows: Array, Rs_world_hand: Array) -> PairStates:
    """Return where pairs are, from rows (K, 20)."""
    Ts_world_body = poses(rows, Rs_world_hand)
    angular = _turned(Ts_world_body[:, :3, :3], rows[:, SPIN])
    linear = _turned(Rs_world_hand, rows[:, VELOCITY])
    return PairStates(
        Ts_world_body=Ts_world_body,
        twists=np.concatenate([angular, linear], axis=-1),
        fingers_m=rows[:, FINGERS].copy(),
        finger_speeds=rows[:, FINGER_SPEEDS].copy(),
    )


def rows_of(states: PairStates, Rs_world_hand: Array) -> Array:
    """Return rows (K, 20): the inverse of `pair_states`; time is zero."""
    Rs_hand_world = np.swapaxes(Rs_world_hand, -1, -2)
    Rs_body_world = np.swapaxes(states.Ts_world_body[:, :3, :3], -1, -2)
    rows = np.zeros((len(Rs_world_hand), WIDTH))
    rows[:, FINGERS] = states.fingers_m
    rows[:, POSITION] = _turned(Rs_hand_world, states.Ts_world_body[:, :3, 3])
    rows[:, QUATERNION_WXYZ] = se3.quaternion_wxyz(Rs_hand_world @ states.Ts_world_body[:, :3, :3])
    rows[:, FINGER_SPEEDS] = states.finger_speeds
    rows[:, VELOCITY] = _turned(Rs_hand_world, states.twists[:, 3:])
    rows[:, SPIN] = _turned(Rs_body_world, states.twists[:, :3])
    return rows


def moved_m(before: Array, after: Array, reach_m: float) -> Array:
    """Return at most how far any point of object or fingers moved between rows (K, 20) [m].

    Args:
        before: (K, 20).
        after: (K, 20).
        reach_m: greatest distance of a point of the object from its centre of mass [m].
    """
    shift = np.linalg.norm(after[:, POSITION] - before[:, POSITION], axis=1)
    # |q - q0| is half the angle for small ones.
    turn = 2.0 * np.linalg.norm(after[:, QUATERNION_WXYZ] - before[:, QUATERNION_WXYZ], axis=1)
    slide = np.abs(after[:, FINGERS] - before[:, FINGERS]).max(axis=1)
    return np.maximum(shift + turn * reach_m, slide)


def _turned(R: Array, v: Array) -> Array:
    """Return vectors (..., 3) turned by rotations (..., 3, 3)."""
    return (R @ v[..., None])[..., 0]


# --- What is seen of pairs while MuJoCo rolls them out -------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Samples:
    """State rows and forces of K pairs at S times; NaN until they are filled in."""

    rows: Array
    """(K, S, 20), see `mujoco_state`."""
    finger_n: Array
    """(K, S, 2) sum of the normal forces of each finger's contacts [N]."""
    times_s: Array
    """(S,) [s]."""

    @classmethod
    def empty(cls, pairs: int, times_s: Array) -> "Samples":
        """Return samples of K pairs at times (S,) [s] of which nothing has been seen."""
        shape = (pairs, len(times_s))
        return cls(
            rows=np.full((*shape, WIDTH), np.nan),
            finger_n=np.full((*shape, 2), np.nan),
            times_s=times_s,
        )

    def held(self, last: Int64, pairs: Mask) -> "Samples":
        """Return them up to the last sample of any pair, some pairs standing still after theirs.

        Args:
            last: (K,) number of the last sample of each pair.
            pairs: (K,) those that stand still; the others stay NaN.
        """
        count = int(last.max()) + 1 if len(last) else 0
        times = np.arange(count)
        at = np.where(pairs[:, None], np.minimum(times, last[:, None]), times)[..., None]
        return Samples(
            rows=np.take_along_axis(self.rows, at, axis=1),
            finger_n=np.take_along_axis(self.finger_n, at, axis=1),
            times_s=self.times_s[:count],
        )

    def motion(self, Rs_world_hand: Array) -> Motion:
        """Return them in the pairs' worlds, whose axes are turned against the hand's (K, 3, 3)."""
        return Motion(
            Ts_world_body=poses(self.rows, Rs_world_hand[:, None]),
            finger_n=self.finger_n,
            times_s=self.times_s,
        )


# --- What a compiled model is told between closing and loads, and what it says -------------------


def set_drag(model: Any, rate_per_s: float) -> None:
    """Let the object's speeds decay at a rate [1/s]."""
    matter = model.body(OBJECT)
    first = int(matter.dofadr[0])
    model.dof_damping[first : first + 3] = rate_per_s * matter.mass[0]
    model.dof_damping[first + 3 : first + 6] = rate_per_s * matter.inertia


def set_stand(model: Any, there: bool) -> None:
    """Let the object meet what it stands on and beside, or not."""
    if not model.nmocap:
        return
    standing = model.geom_bodyid == model.body(STAND).id
    table = model.geom_type == load_mujoco().mjtGeom.mjGEOM_PLANE
    model.geom_contype[standing] = np.where(table[standing], TABLE_SIDE * there, 0)
    model.geom_conaffinity[standing] = np.where(table[standing], 0, OBJECT_SIDE * there)


def read_settings(model: Any) -> dict[str, float]:
    """Return what the compiled model says."""
    hand, held = (model.geom_contype == side for side in (HAND_SIDE, OBJECT_SIDE))
    fingers = [int(model.joint(name).dofadr[0]) for name in FINGER_NAMES]
    matter = model.body(OBJECT)
    return {
        "finger_friction": float(model.geom_friction[hand, 0].min()),
        "object_friction": float(model.geom_friction[held, 0].min()),
        "dt_s": float(model.opt.timestep),
        "object_mass_kg": float(model.body(OBJECT).mass[0]),
        "force_n": float(model.tendon_frictionloss.min()),
        "pad_stiffness_n_per_m": pad_stiffness(model, int(matter.id)),
        "impratio": float(model.opt.impratio),
        "noslip_iterations": float(model.opt.noslip_iterations),
        "elliptic_cone": float(model.opt.cone),
        "armature_kg": float(model.dof_armature[fingers].min()),
        "finger_damping": float(model.dof_damping[fingers].max()),
        "object_drag_per_s": float(model.dof_damping[matter.dofadr[0]] / matter.mass[0]),
        "gravity": float(np.linalg.norm(model.opt.gravity)),
    }
