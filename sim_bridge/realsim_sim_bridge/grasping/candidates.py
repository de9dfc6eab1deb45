"""Antipodal grasp candidates of one object where it stands.

Antipodal pairs of its surface, the hand turned about each, kept where the open hand is free of the
object, its neighbours and the table, and where the closing fingers are free of the neighbours. What
each filter took is counted.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim.records import Mesh
from realsim.records.checked_arrays import rows_of
from realsim.robots.hand import Hand, along_approach
from realsim_sim_bridge.grasping.analytic import farthest_rows, grasp_features
from realsim_sim_bridge.grasping.antipodal import (
    AntipodalPairs,
    CandidateConfig,
    RaySurface,
    antipodal_pairs,
    perpendicular,
)
from realsim_sim_bridge.grasping.hand_free import lowest_corner
from realsim_sim_bridge.grasping.surroundings import (
    SurfaceTree,
    Surroundings,
    hands_free,
    standing_object,
    surface_tree,
    together,
)

# --- Where the open hand can stand around antipodal pairs: free of object, neighbours and table --
# Every pair gives grasps turned about its closing axis. Of each, several stands are tried in order
# of preference: with the contacts in the middle of the pads or nearer to their tips (so that the
# fingers clear the table), and with several openings. The first free stand is the grasp.


IN_TABLE, IN_OBJECT, IN_NEIGHBOUR, FREE = range(4)
"""How far a stand got, in the order of the checks."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HandPoses:
    """Grasps about one object."""

    Ts_obj_grasp: Array
    """(N, 4, 4) [m]."""
    widths_m: Array
    """(N,) distance of the contacts [m]."""
    openings_m: Array
    """(N,) distance of the finger faces before closing [m]."""
    contact_depths_m: Array
    """(N,) z of the contacts in the grasp frame [m]: + = towards the tips. 0 = in the middle of the
    pads of a slide; those of an arc are at `Hand.z_pad` of the width."""

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.Ts_obj_grasp)

    def rows(self, rows: Mask | Int64) -> "HandPoses":
        """Return some of them."""
        return rows_of(self, rows)


def turned_poses(
    pairs: AntipodalPairs, config: CandidateConfig, geometry: Hand, rng: np.random.Generator
) -> HandPoses:
    """Return k fully open grasps per pair, evenly turned about its closing axis.

    Their origins are between the contacts: `Stand` moves the hand to where its pads are there.
    """
    k, widths = config.rotations, pairs.widths_m
    closing = (pairs.points[:, 1] - pairs.points[:, 0]) / widths[:, None]
    u, v = perpendicular(closing)
    first = rng.uniform(0.0, 2 * np.pi, (len(closing), 1))
    turn = (first + 2 * np.pi / k * np.arange(k))[..., None]
    approach = np.cos(turn) * u[:, None] + np.sin(turn) * v[:, None]
    y = np.broadcast_to(closing[:, None], approach.shape)
    R = np.stack([np.cross(y, approach), y, approach], axis=-1)
    Ts = se3.from_rt(R, pairs.points.mean(axis=1)[:, None]).reshape(-1, 4, 4)
    return HandPoses(
        Ts_obj_grasp=Ts,
        widths_m=np.repeat(widths, k),
        openings_m=np.full(len(Ts), geometry.max_opening_m),
        contact_depths_m=np.zeros(len(Ts)),
    )


