"""The axes about which a surface may be symmetric: found anywhere, refined by least squares."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.models.symmetry_config import SymmetryConfig
from realsim.models.symmetry_groups import turn
from realsim.models.symmetry_surface import Surface, refinement

Array = NDArray[np.float64]

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
CAP = 0.1
"""Distances beyond this share of the diameter count as this when directions are ranked."""
WORTH_A_TRY = 0.035
"""Mean distance [share of the diameter] beyond which a direction is not refined: the half turn of
a long object about an axis 4 deg off gives 0.02."""
KEPT = {2: 14, 3: 10, 5: 6}
"""Axes refined per prime order; an icosahedron has 15, 10 and 6. Higher primes have one axis."""
APART_RAD = math.radians(12.0)
"""Directions kept are so far apart; gears with more teeth have half-turn axes closer than that,
but those follow from the main axis."""
SAME_LINE_RAD = math.radians(4.0)
"""Axes nearer than this after the refinement are one."""
LOOSE = 1.5
"""An order is pursued up to so many times the tolerance: the joint fit improves it."""
COARSE_SCALES = (0.12, 0.1, 0.08, 0.06, 0.05, 0.04)
FINE_SCALES = (-0.04, -0.03, -0.03)
"""Tukey's cuts of the refinement [share of the diameter]; negative = by exact distances."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """How well an isometry maps the surface onto itself."""

    worst: float
    """Distance all but the outliers stay below [share of the diameter]."""
    rms: float
    """RMS distance [share of the diameter]."""
    share: float
    """Share of the surface within the distance of a near symmetry."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Axis:
    """An axis with the orders about which the surface may be symmetric."""

    direction: Array
    """(3,) unit."""
    point: Array
    """(3,) on it, near the centre [share of the diameter]."""
    fits: dict[int, Fit]
    """Of the turn by 2 pi / n, per order n."""
    orders: tuple[int, ...]
    """Those worth pursuing, ascending."""


def moved_about(rotations: Array, frame: Array) -> Array:
    """Return isometries (K, 4, 4) of linear parts (K, 3, 3) about the origin of a frame (4, 4)."""
    return frame @ se3.from_rt(rotations, np.zeros(3)) @ se3.invert(frame)


def fits_of(surface: Surface, Ts: Array, config: SymmetryConfig, count: int) -> list[Fit]:
    """Return how well each isometry (K, 4, 4) maps `count` points onto the surface, exactly."""
    d = surface.exact(Ts, count)
    worst = np.quantile(d, 1.0 - config.outliers, axis=1)
    rms = np.sqrt(np.mean(np.square(d), axis=1))
    share = np.mean(d <= config.near_distance, axis=1)
    return [
        Fit(worst=float(w), rms=float(r), share=float(s))
        for w, r, s in zip(worst, rms, share, strict=True)
    ]


def half_sphere(count: int) -> Array:
    """Return evenly spread unit vectors (count, 3) with z > 0."""
    i = np.arange(count) + 0.5
    polar, around = np.arccos(1.0 - i / count), GOLDEN_ANGLE * i
    x, y = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)
    return np.stack([x, y, np.cos(polar)], axis=1)


def _directions(surface: Surface, config: SymmetryConfig) -> Array:
    """Return directions (D, 3) to try: all around, the axes of the file and those of inertia."""
    inertia = np.linalg.eigh(np.cov(surface.points.T))[1].T
    return np.concatenate([np.eye(3), inertia, half_sphere(config.directions)])


def _best(scores: Array, directions: Array, count: int) -> list[int]:
    """Return the best directions, apart from each other."""
    kept: list[int] = []
    for i in np.argsort(scores, kind="stable"):
        if scores[i] > WORTH_A_TRY or len(kept) == count:
            break
        if np.all(np.abs(directions[kept] @ directions[i]) < math.cos(APART_RAD)):
            kept.append(int(i))
    return kept


def _refined_lines(
    surface: Surface, config: SymmetryConfig, angle: float, sign: float, count: int
) -> list[tuple[Array, Array, Fit]]:
    """Return (direction, point, fit) of the best axes for one angle; sign -1 adds an inversion."""
    directions = _directions(surface, config)
    rotations = sign * se3.exp_so3(directions * angle)
    Ts = se3.from_rt(rotations, np.zeros(3))
    scores = np.minimum(surface.near(Ts, config.screening_points), CAP).mean(axis=1)
    found: list[tuple[Array, Array, Fit]] = []
    for i in _best(scores, directions, count):
        E = refinement(
            surface, Ts[i : i + 1], config.fitting_points, (*COARSE_SCALES, *FINE_SCALES)
        )
        T = E @ Ts[i : i + 1] @ se3.invert(E)
        fit = fits_of(surface, T, config, config.fitting_points)[0]
        found.append((E[:3, :3] @ directions[i], E[:3, 3], fit))
    return found


def found_axes(surface: Surface, config: SymmetryConfig) -> list[Axis]:
    """Return the axes about which the surface is symmetric or nearly so, the best first."""
    primes = [n for n in range(2, config.orders + 1) if all(n % k for k in range(2, n))]
    lines: list[tuple[Array, Array, Fit]] = []
    for p in primes:
        lines += _refined_lines(surface, config, 2 * math.pi / p, 1.0, KEPT.get(p, 1))
    lines.sort(key=lambda line: line[2].rms)
    axes: list[Axis] = []
    for direction, point, fit in lines:
        if fit.share < config.near_share:
            continue
        if all(abs(direction @ a.direction) < math.cos(SAME_LINE_RAD) for a in axes):
            axes.append(_with_orders(surface, config, direction, point))
    return axes


def _with_orders(surface: Surface, config: SymmetryConfig, direction: Array, point: Array) -> Axis:
    """Return an axis with how well each order fits it."""
    orders = range(2, config.orders + 1)
    turns = np.stack([turn(direction, 2 * math.pi / n) for n in orders])
    Ts = moved_about(turns, se3.from_translation(point))
    fits = dict(zip(orders, fits_of(surface, Ts, config, config.fitting_points), strict=True))
    likely = tuple(
        n
        for n, fit in fits.items()
        if fit.worst <= LOOSE * config.greatest_tolerance
        and fit.rms <= LOOSE * config.rms_tolerance
    )
    return Axis(direction=direction, point=point, fits=fits, orders=likely)


def best_mirror(surface: Surface, config: SymmetryConfig, axes: list[Axis]) -> Fit:
    """Return how well the best mirror image, turned at will, fits the surface.

    A shape equals its mirror image if an improper isometry maps it onto itself: a mirror plane,
    an inversion, or a turn by half the angle of one of its axes with an inversion.
    """
    fits = [fit for _, _, fit in _refined_lines(surface, config, math.pi, -1.0, KEPT[5])]
    tries = [-np.eye(3)]
    for axis in axes:
        tries += [-turn(axis.direction, math.pi + math.pi / n) for n in axis.orders]
    Ts = np.stack([se3.from_rt(A, np.zeros(3)) for A in tries])
    scores = np.minimum(surface.near(Ts, config.screening_points), CAP).mean(axis=1)
    for i in np.argsort(scores, kind="stable")[: KEPT[5]]:
        E = refinement(
            surface, Ts[i : i + 1], config.fitting_points, (*COARSE_SCALES, *FINE_SCALES)
        )
        T = E @ Ts[i : i + 1] @ se3.invert(E)
        fits += fits_of(surface, T, config, config.fitting_points)
    return min(fits, key=lambda fit: fit.worst)
