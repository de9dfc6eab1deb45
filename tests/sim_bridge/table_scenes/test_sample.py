"""Scenes at rest: the same seed gives the same scene, and what lies on the table stays there."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from realsim.geometry.mesh import save_ply
from realsim.geometry.parts import part
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.table_scenes.config import DropConfig, PoolConfig, TableSceneConfig
from realsim_sim_bridge.table_scenes.drop import settle
from realsim_sim_bridge.table_scenes.pool import ObjectPool, open_pool
from realsim_sim_bridge.table_scenes.sample import (
    Layout,
    generator,
    layout_from_json,
    layout_to_json,
    sample_layout,
)
from realsim_sim_bridge.table_scenes.scene import BuiltScene, build_scene
from refusals import refused

CONFIG = TableSceneConfig(objects=(3, 4))


@cache
def _pool() -> ObjectPool:
    return open_pool(["pybullet"])


@cache
def _layout() -> Layout:
    return sample_layout(7, 0, _pool(), CONFIG)


@cache
def _built() -> BuiltScene:
    return build_scene(_layout(), _pool(), CONFIG)


def _bodies(built: BuiltScene) -> dict[int, SlipBody]:
    return {
        obj_id: SlipBody(
            parts=solid.parts.parts,
            mass_kg=solid.matter.mass_kg,
            center_of_mass=solid.matter.center_of_mass,
            inertia=solid.matter.inertia,
        )
        for obj_id, solid in built.solids.items()
    }


def test_the_same_seed_gives_the_same_scene_whatever_was_made_before() -> None:
    generator(7, 1, "objects").random()
    again = sample_layout(7, 0, open_pool(["pybullet"]), CONFIG)
    assert layout_to_json(again) == layout_to_json(_layout())


def test_other_scenes_and_other_seeds_are_other_scenes() -> None:
    draws = {generator(s, k, "objects").random() for s in range(4) for k in range(4)}
    assert len(draws) == 16


def test_a_layout_comes_back_bit_for_bit() -> None:
    value = layout_to_json(_layout())
    back = layout_from_json(value, "there")
    assert layout_to_json(back) == value
    for a, b in zip(back.objects, _layout().objects, strict=True):
        assert np.array_equal(a.T_table_obj, b.T_table_obj)
    refused("format 9", layout_from_json, value | {"format": 9}, "there")
    refused("damaged", layout_from_json, value | {"objects": [{"key": "x"}]}, "there")


def test_there_are_as_many_objects_as_asked_for_and_of_the_sizes() -> None:
    layout = _layout()
    assert 3 <= len(layout.objects) <= 4
    for laid, model in zip(layout.objects, _built().synthetic.models.values(), strict=True):
        size = float(model.mesh.extent.max())
        assert size == pytest.approx(laid.size_m)
        assert 0.02 <= size / layout.side_m <= 0.20


def test_nothing_is_below_the_top_surface_or_beyond_its_rim() -> None:
    built = _built()
    low, high = built.table.outline.min(axis=0), built.table.outline.max(axis=0)
    for corners in built.hulls():
        assert corners[:, 2].min() >= -1e-3
        assert np.all(corners[:, :2] >= low - 1e-6)
        assert np.all(corners[:, :2] <= high + 1e-6)


def test_a_second_settle_moves_nothing_by_a_millimetre_and_nothing_is_in_another() -> None:
    built = _built()
    poses = {o.obj_id: o.T_world_obj for o in built.synthetic.scene.objects}
    _, ways, depth = settle(built.table, _bodies(built), poses, DropConfig(check_s=2.0))
    assert max(ways.values()) < 1e-3
    assert depth < 1e-3
    assert 1e3 * depth == pytest.approx(_layout().figures["penetration_mm"], abs=0.02)


def test_what_falls_beyond_the_rim_is_counted_and_others_take_its_place() -> None:
    config = replace(CONFIG, tables=("bar_table",), drop=DropConfig(spread=0.5, tries=4.0))
    layout = sample_layout(2, 0, _pool(), config)
    lost = len(layout.fell) + len(layout.overhung) + len(layout.restless)
    assert lost > 0
    assert layout.tried == len(layout.objects) + lost
    assert 3 <= len(layout.objects) <= 4


# --- pools that are hard ----------------------------------------------------------------------


HULLS = TableSceneConfig(objects=(2, 2), pool=PoolConfig(hull_only=True))


def test_a_pool_of_one_object_gives_scenes_of_that_object(tmp_path: Path) -> None:
    save_ply(tmp_path / "box.ply", part("box").mesh, "mm")
    pool = open_pool([str(tmp_path)])
    layout = sample_layout(0, 0, pool, HULLS)
    built = build_scene(layout, pool, HULLS)
    assert [o.name for o in layout.objects] == ["box"] * 2
    assert len({o.scale for o in layout.objects}) == 2
    assert len({m.name for m in built.synthetic.models.values()}) == 2


def test_broken_meshes_are_skipped_and_named_and_the_scene_is_made(tmp_path: Path) -> None:
    save_ply(tmp_path / "box.ply", part("box").mesh, "mm")
    for k in range(4):
        (tmp_path / f"torn{k}.obj").write_text("v 0 0\nf 1 2 3\n")
    layout = sample_layout(0, 0, open_pool([str(tmp_path)]), HULLS)
    assert {o.key for o in layout.objects} == {"box.ply"}
    assert 1 <= len(layout.skipped) <= 4
    assert all("torn" in reason for reason in layout.skipped)


def test_a_pool_of_which_nothing_can_be_used_is_refused_with_the_reasons(tmp_path: Path) -> None:
    for k in range(3):
        (tmp_path / f"torn{k}.obj").write_text("v 0 0\nf 1 2 3\n")
    refused(r"cannot be used.*torn", sample_layout, 0, 0, open_pool([str(tmp_path)]), HULLS)
