"""What an object stands on and beside while the fingers close."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from realsim.arrays import Array

REACH_M = 0.03
"""Neighbours farther from the object are not there [m]: closing fingers shift what they hold in the
end by some mm, rarely by 2 cm, and what goes 5 cm is lost."""
MOST_OVERLAP_M = 0.01
"""What reaches deeper into the object [m] is no error of registration, and is left out."""
PASSES = 4
"""Times that a neighbour's part is moved out of one of the object's parts and maybe into another's;
one that still overlaps is left out."""
RESTING_M = 1e-5
"""Overlap that pushes nothing away [m]: less than a resting object sinks into the table."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Stand:
    """A table and fixed neighbours, table frame, which the object meets and the hand does not.

    Reach has judged before whether the hand meets them. They are there until the hand has closed,
    then they sink, and what holds the object is the hand. While fingers close the object has its
    weight: in an engine that simulates a greater mass (`SlipPhysics.mass_floor_kg`) the weight of
    that mass, because an object that is pushed over a table comes to rest as its weight makes it,
    whatever its mass. From when the table sinks it is the true weight, as in all loads.
    """

    height_m: float
    """Height of the table, where the object's lowest point is [m]: registration leaves objects some
    mm in or above the true one, from which they would jump or onto which they would fall."""
    friction: float
    """Coulomb coefficient between the object and all of it."""
    gravity: float
    """[m/s^2], along -z."""
    obstacles: tuple[Array, ...] = ()
    """Vertices (V, 3) of convex parts of neighbours within `REACH_M` [m]."""
    moved_m: float = 0.0
    """Farthest that one of them was moved out of the object [m]."""
    left_out: int = 0
    """Parts within reach that could not be moved out of the object."""

    @classmethod
    def around(
        cls, parts: Sequence[Array], neighbours: Sequence[Array], friction: float, gravity: float
    ) -> "Stand":
        """Return what is under and around an object.

        A neighbour's part that overlaps the object would throw it. It is moved back along the
        normal of a face, where that is shortest; one that overlaps by more than 1 cm, or is in the
        way of several parts, is left out.

        Args:
            parts: vertices (V, 3) of the object's convex parts where it stands, table frame [m].
            neighbours: likewise, of all its neighbours.
            friction: of the object with the table and with them.
            gravity: [m/s^2].
        """
        corners = np.concatenate(list(parts))
        low, high = corners.min(axis=0) - REACH_M, corners.max(axis=0) + REACH_M
        near = [
            p for p in neighbours if (p.max(axis=0) > low).all() and (p.min(axis=0) < high).all()
        ]
        own = [(part, _normals(part)) for part in parts]
        clear = [_moved_out(part, own) for part in near]
        kept = [(part, moved) for part, moved in clear if part is not None]
        return cls(
            height_m=float(corners[:, 2].min()),
            friction=friction,
            gravity=gravity,
            obstacles=tuple(part for part, _ in kept),
            moved_m=max((moved for _, moved in kept), default=0.0),
            left_out=len(clear) - len(kept),
        )


def _normals(part: Array) -> Array:
    """Return the outward normals (F, 3) of a convex part's faces."""
    return np.unique(np.round(ConvexHull(part).equations[:, :3], 9), axis=0)


def _moved_out(part: Array, own: list[tuple[Array, Array]]) -> tuple[Array | None, float]:
    """Return a neighbour's part outside of the object and how far it moved [m]; None = cannot be.

    Args:
        part: (V, 3) [m].
        own: vertices and normals of the object's parts.
    """
    try:
        normals = _normals(part)
    except QhullError:  # flat: no solid
        return None, 0.0
    at = part
    for _ in range(PASSES):
        depths = [_overlap(at, normals, *mine) for mine in own]
        depth, away = max(depths, key=lambda d: d[0])
        moved = float(np.linalg.norm(at[0] - part[0]))
        if depth <= RESTING_M:
            return at, moved
        at = at + depth * away
        if np.linalg.norm(at[0] - part[0]) > MOST_OVERLAP_M:
            return None, 0.0
    return None, 0.0


def _overlap(part: Array, normals: Array, own: Array, own_normals: Array) -> tuple[float, Array]:
    """Return how far a part must go to leave another, 0 = it has, and its way there (3,)."""
    if (part.min(axis=0) >= own.max(axis=0)).any() or (part.max(axis=0) <= own.min(axis=0)).any():
        return 0.0, np.zeros(3)
    ways = np.concatenate([own_normals, -normals])
    depths = (own @ ways.T).max(axis=0) - (part @ ways.T).min(axis=0)
    least = int(np.argmin(depths))
    return max(float(depths[least]), 0.0), ways[least]
