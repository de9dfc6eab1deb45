"""How an object looks from above in every way it can rest: height templates.

For each stable resting pose the top surface is sampled once, at points of continuous position;
turned about the vertical they serve every yaw. Points just outside of the footprint say where
the surface must end: without them a small lid fits everywhere on a large one of the same height.
"""

import hashlib
import math
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import hull_vertices, symmetry_transforms
from realsim.models.resting import Resting, resting_orientations
from realsim.records import ObjectModel
from realsim.rendering.rays import PlacedMesh, RayScene
from realsim.store.arrays_on_disk import rebuilt, write_arrays

VERSION = 1
"""Version of the files' content; older files are computed again."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TemplateConfig:
    """Which templates an object has, and how they are sampled."""

    least_probability: float = 0.008
    """Resting poses that are rarer are left out: in 1000 random drops each occurs 8 times."""
    same_deg: float = 8.0
    """Resting poses whose directions down differ by less, modulo symmetry, are one [deg]."""
    yaws: int = 24
    """Yaws per full turn: 15 deg apart, so one is within 7.5 deg, from where a fit converges."""
    points: int = 220
    """Points of the top surface per pose; more cost time and decide nothing."""
    outside_points: int = 60
    """Points around the footprint per pose."""
    outside_low_m: float = 0.006
    """The points around lie at least so far outside of the footprint [m]: two cells, so that the
    object's own edge is not taken for them."""
    outside_high_m: float = 0.011
    """They lie at most so far outside [m]: further out stand the neighbours."""
    rays: int = 3000
    """Rays per pose over the box of its footprint; thin objects hit a tenth of their box."""
    symmetry_step_deg: float = 5.0
    """Step at which continuous symmetries are sampled [deg], less than `same_deg`."""
    seed: int = 0
    """Seed of the choice of the points."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (self.yaws >= 1 and self.points >= 1 and self.rays >= self.points):
            raise InputError(
                f"yaws {self.yaws}, points {self.points}, rays {self.rays}; needed are 1 or more "
                "yaws and points, and at least as many rays as points."
            )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ModelTemplates:
    """The height templates of one object; D resting poses."""

    rotations: Array
    """(D, 3, 3) R_table_obj at yaw 0."""
    offsets: Array
    """(D, 3) where the object's origin is from the template's reference point at yaw 0 [m]: the
    middle of the footprint's box, on the table."""
    points: Array32
    """(D, K, 3) of the top surface from the reference point [m], in random order: the first few
    stand for all."""
    outside: Array32
    """(D, L, 3) around the footprint; z = height of the nearest point of the top surface [m]."""
    yaw_counts: Int64
    """(D,) how many yaws differ."""
    yaw_steps: Array
    """(D,) step of the yaws [rad]."""
    probabilities: Array
    """(D,) of the resting poses."""
    center_obj: Array
    """(3,) middle of the object's box [m]."""
    symmetries: Array
    """(S, 3, 3) rotations R_obj_obj after which the object looks the same, samples of the
    continuous ones among them; the identity first."""
    is_ball: bool
    """Whether every rotation is a symmetry."""

    @property
    def reach_m(self) -> float:
        """Greatest horizontal distance of a point from its reference point [m]."""
        reach = [np.linalg.norm(p[..., :2], axis=-1).max() for p in (self.points, self.outside)]
        return float(max(reach))


def model_templates(
    model: ObjectModel, config: TemplateConfig, folder: Path | None
) -> ModelTemplates:
    """Return the templates of an object, from `folder` if they were computed before.

    Args:
        model: need not be watertight, and need not declare its symmetries.
        config: settings.
        folder: where templates are kept between runs; None = nowhere.

    Raises:
        InputError: the mesh is flat, so it cannot rest.
    """
    path = None if folder is None else folder / f"templates_{content_key(model, config)}.npz"
    known = None if path is None else rebuilt(path, _of_file)
    if known is None:
        known = _computed(model, config)
        if path is not None:
            _save(path, known)
    return known