class Stand:
    """One object where it stands, with what is around it."""

    def __init__(
        self,
        surface: RaySurface,
        T_table_obj: Array,
        neighbours: SurfaceTree | None,
        config: CandidateConfig,
        geometry: Hand,
    ) -> None:
        self._surface, self._T_table_obj, self._neighbours = surface, T_table_obj, neighbours
        self._config, self._geometry = config, geometry
        mesh = surface.mesh
        self._tree = surface_tree(mesh.vertices[mesh.faces])

    def placed(self, poses: HandPoses) -> tuple[HandPoses, Int64]:
        """Return the poses in their first free stand, and how far the best stand of each got (N,).

        The poses that come have their origins between the contacts, in the middle of the pads.
        Rows that are not FREE are as they came.
        """
        n = len(poses)
        Ts, openings = poses.Ts_obj_grasp.copy(), poses.openings_m.copy()
        depths = poses.contact_depths_m.copy()
        reached = np.full(n, IN_TABLE, dtype=np.int64)
        for depth in self._config.contact_depths_m:
            for margin in self._config.opening_margins_m:
                rest = np.nonzero(reached != FREE)[0]
                tried = self._stands(poses.rows(rest), depth, margin)
                outcome = self._outcome(tried)
                reached[rest] = np.maximum(reached[rest], outcome)
                free = outcome == FREE
                Ts[rest[free]] = tried.Ts_obj_grasp[free]
                openings[rest[free]] = tried.openings_m[free]
                depths[rest[free]] = tried.contact_depths_m[free]
        placed = replace(poses, Ts_obj_grasp=Ts, openings_m=openings, contact_depths_m=depths)
        return placed, reached

    def _stands(self, poses: HandPoses, depth_m: float, margin_m: float) -> HandPoses:
        """Return the poses, moved back so that the contacts are at z = depth, with an opening."""
        depths = depth_m + self._geometry.z_pad(poses.widths_m)
        Ts = along_approach(poses.Ts_obj_grasp, -depths)
        openings = np.minimum(poses.widths_m + 2 * margin_m, self._geometry.max_opening_m)
        return replace(poses, Ts_obj_grasp=Ts, openings_m=openings, contact_depths_m=depths)

    def _outcome(self, poses: HandPoses) -> Int64:
        """Return what stops each hand (N,): the first of table, object, neighbours, or FREE."""
        config, outcome = self._config, np.full(len(poses), IN_TABLE, dtype=np.int64)
        lowest = lowest_corner(
            self._geometry.boxes(poses.openings_m), self._T_table_obj @ poses.Ts_obj_grasp
        )
        rows = np.nonzero(lowest > config.table_clearance_m)[0]
        outcome[rows] = IN_OBJECT
        rows = rows[self._free_of_object(poses.rows(rows))]
        outcome[rows] = IN_NEIGHBOUR
        near = poses.rows(rows)
        swept = self._geometry.swept_boxes(near.widths_m, near.openings_m)
        Ts_table_grasp = self._T_table_obj @ near.Ts_obj_grasp
        free = hands_free(swept, Ts_table_grasp, self._neighbours, config.neighbour_clearance_m)
        outcome[rows[free]] = FREE
        return outcome

    def _free_of_object(self, poses: HandPoses) -> Mask:
        """Return whether the open hand is free of the object (N,), and a linkage when closed, too.

        A hand whose boxes cross no triangle is wholly outside or, if the object is greater than
        the palm, wholly inside: its boxes hang together.
        """
        boxes = self._geometry.boxes(poses.openings_m)
        clearance_m = self._config.clearance_m
        free = hands_free(boxes, poses.Ts_obj_grasp, self._tree, clearance_m)
        if self._geometry.bars:
            bars = self._geometry.bar_boxes(poses.widths_m[free])
            free[free] = hands_free(bars, poses.Ts_obj_grasp[free], self._tree, clearance_m)
        if self._surface.size_m > self._geometry.palm_width_m:
            middle = boxes[free, 0].mean(axis=1)
            palm = se3.transform(poses.Ts_obj_grasp[free], middle[:, None])[:, 0]
            free[free] = ~self._surface.contains(palm)
        return free


__all__ = [
    "CandidateConfig",
    "Candidates",
    "Surroundings",
    "sample_candidates",
    "standing_object",
    "together",
]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidates(HandPoses):
    """Grasps that are antipodal and whose open hand is free."""

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
    geometry: Hand,
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
    return Candidates(**{f.name: getattr(chosen, f.name) for f in fields(chosen)}, counts=counts)


def _reach_of_hands(mesh: Mesh, T_table_obj: Array, geometry: Hand) -> tuple[Array, float]:
    """Return a sphere on the table (centre (3,), radius [m]) that no hand at the object leaves."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    boxes = geometry.boxes(geometry.max_opening_m)
    # The origin of a grasp is within the object's bounding sphere, moved by less than a finger.
    hand = float(np.linalg.norm(np.abs(boxes).max(axis=(0, 1, 2)))) + geometry.finger_length_m
    radius = 0.5 * float(np.linalg.norm(high - low)) + hand
    return se3.transform(T_table_obj, 0.5 * (low + high)), radius


def _spread_out(Ts: Array, config: CandidateConfig, limit: int, rng: np.random.Generator) -> Int64:
    """Return the numbers of at most `limit` grasps, each the farthest from those before."""
    if len(Ts) <= limit:
        return np.arange(len(Ts))
    first = int(rng.integers(len(Ts)))
    return np.sort(farthest_rows(grasp_features(Ts, config.spread_m), limit, first))
