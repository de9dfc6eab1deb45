"""The relative pose of two views from their depth: which pairs, and how each is measured.

Alignment of depth clouds by KISS-ICP, with what a table-top scene asks of it.

KISS-ICP aligns points with points, so it slides along a table, which is most of every image: the
table's points must go first (`above_table`). Its defaults are those of a car (2 m, 100 m); the
settings here are those of objects of 5 to 15 cm. It knows no normals and no colours.

Every difference between KISS-ICP's interface and this project's lives in this file: it takes and
gives `T_map_cloud`, in metres, as `T_a_b` here; its thresholds are absolute; `convergence` is the
length of its step, rotation and translation in one number [rad, m].
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError, MissingLibraryError
from realsim.geometry import se3
from realsim.geometry.clouds import fit_plane_ransac, refine_plane, voxel_mean
from realsim.records import SupportPlane
from realsim.registration.views import ViewPoints

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


HEIGHT_M = 0.005
"""Points less than this above the table are the table's [m]: three sigma at 40 cm."""
TOP_M = 0.40
"""Points higher than this belong to the room [m]."""
MAX_RANGE_M = 1.0
"""Points farther from the camera are not used [m]."""
WIDTHS_M = (0.016, 0.004)
"""Half-widths of the layers in which the plane is refined one after the other [m]: the first
catches a camera that is 3 cm off, the last is the table's flatness and the noise."""
PLANE_STRIDE = 4
"""Every which point the plane is refined with; 10 000 are plenty."""
RANSAC_POINTS = 3_000
"""Points of a random search for the plane."""
RANSAC_TRIPLES = 200
"""Triples of it: finds a plane of 30 % of the points with p = 0.995."""
LEAST_SHARE = 0.15
"""A plane with a smaller share of a view's points is not taken for the table."""
MAP_SPACING_M = 0.004
"""Edge of the voxels in which points are averaged that others are aligned to [m]."""
SOURCE_SPACING_M = 0.008
"""Edge of the voxels of the points that are aligned [m]; half as many points cost 1.5 times the
accuracy."""
LEAST_POINTS = 60
"""A view with fewer averaged points above the table cannot be aligned."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewCloud:
    """One view split into the table's plane and what stands on it, in camera axes."""

    index: int
    """Number of the view."""
    normal: Array | None
    """(3,) the table's normal towards the camera; None = no table is seen."""
    offset: float
    """normal . p of the table's points [m]; negative, it is minus the camera's height."""
    target: Array
    """(M, 3) averaged points above the table, for others to be aligned to [m]."""
    source: Array
    """(S, 3) coarser ones, to be aligned [m]."""


def view_cloud(view: ViewPoints, plane: SupportPlane | None, rng: np.random.Generator) -> ViewCloud:
    """Return the table and the things of one view.

    Args:
        view: its trusted points and where the camera is said to be.
        plane: the table in world, where the view's own is looked for first; None = the largest
            plane of the view.
        rng: of the random search.
    """
    p = view.points.astype(np.float64)
    p = p[p[:, 2] < MAX_RANGE_M]
    found = T_table_cam = None
    if plane is not None:
        T_table_cam = se3.invert(plane.T_world_table) @ view.T_world_cam
        found = _refine_table(p, T_table_cam[2, :3], -float(T_table_cam[2, 3]))
    if found is None:
        found = _largest(p, rng)
    if found is None:
        things = np.zeros((0, 3))
        if T_table_cam is not None:
            things = p[p @ T_table_cam[2, :3] + T_table_cam[2, 3] > HEIGHT_M]
        normal, offset = None, 0.0
    else:
        normal, offset = found
        height = p @ normal - offset
        things = p[(height > HEIGHT_M) & (height < TOP_M)]
    target = thin_points(things, MAP_SPACING_M)
    return ViewCloud(
        index=view.index,
        normal=normal,
        offset=offset,
        target=target,
        source=thin_points(target, SOURCE_SPACING_M),
    )


def snap_tables(T_a_b: Array, a: ViewCloud, b: ViewCloud) -> Array:
    """Return the relative pose of two views, turned and lifted so that their tables coincide.

    b's things are turned about their centroid, so that what an alignment said of them holds.
    """
    if a.normal is None or b.normal is None or len(b.source) == 0:
        return T_a_b
    return on_plane(T_a_b, (a.normal, a.offset), (b.normal, b.offset), b.source.mean(0))


def on_plane(
    T_a_b: Array, plane_a: tuple[Array, float], plane_b: tuple[Array, float], about: Array
) -> Array:
    """Return T_a_b after the least turn and shift that bring b's plane onto a's.

    Args:
        T_a_b: (4, 4).
        plane_a: normal (3,) and offset in a's axes, n . p = offset [m].
        plane_b: likewise in b's.
        about: (3,) the point, in b's axes, that the turn leaves where it is [m].
    """
    n_a, n_b = plane_a[0], plane_b[0]
    turned = T_a_b[:3, :3] @ n_b
    axis = np.cross(turned, n_a)
    sine, cosine = float(np.linalg.norm(axis)), float(turned @ n_a)
    turn = se3.exp_so3(axis / sine * np.arctan2(sine, cosine)) if sine > 1e-12 else np.eye(3)
    R = turn @ T_a_b[:3, :3]
    center = se3.transform(T_a_b, about[None])[0]
    height = float(n_b @ about) - plane_b[1]
    center = center + (plane_a[1] + height - float(n_a @ center)) * n_a
    return se3.from_rt(R, center - R @ about)


