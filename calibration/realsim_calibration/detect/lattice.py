"""Sort points into a lattice: grow it from a seed, then lay the target's pattern over it."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from realsim.arrays import Array, Int64

Node = tuple[int, int]
SEEDS = 24
"""Points that are tried as the first one; a grid of dots offers far more than clutter does."""
NEIGHBOURS = 10
"""Nearest points among which the two steps of the lattice are sought."""
STEP_TOLERANCE = 0.25
"""Furthest that a point may lie from where its neighbours put it, in steps: half-way points of
clutter stay out, and perspective, which changes a step by a few per cent, stays in."""
MIN_SINE = 0.25
"""Least sine of the angle between the two steps: grids seen at up to 75 deg."""
LINE_SHARE = 0.6
"""Share of a further line that must be seen for the lattice to count as larger."""


def grow_lattices(points: Array, sizes: Array | None = None) -> list[dict[Node, int]]:
    """Return the lattices in points (n, 2), the largest first: {(i, j): point}.

    The steps i, j run clockwise. Lattices grow from points in the middle and, where sizes (n,) are
    given, from the largest ones: the letters on a sheet outnumber its dots and, being loosely in
    rows and columns, may make the larger lattice.
    """
    found: list[dict[Node, int]] = []
    if len(points) < 5:
        return found
    taken = np.zeros(len(points), dtype=bool)
    # Seeds spread over the picture's points from their middle outwards.
    order = np.argsort(np.linalg.norm(points - np.median(points, axis=0), axis=-1))
    if sizes is not None:
        order = np.stack([order, np.argsort(-sizes)], -1).ravel()
    tried = 0
    for seed in order:
        if taken[seed] or tried >= SEEDS:
            continue
        basis = _basis(points, int(seed))
        if basis is None:
            continue
        tried += 1
        lattice = _grown(points, int(seed), basis)
        taken[list(lattice.values())] = True
        found.append(lattice)
        if len(lattice) > 0.5 * len(points):
            break
    return sorted(found, key=len, reverse=True)


def _basis(points: Array, seed: int) -> tuple[Array, Array] | None:
    """Return the two shortest steps that lead from the seed to a point on either side."""
    offset = points - points[seed]
    near = np.argsort(np.linalg.norm(offset, axis=-1))[1 : NEIGHBOURS + 1]
    steps: list[Array] = []
    for k in near:
        step = offset[k]
        length = float(np.linalg.norm(step))
        back = np.linalg.norm(offset[near] + step, axis=-1)
        if back.min() > STEP_TOLERANCE * length:
            continue
        step = (step - offset[near[int(back.argmin())]]) / 2
        if not steps:
            steps.append(step)
            continue
        cross = float(steps[0][0] * step[1] - steps[0][1] * step[0])
        sine = cross / (np.linalg.norm(steps[0]) * np.linalg.norm(step))
        if abs(sine) > MIN_SINE:
            return (steps[0], step) if cross > 0 else (steps[0], -step)
    return None


def _grown(points: Array, seed: int, basis: tuple[Array, Array]) -> dict[Node, int]:
    """Return the lattice that spreads from a seed point by point."""
    lattice: dict[Node, int] = {(0, 0): seed}
    used = {seed}
    front: list[tuple[Node, Array, Array]] = [((0, 0), basis[0], basis[1])]
    while front:
        grown: list[tuple[Node, Array, Array]] = []
        for (i, j), a, b in front:
            here = points[lattice[i, j]]
            for (di, dj), step in (((1, 0), a), ((-1, 0), -a), ((0, 1), b), ((0, -1), -b)):
                node = (i + di, j + dj)
                if node in lattice:
                    continue
                distance = np.linalg.norm(points - (here + step), axis=-1)
                k = int(distance.argmin())
                limit = STEP_TOLERANCE * min(np.linalg.norm(a), np.linalg.norm(b))
                if distance[k] > limit or k in used:
                    continue
                lattice[node] = k
                used.add(k)
                taken = points[k] - here
                new_a, new_b = (taken * di, b) if di else (a, taken * dj)
                grown.append((node, new_a, new_b))
        front = grown
    return lattice


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Laid:
    """A pattern laid over a lattice."""

    points: Int64
    """(n,) the point under each node of the pattern, -1 where there is none."""
    larger: bool
    """Whether the lattice goes on beyond the pattern."""

    @property
    def seen(self) -> int:
        """Nodes of the pattern that have a point."""
        return int((self.points >= 0).sum())


def unimodular(*, mirrored: bool = False) -> list[Int64]:
    """Return the (2, 2) changes of basis with entries -1, 0, 1 and determinant 1 (-1: mirrored)."""
    wanted = -1 if mirrored else 1
    return [
        np.array([[a, b], [c, d]], np.int64)
        for a, b, c, d in product((-1, 0, 1), repeat=4)
        if a * d - b * c == wanted
    ]


def lay_pattern(
    lattice: dict[Node, int], pattern: Int64, beyond: list[Int64], *, mirrored: bool = False
) -> list[Laid]:
    """Return the ways to lay a pattern (n, 2) over a lattice that cover most of its nodes.

    All proper changes of basis are tried, so that it does not matter along which steps the
    lattice was grown; mirrored ones only where asked for.

    Args:
        lattice: {(i, j): point}.
        pattern: (n, 2) nodes of the target.
        beyond: lines of nodes that a larger target would have.
        mirrored: try the mirrored changes of basis instead.
    """
    found: list[Laid] = []
    nodes = np.array(list(lattice), dtype=np.int64).reshape(-1, 2)
    values = np.array(list(lattice.values()), dtype=np.int64)
    if not len(nodes):
        return found
    origin, extent = pattern.min(0), np.ptp(pattern, axis=0) + 1
    pad = extent + 2
    for M in unimodular(mirrored=mirrored):
        seen = nodes @ M.T
        low, size = seen.min(0), np.ptp(seen, axis=0) + 1
        table = np.full(size + 2 * pad, -1, dtype=np.int64)
        table[tuple((seen - low + pad).T)] = values
        slack = size - extent
        for dx in range(min(0, int(slack[0])), max(0, int(slack[0])) + 1):
            for dy in range(min(0, int(slack[1])), max(0, int(slack[1])) + 1):
                shift = pad - origin + [dx, dy]
                line = [(table[tuple((b + shift).T)] >= 0).mean() for b in beyond]
                points = table[tuple((pattern + shift).T)]
                found.append(Laid(points=points, larger=max(line, default=0.0) >= LINE_SHARE))
    most = max(laid.seen for laid in found)
    return [laid for laid in found if laid.seen == most > 0]
