"""Cameras made to agree with each other by what they saw, without any model of an object.

Each view's points are compared with the surfaces that other views measured. It minimises
    sum over pairs of views, points   tukey((n_j . (T_j^-1 T_i p_i - p_j))^2 / (sigma^2 + misfit^2))
  + hand-eye twist h and every view's own f_i, each against its prior; T_i = claimed exp(h + f_i)
by Gauss-Newton with partners sought anew in every round and a reach that shrinks. The views' prior
sigmas are found from the views themselves, as in `refine`.

Where everything that is seen is one plane, or a body of revolution, the prior alone decides.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.robust import mad_sigma, tukey_weights
from realsim.records import CameraIntrinsics
from realsim.registration.evidence import DepthNoise
from realsim.registration.refinement.config import CameraPrior, NoiseConfig
from realsim.registration.views import ViewPoints

GAPS = 3.0
"""A partner may be so many spacings of its surface's points away."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewsConfig:
    """How views are aligned to each other."""

    reach_m: tuple[float, float] = (0.020, 0.004)
    """A partner is sought this near, in the first and the last round [m]: cameras of a real arm
    were off by 4 mm and 0.7 deg, which is 10 mm at half a metre."""
    rounds: int = 14
    """Searches for partners, each followed by one step."""
    points_per_view: int = 3000
    """At most so many points of a view are compared with the others."""
    surface_points: int = 15_000
    """Points at most of the surfaces that they are compared with: partners must be near, or
    curvature is an error."""
    partners: int = 3
    """Views with which each is compared: those whose cameras are nearest and that look the same
    way. Depth errors depend on the place in the image (views of a real F200 disagree by 1.4 mm
    beyond the noise); views from farther apart would have to agree on what neither measured
    right."""
    look_cos: float = 0.5
    """Least cosine between the axes of two cameras that are compared: beyond 60 deg they see
    different sides."""
    neighbours: int = 60
    """Points from which a normal is estimated."""
    roughness: float = 0.03
    """Greatest share of the smallest axis in the spread of these points; more is no surface."""
    facing: float = 0.8
    """Least cosine between the normals of two partners."""
    least_matches: int = 200
    """Two views with fewer partners do not overlap."""
    noise: NoiseConfig = field(default_factory=lambda: NoiseConfig(widest_m=0.005))
    """How much a point says."""
    prior: CameraPrior = field(default_factory=CameraPrior)
    """What the cameras' errors may be."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RefinedViews:
    """Where the cameras are."""

    cameras: Array
    """(V, 4, 4) T_world_cam."""
    hand_eye: Array
    """(6,) twist that all cameras have in common [rad, m]."""
    covariances: Array
    """(V, 6, 6) of the cameras' right perturbations, rotation first [rad, m]."""
    view_sigma: tuple[float, float]
    """1-sigma of the views' own errors as found [deg, mm]."""
    overlaps: Int64
    """(V,) number of views each was compared with; 0 = it kept the robot's word but for the
    hand-eye."""
    misfit_m: float
    """What residuals of a typical pair of views show beyond the noise [m]."""
    history: tuple[dict[str, float], ...]


@dataclass(frozen=True, eq=False, slots=True)
class _Surface:
    """The points of one view with their normals."""

    points: Array
    """(N, 3) in camera axes [m]."""
    normals: Array
    """(N, 3) towards the camera."""
    sigmas: Array
    """(N,) 1-sigma along the normal [m]."""
    tree: Any
    """KD-tree of the points; None = there are none."""
    few: Int64
    """Those that are compared with other views."""
    spacing_m: float
    """Typical distance of neighbours [m]."""
    crowding: float
    """How many of them are one independent measurement."""


@dataclass(frozen=True, eq=False, slots=True)
class _Match:
    """The partners of two views."""

    i: int
    j: int
    residuals: Array
    """(N,) [m]."""
    variances: Array
    """(N,) [m^2]."""
    jacobians: tuple[Array, Array]
    """(N, 6) with respect to the twists of view i and of view j."""
    crowding: float


