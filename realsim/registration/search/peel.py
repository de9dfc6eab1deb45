"""What is left when the sure objects are taken away: starts for those that are not placed yet.

Objects in piles lean and lie on each other; no resting pose fits them. What is measured but
explained by no object falls into clusters; at each of them an object is tried in random turns.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.registration.evidence import Cloud
from realsim.registration.search.candidates import Candidate, Sought
from realsim.registration.search.height_grid import HeightGrid
from realsim.registration.search.polish import owners
from realsim.registration.search.scoring import Score

SURE_AGREE = 0.965
"""An object with a smaller share of agreeing pixels is sought again: right ones have more, and
wrong ones in piles reach 0.96."""
BESIDE_SHARE = 0.25
"""In the end an object is suspect, too, if so many points about it are explained by nothing, as
a share of its own: of a pipe in the wrong turn inside a pile all agrees that shows, but half of
its true place is left over."""
MOST_SUSPECTS = 3
"""Greatest number of these, those with the greatest share first."""
EXPLAINED_M = 0.006
"""Points this near to a sure object are explained [m]."""
LEAST_HEIGHT_M = 0.007
"""Unexplained points lower than this over the table are the table's noise [m]."""
CELL_M = 0.006
"""Points in neighbouring cells of this edge are one cluster [m]."""
LEAST_POINTS = 40
"""Smaller clusters are left-overs at the edges of sure objects."""
MOST_CLUSTERS = 12
"""Number of clusters that are searched, the largest first."""
ROUNDS = 3
"""Times that unsure objects are sought in what is left."""
ROTATIONS = 48
"""Random turns tried at each place of a cluster for each object."""
MOST_STARTS = 480
"""Maximum number of starts of one object in a round, spread over all places: 2 ms each."""
MOST_STARTS_TOGETHER = 1600
"""Maximum number of starts of all objects in a round: 53 each with 30 models, 3 s."""
LEAST_EXTENT = 0.25
"""A cluster smaller than this share of the object's size is not it."""
GREATEST_EXTENT = 1.0
"""A cluster larger than this may hold it, but is searched around several of its points."""


def taken_cells(grid: HeightGrid, T_table_world: Array, cloud: Cloud, explained: Mask) -> Mask:
    """Return the cells (X, Y) of the grid whose top point is explained by sure objects."""
    p = se3.transform(T_table_world, cloud.points)
    cells = grid.cells(p[:, :2])
    inside = np.all((cells >= 0) & (cells < grid.heights.shape), axis=1)
    top = np.zeros(len(p), dtype=bool)
    with np.errstate(invalid="ignore"):
        height = grid.heights[cells[inside, 0], cells[inside, 1]]
        top[inside] = p[inside, 2] > height - grid.cell_m
    taken = np.zeros(grid.heights.shape, dtype=bool)
    free = np.zeros(grid.heights.shape, dtype=bool)
    taken[tuple(cells[top & explained].T)] = True
    free[tuple(cells[top & ~explained].T)] = True
    return taken & ~free


def explained_points(cloud: Cloud, placed: Sequence[tuple[Sought, Candidate]]) -> Mask:
    """Return which points (N,) lie on one of these objects."""
    Ts = [c.T_world_obj for _, c in placed]
    return owners(cloud, [s for s, _ in placed], Ts, EXPLAINED_M) >= 0


def is_sure(score: Score | None) -> bool:
    """Return whether an object need not be sought again."""
    return score is not None and score.agree >= SURE_AGREE


def suspects(
    cloud: Cloud, left: Sequence[Array], placed: Sequence[tuple[Sought, Candidate]],
) -> list[int]:  # fmt: skip
    """Return the places of objects about which much is explained by nothing, the worst first.

    Args:
        cloud: measured points above the table.
        left: clusters (K, 3) of those that no object explains [m].
        placed: all objects.
    """
    if not left:
        return []
    rest = np.concatenate(left)
    Ts = [c.T_world_obj for _, c in placed]
    owner = owners(cloud, [s for s, _ in placed], Ts, EXPLAINED_M)
    found: list[tuple[float, int]] = []
    for n, (sought, c) in enumerate(placed):
        off = np.linalg.norm(rest - sought.body.center(c.T_world_obj), axis=1)
        near = int(np.count_nonzero(off < sought.body.radius_m))
        own = max(1, int(np.count_nonzero(owner == n)))
        if near >= max(LEAST_POINTS, BESIDE_SHARE * own):
            found.append((-near / own, n))
    return [n for _, n in sorted(found)[:MOST_SUSPECTS]]


def clusters(points: Array, T_table_world: Array) -> list[Array]:
    """Return the connected groups (K, 3) of points (N, 3) above the table, the largest first."""
    from scipy.ndimage import label

    points = points[se3.transform(T_table_world, points)[:, 2] > LEAST_HEIGHT_M]
    if len(points) == 0:
        return []
    cells = np.floor((points - points.min(0)) / CELL_M).astype(np.int64)
    filled = np.zeros(cells.max(0) + 1, dtype=bool)
    filled[tuple(cells.T)] = True
    numbered: Any = label(filled, structure=np.ones((3, 3, 3)))
    of_point = numbered[0][tuple(cells.T)]
    numbers, counts = np.unique(of_point, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    keep = [k for k in order if counts[k] >= LEAST_POINTS][:MOST_CLUSTERS]
    return [points[of_point == numbers[k]] for k in keep]


def residual_starts(
    sought: Sought,
    groups: Sequence[Array],
    up_world: Array,
    rng: np.random.Generator,
    turns: int,
    most: int,
) -> list[tuple[Array, str]]:
    """Return poses (4, 4) of an object at clusters of unexplained points, and their names.

    The middle of the box is put where the cluster's points would be its upper surface: under
    their mean by the half of the object's thickness along the way up.

    Args:
        sought: the model.
        groups: clusters of points.
        up_world: (3,) the table's normal.
        rng: of the turns.
        turns: so many at each place of a cluster.
        most: so many starts, spread over all places.
    """
    body = sought.body
    half = 0.5 * np.ptp(body.bounds_obj, axis=0)
    starts: list[tuple[Array, str]] = []
    for n, points in enumerate(groups):
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        if size < LEAST_EXTENT * 2 * body.radius_m:
            continue
        for anchor in _anchors(points, size, body.radius_m, rng):
            for k, R in enumerate(np.asarray(se3.random_rotation(rng, turns))):
                thickness = float(np.abs(R.T @ up_world) @ half)
                center = anchor - 0.5 * thickness * up_world
                T = se3.from_rt(R, center - R @ body.center_obj)
                starts.append((T, f"residual {n}, turn {k}"))
    few = rng.permutation(len(starts))[:most]
    return [starts[k] for k in sorted(few)]


def _anchors(points: Array, size: float, radius: float, rng: np.random.Generator) -> Array:
    """Return the points (K, 3) about which an object is put: one, or several of a large group."""
    if size <= GREATEST_EXTENT * radius:
        return points.mean(0)[None]
    count = int(np.ceil(size / radius))
    seeds = points[rng.integers(0, len(points), count)]
    near = np.linalg.norm(points[:, None] - seeds, axis=-1) < radius
    return np.stack([points[near[:, k]].mean(0) for k in range(count)])
