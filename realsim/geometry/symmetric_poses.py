"""The symmetric equivalent of a pose that is nearest to another: discrete turns, axes, spheres.

A can that is turned about its axis is the same can. Of all poses that look alike the one that lies
nearest to the truth is meant by every error here. About an axis the best angle is computed, not
picked from samples: steps of 5 degrees alone leave 2.2 mm at the rim of a 100 mm disc.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh_shape import hull_vertices

Axes = Sequence[tuple[ArrayLike, ArrayLike]]
"""Continuous symmetries as in `ObjectModel.symmetry_axes`: (direction, point on the axis [m])."""
CHUNK = 2_000_000
"""Symmetries times vertices that are held at once (48 MB)."""
SCREENED_ANGLES = 72
"""Angles about an axis at which the error is looked at first: between two of them it has a single
minimum but for rare shapes, and then the neighbour's is as good."""
SEARCHED_MINIMA = 3
"""Minima among those angles that are refined."""
ANGLE_RAD = 1e-8
"""To which the best angle is found [rad]: 1 nm at the rim of a 20 cm disc."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""Share of a bracket that one step of the golden section leaves."""
PARALLEL = 1e-3
"""Sine of the angle below which two axes are parallel."""
SAME_POINT = 1e-3
"""Distance below which axes meet, as a share of the object's size."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Nearest:
    """The symmetry by which an estimate is nearest to the truth."""

    S: Array
    """(4, 4) T_obj_obj: T_true @ S is nearest to the estimate."""
    distance_m: float
    """Greatest distance of a vertex, |T_estimated v - T_true S v| [m]."""


def nearest_symmetry(
    T_true: ArrayLike,
    T_estimated: ArrayLike,
    vertices: ArrayLike,
    symmetries: ArrayLike | None = None,
    axes: Axes = (),
) -> Nearest:
    """Return the symmetry S that minimises max over v of |T_estimated v - T_true S v|.

    S runs over every turn about an axis times every discrete symmetry, as in BOP (Hodan et al.,
    BOP Challenge 2020, section 2.2), and with different axes through one point over all rotations
    about it. For one S the distance is the norm of an affine map of v: convex, so only corners of
    the convex hull are looked at. About an axis with v, S_k v in cylindrical coordinates the
    squared distance is a_v - b_v cos t - c_v sin t; its maximum over v is minimised over t.

    Args:
        T_true: (4, 4) true pose of the object.
        T_estimated: (4, 4) estimated pose, in the same frame.
        vertices: (V, 3) of the mesh [m].
        symmetries: (S, 4, 4) discrete ones T_obj_obj, the identity among them; None = none.
        axes: of continuous symmetry.

    Raises:
        InputError: the symmetries have another shape, an axis has no direction, or axes are
            parallel or pass each other: no body turns about both.
    """
    M = se3.invert(T_true) @ np.asarray(T_estimated, dtype=np.float64)
    S = np.eye(4)[None] if symmetries is None else np.asarray(symmetries, dtype=np.float64)
    if S.ndim != 3 or S.shape[1:] != (4, 4) or len(S) == 0:
        raise InputError(f"symmetries have shape {S.shape}; (S, 4, 4) with S >= 1 is expected.")
    v = hull_vertices(vertices)
    lines = _lines(axes, float(np.ptp(v, axis=0).max()))
    if not lines:
        return _nearest_discrete(M, v, S)
    if len(lines) > 1:
        return _nearest_about_point(M, lines)
    direction, point = lines[0]
    Ts = np.stack([_best_turn(M, v, one, direction, point) @ one for one in S])
    return _nearest_discrete(M, v, Ts)


def aligned_pose(
    T_true: ArrayLike,
    T_estimated: ArrayLike,
    vertices: ArrayLike,
    symmetries: ArrayLike | None = None,
    axes: Axes = (),
) -> Array:
    """Return T_estimated @ inv(S) (4, 4), the equivalent of the estimate nearest to the truth.

    S is that of `nearest_symmetry`; arguments and errors are the same.
    """
    S = nearest_symmetry(T_true, T_estimated, vertices, symmetries, axes).S
    return np.asarray(T_estimated, dtype=np.float64) @ se3.invert(S)


def _nearest_discrete(M: Array, v: Array, S: Array) -> Nearest:
    """Return the nearest of symmetries (S, 4, 4) to the motion M = inv(T_true) T_estimated."""
    D = M[None] - S
    step = max(1, CHUNK // len(v))
    worst = np.concatenate([
        np.square(v @ np.swapaxes(part[:, :3, :3], -1, -2) + part[:, None, :3, 3])
        .sum(axis=-1)
        .max(axis=1)
        for part in (D[k : k + step] for k in range(0, len(D), step))
    ])  # fmt: skip
    best = int(np.argmin(worst))
    return Nearest(S=S[best], distance_m=float(np.sqrt(worst[best])))


def _nearest_about_point(M: Array, lines: list[tuple[Array, Array]]) -> Nearest:
    """Return the nearest rotation about the point where axes meet: only the shift is left.

    Any other rotation R moves some point of a centrally symmetric body further:
    |(R_M - R) v + t| is at least |t| for v or for -v.
    """
    center = _meeting_point(lines)
    R = M[:3, :3]
    distance = float(np.linalg.norm(M[:3, :3] @ center + M[:3, 3] - center))
    return Nearest(S=se3.from_rt(R, center - R @ center), distance_m=distance)


def _lines(axes: Axes, size_m: float) -> list[tuple[Array, Array]]:
    """Return the different axes as (unit direction, point).

    Raises:
        InputError: one has no direction, or two neither coincide nor meet.
    """
    lines: list[tuple[Array, Array]] = []
    for direction, point in axes:
        a = np.asarray(direction, dtype=np.float64).reshape(3)
        p = np.asarray(point, dtype=np.float64).reshape(3)
        length = float(np.linalg.norm(a))
        if not (np.isfinite(length) and length > 0 and np.all(np.isfinite(p))):
            raise InputError(f"the symmetry axis {a.tolist()} through {p.tolist()} is no line.")
        a = a / length
        is_new = True
        for b, q in lines:
            across = np.cross(a, b)
            sine = float(np.linalg.norm(across))
            if sine < PARALLEL:
                gap, is_new = float(np.linalg.norm(np.cross(p - q, b))), False
            else:
                gap = abs(float((p - q) @ across)) / sine
            if gap > SAME_POINT * size_m:
                raise InputError(
                    f"two axes of continuous symmetry are {1e3 * gap:.3g} mm apart; no body turns "
                    "about both. Give axes that meet in one point (a sphere's), or one axis."
                )
        if is_new:
            lines.append((a, p))
    return lines


def _meeting_point(lines: list[tuple[Array, Array]]) -> Array:
    """Return the point (3,) nearest to all lines: sum (I - a a') (x - p) = 0."""
    across = [np.eye(3) - np.outer(a, a) for a, _ in lines]
    right = sum(P @ p for P, (_, p) in zip(across, lines, strict=True))
    return np.asarray(np.linalg.solve(sum(across, np.zeros((3, 3))), right), np.float64)


def _best_turn(M: Array, v: Array, S: Array, direction: Array, point: Array) -> Array:
    """Return the turn C (4, 4) about an axis that minimises max over v of |M v - C S v|."""
    q, u = se3.transform(M, v) - point, se3.transform(S, v) - point
    q_along, u_along = q @ direction, u @ direction
    q_across = q - q_along[:, None] * direction
    u_across = u - u_along[:, None] * direction
    # |q - C u|^2 = (q_along - u_along)^2 + |q_across|^2 + |u_across|^2 - 2 q_across . C u_across
    a = np.square(q_along - u_along) + np.sum(q_across**2 + u_across**2, axis=1)
    b = 2 * np.sum(q_across * u_across, axis=1)
    c = 2 * np.cross(u_across, q_across) @ direction

    def worst(angles: Array) -> Array:
        return (a - np.cos(angles)[:, None] * b - np.sin(angles)[:, None] * c).max(axis=1)

    # Where all sinusoids together are least: the least-squares angle is screened with the others.
    least_squares = float(np.arctan2(c.sum(), b.sum()))
    step = 2 * np.pi / SCREENED_ANGLES
    angles = np.asarray(least_squares + step * np.arange(SCREENED_ANGLES), np.float64)
    f = worst(angles)
    is_low = (f <= np.roll(f, 1)) & (f <= np.roll(f, -1))
    starts = angles[is_low][np.argsort(f[is_low], kind="stable")[:SEARCHED_MINIMA]]
    found = _golden_section(worst, starts - step, starts + step)
    candidates = np.concatenate([found, starts])
    angle = candidates[int(np.argmin(worst(candidates)))]
    R = se3.exp_so3(angle * direction)
    return se3.from_rt(R, point - R @ point)


def _golden_section(worst: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Return minima (K,) of a function between `low` and `high` (K,), all narrowed at once."""
    inner, outer = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    f_inner, f_outer = worst(inner), worst(outer)
    while float((high - low).max()) > ANGLE_RAD:
        left = f_inner < f_outer
        low, high = np.where(left, low, inner), np.where(left, outer, high)
        new = np.where(left, high - GOLDEN * (high - low), low + GOLDEN * (high - low))
        f_new = worst(new)
        inner, outer = np.where(left, new, outer), np.where(left, inner, new)
        f_inner, f_outer = np.where(left, f_new, f_outer), np.where(left, f_inner, f_new)
    return (low + high) / 2
