"""Antipodal grasp candidates of one object where it stands.

Antipodal pairs of its surface, the hand turned about each, kept where the open hand is free of the
object, its neighbours and the table, and where the closing fingers are free of the neighbours. What
each filter took is counted.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.records import Mesh
from realsim_sim_bridge.grasping.antipodal import RaySurface, antipodal_pairs
from realsim_sim_bridge.grasping.candidate_config import CandidateConfig
from realsim_sim_bridge.grasping.hand import HandGeometry
from realsim_sim_bridge.grasping.hand_poses import (
    FREE,
    IN_NEIGHBOUR,
    IN_OBJECT,
    IN_TABLE,
    Stand,
    turned_poses,
)
from realsim_sim_bridge.grasping.surroundings import Surroundings, standing_object, together

__all__ = [
    "CandidateConfig",
    "Candidates",
    "Surroundings",
    "sample_candidates",
    "standing_object",
    "together",
]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidates:
    """Grasps that are antipodal and whose open hand is free."""

    Ts_obj_grasp: Array
    """(N, 4, 4) [m]."""
    widths_m: Array
    """(N,) distance of the contacts [m]."""
    openings_m: Array
    """(N,) distance of the finger faces before closing [m]."""
    contact_depths_m: Array
    """(N,) z of both contacts in the grasp frame [m]: 0 = middle of the pads, + = to the tips."""
    counts: dict[str, int]
    """How many there were after each step, and what each filter took:

    surface_points = points_without_pair + antipodal_points;
    exits = too_near + too_wide + outside_cone + antipodal_pairs;
    turned = rotations x antipodal_pairs
           = hand_in_table + hand_in_object + hand_in_neighbour + free;
    free = not_chosen + kept. A grasp counts where the best of its stands ended.
    """


def sample_candidates(
    mesh: Mesh,
    T_table_obj: Array,
    surroundings: Surroundings,
    config: CandidateConfig,
    geometry: HandGeometry,
    rng: np.random.Generator,
    limit: int,
) -> Candidates:
    """Return the grasp candidates of an object.

    No piece of the object's triangles reaches into the hand's boxes, nor of the neighbours' into
    what the hand sweeps, where the surroundings have triangles; where they have points, no point.

    Args:
        mesh: the object [m].
        T_table_obj: (4, 4) where it stands; z of the table is up.
        surroundings: the other objects.
        config: how to sample.
        geometry: the hand.
        rng: the only source of chance; the same one gives the same candidates.
        limit: candidates kept, chosen to be far apart.

    Raises:
        InputError: the mesh has no area, or the transform is not rigid.
    """
    T_table_obj = se3.check_rigid(T_table_obj, "the object's pose on the table")
    counts: dict[str, int] = {}
    surface = RaySurface(mesh)
    max_width = geometry.max_opening_m - config.width_margin_m
    pairs = antipodal_pairs(surface, config, max_width, rng, counts)
    poses = turned_poses(pairs, config, geometry, rng)
    counts["turned"] = len(poses)

    center, radius = _reach_of_hands(mesh, T_table_obj, geometry)
    neighbours = surroundings.near(center, radius + config.neighbour_clearance_m).tree()[0]
    stand = Stand(surface, T_table_obj, neighbours, config, geometry)
    poses, reached = stand.placed(poses)
    counts["hand_in_table"] = int(np.sum(reached == IN_TABLE))
    counts["hand_in_object"] = int(np.sum(reached == IN_OBJECT))
    counts["hand_in_neighbour"] = int(np.sum(reached == IN_NEIGHBOUR))
    free = poses.rows(reached == FREE)

    counts["free"] = len(free)
    chosen = free.rows(_spread_out(free.Ts_obj_grasp, config, limit, rng))
    counts["kept"] = len(chosen)
    counts["not_chosen"] = counts["free"] - counts["kept"]
    return Candidates(
        Ts_obj_grasp=chosen.Ts_obj_grasp,
        widths_m=chosen.widths_m,
        openings_m=chosen.openings_m,
        contact_depths_m=chosen.contact_depths_m,
        counts=counts,
    )


def _reach_of_hands(mesh: Mesh, T_table_obj: Array, geometry: HandGeometry) -> tuple[Array, float]:
    """Return a sphere on the table (centre (3,), radius [m]) that no hand at the object leaves."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    boxes = geometry.boxes(geometry.max_opening_m)
    # The origin of a grasp is within the object's bounding sphere, moved by less than a finger.
    hand = float(np.linalg.norm(np.abs(boxes).max(axis=(0, 1, 2)))) + geometry.finger_length_m
    radius = 0.5 * float(np.linalg.norm(high - low)) + hand
    return se3.transform(T_table_obj, 0.5 * (low + high)), radius


def _spread_out(
    Ts: Array, config: CandidateConfig, limit: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return the numbers of at most `limit` grasps, each the farthest from those before.

    A grasp and its half turn about the approach are one: the closing axis enters as y y'.
    """
    if len(Ts) <= limit:
        return np.arange(len(Ts))
    y = Ts[:, :3, 1]
    axis = (y[:, :, None] * y[:, None, :]).reshape(-1, 9)
    features = np.concatenate([2.0 / config.spread_m * Ts[:, :3, 3], Ts[:, :3, 2], axis], axis=1)
    chosen = [int(rng.integers(len(Ts)))]
    nearest = np.full(len(Ts), np.inf)
    while len(chosen) < limit:
        step = np.sum((features - features[chosen[-1]]) ** 2, axis=1)
        nearest = np.minimum(nearest, step)
        chosen.append(int(np.argmax(nearest)))
    return np.sort(np.array(chosen))
