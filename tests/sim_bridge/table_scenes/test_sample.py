"""Scenes at rest: the same seed gives the same scene, and what lies on the table stays there."""

from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.app.generate.run import GenerateOutcome
from realsim.app.generate.tables import notes_of
from realsim.geometry.mesh import mass_properties, save_ply
from realsim.geometry.parts import part
from realsim.models.library_files import properties_file, read_properties
from realsim.models.library_session import known_solids
from realsim.rendering.appearance import Material
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.table_scenes.cameras import ViewConfig, intrinsics_of, views
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
from realsim_sim_bridge.table_scenes.scene import (
    BuiltScene,
    OwnLooks,
    build_scene,
    own_looks,
    write_models,
)
from realsim_sim_bridge.table_scenes.tables import corners
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
    for hull in built.hulls():
        assert hull[:, 2].min() >= -1e-3
        assert np.all(hull[:, :2] >= low - 1e-6)
        assert np.all(hull[:, :2] <= high + 1e-6)


def test_a_second_settle_moves_nothing_by_a_millimetre_and_nothing_is_in_another() -> None:
    built = _built()
    poses = {o.obj_id: o.T_world_obj for o in built.synthetic.scene.objects}
    bodies = {i: SlipBody.of(solid.parts, solid.matter) for i, solid in built.solids.items()}
    _, ways, depth = settle(built.table, bodies, poses, DropConfig(check_s=2.0))
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
    assert {o.open_edges for o in layout.objects} == {0}


def test_a_mesh_that_lacks_faces_is_told_as_open(tmp_path: Path) -> None:
    box = part("box").mesh
    save_ply(tmp_path / "cut.ply", replace(box, faces=box.faces[:-40]), "mm")
    pool = open_pool([str(tmp_path)])
    layout = sample_layout(0, 0, pool, HULLS)
    edges = layout.objects[0].open_edges
    write_models(tmp_path, build_scene(layout, pool, HULLS))
    said = read_properties(tmp_path / properties_file(1))
    assert edges > 0
    assert said.verdict == "doubtful" and said.reasons == (f"open: {edges} boundary edges",)
    laid = {"pool": 0, "key": "cut.ply", "open_edges": edges}
    (note,) = notes_of({"scenes": [{"skipped": [], "objects": [laid]}]}, GenerateOutcome())
    assert f"open meshes: cut.ply ({edges} boundary edges)" in note


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


# --- Cameras of generated scenes, how these look, and the models that the school takes.

CUBE = [corners((-0.05, -0.05, 0.0), (0.05, 0.05, 0.1))]
SCENE = TableSceneConfig(objects=(2, 2))


@cache
def _small_layout() -> Layout:
    return sample_layout(1, 0, _pool(), SCENE)


@cache
def _small_built(own: OwnLooks = OwnLooks()) -> BuiltScene:  # noqa: B008 - frozen, and no argument of a user
    return build_scene(_small_layout(), _pool(), SCENE, own=own)


# --- cameras ----------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [(1.0, 2.0), (0.25, 0.5)])
def test_cameras_are_as_far_away_as_asked_above_the_table_and_look_at_it(
    radius: tuple[float, float],
) -> None:
    config = ViewConfig(count=64, radius_m=radius)
    Ts = views(CUBE, config, np.random.default_rng(0))
    eyes, forward = Ts[:, :3, 3], Ts[:, :3, 2]
    assert np.all(eyes[:, 2] > config.clearance_m)
    middle = np.array([0, 0, 0.0 if radius[0] >= config.near_m else 0.05])
    away = np.linalg.norm(eyes - middle, axis=1)
    slack = 1e-9 if radius[0] >= config.near_m else 0.05 * np.sqrt(2)
    assert away.min() >= radius[0] - slack
    assert away.max() <= radius[1] + slack
    to_middle = middle - eyes
    cosine = np.einsum("ij,ij->i", forward, to_middle) / np.linalg.norm(to_middle, axis=1)
    assert np.degrees(np.arccos(cosine.min())) < 25


