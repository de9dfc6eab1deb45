"""Small quick simulated tables with known truth, rendered once per test process.

A sixteenth of a D405's pixels with a quarter of its disparity's noise: depth has the D405's sigma.
What takes a scene takes any with these fields, as `outside_lab.LabScene`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.geometry.parts import part, part_names
from realsim.records import ObjectModel, ObjectPose, SupportPlane
from realsim.registration.body import Body, make_body
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import DepthNoise
from realsim.registration.register import Registration, register_scene
from realsim.registration.search.bench import FindConfig
from realsim.registration.simulated import (
    TableLabConfig,
    TableScene,
    resized,
    scatter_objects,
    table_scene,
)
from realsim.registration.simulated_lab import table_square
from realsim.registration.views import SampleConfig, ViewPoints, sample_views
from realsim.rendering.rays import BACKGROUND, PlacedMesh

SMALL_LAB = resized(TableLabConfig(disc_m=0.12, distance_m=(0.25, 0.40), views=12), 320)
"""Images of 320x180 of a few objects close together; the errors are a real lab's."""

QUICK = RegistrationConfig(field_cells=64, find=FindConfig(field_cells=64), with_single_view=False)
"""One coarse distance field per model, which all tests of a process share."""

TABLE = SupportPlane(T_world_table=np.eye(4), rms_m=1e-3, inliers=1000)
"""Where the table really is."""

NOISE = DepthNoise(per_m=0.08 / (648 * 0.018), floor_m=2e-4)
"""What the depth's noise really is."""


@lru_cache(maxsize=1)
def part_models() -> dict[int, ObjectModel]:
    """Return all shipped parts by id."""
    return {part(name).obj_id: part(name) for name in part_names()}


@lru_cache(maxsize=8)
def small_scene(seed: int, objects: int = 5, views: int = 12) -> TableScene:
    """Return different parts chosen at random, put down at random; the errors are a real lab's."""
    rng = np.random.default_rng([seed, objects, views])
    ids = [int(i) for i in rng.choice(sorted(part_models()), objects, replace=False)]
    return scene_of(ids, replace(SMALL_LAB, views=views), rng)


@lru_cache(maxsize=8)
def named_scene(seed: int, names: tuple[str, ...], views: int = 12) -> TableScene:
    """Return these parts put down at random; a name may come several times."""
    rng = np.random.default_rng([seed, len(names), views])
    return scene_of([part(name).obj_id for name in names], replace(SMALL_LAB, views=views), rng)


def scene_of(ids: Sequence[int], config: TableLabConfig, rng: np.random.Generator) -> TableScene:
    """Return the parts of these ids put down at random."""
    models = {i: part_models()[i] for i in ids}
    placed = scatter_objects({i: m.mesh for i, m in models.items()}, ids, config, rng)
    assert not placed.left_out, f"objects {[o.obj_id for o in placed.left_out]} found no room"
    return table_scene(models, placed.objects, config, rng)


def true_cameras(scene: TableScene) -> TableScene:
    """Return the scene with cameras that are said to be where they really were."""
    frames = zip(scene.frames, scene.Ts_world_cam, strict=True)
    return replace(scene, frames=tuple(replace(f, T_world_cam=T) for f, T in frames))


def things_of(scene: Any) -> list[PlacedMesh]:
    """Return the objects where they really stand, and the table, for a renderer."""
    meshes = {i: m.mesh for i, m in scene.models.items()}
    objects = [PlacedMesh(p.instance, meshes[p.obj_id], p.T_world_obj) for p in scene.truth]
    return [*objects, PlacedMesh(BACKGROUND, table_square((0.0, 0.0)), np.eye(4))]


def true_poses(scene: Any) -> list[Array]:
    """Return where the objects really stand."""
    return [p.T_world_obj for p in scene.truth]


def bodies_of(scene: Any, cells: int = 64, samples: int = 200) -> list[Body]:
    """Return the objects where they really stand, for a fit."""
    return [make_body(p, scene.models[p.obj_id], cells, samples) for p in scene.truth]


def body_at(model: ObjectModel, cells: int, samples: int, T_world_obj: Any = None) -> Body:
    """Return an object at a pose, or at the origin, for a fit."""
    T = np.eye(4) if T_world_obj is None else T_world_obj
    pose = ObjectPose(obj_id=model.obj_id, instance=0, T_world_obj=T)
    return make_body(pose, model, cells, samples)


def views_of(scene: Any, noise: DepthNoise = NOISE, **config: Any) -> tuple[ViewPoints, ...]:
    """Return the points of the views: of every pixel, unless `SampleConfig` says otherwise."""
    sampling = SampleConfig(**{"stride": 1} | config)
    return sample_views(scene.intrinsics, scene.frames, noise, sampling)


def off_by(
    pose: ObjectPose, model: ObjectModel, rng: np.random.Generator, mm: float, deg: float
) -> ObjectPose:
    """Return the pose moved by `mm` and turned by `deg` about the middle of its model's box."""
    w, v = rng.normal(size=(2, 3))
    xi = np.r_[np.radians(deg) * w / np.linalg.norm(w), 1e-3 * mm * v / np.linalg.norm(v)]
    C = se3.from_translation(model.mesh.bounds.mean(0))
    return replace(pose, T_world_obj=pose.T_world_obj @ C @ se3.exp(xi) @ se3.invert(C))


def starts_off_by(scene: Any, mm: float, deg: float, seed: int = 0) -> list[ObjectPose]:
    """Return the true poses, each moved by `mm` and turned by `deg`."""
    rng = np.random.default_rng(seed)
    return [off_by(p, scene.models[p.obj_id], rng, mm, deg) for p in scene.truth]


def errors_mm(scene: Any, found: Iterable[ObjectPose]) -> dict[int, float]:
    """Return how far the farthest point of each found object is from where it really is [mm]."""
    true = {p.instance: p.T_world_obj for p in scene.truth}
    return {
        o.instance: 1e3
        * mssd_symmetric(true[o.instance], o.T_world_obj, scene.models[o.obj_id])
        for o in found if o.instance in true
    }  # fmt: skip


def register(
    scene: Any, starts: Any, config: RegistrationConfig = QUICK, **other: Any
) -> Registration:
    """Return the registration of a scene, or of `other` frames, models, fixed cameras."""
    given = {"frames": scene.frames, "models": scene.models} | other
    return register_scene("s", scene.intrinsics, wanted=starts, config=config, **given)
