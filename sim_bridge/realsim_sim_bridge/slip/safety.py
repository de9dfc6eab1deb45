"""How many times each stage's load a closed grasp bears, where the fingers hold the object now.

Limit analysis on the convex parts that the engine collides
(docs/decisions/0049-safety-factor.md). Where the factor says for sure what comes of a stage, no
engine needs to play it.
"""

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import ConvexHull

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.records import STAGES, Mesh
from realsim.robots.hand import Hand, along_approach
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.grasping.limit_analysis import pad_patches, safety_factors
from realsim_sim_bridge.slip.motion import SlipMotion, stage_loads
from realsim_sim_bridge.slip.world import PairStates, SlipBody, SlipPhysics

if TYPE_CHECKING:
    from realsim_sim_bridge.slip.slip_test import SlipTrial


CLEAR_M = 0.003
"""So far outside the pads rays start [m]: a pad's edge may be in what is curved."""
FLAT_M = 2e-5
"""What is so near to a pad that touches is touched too [m]: rounding, and how the engines rest."""
FEW = 3.0
"""A third of a pad's points carries the load where the object is curved, and is pressed in as many
times as deep. Of the benchmark's stages at 70 N whose factor was above 3 none was lost for 1 to 4,
some for 6."""
REST_M_PER_S = 0.001
"""What moves faster in the closed hand, at its surface [m/s], is not held yet: nothing is sure."""
BALANCED = 1e-6
"""A lesser factor is zero: rigid pads cannot balance even their own squeeze. What is in the hand
says otherwise, and the engine has to tell."""


def hull_surface(body: SlipBody) -> RaySurface:
    """Return the surface of the convex parts, which may overlap."""
    firsts = np.cumsum([0, *(len(part) for part in body.parts)])
    faces = [ConvexHull(p).simplices + n for p, n in zip(body.parts, firsts, strict=False)]
    return RaySurface(
        Mesh(vertices=np.concatenate(body.parts), faces=np.concatenate(faces).astype(np.int32))
    )


def closed_safety(
    surface: RaySurface,
    trial: "SlipTrial",
    states: PairStates,
    physics: SlipPhysics,
    motion: SlipMotion,
    hand: Hand,
) -> Array:
    """Return the safety factors (N, 4) of the stages; of `close`, that of the weight at rest.

    Args:
        surface: of the body's parts.
        trial: N grasps.
        states: where objects and fingers are, none removed.
        physics: friction, force and pads.
        motion: of the stages.
        hand: sizes of the pads.
    """
    n = len(trial)
    if n == 0:
        return np.zeros((0, len(STAGES)))
    Ts_grasp_world = se3.from_rt(
        np.swapaxes(trial.Ts_table_grasp[:, :3, :3], 1, 2), np.zeros((n, 3))
    )
    Ts_obj_grasp = trial.body.principal_frame()[0] @ se3.invert(
        Ts_grasp_world @ states.Ts_world_body
    )
    closed = 2.0 * states.fingers_m.max(axis=1)
    Ts_obj_pads = along_approach(Ts_obj_grasp, hand.z_pad(states.fingers_m.sum(axis=1)))
    pressed = physics.force_n / physics.pads.pad_stiffness_n_per_m if physics.pads else 0.0
    patches = pad_patches(
        surface, Ts_obj_pads, closed + 2.0 * CLEAR_M, hand, FLAT_M + FEW * pressed
    )
    centers = se3.transform(se3.invert(Ts_obj_pads), trial.body.center_of_mass[None])[:, 0]
    loads = stage_loads(trial, motion, states.Ts_world_body)
    factors = safety_factors(
        patches,
        loads.about_grasp(centers),
        np.full(n, physics.friction),
        np.full(n, physics.force_n),
    )
    by_stage = [factors[:, loads.stage == k].min(axis=1) for k in range(len(STAGES))]
    found = np.stack(by_stage, axis=1)
    return np.where(found < BALANCED, 0.0, found)


def resting(body: SlipBody, states: PairStates) -> Mask:
    """Return which objects (N,) are at rest in the closed hand."""
    spin, speed = (
        np.linalg.norm(states.twists[:, part], axis=1) for part in (slice(3), slice(3, 6))
    )
    return speed + body.reach() * spin < REST_M_PER_S
