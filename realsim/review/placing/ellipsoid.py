"""How sure a pose is, to be looked at: an ellipsoid about the object's middle, and its turns.

The covariance of a pose is that of its right perturbation, T exp(xi) with xi = [omega, v] in the
object's frame. A point c of the object is then off by R (v - c x omega), hence
    C_world = R J C J^T R^T,  J = [-hat(c), I].
Of a body of revolution the turn about its own axis means nothing. Its middle is therefore taken on
the axis, where that turn moves nothing.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import Mesh, ObjectModel, ObjectPose

PARALLEL = 1e-3
"""Sine below which two axes of revolution are one."""


class Ellipsoid(NamedTuple):
    """Where the middle of an object may be."""

    T_world_ellipsoid: Array
    """(4, 4): its centre, and its axes as columns, the longest first."""
    radii_m: Array
    """(3,) half axes, the longest first [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseSigmas:
    """How sure position and turn of an object are."""

    position_m: float
    """1-sigma of the position along its worst axis [m]."""
    sigmas_deg: tuple[float, ...]
    """1-sigma about the principal axes, the greatest first [deg]; two of a body of revolution, none
    of a ball."""
    words: str
    """The turns for a person, and what was left out."""


def ellipsoid_of(
    placed: ObjectPose,
    sigmas: float = 2.0,
    exaggeration: float = 1.0,
    model: ObjectModel | None = None,
) -> Ellipsoid | None:
    """Return the ellipsoid of the position of an object's middle; None = nothing is known.

    Args:
        placed: the object with its covariance.
        sigmas: how many 1-sigmas its half axes are long.
        exaggeration: by which it is blown up, to be seen at all.
        model: whose middle is meant; None = the origin of the object's frame.

    Raises:
        InputError: sigmas or exaggeration are not positive.
    """
    if not (0 < sigmas < np.inf and 0 < exaggeration < np.inf):
        raise InputError(
            f"an ellipsoid of {sigmas} sigmas, {exaggeration} times as large, cannot be drawn; "
            "both must be positive."
        )
    C = placed.covariance
    if C is None or not np.all(np.isfinite(C)):
        return None
    c = np.zeros(3) if model is None else middle_of(model)
    R = placed.T_world_obj[:3, :3]
    J = np.concatenate([-se3.hat(c), np.eye(3)], axis=1)
    values, vectors = np.linalg.eigh(R @ J @ (0.5 * (C + C.T)) @ J.T @ R.T)
    radii = sigmas * exaggeration * np.sqrt(np.maximum(values[::-1], 0.0))
    axes = vectors[:, ::-1].copy()
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return Ellipsoid(se3.from_rt(axes, R @ c + placed.T_world_obj[:3, 3]), radii)


def middle_of(model: ObjectModel) -> Array:
    """Return the middle (3,) of an object in its frame [m]: of its bounds, on its own axis."""
    c = model.mesh.bounds.mean(0)
    axes = _axes(model)
    if len(axes) == 1:
        a, p = axes[0]
        return p + a * (a @ (c - p))
    if len(axes) > 1:  # of a ball: where its axes meet
        across = [np.eye(3) - np.outer(a, a) for a, _ in axes]
        right = np.sum([P @ p for P, (_, p) in zip(across, axes, strict=True)], axis=0)
        return np.asarray(np.linalg.solve(np.sum(across, axis=0), right), np.float64)
    return c


def pose_sigmas(placed: ObjectPose, model: ObjectModel) -> PoseSigmas | None:
    """Return how sure the pose is, turns that look alike left out; None = nothing is known.

    Args:
        placed: the object with its covariance.
        model: the object, with its axes of revolution.
    """
    C = placed.covariance
    if C is None or not np.all(np.isfinite(C)):
        return None
    position_m = float(np.sqrt(max(float(np.linalg.eigvalsh(C[3:, 3:])[-1]), 0.0)))
    axes = _axes(model)
    if len(axes) > 1:
        words = "a ball: every turn of it looks alike"
        return PoseSigmas(position_m=position_m, sigmas_deg=(), words=words)
    basis = np.eye(3) if not axes else np.linalg.svd(axes[0][0][None])[2][1:]
    values = np.linalg.eigvalsh(basis @ (0.5 * (C + C.T))[:3, :3] @ basis.T)[::-1]
    found = tuple(float(s) for s in np.degrees(np.sqrt(np.maximum(values, 0.0))))
    figures = ", ".join(f"{s:.2g}" for s in found[:-1]) + f" and {found[-1]:.2g} deg"
    if axes:
        words = f"{figures} across its own axis; turns about that axis look alike and are left out"
    else:
        words = f"{figures} about its principal axes"
    return PoseSigmas(position_m=position_m, sigmas_deg=found, words=words)


def _axes(model: ObjectModel) -> list[tuple[Array, Array]]:
    """Return the different axes of revolution as (unit direction, point on it [m])."""
    found: list[tuple[Array, Array]] = []
    for direction, point in model.symmetry_axes:
        a = np.asarray(direction, dtype=np.float64)
        a = a / np.linalg.norm(a)
        if all(np.linalg.norm(np.cross(a, b)) > PARALLEL for b, _ in found):
            found.append((a, np.asarray(point, dtype=np.float64)))
    return found


@lru_cache(maxsize=4)
def unit_sphere(divisions: int = 2) -> Mesh:
    """Return a sphere of radius 1: an icosahedron whose edges were halved so many times.

    Args:
        divisions: 0 to 5; 20 4^divisions triangles, 320 of two.

    Raises:
        InputError: another number of divisions.
    """
    if not 0 <= divisions <= 5:
        raise InputError(f"a sphere of {divisions} divisions; 0 to 5 is accepted.")
    g = (1 + np.sqrt(5)) / 2
    v = np.array([[0, s, t * g] for s in (-1, 1) for t in (-1, 1)], dtype=np.float64)
    v = np.concatenate([v, np.roll(v, 1, axis=1), np.roll(v, 2, axis=1)])
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    # Faces are the triples of corners an edge apart, turned outwards.
    near = v @ v.T > 0.4
    f = np.array([t for t in combinations(range(12), 3) if near[np.ix_(t, t)].all()])
    inward = np.linalg.det(v[f]) < 0
    f[inward] = f[inward, ::-1]
    for _ in range(divisions):
        edges = np.sort(f[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        (a, b, c), (ab, bc, ca) = f.T, (len(v) + index.reshape(-1, 3)).T
        rows = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        f = np.concatenate([np.stack(r, axis=1) for r in rows])
        v = np.concatenate([v, v[unique].sum(axis=1)])
        v /= np.linalg.norm(v, axis=1, keepdims=True)
    return Mesh(vertices=v, faces=f.astype(np.int32))