def refine_views(
    intrinsics: CameraIntrinsics,
    views: Sequence[ViewPoints],
    noise: DepthNoise,
    config: ViewsConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> RefinedViews:
    """Return the cameras refined from the overlap of their depth images.

    Args:
        intrinsics: the camera.
        views: trusted points of all views, with the cameras' claimed poses.
        noise: of the depth.
        config: settings.
        progress: called with (rounds done, rounds).

    Raises:
        InputError: there are fewer than two views.
    """
    config = config or ViewsConfig()
    if len(views) < 2:
        raise InputError(
            f"{len(views)} views were given; two that overlap are the least that can be aligned."
        )
    area = config.noise.area_at(intrinsics.width)
    surfaces = [_surface(v, noise, area, config) for v in views]
    claimed = np.stack([v.T_world_cam for v in views])
    pairs = _pairs(claimed, config)
    twists, hand = np.zeros((len(views), 6)), np.zeros(6)
    p = config.prior
    sigmas = np.array([np.radians(p.view_deg), p.view_mm / 1e3])
    covariances = np.zeros((len(views), 6, 6))
    overlaps = np.zeros(len(views), np.int64)
    history: list[dict[str, float]] = []
    for round_, reach in enumerate(np.geomspace(*config.reach_m, config.rounds)):
        cameras = claimed @ se3.exp(twists)
        found = [_match(surfaces, cameras, i, j, reach, config) for i, j in pairs]
        matches = [m for m in found if m is not None]
        overlaps = np.bincount([k for m in matches for k in (m.i, m.j)], minlength=len(views))
        misfits = [_misfit(m, config.noise) for m in matches]
        A, b = _prior(twists, hand, sigmas, p)
        for m, misfit in zip(matches, misfits, strict=True):
            _add(A, b, m, misfit, config.noise)
        inverse: Array = np.asarray(np.linalg.inv(A), dtype=np.float64)
        step = inverse @ b
        n = twists.size
        twists = twists + step[:n].reshape(-1, 6)
        hand = hand + step[n:]
        covariances = np.stack([inverse[k : k + 6, k : k + 6] for k in range(0, n, 6)])
        if p.learn_views and len(views) >= p.learn_from:
            sigmas = _learn_sigmas(twists - hand, inverse[n:, n:], covariances, p)
        median = float(np.median(misfits)) if misfits else config.noise.widest_m
        history.append(_row(matches, step, median, sigmas))
        if progress is not None:
            progress(round_ + 1, config.rounds)
    return RefinedViews(
        cameras=claimed @ se3.exp(twists), hand_eye=hand, covariances=covariances,
        view_sigma=(float(np.degrees(sigmas[0])), 1e3 * float(sigmas[1])), overlaps=overlaps,
        misfit_m=history[-1]["misfit_mm"] / 1e3, history=tuple(history),
    )  # fmt: skip


def _surface(view: ViewPoints, noise: DepthNoise, area_px: float, config: ViewsConfig) -> _Surface:
    """Return a view's points with the normals of the surface around them."""
    from scipy.spatial import KDTree

    dense = view.points.astype(np.float64)
    every = max(1, -(-len(dense) // config.surface_points))
    p = dense[::every]
    if len(p) < config.neighbours:
        return _nothing()
    near = dense[KDTree(dense).query(p, config.neighbours)[1]]
    off = near - near.mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
    n = axes[:, :, 0]
    n = n * -np.sign(np.sum(n * p, axis=1, keepdims=True))
    smooth = values[:, 0] < config.roughness * values.sum(axis=1)
    p, n = p[smooth], n[smooth]
    if len(p) < 2:
        return _nothing()
    cosine = np.abs(np.sum(n * p, axis=1)) / np.linalg.norm(p, axis=1)
    sigma = noise.sigma(p[:, 2]) * np.clip(cosine, config.noise.oblique, None)
    few = np.arange(0, len(p), max(1, -(-len(p) // config.points_per_view)))
    tree = KDTree(p)
    spacing = float(np.median(tree.query(p[few], 2)[0][:, 1]))
    crowding = max(1.0, area_px * len(few) / (view.area_px * every * len(p)))
    sigma = np.maximum(sigma, config.noise.floor_m)
    return _Surface(p, n, sigma, tree, few, spacing, crowding)


def _nothing() -> _Surface:
    """Return the surface of a view that saw none."""
    none = np.zeros((0, 3))
    return _Surface(none, none, np.zeros(0), None, np.zeros(0, np.int64), 0.0, 1.0)


def _pairs(cameras: Array, config: ViewsConfig) -> list[tuple[int, int]]:
    """Return which views are compared."""
    centers, axes = cameras[:, :3, 3], cameras[:, :3, 2]
    gap = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    gap[axes @ axes.T < config.look_cos] = np.inf
    np.fill_diagonal(gap, np.inf)
    pairs: set[tuple[int, int]] = set()
    for i, row in enumerate(gap):
        for j in np.argsort(row, kind="stable")[: config.partners]:
            if np.isfinite(row[j]):
                pairs.add((min(i, int(j)), max(i, int(j))))
    # The direction alternates, so that no view is always the one whose normals are used.
    return [(i, j) if (i + j) % 2 else (j, i) for i, j in sorted(pairs)]


def _match(
    surfaces: Sequence[_Surface], cameras: Array, i: int, j: int, reach: float, config: ViewsConfig
) -> _Match | None:
    """Return the points of view i that lie on the surface of view j; None = too few."""
    a, b = surfaces[i], surfaces[j]
    if a.tree is None or b.tree is None:
        return None
    M = se3.invert(cameras[j]) @ cameras[i]
    moved = se3.transform(M, a.points[a.few])
    # Sampling leaves gaps along the surface; only the distance along the normal must be small.
    far, at = b.tree.query(moved, distance_upper_bound=max(reach, GAPS * b.spacing_m))
    close = np.isfinite(far)
    k, at, moved = a.few[close], at[close], moved[close]
    n_j = b.normals[at]
    r = np.sum(n_j * (moved - b.points[at]), axis=1)
    good = np.sum((a.normals[k] @ M[:3, :3].T) * n_j, axis=1) > config.facing
    good &= np.abs(r) < reach
    if np.count_nonzero(good) < config.least_matches:
        return None
    k, at, moved, n_j, r = k[good], at[good], moved[good], n_j[good], r[good]
    n_i: Array = n_j @ M[:3, :3]
    J_i = _moved_by(a.points[k], n_i)
    J_j = -_moved_by(moved, n_j)
    variances = np.square(a.sigmas[k]) + np.square(b.sigmas[at])
    return _Match(i, j, r, variances, (J_i, J_j), a.crowding)


def _moved_by(points: Array, normals: Array) -> Array:
    """Return by how much a twist of their frame moves points along normals: (N, 6) of (N, 3)."""
    turned: Array = np.cross(points, normals).astype(np.float64)
    return np.concatenate([turned, normals], axis=1)


def _misfit(match: _Match, noise: NoiseConfig) -> float:
    """Return by how much residuals are wider than their noise [m], robustly.

    Of every pair on its own: a depth camera's distortions are alike in views from nearby, so these
    agree better than views from far apart, and say more.
    """
    spread = mad_sigma(match.residuals)
    beyond = np.sqrt(max(spread**2 - float(np.median(match.variances)), 0.0))
    return float(np.clip(beyond, noise.least_misfit_m, noise.widest_m))


def _prior(twists: Array, hand: Array, sigmas: Array, prior: CameraPrior) -> tuple[Array, Array]:
    """Return the prior's normal matrix and right side of all twists and the common one."""
    n = twists.size
    A, b = np.zeros((n + 6, n + 6)), np.zeros(n + 6)
    own = np.diag(1.0 / np.square(np.repeat(sigmas, 3)))
    common = np.repeat([np.radians(prior.hand_eye_deg), prior.hand_eye_mm / 1e3], 3)
    last = slice(n, n + 6)
    A[last, last] = np.diag(1.0 / np.square(common)) + len(twists) * own
    b[last] = -hand / np.square(common)
    for k, x in enumerate(twists):
        at = slice(6 * k, 6 * k + 6)
        A[at, at] = own
        A[at, last] = A[last, at] = -own
        b[at] = -own @ (x - hand)
        b[last] += own @ (x - hand)
    return A, b


def _add(A: Array, b: Array, match: _Match, misfit: float, noise: NoiseConfig) -> None:
    """Add what the partners of two views say."""
    r, (J_i, J_j) = match.residuals, match.jacobians
    q = np.square(r) / (noise.cut_sigmas**2 * (match.variances + misfit**2))
    # A misfit of the surfaces is common to all points of a patch, as the noise is.
    w = (tukey_weights(q) / ((match.variances + misfit**2) * match.crowding))[:, None]
    i, j = slice(6 * match.i, 6 * match.i + 6), slice(6 * match.j, 6 * match.j + 6)
    A[i, i] += J_i.T @ (w * J_i)
    A[j, j] += J_j.T @ (w * J_j)
    cross = J_i.T @ (w * J_j)
    A[i, j] += cross
    A[j, i] += cross.T
    b[i] -= J_i.T @ (w[:, 0] * r)
    b[j] -= J_j.T @ (w[:, 0] * r)


def _learn_sigmas(own: Array, common: Array, covariances: Array, prior: CameraPrior) -> Array:
    """Return the 1-sigma of the views' own turns and shifts [rad, m]: one step of EM.

    A view's own twist is at least as uncertain as the difference of the two covariances.
    """
    variance = np.diagonal(covariances, axis1=1, axis2=2) - np.diag(common)
    spread = np.square(own) + np.clip(variance, 0.0, None)
    found = np.sqrt([spread[:, :3].mean(), spread[:, 3:].mean()])
    said = np.array([np.radians(prior.view_deg), prior.view_mm / 1e3])
    return np.clip(found, prior.learn_factor[0] * said, prior.learn_factor[1] * said)


def _row(matches: Sequence[_Match], step: Array, misfit: float, sigmas: Array) -> dict[str, float]:
    """Return one line of the history."""
    x = step[:-6].reshape(-1, 6)
    return {
        "pairs": float(len(matches)),
        "points": float(sum(len(m.residuals) for m in matches)),
        "misfit_mm": 1e3 * misfit,
        "step_mm": 1e3 * float(np.linalg.norm(x[:, 3:], axis=1).max()),
        "step_deg": float(np.degrees(np.linalg.norm(x[:, :3], axis=1).max())),
        "view_mm": 1e3 * float(sigmas[1]),
        "view_deg": float(np.degrees(sigmas[0])),
    }