def content_key(model: ObjectModel, config: object) -> str:
    """Return a name that depends on the shape, its symmetries and a config dataclass."""
    digest = hashlib.blake2b(digest_size=16)
    for part in (model.mesh.vertices, model.mesh.faces, model.symmetries):
        digest.update(part.tobytes())
    digest.update(repr((VERSION, model.symmetry_axes, astuple(config))).encode())  # pyright: ignore[reportArgumentType]
    return digest.hexdigest()


def turned(yaw: float | Array) -> Array:
    """Return rotations (..., 3, 3) about z by yaws (...) [rad]."""
    return se3.exp_so3(np.asarray(yaw)[..., None] * np.array([0.0, 0.0, 1.0]))


def is_ball(model: ObjectModel) -> bool:
    """Return whether every rotation of an object is a symmetry: two axes of revolution or more.

    BOP lists axes; the turns about two of them generate all rotations.
    """
    axes = np.array([direction for direction, _ in model.symmetry_axes])
    return len(axes) > 1 and bool(np.linalg.matrix_rank(axes, tol=1e-3) > 1)


def _computed(model: ObjectModel, config: TemplateConfig) -> ModelTemplates:
    """Return the templates of an object."""
    ball = is_ball(model)
    step = math.radians(config.symmetry_step_deg)
    symmetries = np.eye(3)[None] if ball else symmetry_transforms(model, step)[:, :3, :3]
    poses = _distinct(resting_orientations(model.mesh), symmetries, ball, config)
    scene = RayScene([PlacedMesh(0, model.mesh, np.eye(4))])
    corners = hull_vertices(model.mesh.vertices)
    rng = np.random.default_rng(config.seed)
    sampled = [_sampled(scene, corners, pose.R, config, rng) for pose, _ in poses]
    periods = [_yaw_period(pose.R, symmetries, ball, config) for pose, _ in poses]
    counts = np.array([max(1, math.ceil(p * config.yaws / (2 * np.pi) - 1e-6)) for p in periods])
    low, high = model.mesh.bounds
    return ModelTemplates(
        rotations=np.stack([pose.R for pose, _ in poses]),
        offsets=np.stack([offset for offset, _, _ in sampled]),
        points=np.stack([points for _, points, _ in sampled]),
        outside=np.stack([outside for _, _, outside in sampled]),
        yaw_counts=counts.astype(np.int64),
        yaw_steps=np.array(periods) / counts,
        probabilities=np.array([probability for _, probability in poses]),
        center_obj=0.5 * (low + high),
        symmetries=symmetries,
        is_ball=ball,
    )


def _distinct(
    found: tuple[Resting, ...], symmetries: Array, ball: bool, config: TemplateConfig
) -> list[tuple[Resting, float]]:
    """Return the resting poses that differ, with the probability of all that are the same."""
    total: dict[int, float] = {}
    for pose in found:
        total[pose.basin] = total.get(pose.basin, 0.0) + pose.probability
    likely = [pose for pose in found if total[pose.basin] >= config.least_probability]
    kept: list[tuple[Resting, float]] = []
    for pose in likely or list(found[:1]):
        # The direction up in the object's axes says all about a pose but its yaw.
        same = symmetries @ pose.R[2]
        for k, (other, probability) in enumerate(kept):
            if ball or np.max(same @ other.R[2]) > math.cos(math.radians(config.same_deg)):
                kept[k] = (other, probability + pose.probability)
                break
        else:
            kept.append((pose, pose.probability))
    return kept


