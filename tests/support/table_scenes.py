"""Small quick simulated tables with known truth, rendered once per test process.

A sixteenth of a D405's pixels with a quarter of its disparity's noise: depth has the D405's sigma.
"""

from functools import lru_cache

import numpy as np

from realsim.geometry.parts import part, part_names
from realsim.records import ObjectModel
from realsim.registration.config import RegistrationConfig
from realsim.registration.search.bench import FindConfig
from realsim.registration.simulated import (
    TableLabConfig,
    TableScene,
    resized,
    scatter_objects,
    table_scene,
)

SMALL_LAB = resized(TableLabConfig(disc_m=0.12, distance_m=(0.25, 0.40), views=12), 320)
"""Images of 320x180 of a few objects close together; the errors are a real lab's."""

QUICK = RegistrationConfig(field_cells=64, find=FindConfig(field_cells=64), with_single_view=False)
"""One coarse distance field per model, which all tests of a process share."""


@lru_cache(maxsize=1)
def part_models() -> dict[int, ObjectModel]:
    """Return all shipped parts by id."""
    return {part(name).obj_id: part(name) for name in part_names()}


@lru_cache(maxsize=8)
def small_scene(seed: int, objects: int = 5, views: int = 12) -> TableScene:
    """Return different parts chosen at random, put down at random; the errors are a real lab's."""
    rng = np.random.default_rng([seed, objects, views])
    ids = [int(i) for i in rng.choice(sorted(part_models()), objects, replace=False)]
    return _scene(tuple(ids), views, rng)


@lru_cache(maxsize=8)
def named_scene(seed: int, names: tuple[str, ...], views: int = 12) -> TableScene:
    """Return these parts put down at random; a name may come several times."""
    rng = np.random.default_rng([seed, len(names), views])
    return _scene(tuple(part(name).obj_id for name in names), views, rng)


def _scene(ids: tuple[int, ...], views: int, rng: np.random.Generator) -> TableScene:
    from dataclasses import replace

    config = replace(SMALL_LAB, views=views)
    models = {i: part_models()[i] for i in ids}
    meshes = {i: m.mesh for i, m in models.items()}
    placed = scatter_objects(meshes, ids, config, rng)
    assert not placed.left_out, f"objects {[o.obj_id for o in placed.left_out]} found no room"
    return table_scene(models, placed.objects, config, rng)
