"""The last touch: every measured point belongs to the object nearest to it, and only to that.

Where objects touch, the neighbour's points pull at a fit. Once all poses are about right each
point goes to the object whose surface is nearest, and every object is fitted to its own. A result
is taken only if it explains the images as well as before: a thin-walled cup may slide along its
axis without its points noticing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.geometry.distance_field import sample
from realsim.registration.evidence import Cloud
from realsim.registration.search.refine import Candidate, CandidateConfig, Sought, candidate
from realsim.registration.search.scoring import Canvas, compose, score

Array = NDArray[np.float64]
NOBODY = -1
"""Owner of a point that is near to no object."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PolishConfig:
    """How points are shared out."""

    reach_m: float = 0.005
    """A point further than this from every surface belongs to nobody [m]."""
    rounds: int = 2
    """Times that points are shared out and objects fitted."""
    least_points: int = 60
    """Fewer own points leave an object where it is."""
    kept_gain: float = 0.97
    """Share of the rendered gain that must remain."""


def owners(
    cloud: Cloud, soughts: Sequence[Sought], Ts: Sequence[Array], reach_m: float
) -> NDArray[np.int64]:
    """Return for every point (N,) the place of the object whose surface is nearest; -1 = none.

    Args:
        cloud: measured points.
        soughts: the objects' models.
        Ts: their poses (4, 4).
        reach_m: greatest distance [m].
    """
    nearest = np.full(len(cloud.points), reach_m)
    owner = np.full(len(cloud.points), NOBODY, dtype=np.int64)
    for n, (sought, T) in enumerate(zip(soughts, Ts, strict=True)):
        field = sought.body.field
        _claim(
            cloud.points, T, sought.body.center(T), sought.reach_m + reach_m,
            (field.grid, field.origin, field.cell), (nearest, owner), n,
        )  # fmt: skip
    return owner


@njit
def _claim(
    points: Array,
    T: Array,
    center: Array,
    radius: float,
    lattice: tuple[NDArray[np.float32], Array, float],
    state: tuple[Array, NDArray[np.int64]],
    number: int,
) -> None:
    """Give an object the points that are nearer to it than to those before it."""
    grid, origin, cell = lattice
    nearest, owner = state
    for m in range(len(points)):
        a, b, c = points[m, 0] - center[0], points[m, 1] - center[1], points[m, 2] - center[2]
        if a * a + b * b + c * c > radius * radius:
            continue
        a, b, c = points[m, 0] - T[0, 3], points[m, 1] - T[1, 3], points[m, 2] - T[2, 3]
        x = T[0, 0] * a + T[1, 0] * b + T[2, 0] * c
        y = T[0, 1] * a + T[1, 1] * b + T[2, 1] * c
        z = T[0, 2] * a + T[1, 2] * b + T[2, 2] * c
        d = abs(sample(grid, origin, cell, x, y, z)[0])
        if d < nearest[m]:
            nearest[m] = d
            owner[m] = number


def polished(
    canvas: Canvas,
    cloud: Cloud,
    placed: Sequence[tuple[Sought, Candidate]],
    config: PolishConfig,
    refine: CandidateConfig,
) -> list[Candidate]:
    """Return the placed objects fitted to their own points.

    Args:
        canvas: where poses are rendered.
        cloud: fine points above the table.
        placed: models and poses.
        config: see there.
        refine: stages and constants of the fit.
    """
    now = [c for _, c in placed]
    soughts = [s for s, _ in placed]
    for _ in range(config.rounds):
        owner = owners(cloud, soughts, [c.T_world_obj for c in now], config.reach_m)
        for n, sought in enumerate(soughts):
            own = np.flatnonzero(owner == n)
            if len(own) < config.least_points:
                continue
            if len(own) > refine.fine_points:
                own = own[np.linspace(0, len(own) - 1, refine.fine_points).astype(np.int64)]
            mine = Cloud(
                points=cloud.points[own], towards=cloud.towards[own], sigmas=cloud.sigmas[own]
            )
            T = refine.fit(sought, mine, now[n].T_world_obj, refine.fine)
            new = candidate(sought, canvas, T, now[n].source, True)
            buffer = compose(canvas.table, [c.rendered for k, c in enumerate(now) if k != n])
            before = score(canvas, now[n].rendered, buffer).gain
            if score(canvas, new.rendered, buffer).gain >= config.kept_gain * before:
                now[n] = new
    return now