def _refine_table(p: Array, normal: Array, offset: float) -> tuple[Array, float] | None:
    """Return the plane (normal, offset) near a given one, or None if the view has none there."""
    few = p[::PLANE_STRIDE]
    if len(few) < LEAST_POINTS:
        return None
    n, d = np.asarray(normal, dtype=np.float64), offset
    inliers = np.zeros(len(few), dtype=bool)
    for width in WIDTHS_M:
        n, d, inliers = refine_plane(few, n, d, width)
    if np.mean(inliers) < LEAST_SHARE or d > 0:
        return None
    return n, float(d)


def _largest(p: Array, rng: np.random.Generator) -> tuple[Array, float] | None:
    """Return the view's largest plane (normal towards the camera, offset), or None."""
    few = p[:: max(1, len(p) // RANSAC_POINTS)]
    try:
        n, d, inliers = fit_plane_ransac(few, rng, WIDTHS_M[-1], RANSAC_TRIPLES)
    except DegenerateError:
        return None
    if np.mean(inliers) < LEAST_SHARE:
        return None
    return _refine_table(p, n, float(d)) if d < 0 else _refine_table(p, -n, -float(d))


VOXEL_M = 0.004
"""Edge of the voxels of a view's map [m]; partners are found up to two of them away."""
POINTS_PER_VOXEL = 2
"""Points kept in each: the clouds are averaged in voxels of this size already."""
REACH_M = 0.010
"""Distances beyond this count as this much [m]: such a point has no partner."""
PARTNER_M = 0.005
"""A point with another this near has a partner [m]: the spacing of the averaged points."""
ZOOM_DEG = 20.0
"""Being e times as far away makes two views as different as this angle [deg]."""
MOST_DEG = 40.0
"""Views farther apart than this are paired only if the tree needs it [deg]: beyond it the alignment
is wrong by 1.3 mm in simulation, within 15 degrees by 0.25."""


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

    def __init__(self, clouds: Sequence[ViewCloud], fit: FitConfig) -> None:
        """Keep the views."""
        self.clouds = clouds
        self.fit = fit
        self._maps: dict[int, LocalMap] = {}

    def measure(self, first: int, second: int, T_guess: Array) -> Edge:
        """Return the pose of the second view in the first, from a guess T_first_second (4, 4).

        The table gives three of the six numbers, KISS-ICP the other three.
        """
        a, b = self.clouds[first], self.clouds[second]
        guess = snap_tables(T_guess, a, b)
        T = snap_tables(self._map(first).align(b.source, guess, self.fit), a, b)
        overlap, distance = self.agreement(first, second, T)
        return Edge(
            first=first, second=second, T_first_second=T, overlap=overlap, distance_m=distance
        )

    def agreement(self, first: int, second: int, T_first_second: Array) -> tuple[float, float]:
        """Return the overlap [share] and mean capped distance [m] of two views at a pose."""
        d = self._map(first).distances(self.clouds[second].source, T_first_second, REACH_M)
        return float(np.mean(d < PARTNER_M)), float(np.mean(d))

    def _map(self, k: int) -> LocalMap:
        """Return the map of view k in its own axes."""
        if k not in self._maps:
            self._maps[k] = LocalMap(self.clouds[k].target, VOXEL_M, POINTS_PER_VOXEL)
        return self._maps[k]


def view_angles(Ts_world_cam: Array, aim: Array) -> Array:
    """Return how different the views are (F, F) [deg]: directions to `aim` (3,), and distances."""
    rays = Ts_world_cam[:, :3, 3] - aim
    far = np.linalg.norm(rays, axis=1)
    u = rays / far[:, None]
    angles = np.degrees(np.arccos(np.clip(u @ u.T, -1.0, 1.0)))
    zoom = ZOOM_DEG * (np.log(far)[:, None] - np.log(far)[None])
    return np.hypot(angles, zoom)


def neighbour_pairs(angles: Array) -> list[tuple[int, int]]:
    """Return pairs of places (i, j), i < j: the tree of nearest views, then each one's next.

    The tree joins all views by the shortest steps there are; the second pair of each view tells a
    wrong view from a wrong alignment.

    Args:
        angles: (F, F) of `view_angles`.
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
            if angles[j, k] < MOST_DEG:
                pairs.add(pair)
            break
    return sorted(pairs)


def further_pairs(
    angles: Array, known: Sequence[tuple[int, int]], suspects: Sequence[int], each: int
) -> list[tuple[int, int]]:
    """Return up to `each` more pairs for every suspect view, the nearest not yet known."""
    pairs, new = set(known), set[tuple[int, int]]()
    for k in suspects:
        added = 0
        for j in np.argsort(angles[k], kind="stable").tolist():
            pair = (min(j, k), max(j, k))
            if angles[j, k] > MOST_DEG or added == each:
                break
            if j != k and pair not in pairs:
                pairs.add(pair)
                new.add(pair)
                added += 1
    return sorted(new)


def relative(Ts_world_cam: Array, first: int, second: int) -> Array:
    """Return T_first_second (4, 4) of two of the poses."""
    return se3.invert(Ts_world_cam[first]) @ Ts_world_cam[second]
