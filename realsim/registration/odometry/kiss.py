"""Alignment of depth clouds by KISS-ICP, with what a table-top scene asks of it.

KISS-ICP aligns points with points, so it slides along a table, which is most of every image: the
table's points must go first (`above_table`). Its defaults are those of a car (2 m, 100 m); the
settings here are those of objects of 5 to 15 cm. It knows no normals and no colours.

Every difference between KISS-ICP's interface and this project's lives in this file: it takes and
gives `T_map_cloud`, in metres, as `T_a_b` here; its thresholds are absolute; `convergence` is the
length of its step, rotation and translation in one number [rad, m].
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, MissingLibraryError
from realsim.geometry import se3
from realsim.geometry.clouds import voxel_mean

LEAST_POINTS = 30
"""Fewer points have no shape."""
GATE_SIGMAS = 3.0
"""KISS-ICP's own ratio of the reach of its partners to the width of its kernel."""


@dataclass(frozen=True, kw_only=True, slots=True)
class OdometryConfig:
    """Settings of KISS-ICP for things on a table."""

    voxel_m: float = 0.004
    """Edge of the map's voxels [m]; partners are looked for in the neighbouring ones, up to two
    edges away. 10 mm lost a third of the motion in simulation."""
    points_per_voxel: int = 2
    """Points kept in a voxel of the running map: the clouds are averages already. KISS-ICP's own
    20 cost three times as much and drift twice as far (60 views of 5 degrees)."""
    max_range_m: float = 1.0
    """Points farther from the camera are not used [m]: stereo is worth nothing there."""
    initial_threshold_m: float = 0.020
    """First guess of how wrong the predicted motion is [m]; it adapts from there."""
    min_motion_m: float = 0.002
    """Corrections of the prediction below this do not make the threshold smaller [m]."""
    convergence: float = 1e-5
    """Length of a step at which the iteration ends [rad, m]; KISS-ICP's own 1e-4 stops early on
    motions of millimetres, 1e-7 costs more and gives the same."""
    max_iterations: int = 500
    """Steps at most."""
    overlap_m: float = 0.005
    """A point with another this near has a partner [m]: the spacing of the thinned clouds."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Odometry:
    """Camera motion from depth alone."""

    Ts_first_cam: Array
    """(F, 4, 4) each camera in the first one's axes [m]."""
    overlaps: Array
    """(F,) share of a view's points that have a partner in those before it; 1 for the first."""
    distances_m: Array
    """(F,) median distance to that partner [m]; 0 for the first."""
    cpu_s: float
    """CPU time of all of it [s]."""


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


def odometry(
    clouds: Sequence[Array], config: OdometryConfig, guesses: Sequence[Array] | None = None
) -> Odometry:
    """Return the camera's motion through clouds, each aligned to the map of those before it.

    Args:
        clouds: per view (N, 3) points in camera axes, the table removed [m].
        config: settings.
        guesses: per view a guess of its T_first_cam (4, 4), of which the motion from view to view
            is used; None = the camera goes on as it did.

    Raises:
        InputError: there is no cloud, or one has too few points; it is named.
    """
    _check(clouds, guesses)
    began = time.process_time()
    icp = _odometry_of(config)
    poses: list[Array] = []
    overlaps, distances = [1.0], [0.0]
    stamps = np.zeros(0)
    for k, cloud in enumerate(clouds):
        if guesses is not None and k > 0:
            icp.last_delta = se3.invert(guesses[k - 1]) @ guesses[k]
        before = icp.local_map.point_cloud() if k > 0 else None
        _, source = icp.register_frame(np.ascontiguousarray(cloud, dtype=np.float64), stamps)
        T = np.array(icp.last_pose, dtype=np.float64)
        if before is not None:
            d = _distances(before, se3.transform(T, np.asarray(source)), config)
            overlaps.append(float(np.mean(d < config.overlap_m)))
            distances.append(float(np.median(d)))
        else:
            icp.last_delta = np.eye(4)
        poses.append(T)
    Ts = np.stack(poses)
    return Odometry(
        Ts_first_cam=se3.invert(Ts[0]) @ Ts,
        overlaps=np.array(overlaps),
        distances_m=np.array(distances),
        cpu_s=time.process_time() - began,
    )


def thin_points(points: Array, spacing_m: float) -> Array:
    """Return the points (M, 3) averaged in voxels of this edge: less noise than picking one."""
    return voxel_mean(points, spacing_m).points


def _odometry_of(config: OdometryConfig) -> Any:
    """Return KISS-ICP's own odometry with these settings."""
    settings = import_kiss("config").KISSConfig()
    settings.data.max_range = config.max_range_m
    settings.data.min_range = 0.0
    # The camera stands still while it measures.
    settings.data.deskew = False
    settings.mapping.voxel_size = config.voxel_m
    settings.mapping.max_points_per_voxel = config.points_per_voxel
    settings.registration.convergence_criterion = config.convergence
    settings.registration.max_num_iterations = config.max_iterations
    # The sums of several threads differ in their last digits from run to run.
    settings.registration.max_num_threads = 1
    settings.adaptive_threshold.fixed_threshold = None
    settings.adaptive_threshold.initial_threshold = config.initial_threshold_m
    settings.adaptive_threshold.min_motion_th = config.min_motion_m
    return import_kiss("kiss_icp").KissICP(config=settings)


def _distances(map_points: Array, points: Array, config: OdometryConfig) -> Array:
    """Return each point's distance (N,) to the map's points [m]."""
    from scipy.spatial import KDTree

    tree: Any = KDTree(thin_points(map_points, config.voxel_m / 2))
    return np.asarray(tree.query(points)[0], dtype=np.float64)


def _check(clouds: Sequence[Array], guesses: Sequence[Array] | None) -> None:
    """Raise InputError if there is nothing to align, or a cloud is too small."""
    if not clouds:
        raise InputError("no clouds were given; odometry needs at least one view.")
    if guesses is not None and len(guesses) != len(clouds):
        raise InputError(
            f"{len(guesses)} guesses were given for {len(clouds)} clouds; one for each is needed."
        )
    for k, cloud in enumerate(clouds):
        if np.asarray(cloud).ndim != 2 or np.asarray(cloud).shape[1] != 3:
            raise InputError(
                f"cloud {k} has shape {np.asarray(cloud).shape}; points (N, 3) are expected."
            )
        if len(cloud) < LEAST_POINTS:
            raise InputError(
                f"cloud {k} has {len(cloud)} points; at least {LEAST_POINTS} are needed. Is there "
                "anything on the table in this view, and is the table's height right?"
            )