def _yaw_period(R: Array, symmetries: Array, ball: bool, config: TemplateConfig) -> float:
    """Return the yaw [rad] after which the object looks the same in a resting pose."""
    if ball:
        return 2 * math.pi / config.yaws
    about = R @ symmetries @ R.T
    upright = about[about[:, 2, 2] > math.cos(math.radians(config.same_deg) / 2)]
    yaws = np.abs(np.arctan2(upright[:, 1, 0], upright[:, 0, 0]))
    turns = yaws[yaws > 1e-3]
    least = float(np.min(turns, initial=2 * math.pi))
    # A part of a full turn: a pose that is tilted a little by its facets has it not exactly.
    return 2 * math.pi / round(2 * math.pi / least)


def _sampled(
    scene: RayScene, corners: Array, R: Array, config: TemplateConfig, rng: np.random.Generator
) -> tuple[Array, Array32, Array32]:
    """Return the offset (3,), the points (K, 3) and the points around (L, 3) of one pose."""
    standing = corners @ R.T
    low, high = standing.min(0), standing.max(0)
    reference = np.array([*(low + high)[:2] / 2, low[2]])
    extent = np.maximum(high - low, 1e-4)
    pitch = math.sqrt(float(extent[0] * extent[1]) / config.rays)
    margin = math.ceil(config.outside_high_m / pitch) + 1
    counts = np.ceil(extent[:2] / pitch).astype(np.int64) + 2 * margin
    cell = (np.moveaxis(np.indices(tuple(counts)), 0, -1) - (counts - 1) / 2) * pitch
    grid = np.concatenate([cell, np.full((*counts, 1), 2 * extent[2])], -1).reshape(-1, 3)
    directions = np.broadcast_to(-R[2], grid.shape).astype(np.float32)
    t, _ = scene.first_hits((grid + reference) @ R, directions)
    top = (2 * extent[2] - t.astype(np.float64)).reshape(tuple(counts))
    hit = np.isfinite(top)
    inside = np.concatenate([cell[hit], top[hit][:, None]], -1)
    if len(inside) == 0:  # thinner than the rays are apart: its corners are what is seen
        inside = standing - reference
        around = inside[:0]
    else:
        around = _around(cell, top, hit, pitch, config)
    points = _chosen(inside, config.points, rng)
    outside = _chosen(around, config.outside_points, rng) if len(around) else np.zeros((0, 3))
    if len(outside) == 0:
        outside = np.tile([0.0, 0.0, np.inf], (config.outside_points, 1))
    return -reference, points.astype(np.float32), outside.astype(np.float32)


def _around(cell: Array, top: Array, hit: Mask, pitch: float, c: TemplateConfig) -> Array:
    """Return points (N, 3) just outside of a footprint, z = height of its nearest point."""
    from scipy.ndimage import distance_transform_edt

    found: tuple[Array, Int64] = distance_transform_edt(~hit, return_indices=True)  # pyright: ignore[reportAssignmentType]
    distance, nearest = found[0] * pitch, found[1]
    ring = (distance >= c.outside_low_m) & (distance <= c.outside_high_m)
    return np.concatenate([cell[ring], top[tuple(nearest[:, ring])][:, None]], -1)


def _chosen(points: Array, count: int, rng: np.random.Generator) -> Array:
    """Return `count` of the points in random order, evenly often where there are too few."""
    order = np.concatenate([rng.permutation(len(points)) for _ in range(-(-count // len(points)))])
    return points[order[:count]]


def _save(path: Path, t: ModelTemplates) -> None:
    """Write templates; the name appears only when the file is complete."""
    arrays = {
        "rotations": t.rotations, "offsets": t.offsets, "points": t.points, "outside": t.outside,
        "yaw_counts": t.yaw_counts, "yaw_steps": t.yaw_steps, "probabilities": t.probabilities,
        "center_obj": t.center_obj, "symmetries": t.symmetries,
    }  # fmt: skip
    write_arrays(path, arrays, {"is_ball": t.is_ball})


def _of_file(arrays: dict[str, Any], notes: dict[str, Any]) -> ModelTemplates:
    """Return the templates of a file."""
    return ModelTemplates(is_ball=bool(notes["is_ball"]), **arrays)
