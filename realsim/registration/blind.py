"""How sure a pose is, and what becomes of the directions that the points do not see.

The covariance comes from the information matrix; axes that nothing determines get a prior.

A fit that drifts along such an axis would quietly turn the label of a round can. Of all poses that
the points cannot tell apart, T_fit S(alpha) with S the blind turns and shifts, the one nearest to
the start is taken:
    turn about the axis (p, a):  T_fit S(-theta), theta the twist about a of R_start^T R_fit
    (swing-twist: of the quaternion (w, v) of that rotation, tan(theta / 2) = (v . a) / w),
    shift along d:               T_fit S(-s), s = d . R_fit^T (c_fit - c_start).
Then the other directions are fitted again, because the axis is known only as well as the points
tell. The pose is taken only if it explains the images as well as before, and if its points do not
see those directions either: a handle may come into sight only where it belongs.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import ObjectModel
from realsim.registration.body import Body
from realsim.registration.compare import Comparer
from realsim.registration.evidence import Cloud
from realsim.registration.solver import FINE, FreeSpace, PoseFit, solve_pose


@dataclass(frozen=True, kw_only=True, slots=True)
class CovarianceConfig:
    """The parts of the uncertainty that the residuals do not show."""

    systematic_translation_m: float = 0.0002
    """1-sigma common to all points: camera poses and depth bias do not average out."""
    systematic_rotation_deg: float = 0.03
    """1-sigma of the rotation that is common to all points."""
    correlation_area_px: float = 50.0
    """Pixels that share one matching window's noise: 12 200 px of a D405 hold 243 independent
    samples. 1 for independent pixels."""
    unobservable_sensitivity: float = 0.04
    """An axis along which the surface moves along its normal by less than this share of the motion
    (root mean square) is not determined: it is the facets of a round body, not its shape."""
    prior_m: float = 0.03
    """1-sigma given to such an axis, as motion of the surface: about any turn of a small body."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Uncertainty:
    """Covariance and unobservable axes of one pose."""

    covariance: Array
    """(6, 6) of the right perturbation of T_world_obj, rotation first [rad, m]."""
    unobservable: tuple[str, ...]
    """Axes that the points do not determine, in words."""
    sensitivities: tuple[float, ...]
    """(6,) root mean square cosine along each principal axis, least first."""


def uncertainty(body: Body, fit: PoseFit, stride: int, config: CovarianceConfig) -> Uncertainty:
    """Return how sure a fitted pose is.

    With H the information about the box centre, in units where the rotation is times the radius:
        C = k s^2 H^-1 + C_systematic,   s^2 = max(1, weighted mean of (r / sigma)^2),
        k = max(1, correlation_area / stride^2)  (points per independent sample).
    Along eigenvectors of H whose sensitivity sqrt(lambda / sum w) is too small, the prior replaces
    k s^2 / lambda. Mapped to the object's origin by the adjoint.
    """
    values, vectors, scale = principal_axes(body, fit)
    sensitivity = _sensitivities(values, fit)
    blind = sensitivity < config.unobservable_sensitivity
    inflation = max(1.0, config.correlation_area_px / stride**2) * max(1.0, fit.variance)
    if not np.isfinite(inflation):
        inflation = 1.0
    variances = np.where(blind, config.prior_m**2, inflation / np.where(blind, 1.0, values))
    C = (vectors * variances) @ vectors.T / np.outer(scale, scale)
    floor = [np.radians(config.systematic_rotation_deg)] * 3 + [config.systematic_translation_m] * 3
    C = C + np.diag(np.square(floor))
    # T exp(xi_origin) = T c exp(xi_center) c^-1, hence xi_origin = Ad(c) xi_center.
    Ad = se3.adjoint(se3.from_translation(body.center_obj))
    C = Ad @ C @ Ad.T
    return Uncertainty(
        covariance=0.5 * (C + C.T),
        unobservable=tuple(axis_name(vectors[:, i]) for i in np.flatnonzero(blind)),
        sensitivities=tuple(float(s) for s in sensitivity),
    )


def blind_motions(body: Body, fit: PoseFit, config: CovarianceConfig) -> Array:
    """Return the motions (6, K) that the points do not determine.

    They are orthonormal, about the box centre, rotation first, turns times the body's radius [m].
    """
    values, vectors, _ = principal_axes(body, fit)
    return vectors[:, _sensitivities(values, fit) < config.unobservable_sensitivity]


