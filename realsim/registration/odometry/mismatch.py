"""Images that do not belong to their poses: swapped ones, and lists shifted against each other.

Such errors are too large for an alignment to bridge. They are found by putting an image at other
views' poses and asking how well it agrees with what the views around there see.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array, Int64
from realsim.geometry import se3
from realsim.registration.odometry.faults import differences
from realsim.registration.odometry.pairs import Edge, PairMeter

LEAST_OVERLAP = 0.6
"""An alignment with less overlap has failed: right ones have 0.78 or more in simulation, wrong
ones 0.6 at most."""
GROSS_MM = 10.0
"""A difference beyond this is no inaccuracy [mm]."""
GROSS_DEG = 2.0
"""A turn beyond this is no inaccuracy [deg]."""
SUSPECT_SHARE = 0.6
"""A view is suspect if this share of its pairs failed or differ grossly."""
REFERENCES = 3
"""Views around a pose that an image put there is compared with."""
REACH_DEG = 40.0
"""Such views are at most this far away [deg]."""
FITS_FACTOR = 1.6
"""An image fits a pose if its distance to what is seen there is at most so many times that of
aligned pairs (unaligned right ones: 1.05 times)."""
BETTER_FACTOR = 0.75
"""Greatest ratio of that distance to the distance at the image's own pose."""
SHIFTS = (1, -1, 2, -2)
"""Shifts of one list against the other that are tried."""
LEAST_SHIFTED = 3
"""Views after a shift at least: fewer are images mixed up one by one."""
MOST_PAIRS = 400
"""Pairs that a shift is tried on at most."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mismatch:
    """An image at a wrong pose; numbers are places in the list of views."""

    kind: Literal["swapped", "other", "shifted"]
    place: int
    """The view; of a shift, the first one."""
    other: int
    """The view whose pose it fits; of a shift, how many poses ahead."""


def has_failed(edge: Edge) -> bool:
    """Return whether a pair could not be aligned."""
    return edge.overlap < LEAST_OVERLAP


def suspects(Ts_world_cam: Array, edges: Sequence[Edge]) -> list[int]:
    """Return the places of views most of whose pairs failed or differ grossly."""
    r = differences(Ts_world_cam, edges)
    total, bad = np.zeros(len(Ts_world_cam)), np.zeros(len(Ts_world_cam))
    for e, x in zip(edges, r, strict=True):
        gross = np.linalg.norm(x[3:]) * 1e3 > GROSS_MM or (
            np.degrees(np.linalg.norm(x[:3])) > GROSS_DEG
        )
        for k in (e.first, e.second):
            total[k] += 1
            bad[k] += has_failed(e) or gross
    return np.flatnonzero((total > 0) & (bad >= SUSPECT_SHARE * total)).tolist()


def find_mismatches(
    meter: PairMeter, Ts_world_cam: Array, edges: Sequence[Edge], angles: Array
) -> tuple[tuple[Mismatch, ...], Int64]:
    """Return the images at wrong poses, and the pose (F,) that fits each; -1 = none is left.

    Args:
        meter: the views.
        Ts_world_cam: (F, 4, 4) claimed.
        edges: all pairs as measured.
        angles: (F, F) how different the views are [deg].
    """
    n = len(Ts_world_cam)
    own = np.arange(n)
    doubted = suspects(Ts_world_cam, edges)
    aligned = [e.distance_m for e in edges if not has_failed(e)]
    if not doubted or not aligned:
        return (), own
    fits = FITS_FACTOR * float(np.median(aligned))
    single, single_poses = _singles(doubted, meter, Ts_world_cam, angles, fits)
    if single and all(m.kind == "swapped" for m in single) and 2 * len(single) == len(doubted):
        return single, single_poses
    # Every view after a shift is off, but on a regular path by the same motion: its neighbours
    # agree, so a single suspect is enough to ask.
    shifted = _shift(meter, Ts_world_cam, edges, fits)
    if shifted is None:
        return single, single_poses
    poses = own + np.where(own >= shifted.place, shifted.other, 0)
    return (shifted,), np.where((poses >= 0) & (poses < n), poses, -1)


def _singles(
    doubted: Sequence[int], meter: PairMeter, Ts: Array, angles: Array, fits: float
) -> tuple[tuple[Mismatch, ...], Int64]:
    """Return the doubted images that fit other poses, one by one, and every view's pose (F,)."""
    poses = np.arange(len(Ts))
    for k in doubted:
        poses[k] = _best_pose(k, doubted, meter, Ts, angles, fits)
    found: list[Mismatch] = []
    for k in doubted:
        q = int(poses[k])
        swapped = poses[q] == k
        if q != k and (not swapped or k < q):
            found.append(Mismatch(kind="swapped" if swapped else "other", place=k, other=q))
    return tuple(found), poses


