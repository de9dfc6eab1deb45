"""How likely a pose of one to three views is right, its unobservable directions integrated.

So few views leave directions open in which a fit may slide: a mug's turn while its handle is
hidden, a plate's place on the table. There a Gaussian about the fit says too little, because the
images stay as well explained over centimetres, or better elsewhere. So poses T_ij along the two
least determined directions v, w are tried, the others fitted again:
    T_ij = T exp(a_i v + b_j w),    w_ij ~ exp(-C_ij / temperature) prior(T_ij) da_i db_j,
    C = 1/2 sum min((z_measured - z_rendered)^2 / sigma^2, cap^2) / pixels of one measurement,
over the union of all footprints, neighbours and table rendered as well. The best pose T_best is
taken, and
    P(MSSD < bound) = sum w_ij E_t Phi((bound - hypot(MSSD(T_ij, T_best), t)) / s),
s being half a step: the probability is a continuous function of the pose. t is what an offset of
the views' depth moves everything by along the ray, which no point can tell; it has the sigma of the
camera, or what a photograph leaves of it. The photograph's edges count in C as well. Declared
symmetries do not count, because MSSD knows them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, ndtr

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.metrics import aligned_pose, mssd_symmetric
from realsim.registration.blind import axis_name, principal_axes
from realsim.registration.body import Body, footprint, moved_about_center
from realsim.registration.compare import Comparer
from realsim.registration.evidence import Cloud
from realsim.registration.photo_fit import Edges
from realsim.registration.refinement.flat import laid_down
from realsim.registration.solver import FINE, PoseFit, solve_pose

CHOICE = 2.0
"""How fast the probability goes over from the fit's to the rival's [1 / temperature]."""
UNLIKELY = 1e-5
"""Poses of less weight are no part of the spread."""
NODES = 9
"""Nodes of the quadrature over the offset of the depth."""


BOUND_M = 0.003
"""A pose is right within this MSSD [m]."""
OFFSETS_M = (-0.014, -0.009, -0.005, -0.002, 0.0, 0.002, 0.005, 0.009, 0.014)
"""Offsets along either direction, as motion of the surface [m]: as far as starts are off."""
AROUND_RAYS = 1500
"""Rays aimed at the object in each frame; sets the stride."""
CAP = 4.0
"""A pixel that is further off counts as so many sigmas: something else is there."""
FLOOR_M = 0.0006
"""Least 1-sigma of a pixel [m]: mesh and neighbours are off by as much."""
TEMPERATURE = 3.0
"""Costs are divided by this: residuals of neighbouring pixels share what is wrong with mesh,
lens and edges, and are not independent."""
UNKNOWN = 2.0
"""A pixel of which nothing is predicted (no table behind it) counts as so many sigmas."""
DECLARED_SHARE = 0.3
"""A direction that moves the surface, modulo symmetry, by less than this share of its length is
a declared symmetry."""
PRIOR_M = 0.015
"""1-sigma of how far the surface is from a claimed start [m]."""
BETTER = 4.0
"""Temperatures by which another pose must cost less to be taken instead of the fit."""
LIKELY = 40.0
"""Poses that depth holds more than this against, over the best, are not shown to the
photograph."""
OFFSET_NOISES = 0.5
"""1-sigma of the offset of a view's inverse depth that no photograph tells, in units of its
noise k: what a calibrated stereo camera wanders by, less than what it may be off by."""
FLAT_M = 0.008
"""An object that rises less over the table lies on it, whatever its own points say [m]."""
LEAST_OPEN = 0.002
"""A direction whose 1-sigma is greater is named as one that is not seen [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Around:
    """What the images say of a pose and those around it."""

    fit: PoseFit
    """At the best of the poses."""
    probability: float
    """That the best pose is right within the bound."""
    spread: Array
    """(6, 6) covariance of the weighted poses about the best one, right twist about the box's
    centre, turns times the radius [m^2]."""
    weak: Array
    """(6, 2) the directions along which poses were tried, in the same units."""
    step_m: float
    """Least step along them [m]."""
    unseen: tuple[str, ...]
    """Directions that are wider than they should be, in words with their 1-sigma."""
    unlike: str = ""
    """In words, why depth and photograph tell of different things."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Images:
    """What poses are held against."""

    comparer: Comparer
    """The frames, their noise, and the table."""
    area_px: float
    """Pixels of one independent measurement of depth."""
    offset_per_m: float
    """1-sigma of the offset of the views' inverse depth [1/m]."""


def around(
    body: Body,
    fit: PoseFit,
    cloud: Cloud,
    others: Sequence[tuple[Body, Array]],
    claimed: Array | None,
    edges: Edges | None,
    images: Images,
) -> Around:
    """Return the best pose near a fit, and how likely it is right.

    Args:
        body: the object.
        fit: of its points.
        cloud: these points.
        others: the other objects and their poses (4, 4).
        claimed: (4, 4) the start, if somebody claimed it; None = a search found it.
        edges: what the photograph shows of it; None = nothing.
        images: what the poses are compared with.
    """
    weak = _weak_directions(body, fit)
    offsets, steps = np.array(OFFSETS_M), np.gradient(OFFSETS_M)
    moves = [weak @ np.array([a, b]) for a in offsets for b in offsets]
    starts = [moved_about_center(body, fit.T_world_obj, x) for x in moves]
    fits = [solve_pose(body, cloud, T, FINE, held=weak) for T in starts]
    middle = len(fits) // 2
    # What else decided the fit (neighbours, the photograph) moves all poses as it moved the fit.
    Ts = np.stack([_moved_alike(body, fits[middle], fit, f.T_world_obj) for f in fits])
    fits[middle] = fit
    Ts = _laid_down(body, Ts, images)
    costs = _costs(body, Ts, others, images)
    if edges is not None:
        is_likely = costs < costs.min() + LIKELY
        is_likely[middle] = True
        amended = [edges.amended(T, weak) for T in Ts[is_likely]]
        Ts[is_likely] = _laid_down(body, np.stack([T for T, _ in amended]), images)
        seen = np.array([cost for _, cost in amended])
        costs[is_likely] = _costs(body, Ts[is_likely], others, images) + seen
        costs[~is_likely] = np.inf
    if claimed is not None:
        away = np.array([mssd_symmetric(claimed, T, body.model) for T in Ts])
        costs = costs + 0.5 * TEMPERATURE * np.square(away / PRIOR_M)
    best = int(np.argmin(costs))
    if costs[best] > costs[middle] - BETTER * TEMPERATURE:
        best = middle
    volumes = np.outer(steps, steps).ravel()
    weights = np.exp(-(costs - costs.min()) / TEMPERATURE) * volumes
    weights /= weights.sum()
    # A pose of the grid stands for all that lie within half a step of it.
    half = 0.5 * np.sqrt(volumes)
    probability, follows = _within(body, (Ts, best), weights, half, images)
    rival = int(np.argmin(costs))
    if rival != middle:
        # Where the choice changes, the probability does not jump: it is that of both.
        gap = (costs[middle] - costs[rival]) / TEMPERATURE - BETTER
        both = [_within(body, (Ts, n), weights, half, images)[0] for n in (middle, rival)]
        probability = float(np.array(both) @ expit(CHOICE * gap * np.array([-1.0, 1.0])))
    xi = np.array([
        _twist(body, Ts[best], T) if w > UNLIKELY else np.zeros(6)
        for T, w in zip(Ts, weights, strict=True)
    ])  # fmt: skip
    spread = np.asarray((xi * weights[:, None]).T @ xi)
    spread[3:, 3:] += np.outer(follows, follows)
    return Around(
        fit=fits[best].at(Ts[best]), probability=probability, spread=spread, weak=weak,
        step_m=float(steps.min()), unseen=_unseen(spread),
    )  # fmt: skip


def _within(
    body: Body, poses: tuple[Array, int], weights: Array, half: Array, images: Images
) -> tuple[float, Array]:
    """Return the probability that the best of weighted poses is right within the bound.

    Also how an offset of the depth of 1 sigma moves it (3,), in its own axes [m].
    """
    Ts, best = poses
    off = np.array([mssd_symmetric(Ts[best], T, body.model) for T in Ts])
    frames = images.comparer.frames
    follows = np.mean([_follows(body, Ts[best], f.T_world_cam) for f in frames], axis=0)
    follows = follows * images.offset_per_m / np.sqrt(len(frames))
    nodes, shares = np.polynomial.hermite_e.hermegauss(NODES)
    t = np.hypot(off[:, None], np.linalg.norm(follows) * nodes)
    within = ndtr((BOUND_M - t) / half[:, None]) @ (shares / shares.sum())
    return float(weights @ within), follows


def integrated(body: Body, covariance: Array, found: Around) -> Array:
    """Return the covariance (6, 6) of a fit with the spread of what was tried in place of its own.

    Along the directions that were tried the Gaussian about the fit is replaced; of it is left what
    is narrower than a step of the grid, whose poses are all alike.

    Args:
        body: the object.
        covariance: (6, 6) of the right twist about the object's origin, rotation first [rad, m].
        found: what was tried.
    """
    scale = np.repeat([body.radius_m, 1.0], 3)
    to_centre = scale[:, None] * se3.adjoint(se3.from_translation(-body.center_obj))
    Q = np.eye(6) - found.weak @ found.weak.T
    own = to_centre @ covariance @ to_centre.T
    narrow = np.minimum(np.diag(found.weak.T @ own @ found.weak), found.step_m**2 / 12.0)
    C = Q @ own @ Q + found.spread + (found.weak * narrow) @ found.weak.T
    back = np.linalg.inv(to_centre)
    C = back @ C @ back.T
    return 0.5 * (C + C.T)


def _weak_directions(body: Body, fit: PoseFit) -> Array:
    """Return the two least determined motions (6, 2) of the surface that are no declared symmetry.

    Motions are orthonormal, about the centre of the box, rotation first, turns times the radius.
    """
    _, vectors, _ = principal_axes(body, fit)
    chosen: list[Array] = []
    length = OFFSETS_M[-1]
    for v in vectors.T:
        T = moved_about_center(body, np.eye(4), length * v)
        apart = se3.transform(T, body.bounds_obj) - body.bounds_obj
        moved = float(np.linalg.norm(apart, axis=1).max())
        if mssd_symmetric(np.eye(4), T, body.model) > DECLARED_SHARE * moved:
            chosen.append(v)
        if len(chosen) == 2:
            break
    return np.stack(chosen, axis=1)


def _moved_alike(body: Body, before: PoseFit, after: PoseFit, T_world_obj: Array) -> Array:
    """Return a pose (4, 4) moved in world as a fit was, turned about the centre of its box."""
    R = after.T_world_obj[:3, :3] @ before.T_world_obj[:3, :3].T
    shift = body.center(after.T_world_obj) - body.center(before.T_world_obj)
    center = body.center(T_world_obj)
    return se3.from_rt(R, center + shift - R @ center) @ T_world_obj


def _laid_down(body: Body, Ts: Array, images: Images) -> Array:
    """Return poses T_world_obj (N, 4, 4), laid down on the table if the object is flat."""
    plane = images.comparer.plane
    if plane is None:
        return Ts
    T = plane.T_world_table
    return T @ laid_down(body, se3.invert(T) @ Ts, FLAT_M)


def _follows(body: Body, T_world_obj: Array, T_world_cam: Array) -> Array:
    """Return how the object (3,) follows the offset of inverse depth, in its own axes [m^2]."""
    T = se3.invert(T_world_cam) @ T_world_obj
    center = body.center(T)
    return T[:3, :3].T @ (-center[2] * center)


def _twist(body: Body, T_best: Array, T: Array) -> Array:
    """Return the motion (6,) from the best pose to another, turned by symmetry to be the least.

    It is that of the box's centre, turns times the radius [m].
    """
    c = se3.from_translation(body.center_obj)
    T_to = aligned_pose(T_best, T, body.model)
    return se3.log(se3.invert(T_best @ c) @ T_to @ c) * np.repeat([body.radius_m, 1.0], 3)


def _costs(body: Body, Ts: Array, others: Sequence[tuple[Body, Array]], images: Images) -> Array:
    """Return what the depth of all frames holds against each of the poses (N, 4, 4)."""
    comparer = images.comparer
    costs = np.zeros(len(Ts))
    intrinsics = comparer.intrinsics
    stride = comparer.stride_of(body, Ts[len(Ts) // 2])
    share = min(1.0, stride**2 / images.area_px)
    shape = (-(-intrinsics.height // stride), -(-intrinsics.width // stride))
    for frame in comparer.frames:
        T_cam_world = se3.invert(frame.T_world_cam)
        prints = [footprint(body, intrinsics, T_cam_world @ T, stride) for T in Ts]
        at = [p.rows // stride * shape[1] + p.columns // stride for p in prints]
        cells = np.unique(np.concatenate(at))
        rows, columns = cells // shape[1] * stride, cells % shape[1] * stride
        measured = frame.depth_m[rows, columns].astype(np.float64)
        behind = np.full(shape[0] * shape[1], np.inf)
        for other, T in others:
            p = footprint(other, intrinsics, T_cam_world @ T, stride)
            k = p.rows // stride * shape[1] + p.columns // stride
            behind[k] = np.minimum(behind[k], p.z)
        known = np.minimum(behind[cells], comparer.table(frame, rows, columns))
        seen = measured > 0
        sigma = np.hypot(comparer.noise.sigma(measured), FLOOR_M)
        index = np.full(shape[0] * shape[1], -1)
        index[cells] = np.arange(len(cells))
        for n, (p, k) in enumerate(zip(prints, at, strict=True)):
            z = known.copy()
            z[index[k]] = np.minimum(z[index[k]], p.z)
            r = np.where(np.isfinite(z), (measured - z) / sigma, UNKNOWN)
            costs[n] += 0.5 * share * float(np.sum(np.minimum(r * r, CAP**2)[seen]))
    return costs


def _unseen(spread: Array) -> tuple[str, ...]:
    """Return the directions of a spread (6, 6) that are wider than `LEAST_OPEN`, in words."""
    values, vectors = np.linalg.eigh(spread)
    return tuple(
        f"{axis_name(vectors[:, i])} by {1e3 * np.sqrt(values[i]):.1f} mm"
        for i in np.argsort(-values) if values[i] > LEAST_OPEN**2
    )  # fmt: skip