def principal_axes(body: Body, fit: PoseFit) -> tuple[Array, Array, Array]:
    """Return eigenvalues (6,) and vectors (6, 6) of the scaled information, and the scale (6,)."""
    radius = body.radius_m
    scale = np.array([radius, radius, radius, 1.0, 1.0, 1.0])
    values, vectors = np.linalg.eigh(fit.information / np.outer(scale, scale))
    return np.maximum(values, 0.0), vectors, scale


def _sensitivities(values: Array, fit: PoseFit) -> Array:
    """Return the root mean square cosine (6,) along each principal axis; 0 without points."""
    return np.sqrt(values / fit.weight) if fit.weight > 0 else np.zeros(6)


def axis_name(vector: Array) -> str:
    """Return the principal axis (6,) in words: what moves, along which axis of the object."""
    turn, shift = vector[:3], vector[3:]
    kind, part = ("turn about", turn) if turn @ turn > 0.5 else ("shift along", shift)
    axis = part / np.linalg.norm(part)
    axis = axis * np.sign(axis[int(np.argmax(np.abs(axis)))])
    return f"{kind} ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}) of the object"


TOLERATED_LOSS = 0.04
"""Greatest share of the rendered gain that may be lost. Scanned cans in real frames lose 2 to
5 % when turned about their axis (dents, and the fit was the best of many); a box or a jug
loses 15 % and more."""
LEAST_TURN_SHARE = 0.5
"""A blind motion whose turn (times the radius) is less than this share of it is a shift."""
DECLARED_DEG = 5.0
"""A declared continuous symmetry within this angle of a blind turn is the same axis."""
DECLARED_M = 0.005
"""It must also pass the fitted axis this near [m]."""
START_ROUNDS = 3
"""Alternations of setting back and fitting the rest; the third moves nothing by 0.02 mm."""
START_PASSES = 30
"""Greatest number of turns through several blind axes until nothing is left."""
SETTLED_DEG = 1e-4
"""A pass that turns less than this ends them."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BlindAxis:
    """One direction in the object's frame that the points do not determine."""

    turn: bool
    """Whether it is a turn about the axis or a shift along it."""
    axis: Array
    """(3,) unit direction."""
    point: Array
    """(3,) a point on the axis [m]; of a shift, the box centre."""
    declared: bool
    """Whether the model declares this continuous symmetry."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Kept:
    """The fit after the blind directions were set back, and what was done."""

    fit: PoseFit
    axes: tuple[BlindAxis, ...]
    report: dict[str, Any]
    """Empty if nothing is blind."""


def blind_axes(body: Body, motions: Array) -> list[BlindAxis]:
    """Return the turns and shifts in the blind motions (6, K), declared axes in place of fitted.

    The blind motions are a subspace; the singular vectors of its rotation part split it into turns
    and shifts. A turn with the motion v of the box centre (per radian) goes round the line through
    centre + a x v with direction a.
    """
    if motions.shape[1] == 0:
        return []
    _, _, mixing = np.linalg.svd(motions[:3])
    axes: list[BlindAxis] = []
    for motion in mixing @ motions.T:
        turning = float(np.linalg.norm(motion[:3]))
        if turning >= LEAST_TURN_SHARE:
            a = motion[:3] / turning
            point = body.center_obj + np.cross(a, motion[3:] * body.radius_m / turning)
            axes.append(_declared(body.model, a, point))
        else:
            d = motion[3:] / np.linalg.norm(motion[3:])
            axes.append(BlindAxis(turn=False, axis=d, point=body.center_obj, declared=False))
    return axes


def _declared(model: ObjectModel, axis: Array, point: Array) -> BlindAxis:
    """Return the model's continuous symmetry that this turn is, or the turn as it was found."""
    for direction, origin in model.symmetry_axes:
        a = np.asarray(direction, dtype=np.float64)
        a = a / np.linalg.norm(a)
        off = point - np.asarray(origin, dtype=np.float64)
        distance = float(np.linalg.norm(off - (off @ a) * a))
        if abs(a @ axis) > np.cos(np.radians(DECLARED_DEG)) and distance < DECLARED_M:
            return BlindAxis(turn=True, axis=a, point=point - off + (off @ a) * a, declared=True)
    return BlindAxis(turn=True, axis=axis, point=point, declared=False)