def _best_pose(
    k: int, doubted: Sequence[int], meter: PairMeter, Ts: Array, angles: Array, fits: float
) -> int:
    """Return the place of the pose that image k fits: its own unless another is much better."""
    n = len(Ts)
    near = [k + s for s in SHIFTS if 0 <= k + s < n]
    own = _misfit(k, k, doubted, meter, Ts, angles)
    costs = {q: _misfit(k, q, doubted, meter, Ts, angles) for q in sorted({*near, *doubted} - {k})}
    if not costs:
        return k
    q = min(costs, key=lambda q: costs[q])
    return q if costs[q] < min(fits, BETTER_FACTOR * own) else k


def _misfit(
    k: int, q: int, doubted: Sequence[int], meter: PairMeter, Ts: Array, angles: Array
) -> float:
    """Return the mean distance [m] of image k, put at pose q, to what trusted views see there."""
    around = [
        j
        for j in np.argsort(angles[q], kind="stable").tolist()
        if j not in (k, q) and j not in doubted and angles[q, j] < REACH_DEG
    ][:REFERENCES]
    if not around:
        return np.inf
    return float(np.mean([meter.agreement(j, k, se3.invert(Ts[j]) @ Ts[q])[1] for j in around]))


def _shift(meter: PairMeter, Ts: Array, edges: Sequence[Edge], fits: float) -> Mismatch | None:
    """Return from which view on the images fit the poses some places ahead, or None.

    With the pairs' distances as claimed (a), with both poses shifted (b) and only the later one's
    (c), a shift from view k on costs: a of pairs before k, b of pairs from k on, c across.
    """
    few = edges[:: max(1, -(-len(edges) // MOST_PAIRS))]
    first = np.array([e.first for e in few])
    second = np.array([e.second for e in few])
    claimed = _distances(meter, Ts, few, 0, 0)
    best: tuple[float, Mismatch] | None = None
    for s in SHIFTS:
        both, later = _distances(meter, Ts, few, s, s), _distances(meter, Ts, few, 0, s)
        last = len(Ts) - max(s, 0) - LEAST_SHIFTED
        for k in range(max(0, -s), last + 1):
            cost = np.where(second < k, claimed, np.where(first >= k, both, later))
            # Pairs whose shifted pose is beyond the end of the list say nothing.
            touched = (second >= k) & np.isfinite(cost)
            if np.count_nonzero(touched) < 3:
                continue
            saved = float(np.sum(claimed[touched] - cost[touched]))
            after, before = np.mean(cost[touched]), np.mean(claimed[touched])
            if after < min(fits, BETTER_FACTOR * before) and (best is None or saved > best[0]):
                best = saved, Mismatch(kind="shifted", place=k, other=s)
    return None if best is None else best[1]


def _distances(
    meter: PairMeter, Ts: Array, edges: Sequence[Edge], first_by: int, second_by: int
) -> Array:
    """Return the mean distances (E,) [m] with the pairs' poses shifted; inf = no such pose."""
    n = len(Ts)
    out = np.full(len(edges), np.inf)
    for row, e in enumerate(edges):
        i, j = e.first + first_by, e.second + second_by
        if 0 <= i < n and 0 <= j < n:
            out[row] = meter.agreement(e.first, e.second, se3.invert(Ts[i]) @ Ts[j])[1]
    return out
