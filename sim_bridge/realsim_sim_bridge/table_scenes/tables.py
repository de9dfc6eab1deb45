"""Ten table models, made in code: top, frame and details with a role each, and what they stand on.

The frame is `table`: the top surface is z = 0, the floor z = -height. Outlines are convex, so that
what collides is the outline as a thick plate and the rims that rise above it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int32
from realsim.geometry import parts_solids as solids
from realsim.geometry.mesh import box_mesh
from realsim.records import Mesh

Role = Literal["top", "frame", "detail", "floor", "wall"]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TablePart:
    """A piece of a table, or of the room, that has one material."""

    name: str
    role: Role
    mesh: Mesh
    """In the table's frame [m]; closed."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TableModel:
    """A table."""

    name: str
    outline: Array
    """(N, 2) rim of the top surface, convex, counter-clockwise [m]."""
    height_m: float
    """Height of the top surface over the floor."""
    parts: tuple[TablePart, ...]
    rims: tuple[Array, ...] = ()
    """Convex parts (V, 3) that rise above the top surface: an edge, the boards of a crate [m]."""

    @property
    def size_m(self) -> Array:
        """(2,) sides of the box around the outline [m]."""
        return np.ptp(self.outline, axis=0)

    @property
    def inside(self) -> Array:
        """(N', 2) where objects may lie: the outline without what the rims cover [m]."""
        low, high = self.outline.min(axis=0), self.outline.max(axis=0)
        for rim in self.rims:
            a, b = rim[:, :2].min(axis=0), rim[:, :2].max(axis=0)
            k = int(np.argmin(b - a))
            if (a[k] + b[k]) > (low[k] + high[k]):
                high[k] = min(high[k], a[k])
            else:
                low[k] = max(low[k], b[k])
        return np.clip(self.outline, low, high)


def box(low: Sequence[float], high: Sequence[float], bevel: float = 0.0) -> Array:
    """Return the triangles (F, 3, 3) of a box between two corners; `bevel` rounds its rims [m]."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    least = min(x1 - x0, y1 - y0, z1 - z0)
    return solids.extrude(ring, z0, z1, chamfer=min(bevel, 0.3 * least))


def corners(low: Sequence[float], high: Sequence[float]) -> Array:
    """Return the eight corners (8, 3) of a box [m]."""
    return box_mesh(low, high).vertices


def turned(profile: ArrayLike, x: float = 0.0, y: float = 0.0, segments: int = 48) -> Array:
    """Return the triangles of a profile (N, 2) of r, z turned about a vertical axis at x, y [m]."""
    return solids.revolve(profile, segments) + np.array([x, y, 0.0])


def rod(a: Sequence[float], b: Sequence[float], width: float) -> Array:
    """Return the triangles of a square rod from a to b [m]."""
    start, end = np.array(a, dtype=np.float64), np.array(b, dtype=np.float64)
    z = (end - start) / np.linalg.norm(end - start)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(x) < 1e-6 else x / np.linalg.norm(x)
    y = np.cross(z, x)
    w = width / 2
    ring = [-w * x - w * y, w * x - w * y, w * x + w * y, -w * x + w * y]
    A, B = (np.array([p + c for c in ring]) for p in (start, end))
    ends = [A[[0, 2, 1]], A[[0, 3, 2]], B[[0, 1, 2]], B[[0, 2, 3]]]
    return np.concatenate([solids.join(A, B), np.stack(ends)])


def part(name: str, role: Role, pieces: Sequence[Array]) -> TablePart:
    """Return a part of several closed pieces, which may touch."""
    vertices: list[Array] = []
    faces: list[Int32] = []
    for piece in pieces:
        v, f = solids.weld([piece])
        faces.append(f + sum(len(a) for a in vertices))
        vertices.append(v)
    mesh = Mesh(vertices=np.concatenate(vertices), faces=np.concatenate(faces).astype(np.int32))
    return TablePart(name=name, role=role, mesh=mesh)


def rounded(width: float, depth: float, radius: float, steps: int = 6) -> Array:
    """Return a rectangle (N, 2) with round corners, counter-clockwise, about the origin [m]."""
    x, y = width / 2 - radius, depth / 2 - radius
    middles = ((x, y, 0.0), (-x, y, 0.5), (-x, -y, 1.0), (x, -y, 1.5))
    return np.concatenate(
        [solids.arc((a, b), radius, t * np.pi, (t + 0.5) * np.pi, steps) for a, b, t in middles]
    )


def ellipse(width: float, depth: float, power: float = 2.0, n: int = 72) -> Array:
    """Return a superellipse (n, 2) about the origin [m]; 2 = ellipse, 3 = nearly a rectangle."""
    t = 2 * np.pi * np.arange(n) / n
    c, s = np.cos(t), np.sin(t)
    x, y = np.sign(c) * np.abs(c) ** (2 / power), np.sign(s) * np.abs(s) ** (2 / power)
    return np.stack([width / 2 * x, depth / 2 * y], -1)


# --- the room ---------------------------------------------------------------------------------

FLOOR_RADIUS_M = 20.0
"""Radius of the floor [m]: its end is far enough to look like the horizon."""
WALL_HALF_M = 6.0
"""Half the length of a wall [m]."""
WALL_HEIGHT_M = 2.8
WALL_CLEAR_M = 0.4
"""Walls stand so far beyond the farthest camera at least [m]."""


def floor(height_m: float) -> TablePart:
    """Return the floor under a table."""
    disc = solids.extrude(solids.circle(FLOOR_RADIUS_M, 64), -height_m - 0.1, -height_m)
    return part("floor", "floor", [disc])


def walls(height_m: float, farthest_m: float, rng: np.random.Generator) -> TablePart:
    """Return one to three walls around a table, none of them between a camera and the table."""
    pieces: list[Array] = []
    sides = rng.permutation(4)[: int(rng.integers(1, 4))]
    for side in sorted(sides.tolist()):
        away = max(farthest_m + WALL_CLEAR_M, float(rng.uniform(1.5, 3.5)))
        a = WALL_HALF_M
        piece = box((-a, away, -height_m), (a, away + 0.1, WALL_HEIGHT_M - height_m))
        turn = side * np.pi / 2
        c, s = round(np.cos(turn)), round(np.sin(turn))
        pieces.append(piece @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T)
    return part("wall", "wall", pieces)
