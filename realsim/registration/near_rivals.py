"""Near-symmetric poses compared again, now that the cameras are right.

In the search, cameras are off by a millimetre, and a pipe whose ends differ by half a millimetre
stays undecided. Refined, the averaged points lie within a tenth of a millimetre of the surface; so
the pose and its rival are fitted to the same points, and the squares of their residuals compared
cell by cell over the surface (a paired t-test over cells of `cell_m`, each an independent piece).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.registration.body import Body
from realsim.registration.evidence import Cloud
from realsim.registration.judging.verdict import CONTRAST_DECIDED
from realsim.registration.solver import SolverConfig, solve_pose


@dataclass(frozen=True, kw_only=True, slots=True)
class RivalConfig:
    """When one of two near-symmetric poses is decided for."""

    cell_m: float = 0.005
    """Cells of the surface whose residuals count as independent [m]."""
    floor_m: float = 1e-4
    """What residuals are compared with at least [m]: no mesh and no camera is better."""
    cap_m: float = 0.003
    """Larger residuals count as this [m]: points of a neighbour."""
    t: float = 4.0
    """Standard errors by which the rival must be worse..."""
    ratio: float = 0.25
    """...and share of the mean square by which it must be."""
    same_m: float = 0.001
    """Fitted poses nearer than this are one [m]."""
    least_cells: int = 12
    """Fewer cells decide nothing."""
    solver: SolverConfig = field(default_factory=SolverConfig)
    """The fits."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Duel:
    """What came of a pose and its rival."""

    contrast: float | None
    """On the scale of the search's: `CONTRAST_DECIDED` and more is decided; negative = the rival is
    better; None = the rival turned out to be the same pose."""
    T_rival: Array
    """(4, 4) the rival, fitted."""


def duel(
    body: Body, T: Array, T_rival: Array, cloud: Cloud, misfit_m: float, config: RivalConfig
) -> Duel | None:
    """Return how clearly a pose is better than its rival; None = too few points to say.

    Args:
        body: the object.
        T: (4, 4) its pose.
        T_rival: (4, 4) the other, near enough to be fitted.
        cloud: the object's averaged points, cameras refined.
        misfit_m: by how much the object's mesh is off everywhere [m].
        config: see there.
    """
    fitted = [
        solve_pose(body, cloud, X, config.solver.fine, config.solver).T_world_obj
        for X in (T, T_rival)
    ]
    if mssd_symmetric(fitted[0], fitted[1], body.model) < config.same_m:
        # On better points the two are one: the rival was no more than an unfinished fit.
        return Duel(contrast=None, T_rival=fitted[1])
    squares = [_squares(body, X, cloud, misfit_m, config) for X in fitted]
    cells = np.floor(se3.transform(se3.invert(T), cloud.points) / config.cell_m).astype(np.int64)
    _, of = np.unique(cells, axis=0, return_inverse=True)
    of = of.reshape(-1)
    count = np.bincount(of)
    if len(count) < config.least_cells:
        return None
    means = [np.bincount(of, weights=s) / count for s in squares]
    worse = means[1] - means[0]
    error = float(np.std(worse, ddof=1) / np.sqrt(len(worse)))
    t = float(worse.mean()) / max(error, 1e-12)
    ratio = float(worse.mean() / min(means[0].mean(), means[1].mean()))
    size = min(abs(t) / config.t, abs(ratio) / config.ratio)
    return Duel(contrast=float(np.sign(t)) * CONTRAST_DECIDED * size, T_rival=fitted[1])


def duels(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    rivals: Sequence[Array | None],
    clouds: Sequence[Cloud],
    misfits_m: Sequence[float],
    config: RivalConfig,
) -> list[Duel | None]:
    """Return the duel of every object that has a rival; arguments as of `duel`, per object."""
    return [
        None if R is None else duel(b, T, R, c, float(m), config)
        for b, T, R, c, m in zip(bodies, poses, rivals, clouds, misfits_m, strict=True)
    ]


def _squares(body: Body, T: Array, cloud: Cloud, misfit_m: float, config: RivalConfig) -> Array:
    """Return (N,) squares of the residuals, in units of what they should be."""
    d = np.minimum(np.abs(body.field.distance(cloud.points, se3.invert(T))), config.cap_m)
    return np.square(d) / (np.square(cloud.sigmas) + max(misfit_m, config.floor_m) ** 2)
