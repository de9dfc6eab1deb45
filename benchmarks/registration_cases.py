"""The scenes of the registration benchmark: models, layouts, views, starts.

Imported by `registration.py`'s workers. Everything depends on the seed alone; what is dear to make
is kept in a folder. Seeds from 100 on are for the published figures, those below for development.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scale_shapes import SHAPES

from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose
from realsim.registration.simulated import (
    TableLabConfig,
    TableScene,
    full_size,
    scatter_objects,
    table_scene,
    with_found_symmetries,
)
from realsim.store.atomic import write_text

OBJECTS = 14
THIN = "cup"
"""In every scene: its wall is 2 mm."""
WIDER_M = 0.01
"""By so much the disc is widened until all objects find room [m]."""
ROUGH = (0.030, 20.0)
"""How far a rough start is off [m, deg]: exactly, in random directions."""
FINE = (0.005, 5.0)
STREAMS = {"layout": 1, "views": 2, "rough": 3, "fine": 4, "pile": 5, "provoked": 6, "absent": 7}


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneKey:
    """Which scene."""

    seed: int
    views: int
    pile: bool = False
    bias_px: float = 0.0
    full: bool = False
    """Images of 1280x720 instead of 640x360."""
    objects: int = OBJECTS


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random numbers of one purpose."""
    return np.random.default_rng([seed, STREAMS[name]])


@cache
def library(keep: Path | None) -> dict[int, ObjectModel]:
    """Return the 30 objects with the symmetries found in their meshes."""
    models: dict[int, ObjectModel] = {}
    for n, (name, mesh) in enumerate(SHAPES.items(), start=1):
        model = ObjectModel(obj_id=n, name=name, mesh=mesh())
        path = None if keep is None else keep / "symmetries" / f"{name}.json"
        if path is not None and path.is_file():
            found = json.loads(path.read_text())
            axes = tuple((tuple(a), tuple(p)) for a, p in found["axes"])
            model = replace(model, symmetries=np.array(found["discrete"]), symmetry_axes=axes)
        else:
            model = with_found_symmetries(model)
            if path is not None:
                axes = [[list(a), list(p)] for a, p in model.symmetry_axes]
                path.parent.mkdir(parents=True, exist_ok=True)
                write_text(path, json.dumps({"discrete": model.symmetries.tolist(), "axes": axes}))
        models[n] = model
    return models


def chosen_ids(seed: int, models: Mapping[int, ObjectModel], count: int) -> list[int]:
    """Return which models a scene has; the thin-walled one is always among them."""
    thin = next(i for i, m in models.items() if m.name == THIN)
    others = sorted(set(models) - {thin})
    picked = stream(seed, "layout").choice(others, count - 1, replace=False)
    return [thin, *(int(i) for i in picked)]


def standing(seed: int, models: Mapping[int, ObjectModel], count: int) -> tuple[ObjectPose, ...]:
    """Return objects standing and lying so close that they nearly touch."""
    ids = chosen_ids(seed, models, count)
    config = TableLabConfig()
    rng = np.random.default_rng([seed, STREAMS["layout"], 1])
    while True:
        put = scatter_objects({i: models[i].mesh for i in ids}, ids, config, rng)
        if not put.left_out:
            return put.objects
        config = replace(config, disc_m=config.disc_m + WIDER_M)


def make_scene(key: SceneKey, keep: Path | None) -> TableScene:
    """Return the scene, its depth images from the folder if they are there."""
    models = library(keep)
    if key.pile:
        from registration_piles import piled

        ids = chosen_ids(key.seed, models, key.objects)
        placed = piled({i: models[i] for i in ids}, stream(key.seed, "pile"), keep)
    else:
        placed = standing(key.seed, models, key.objects)
    config = TableLabConfig(views=key.views, bias_px=key.bias_px)
    if key.full:
        config = full_size(config)
    used = {p.obj_id: models[p.obj_id] for p in placed}
    rng = np.random.default_rng([key.seed, STREAMS["views"], key.views, int(key.pile)])
    return table_scene(used, placed, config, rng, None if keep is None else keep / "depth")


def moved_start(pose: ObjectPose, model: ObjectModel, off: tuple[float, float],
                rng: np.random.Generator) -> ObjectPose:  # fmt: skip
    """Return a start that is off by a distance [m] and an angle [deg] about the box's middle."""
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    low, high = model.mesh.bounds
    middle = se3.from_translation(0.5 * (low + high))
    delta = se3.from_rt(se3.exp_so3(np.radians(off[1]) * axes[0]), off[0] * axes[1])
    T = pose.T_world_obj @ middle @ delta @ se3.invert(middle)
    return ObjectPose(obj_id=pose.obj_id, instance=pose.instance, T_world_obj=T)


def starts_of(scene: TableScene, seed: int, kind: str) -> list[ObjectPose]:
    """Return 'rough' or 'fine' starts of all objects."""
    rng = stream(seed, kind)
    off = ROUGH if kind == "rough" else FINE
    return [moved_start(p, scene.models[p.obj_id], off, rng) for p in scene.truth]
