"""Alignment of depth clouds by KISS-ICP, with what a table-top scene asks of it.

KISS-ICP aligns points with points, so it slides along a table, which is most of every image: the
table's points must go first (`above_table`). Its defaults are those of a car (2 m, 100 m); the
settings here are those of objects of 5 to 15 cm. It knows no normals and no colours.

Every difference between KISS-ICP's interface and this project's lives in this file: it takes and
gives `T_map_cloud`, in metres, as `T_a_b` here; its thresholds are absolute; `convergence` is the
length of its step, rotation and translation in one number [rad, m].
"""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import MissingLibraryError
from realsim.geometry import se3
from realsim.geometry.clouds import voxel_mean

GATE_SIGMAS = 3.0
"""KISS-ICP's own ratio of the reach of its partners to the width of its kernel."""


def import_kiss(module: str) -> Any:
    """Return a module of the package `kiss_icp`; the only way realsim imports it.

    Raises:
        MissingLibraryError: it is not installed.
    """
    try:
        return import_module(f"kiss_icp.{module}")
    except ImportError as error:
        raise MissingLibraryError(
            f"kiss_icp cannot be imported: {error}. Camera motion from depth needs it; install it "
            "with `uv sync --inexact` or `pip install kiss-icp`."
        ) from error


class LocalMap:
    """Points that other clouds are aligned to: KISS-ICP's voxel map and a tree for distances."""

    def __init__(self, points: Array, voxel_m: float, points_per_voxel: int) -> None:
        """Keep the points (N, 3) [m], at most so many in a voxel of this edge."""
        from scipy.spatial import KDTree

        mapping = import_kiss("mapping")
        # Nothing is ever removed: the distance beyond which KISS-ICP forgets is not used here.
        self._map: Any = mapping.VoxelHashMap(voxel_m, np.inf, points_per_voxel)
        self._map.add_points(np.ascontiguousarray(points))
        self._tree: Any = KDTree(points)

    def align(self, points: Array, T_guess: Array, fit: "FitConfig") -> Array:
        """Return T_map_cloud (4, 4) of the points (N, 3), from a guess of it."""
        registration = import_kiss("registration").Registration(
            fit.max_iterations, fit.convergence, 1
        )
        T: Array = registration.align_points_to_map(
            points=np.ascontiguousarray(points),
            voxel_map=self._map,
            initial_guess=np.ascontiguousarray(T_guess),
            max_correspondance_distance=GATE_SIGMAS * fit.kernel_m,
            kernel=fit.kernel_m,
        )
        return np.asarray(T, dtype=np.float64)

    def distances(self, points: Array, T: Array, reach_m: float) -> Array:
        """Return each point's distance (N,) [m] to the map, `reach_m` if it is farther."""
        d, _ = self._tree.query(se3.transform(T, points), distance_upper_bound=reach_m)
        return np.minimum(np.asarray(d, dtype=np.float64), reach_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class FitConfig:
    """How one cloud is aligned to a map."""

    kernel_m: float = 0.005
    """Width of the robust kernel [m]; the errors looked for are smaller."""
    convergence: float = 1e-4
    """Length of a step at which it ends [rad, m]: what is left then is 0.1 mm. 1e-7 costs three
    times as much and gives the same to 0.05 mm."""
    max_iterations: int = 100
    """Steps at most."""


def thin_points(points: Array, spacing_m: float) -> Array:
    """Return the points (M, 3) averaged in voxels of this edge: less noise than picking one."""
    return voxel_mean(points, spacing_m).points
