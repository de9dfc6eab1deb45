"""Scenes at rest: the same seed gives the same scene, and what lies on the table stays there."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import save_ply
from realsim.geometry.parts import part
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.table_scenes.config import (
    DropConfig,
    PoolConfig,
    TableSceneConfig,
)
from realsim_sim_bridge.table_scenes.drop import settle
from realsim_sim_bridge.table_scenes.pool import ObjectPool, open_pool
from realsim_sim_bridge.table_scenes.sample import (
    Layout,
    generator,
    layout_from_json,
    layout_to_json,
    sample_layout,
    scene_table,
)
from realsim_sim_bridge.table_scenes.scene import BuiltScene, build_scene

CONFIG = TableSceneConfig(objects=(4, 6))


@cache
def _pool() -> ObjectPool:
    return open_pool(["pybullet"])


@cache
def _layout(number: int) -> Layout:
    return sample_layout(7, number, _pool(), CONFIG)


@cache
def _built(number: int) -> BuiltScene:
    return build_scene(_layout(number), _pool(), CONFIG)


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
    _layout(1)
    again = sample_layout(7, 0, open_pool(["pybullet"]), CONFIG)
    assert layout_to_json(again) == layout_to_json(_layout(0))


def test_other_scenes_and_other_seeds_are_other_scenes() -> None:
    a, b = _layout(0), _layout(1)
    assert {o.key for o in a.objects} != {o.key for o in b.objects}
    draws = {generator(s, k, "objects").random() for s in range(4) for k in range(4)}
    assert len(draws) == 16


def test_a_layout_comes_back_bit_for_bit() -> None:
    value = layout_to_json(_layout(0))
    back = layout_from_json(value, "there")
    assert layout_to_json(back) == value
    for a, b in zip(back.objects, _layout(0).objects, strict=True):
        assert np.array_equal(a.T_table_obj, b.T_table_obj)
    with pytest.raises(InputError, match="format 9"):
        layout_from_json(value | {"format": 9}, "there")
    with pytest.raises(InputError, match="damaged"):
        layout_from_json(value | {"objects": [{"key": "x"}]}, "there")


@pytest.mark.parametrize("number", [0, 1])
def test_there_are_as_many_objects_as_asked_for_and_of_the_sizes(number: int) -> None:
    layout = _layout(number)
    assert 4 <= len(layout.objects) <= 6
    for laid, model in zip(layout.objects, _built(number).synthetic.models.values(), strict=True):
        size = float(model.mesh.extent.max())
        assert size == pytest.approx(laid.size_m)
        assert 0.02 <= size / layout.side_m <= 0.20


@pytest.mark.parametrize("number", [0, 1])
def test_nothing_is_below_the_top_surface_or_beyond_its_rim(number: int) -> None:
    built = _built(number)
    low, high = built.table.outline.min(axis=0), built.table.outline.max(axis=0)
    for corners in built.hulls():
        assert corners[:, 2].min() >= -1e-3
        assert np.all(corners[:, :2] >= low - 1e-6)
        assert np.all(corners[:, :2] <= high + 1e-6)


@pytest.mark.parametrize("number", [0, 1])
def test_a_second_settle_moves_nothing_by_a_millimetre_and_nothing_is_in_another(
    number: int,
) -> None:
    built = _built(number)
    poses = {o.obj_id: o.T_world_obj for o in built.synthetic.scene.objects}
    _, ways, depth = settle(built.table, _bodies(built), poses, DropConfig(check_s=2.0))
    assert max(ways.values()) < 1e-3
    assert depth < 1e-3
    assert 1e3 * depth == pytest.approx(_layout(number).figures["penetration_mm"], abs=0.02)


def test_an_object_that_hangs_in_the_air_moves_in_a_settle() -> None:
    built = _built(0)
    poses = {o.obj_id: o.T_world_obj for o in built.synthetic.scene.objects}
    first = next(iter(poses))
    poses[first] = se3.from_translation([0, 0, 0.3]) @ poses[first]
    _, ways, _ = settle(built.table, _bodies(built), poses, CONFIG.drop)
    assert ways[first] > 0.1


def test_what_falls_beyond_the_rim_is_counted_and_others_take_its_place() -> None:
    config = replace(CONFIG, tables=("bar_table",), drop=DropConfig(spread=0.5, tries=4.0))
    layout = sample_layout(2, 0, _pool(), config)
    lost = len(layout.fell) + len(layout.overhung) + len(layout.restless)
    assert lost > 0
    assert layout.tried == len(layout.objects) + lost
    assert 4 <= len(layout.objects) <= 6


def test_a_table_is_drawn_of_those_that_are_wanted() -> None:
    config = TableSceneConfig(tables=("crate", "oval"))
    drawn = {scene_table(0, k, config)[0].name for k in range(20)}
    assert drawn == {"crate", "oval"}


# --- pools that are hard ----------------------------------------------------------------------


def _hulls(few: int) -> TableSceneConfig:
    return TableSceneConfig(objects=(few, few), pool=PoolConfig(hull_only=True))


def test_a_pool_of_one_object_gives_scenes_of_that_object(tmp_path: Path) -> None:
    save_ply(tmp_path / "box.ply", part("box").mesh, "mm")
    pool = open_pool([str(tmp_path)])
    layout = sample_layout(0, 0, pool, _hulls(3))
    built = build_scene(layout, pool, _hulls(3))
    assert [o.name for o in layout.objects] == ["box"] * 3
    assert len({o.scale for o in layout.objects}) == 3
    assert len({m.name for m in built.synthetic.models.values()}) == 3


def test_broken_meshes_are_skipped_and_named_and_the_scene_is_made(tmp_path: Path) -> None:
    save_ply(tmp_path / "box.ply", part("box").mesh, "mm")
    for k in range(4):
        (tmp_path / f"torn{k}.obj").write_text("v 0 0\nf 1 2 3\n")
    layout = sample_layout(0, 0, open_pool([str(tmp_path)]), _hulls(3))
    assert {o.key for o in layout.objects} == {"box.ply"}
    assert 1 <= len(layout.skipped) <= 4
    assert all("torn" in reason for reason in layout.skipped)


def test_a_pool_of_which_nothing_can_be_used_is_refused_with_the_reasons(tmp_path: Path) -> None:
    for k in range(3):
        (tmp_path / f"torn{k}.obj").write_text("v 0 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"cannot be used.*torn"):
        sample_layout(0, 0, open_pool([str(tmp_path)]), _hulls(3))


def test_objects_keep_their_size_where_that_is_asked(tmp_path: Path) -> None:
    mesh = part("box").mesh
    save_ply(tmp_path / "box.ply", mesh, "mm")
    config = TableSceneConfig(
        objects=(2, 2), pool=PoolConfig(hull_only=True, keep_size=True, unit="mm")
    )
    layout = sample_layout(0, 0, open_pool([str(tmp_path)]), config)
    size = float(mesh.extent.max())
    assert [o.size_m for o in layout.objects] == pytest.approx([size, size], rel=1e-5)
