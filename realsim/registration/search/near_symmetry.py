"""Rotations after which an object looks nearly, but not quite, as before.

A gear turned by half a tooth, a pipe end for end, a mug turned half around: a fit ends up there as
willingly as at the truth, and no absolute score can tell them apart. Whoever has found a pose
compares it with these.

Every turn about the likely axes is tried, and half turns in all directions. Each is shifted, and
once more freely moved, to where most of the surface agrees; what agrees for most of the surface
but not for all of it is kept.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.distance_field import DistanceField, raycasting_scene
from realsim.geometry.mesh import box_corners, sample_surface, symmetry_transforms
from realsim.geometry.robust import tukey_weights
from realsim.interop import import_open3d
from realsim.records import ObjectModel
from realsim.registration.search.templates import content_key, is_ball
from realsim.store.arrays_on_disk import rebuilt, write_arrays

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
PARALLEL = 0.998
"""Cosine from which on two axes are one (3.6 deg)."""
DAMPING = 1e-6
"""Damping of the least squares: a turn about the axis of a lathe's work moves nothing."""
REMEMBERED = 64
"""Models whose near symmetries are kept in memory."""
_memory: dict[str, Array] = {}


@dataclass(frozen=True, kw_only=True, slots=True)
class NearSymmetryConfig:
    """What is nearly a symmetry, and how it is sought."""

    near_m: float = 0.002
    """Most of the surface must come to lie within this of the surface [m]: what a fit takes for
    noise and calibration errors."""
    near_share_of_size: float = 0.025
    """The same as a share of the longest side, if that is more."""
    least_share: float = 0.7
    """Share of the surface for which that must hold."""
    far_least_share: float = 0.6
    """The same if the motion is far from every symmetry: a knob turned by half a lobe. A
    small tilt fits so much, too, but a fit to images turns it back."""
    far_share: float = 0.25
    """A motion is far by so much of the longest side."""
    true_m: float = 0.00125
    """If all of the surface lies within this, it is a true symmetry [m]: no camera sees it."""
    true_share_of_size: float = 0.01
    """The same as a share of the longest side, if that is less."""
    outliers: float = 0.004
    """Share of the surface that may be further off all the same: edges of triangles, spikes."""
    orders: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20)
    """Turns by k / n of a full turn are tried about the likely axes, for these n."""
    directions: int = 300
    """Directions of the half sphere about which half turns are tried: 8 deg apart."""
    beside_share: float = 0.13
    """Axes are also laid so far beside the middle of the box [share of each side]: a mug's axis is
    there because of its handle. The fit bridges half of it."""
    screening_points: int = 120
    """Surface points that rank the turns."""
    fitting_points: int = 250
    """Surface points by which a turn is moved to where it fits."""
    judging_points: int = 700
    """Surface points by which it is judged, by exact distances."""
    screened: int = 110
    """Number of best turns that are fitted: 0.7 ms each."""
    judged: int = 90
    """Number of fitted turns that are judged: 2 ms each."""
    cells: int = 36
    """Cells of the distance field that ranks and fits, along the longest side."""
    scales: tuple[float, ...] = (0.15, 0.12, 0.1, 0.08, 0.06, 0.05, 0.04, 0.03, 0.03)
    """Tukey's cut of each step of the fit [share of the longest side]."""
    distinct_share: float = 0.05
    """Motions whose images of the object's box differ by less (RMS) are one [share of the longest
    side]: a fit that starts from one ends at the other."""
    drift_share: float = 0.1
    """A motion that was fitted and differs from a symmetry by less has drifted there: so near there
    is no other place where the surface fits [share of the longest side]."""
    most: int = 48
    """Returned at most, those with the greatest share first."""
    symmetry_step_deg: float = 3.0
    """Step at which continuous symmetries are sampled [deg]."""
    seed: int = 0
    """Seed of the surface points."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (0 < self.least_share < 1 and self.near_m > 0 and min(self.orders, default=2) > 1):
            raise InputError(
                f"least_share {self.least_share}, near_m {self.near_m}, orders {self.orders}; "
                "needed are a share between 0 and 1, a positive length and orders from 2 on."
            )


@dataclass(frozen=True, eq=False)
class _Shape:
    """The surface whose near symmetries are sought."""

    points: Array
    """(N, 3) on the surface, in random order [m]."""
    field: DistanceField
    size: float
    """Longest side [m]."""
    centers: Array
    """(C, 3) points through which an axis may go [m]."""
    box: Array
    """(8, 3) corners of its box [m]."""
    images: Array
    """(S, 24) these corners moved by the declared symmetries [m]."""

    def gaps(self, Ts: Array) -> Array:
        """Return by how much motions (K, 4, 4) differ from the nearest symmetry (K,) [m].

        It is the RMS over the corners c of the box of |T c - S c|, least over the symmetries S.
        Poses T S and T are the same object, so that of inv(B) A tells how much A and B differ.
        """
        moved = se3.transform(Ts, self.box).reshape(len(Ts), -1)
        # Far from the origin the products would lose digits.
        moved, images = moved - self.box.ravel(), self.images - self.box.ravel()
        squared = np.square(moved).sum(1)[:, None] + np.square(images).sum(1)
        nearest = (squared - 2 * moved @ images.T).min(1)
        return np.sqrt(np.maximum(nearest, 0.0) / len(self.box))


def near_symmetries(model: ObjectModel, config: NearSymmetryConfig, folder: Path | None) -> Array:
    """Return motions T_obj_obj (N, 4, 4) after which an object looks nearly as before.

    True symmetries, declared or not, are not among them, nor are two that differ by a declared
    one. Each is moved to where it fits the whole surface best; whoever compares images refines the
    pose T_world_obj T_obj_obj by what was measured.

    Args:
        model: need not declare its symmetries.
        config: settings.
        folder: where results are kept between runs; None = in memory.
    """
    if is_ball(model):
        return np.zeros((0, 4, 4))
    key = content_key(model, config)
    path = None if folder is None else folder / f"near_{key}.npz"
    known = _memory.get(key) if path is None else rebuilt(path, _motions)
    if known is None:
        known = _computed(model, config)
        known.setflags(write=False)
        if path is not None:
            write_arrays(path, {"transforms": known}, {})
    while len(_memory) >= REMEMBERED:
        _memory.pop(next(iter(_memory)))
    _memory[key] = known
    return known


def _computed(model: ObjectModel, config: NearSymmetryConfig) -> Array:
    """Return the near symmetries of an object, those that fit best first."""
    shape = _shape_of(model, config)
    about, anywhere = _turns(shape, model, config)
    shifted = _fit_motions(shape, _ranked(shape, about, config), config, shift_only=True)
    across = _ranked(shape, anywhere, config)
    moved = _fit_motions(shape, np.concatenate([shifted, across]), config, shift_only=False)
    moved = moved[shape.gaps(moved) > config.drift_share * shape.size]
    near = max(config.near_m, config.near_share_of_size * shape.size)
    both = np.concatenate([shifted, moved])
    q = se3.transform(both, shape.points[: config.fitting_points]).reshape(-1, 3)
    fits = np.abs(shape.field.distance(q)).reshape(len(both), -1) <= near
    # Of two motions that are nearly one the first is kept: the one that fits better.
    order = np.argsort(-fits.mean(1), kind="stable")
    Ts = _distinct(shape, both[order], config)[: config.judged]
    if len(Ts) == 0:
        return Ts
    distances = _exact(model, shape.points[: config.judging_points], Ts)
    true = min(config.true_m, config.true_share_of_size * shape.size)
    share = np.mean(distances <= near, axis=1)
    worst = np.quantile(distances, 1 - config.outliers, axis=1)
    far = shape.gaps(Ts) > config.far_share * shape.size
    least = np.where(far, config.far_least_share, config.least_share)
    good = np.flatnonzero((share >= least) & (worst > true))
    return Ts[good[np.argsort(-share[good], kind="stable")][: config.most]]


def _shape_of(model: ObjectModel, config: NearSymmetryConfig) -> _Shape:
    """Return the surface of a model with what is needed of it."""
    rng = np.random.default_rng(config.seed)
    points, _ = sample_surface(model.mesh, max(config.judging_points, 1000), rng)
    declared = [np.asarray(point, dtype=np.float64) for _, point in model.symmetry_axes]
    low, high = model.mesh.bounds
    middle = (low + high) / 2
    beside = config.beside_share * np.concatenate([np.diag(high - low), -np.diag(high - low)])
    centers = [middle, points.mean(0), *(middle + beside), *declared[:1]]
    box = box_corners(low, high)
    symmetries = symmetry_transforms(model, math.radians(config.symmetry_step_deg))
    return _Shape(
        points=points,
        field=DistanceField.from_mesh(model.mesh, config.cells),
        size=float(model.mesh.extent.max()),
        centers=np.stack(centers),
        box=box,
        images=se3.transform(symmetries, box).reshape(len(symmetries), -1),
    )


def _turns(shape: _Shape, model: ObjectModel, config: NearSymmetryConfig) -> tuple[Array, Array]:
    """Return rotations (K, 3, 3) to try: about likely axes, and half turns about any axis."""
    inertia = np.linalg.eigh(np.cov(shape.points.T))[1].T
    declared = [np.asarray(a) / np.linalg.norm(a) for a, _ in model.symmetry_axes]
    discrete = se3.log_so3(model.symmetries[1:, :3, :3])
    angles = np.linalg.norm(discrete, axis=1)
    axes = _unlike(np.concatenate([np.eye(3), inertia, np.reshape(declared, (-1, 3)),
                                   discrete / angles[:, None]]))  # fmt: skip
    vectors = [
        (2 * math.pi * k / n) * axes
        for n in config.orders
        for k in range(1, n // 2 + 1)
        if math.gcd(k, n) == 1
    ]
    vectors += [-v for v in vectors]
    # Half way between two steps of a toothed wheel's own symmetry.
    for axis in axes:
        own = angles[np.abs(discrete @ axis) > PARALLEL * angles]
        if len(own):
            vectors.append(0.5 * own.min() * axis[None])
    i = np.arange(config.directions) + 0.5
    polar, around = np.arccos(1.0 - i / config.directions), GOLDEN_ANGLE * i
    across = [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)]
    half = math.pi * np.stack(across, 1)
    return se3.exp_so3(np.concatenate(vectors)), se3.exp_so3(half)


def _unlike(axes: Array) -> Array:
    """Return the axes (A, 3) without those that are nearly along an earlier one."""
    kept: list[Array] = []
    for axis in axes:
        if all(abs(axis @ other) < PARALLEL for other in kept):
            kept.append(axis)
    return np.stack(kept)


def _ranked(shape: _Shape, rotations: Array, config: NearSymmetryConfig) -> Array:
    """Return the best motions (M, 4, 4) of rotations about one of the centres."""
    points = shape.points[: config.screening_points]
    centers = np.repeat(shape.centers, len(rotations), axis=0)
    R = np.tile(rotations, (len(shape.centers), 1, 1))
    Ts = se3.from_rt(R, centers - np.einsum("kij,kj->ki", R, centers))
    gaps = np.abs(shape.field.distance(se3.transform(Ts, points).reshape(-1, 3)))
    cost = np.minimum(gaps / shape.size, config.scales[0]).reshape(len(Ts), -1).mean(1)
    best = np.argmin(cost.reshape(len(shape.centers), -1), axis=0)
    least = cost.reshape(len(shape.centers), -1).min(0)
    order = np.argsort(least, kind="stable")
    Ts = Ts.reshape(len(shape.centers), len(rotations), 4, 4)[best[order], order]
    return _distinct(shape, Ts, config)[: config.screened]


def _fit_motions(
    shape: _Shape, Ts: Array, config: NearSymmetryConfig, *, shift_only: bool
) -> Array:
    """Return motions (K, 4, 4) moved to where most of the surface agrees.

    Gauss-Newton with Tukey's weights on the distance d of q = T p; a twist (w, v) of the left
    changes it by (q x g) w + g v, g the gradient of the distance.
    """
    p = shape.points[: config.fitting_points]
    for scale in config.scales:
        q = se3.transform(Ts, p)
        d, g = shape.field.distance_gradient(q.reshape(-1, 3))
        d, g = d.reshape(q.shape[:2]), g.reshape(q.shape)
        lever = q - shape.centers[0]
        J = np.concatenate([np.cross(lever, g) / shape.size, g], axis=2)
        if shift_only:
            J[:, :, :3] = 0.0
        w = tukey_weights(np.square(d / (scale * shape.size)))
        Jw = J * w[:, :, None]
        H = np.swapaxes(Jw, 1, 2) @ J
        H += np.eye(6) * (DAMPING + DAMPING * np.trace(H, axis1=1, axis2=2)[:, None, None])
        twist = -np.linalg.solve(H, np.einsum("kni,kn->ki", Jw, d)[:, :, None])[:, :, 0]
        twist[:, :3] /= shape.size
        about = se3.from_translation(shape.centers[0])
        Ts = about @ se3.exp(twist) @ se3.invert(about) @ Ts
    return Ts


def _distinct(shape: _Shape, Ts: Array, config: NearSymmetryConfig) -> Array:
    """Return the motions that differ from all symmetries, and from each other modulo these."""
    limit = config.distinct_share * shape.size
    backs = np.concatenate([np.eye(4)[None], np.zeros_like(Ts)])
    kept: list[int] = []
    for k, T in enumerate(Ts):
        if shape.gaps(backs[: len(kept) + 1] @ T).min() > limit:
            kept.append(k)
            backs[len(kept)] = se3.invert(T)
    return Ts[kept]


def _exact(model: ObjectModel, points: Array, Ts: Array) -> Array:
    """Return the exact distances (K, N) of points moved by Ts (K, 4, 4) to the surface [m]."""
    o3d = import_open3d()
    moved = np.ascontiguousarray(se3.transform(Ts, points).reshape(-1, 3), dtype=np.float32)
    found = raycasting_scene(model.mesh).compute_distance(o3d.core.Tensor(moved), 1).numpy()
    return np.asarray(found, dtype=np.float64).reshape(len(Ts), -1)


def _motions(arrays: dict[str, Array], _: dict[str, Any]) -> Array:
    """Return the motions of a file."""
    return np.asarray(arrays["transforms"], dtype=np.float64)