def twist_rad(R: Array, axis: Array) -> float:
    """Return the turn of the rotation R (3, 3) about the unit axis (3,): its twist [rad].

    The twist is the rotation about the axis that is nearest to R; 0 for a half turn across it.
    """
    w, *v = se3.quaternion_wxyz(R)
    along = float(np.dot(v, axis))
    # Two quaternions stand for R; the one with w >= 0 turns by at most half a circle.
    return 2.0 * float(np.arctan2(np.copysign(along, along * w), abs(w))) if along else 0.0


def nearest_to_start(
    T_fit: Array, T_start: Array, center_obj: Array, axes: list[BlindAxis]
) -> Array:
    """Return of the poses T_fit S, S any blind motion, the one nearest to the start.

    Several blind turns are taken back one after the other until nothing is left (of a sphere, the
    start's rotation); shifts come last because turns about the axes move the centre.
    """
    T = T_fit
    turns = [a for a in axes if a.turn]
    for _ in range(START_PASSES):
        most = 0.0
        for a in turns:
            angle = twist_rad(T_start[:3, :3].T @ T[:3, :3], a.axis)
            P = se3.from_translation(a.point)
            back = se3.from_rt(se3.exp_so3(-angle * a.axis), np.zeros(3))
            T = T @ P @ back @ se3.invert(P)
            most = max(most, abs(angle))
        if most < np.radians(SETTLED_DEG):
            break
    apart = T_start - T
    gap = T[:3, :3].T @ (apart[:3, :3] @ center_obj + apart[:3, 3])
    for a in axes:
        if not a.turn:
            T = T @ se3.from_translation((gap @ a.axis) * a.axis)
    return T


def keep_start(
    body: Body,
    fit: PoseFit,
    data: tuple[Cloud, Comparer, FreeSpace | None],
    covariance: CovarianceConfig,
) -> Kept:
    """Return the fit with its blind directions as they were at the start.

    Args:
        body: the object; its start is what is kept.
        fit: of the points that do not see those directions.
        data: the object's points, the frames to render in, and the images of free space.
        covariance: what says what is blind.
    """
    cloud, comparer, free_space = data
    motions = blind_motions(body, fit, covariance)
    axes = blind_axes(body, motions)
    if not axes:
        return Kept(fit=fit, axes=(), report={})
    T, new = fit.T_world_obj, fit
    for _ in range(START_ROUNDS):
        T = nearest_to_start(T, body.T_start, body.center_obj, axes)
        new = solve_pose(body, cloud, T, FINE[-1:], free_space)
        T = new.T_world_obj
    T = nearest_to_start(T, body.T_start, body.center_obj, axes)
    stride = comparer.stride_of(body, fit.T_world_obj)
    before = comparer.gain(body, fit.T_world_obj, stride)[0]
    after = comparer.gain(body, T, stride)[0]
    still = blind_motions(body, new, covariance).shape[1] >= motions.shape[1]
    taken = still and after >= before - TOLERATED_LOSS * abs(before)
    kept = new.at(T) if taken else fit
    report = {
        "axes": [_axis_report(a, body, fit.T_world_obj, kept.T_world_obj) for a in axes],
        "gain_px": [before, after],
        "start_kept": bool(taken),
        "why_not": "" if taken else _why_not(still, before, after),
    }
    return Kept(fit=kept, axes=tuple(axes), report=report)


def _why_not(still: bool, before: float, after: float) -> str:
    """Return why the fit stands although it left the start along a blind direction."""
    if not still:
        return "with the start's value the points do determine this direction, and speak against it"
    if before == 0.0:  # hidden as it lies: nothing of it is rendered in sight
        return "where the fit has it nothing of it is in sight, and the start's value is no better"
    share = (before - after) / abs(before)
    return (
        f"the start's value would lose {100 * share:.1f} % of the rendered gain "
        f"(at most {100 * TOLERATED_LOSS:g} %)"
    )


def _axis_report(axis: BlindAxis, body: Body, T_fit: Array, T_kept: Array) -> dict[str, Any]:
    """Return one axis as JSON values: how far from the start the fit was and the end is."""
    figures: dict[str, Any] = {
        "kind": "turn about" if axis.turn else "shift along",
        "axis_obj": [float(x) for x in axis.axis],
        "declared": axis.declared,
    }
    for name, T in (("fit", T_fit), ("end", T_kept)):
        if axis.turn:
            angle = twist_rad(body.T_start[:3, :3].T @ T[:3, :3], axis.axis)
            figures[f"{name}_deg"] = float(np.degrees(angle))
        else:
            off = T[:3, :3].T @ (body.center(T) - body.center(body.T_start))
            figures[f"{name}_mm"] = float(1e3 * off @ axis.axis)
    return figures