def test_no_camera_stands_in_an_object_or_a_rim() -> None:
    tall = [corners((0.1, -0.3, 0.0), (0.35, 0.3, 0.6))]
    config = ViewConfig(count=64, radius_m=(0.3, 0.5), elevation_deg=(15, 60))
    for solids, rims in (([*CUBE, *tall], []), (CUBE, tall)):
        eyes = views(solids, config, np.random.default_rng(1), rims)[:, :3, 3]
        low, high = tall[0].min(axis=0), tall[0].max(axis=0)
        gap = np.maximum(np.maximum(low - eyes, eyes - high).max(axis=1), 0)
        assert gap.min() > config.clearance_m


def test_cameras_that_can_only_stand_in_something_are_refused() -> None:
    block = [corners((-1, -1, 0), (1, 1, 2.0))]
    config = ViewConfig(count=4, radius_m=(0.3, 0.4), near_m=0.0)
    why = r"stand in the objects.*larger --radius"
    refused(why, views, block, config, np.random.default_rng(0))


def test_a_radius_that_cannot_be_is_refused() -> None:
    for radius in ((0.01, 0.05), (2.0, 1.0), (1.0, 9.0), (-1.0, 1.0)):
        refused("least <= most", ViewConfig, radius_m=radius)


@pytest.mark.parametrize(("profile", "fov_deg"), [("d435", 69.4), ("d405", 89.3)])
def test_fields_of_view_are_the_cameras(profile: str, fov_deg: float) -> None:
    for size in ((1920, 1080), (640, 360)):
        camera = intrinsics_of(profile, size)
        fov = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
        assert fov == pytest.approx(fov_deg, abs=1.0)
        assert (camera.cx, camera.cy) == ((size[0] - 1) / 2, (size[1] - 1) / 2)


# --- looks ------------------------------------------------------------------------------------


def _bytes(material: Material) -> list[bytes]:
    values = (getattr(material, f.name) for f in fields(material))
    return [v.tobytes() if isinstance(v, np.ndarray) else repr(v).encode() for v in values]


def test_the_same_seed_gives_the_same_looks_to_the_byte() -> None:
    a = _small_built().synthetic
    b = build_scene(_small_layout(), open_pool(["pybullet"]), SCENE).synthetic
    assert a.digests() == b.digests()
    assert [_bytes(m) for m in a.materials.values()] == [_bytes(m) for m in b.materials.values()]
    assert set(a.materials) == {0, 1}


def test_no_object_gets_the_name_of_another_file() -> None:
    layout = _small_layout()
    names = ("mug", "mug", "mug-no2")
    called = tuple(replace(layout.objects[0], name=name) for name in names)
    scene = build_scene(replace(layout, objects=called), open_pool(["pybullet"]), SCENE).synthetic
    assert [m.name for m in scene.models.values()] == ["mug", "mug-no3", "mug-no2"]


def test_the_users_own_pictures_cover_table_floor_and_objects(tmp_path: Path) -> None:
    for k, color in enumerate(((0, 0, 255), (0, 255, 0))):
        cv2.imwrite(str(tmp_path / f"paint{k}.png"), np.full((16, 16, 3), color, np.uint8))
    built = _small_built(own_looks(None, tmp_path)).synthetic
    looks = {p.material.name for p in built.surroundings if p.material is not None}
    assert looks & {"paint0", "paint1"}
    assert {m.name for m in built.materials.values()} <= {"paint0", "paint1"}


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    refused(r"--textures .* holds no image", own_looks, None, tmp_path)
    refused(r"--hdris .* is no folder", own_looks, tmp_path / "none", None)


# --- models -----------------------------------------------------------------------------------


def test_the_school_knows_the_parts_and_the_matter_that_were_dropped(tmp_path: Path) -> None:
    built = _small_built()
    write_models(tmp_path, built)
    solids, unknown = known_solids(tmp_path, [1, 2])
    assert not unknown
    for obj_id, solid in built.solids.items():
        kept = solids[obj_id]
        assert all(
            np.array_equal(np.unique(a, axis=0), np.unique(b, axis=0))
            for a, b in zip(kept.parts.parts, solid.parts.parts, strict=True)
        )
        assert kept.matter.mass_kg == solid.matter.mass_kg
        mesh = built.synthetic.models[obj_id].mesh
        assert kept.matter.mass_kg == pytest.approx(mass_properties(mesh, 1000.0).mass_kg)
