"""The relative pose of two views from their depth: which pairs, and how each is measured."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.registration.odometry.above_table import ViewCloud, snapped
from realsim.registration.odometry.kiss import FitConfig, LocalMap

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class PairConfig:
    """How two views are aligned and which are."""

    fit: FitConfig = field(default_factory=FitConfig)
    voxel_m: float = 0.004
    """Edge of the voxels of the map [m]; partners are found up to two of them away."""
    points_per_voxel: int = 2
    """Points kept in each: the clouds are averaged in voxels of this size already."""
    reach_m: float = 0.010
    """Distances beyond this count as this much [m]: such a point has no partner."""
    partner_m: float = 0.005
    """A point with another this near has a partner [m]: the spacing of the averaged points."""
    zoom_deg: float = 20.0
    """Being e times as far away makes two views as different as this angle [deg]."""
    most_deg: float = 40.0
    """Views farther apart than this are paired only if the tree needs it [deg]: beyond it the
    alignment is wrong by 1.3 mm in simulation, within 15 degrees by 0.25."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Edge:
    """The measured relative pose of two views; numbers are places in the list of views."""

    first: int
    second: int
    T_first_second: Array
    """(4, 4) the second camera in the first one's axes [m]."""
    overlap: float
    """Share of the second view's points that have a partner in the first."""
    distance_m: float
    """Mean distance of those points to the first view's, capped [m]."""


class PairMeter:
    """Measures relative poses of views; the map of each view is made once, when it is needed."""

    def __init__(self, clouds: Sequence[ViewCloud], config: PairConfig) -> None:
        """Keep the views."""
        self.clouds = clouds
        self.config = config
        self._maps: dict[int, LocalMap] = {}

    def measure(self, first: int, second: int, T_guess: Array) -> Edge:
        """Return the pose of the second view in the first, from a guess T_first_second (4, 4).

        The table gives three of the six numbers, KISS-ICP the other three.
        """
        a, b = self.clouds[first], self.clouds[second]
        guess = snapped(T_guess, a, b)
        T = snapped(self._map(first).align(b.source, guess, self.config.fit), a, b)
        overlap, distance = self.agreement(first, second, T)
        return Edge(
            first=first, second=second, T_first_second=T, overlap=overlap, distance_m=distance
        )

    def agreement(self, first: int, second: int, T_first_second: Array) -> tuple[float, float]:
        """Return the overlap [share] and mean capped distance [m] of two views at a pose."""
        d = self._map(first).distances(
            self.clouds[second].source, T_first_second, self.config.reach_m
        )
        return float(np.mean(d < self.config.partner_m)), float(np.mean(d))

    def _map(self, k: int) -> LocalMap:
        """Return the map of view k in its own axes."""
        if k not in self._maps:
            self._maps[k] = LocalMap(
                self.clouds[k].target, self.config.voxel_m, self.config.points_per_voxel
            )
        return self._maps[k]


def view_angles(Ts_world_cam: Array, aim: Array, zoom_deg: float) -> Array:
    """Return how different the views are (F, F) [deg]: directions to `aim` (3,), and distances."""
    rays = Ts_world_cam[:, :3, 3] - aim
    far = np.linalg.norm(rays, axis=1)
    u = rays / far[:, None]
    angles = np.degrees(np.arccos(np.clip(u @ u.T, -1.0, 1.0)))
    zoom = zoom_deg * (np.log(far)[:, None] - np.log(far)[None])
    return np.hypot(angles, zoom)


def neighbour_pairs(angles: Array, config: PairConfig) -> list[tuple[int, int]]:
    """Return pairs of places (i, j), i < j: the tree of nearest views, then each one's next.

    The tree joins all views by the shortest steps there are; the second pair of each view tells a
    wrong view from a wrong alignment.

    Args:
        angles: (F, F) of `view_angles`.
        config: see there.
    """
    from scipy.sparse.csgraph import minimum_spanning_tree

    n = len(angles)
    # Coinciding views are 0 degrees apart, which a sparse graph takes for no edge.
    tree = minimum_spanning_tree(angles + 1e-6 - 1e-6 * np.eye(n)).tocoo()
    pairs = {
        (min(i, j), max(i, j)) for i, j in zip(tree.row.tolist(), tree.col.tolist(), strict=True)
    }
    for k in range(n):
        for j in np.argsort(angles[k], kind="stable").tolist():
            pair = (min(j, k), max(j, k))
            if j == k or pair in pairs:
                continue
            if angles[j, k] < config.most_deg:
                pairs.add(pair)
            break
    return sorted(pairs)


def further_pairs(
    angles: Array, known: Sequence[tuple[int, int]], suspects: Sequence[int], each: int,
    config: PairConfig,
) -> list[tuple[int, int]]:  # fmt: skip
    """Return up to `each` more pairs for every suspect view, the nearest not yet known."""
    pairs, new = set(known), set[tuple[int, int]]()
    for k in suspects:
        added = 0
        for j in np.argsort(angles[k], kind="stable").tolist():
            pair = (min(j, k), max(j, k))
            if angles[j, k] > config.most_deg or added == each:
                break
            if j != k and pair not in pairs:
                pairs.add(pair)
                new.add(pair)
                added += 1
    return sorted(new)


def relative(Ts_world_cam: Array, first: int, second: int) -> Array:
    """Return T_first_second (4, 4) of two of the poses."""
    return se3.invert(Ts_world_cam[first]) @ Ts_world_cam[second]
