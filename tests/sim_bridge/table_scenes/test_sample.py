"""Scenes at rest: the same seed gives the same scene, and what lies on the table stays there.

Pools of objects: a fixed order, weights, what is broken is named.
"""

import shutil
from collections import Counter
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
from realsim.models.convex_hulls import hull_volume
from realsim.models.library_files import properties_file, read_properties
from realsim.models.library_session import known_solids
from realsim.rendering.appearance import Material
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.table_scenes.cameras import ViewConfig, intrinsics_of, views
from realsim_sim_bridge.table_scenes.config import DropConfig, PoolConfig, TableSceneConfig
from realsim_sim_bridge.table_scenes.drop import settle
from realsim_sim_bridge.table_scenes.pool import ObjectPool, open_pool, read_object
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
from realsim_sim_bridge.table_scenes.table_shapes import table, table_names
from realsim_sim_bridge.table_scenes.tables import corners, floor, walls
from refusals import refused

CONFIG = TableSceneConfig(objects=(3, 4))


@cache
def _pool() -> ObjectPool:
    return open_pool(["pybullet"])


@cache
def _layout() -> Layout:
    return sample_layout(7, 0, _pool(), CONFIG)


@cache
def _built(own: OwnLooks = OwnLooks()) -> BuiltScene:  # noqa: B008 - frozen, and no argument of a user
    return build_scene(_layout(), _pool(), CONFIG, own=own)


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
    a = _built().synthetic
    b = build_scene(_layout(), open_pool(["pybullet"]), CONFIG).synthetic
    assert a.digests() == b.digests()
    assert [_bytes(m) for m in a.materials.values()] == [_bytes(m) for m in b.materials.values()]
    assert set(a.materials) == set(range(len(_layout().objects)))


def test_no_object_gets_the_name_of_another_file() -> None:
    layout = _layout()
    names = ("mug", "mug", "mug-no2")
    called = tuple(replace(layout.objects[0], name=name) for name in names)
    scene = build_scene(replace(layout, objects=called), open_pool(["pybullet"]), CONFIG).synthetic
    assert [m.name for m in scene.models.values()] == ["mug", "mug-no3", "mug-no2"]


def test_the_users_own_pictures_cover_table_floor_and_objects(tmp_path: Path) -> None:
    for k, color in enumerate(((0, 0, 255), (0, 255, 0))):
        cv2.imwrite(str(tmp_path / f"paint{k}.png"), np.full((16, 16, 3), color, np.uint8))
    built = _built(own_looks(None, tmp_path)).synthetic
    looks = {p.material.name for p in built.surroundings if p.material is not None}
    assert looks & {"paint0", "paint1"}
    assert {m.name for m in built.materials.values()} <= {"paint0", "paint1"}


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    refused(r"--textures .* holds no image", own_looks, None, tmp_path)
    refused(r"--hdris .* is no folder", own_looks, tmp_path / "none", None)


# --- models -----------------------------------------------------------------------------------


def test_the_school_knows_the_parts_and_the_matter_that_were_dropped(tmp_path: Path) -> None:
    built = _built()
    write_models(tmp_path, built)
    solids, unknown = known_solids(tmp_path, sorted(built.solids))
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


# --- Pools of objects, and the ten tables they lie on.


def _folder(path: Path, names: tuple[str, ...]) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    for name in names:
        save_ply(path / f"{name}.ply", part(name).mesh, "mm")
    return path


def test_pybullet_has_a_thousand_objects_in_a_fixed_order() -> None:
    pool = open_pool(["pybullet"])
    assert len(pool) == 1000
    assert list(pool.sources[0].keys) == sorted(pool.sources[0].keys)
    assert pool.digest == open_pool(["pybullet"]).digest


def test_a_procedural_object_is_the_hulls_of_its_parts() -> None:
    source = open_pool(["pybullet"]).sources[0]
    for key in source.keys[:200:40]:
        found = read_object(source, key, PoolConfig())
        corners = np.concatenate(found.parts.parts)
        assert np.array_equal(np.unique(corners, axis=0), np.unique(found.mesh.vertices, axis=0))
        assert all(hull_volume(p) > 0 for p in found.parts.parts)
        assert 0.01 < float(found.mesh.extent.max()) < 1.0


def test_meshes_are_found_in_folders_of_folders_and_drawn_by_weight(tmp_path: Path) -> None:
    _folder(tmp_path / "a/00000001", ("mug",))
    _folder(tmp_path / "a/00000002/deep", ("cube",))
    _folder(tmp_path / "b", ("box",))
    (tmp_path / "a/notes.txt").write_text("no mesh")
    pool = open_pool([f"{tmp_path / 'a'}=3", str(tmp_path / "b")])
    assert pool.sources[0].keys == ("00000001/mug.ply", "00000002/deep/cube.ply")
    rng = np.random.default_rng(0)
    drawn = Counter(pool.draw(rng)[0] for _ in range(4000))
    assert drawn[0] / 4000 == pytest.approx(0.75, abs=0.03)


def test_files_whose_names_read_alike_have_names_of_their_own(tmp_path: Path) -> None:
    cube = _folder(tmp_path, ("cube",)) / "cube.ply"
    for name in ("a/büchse", "a/bächse", "a/a b", "a/a-b", "a/cube", "b/cube"):
        copied = tmp_path / "pools" / f"{name}.ply"
        copied.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(cube, copied)
    first, second = (str(tmp_path / "pools" / name) for name in "ab")
    pool = open_pool([first, second])
    assert len({read_object(s, k, HULLS.pool).name for s in pool.sources for k in s.keys}) == 6
    assert read_object(open_pool([second]).sources[0], "cube.ply", HULLS.pool).name == "cube"


def test_convex_parts_are_kept_by_content_whatever_the_size(tmp_path: Path) -> None:
    source = open_pool([str(_folder(tmp_path / "m", ("cube",)))]).sources[0]
    first = read_object(source, source.keys[0], PoolConfig(), tmp_path / "cache")
    kept = sorted((tmp_path / "cache").iterdir())
    again = read_object(source, source.keys[0], PoolConfig(), tmp_path / "cache")
    assert len(kept) == 1
    assert sorted((tmp_path / "cache").iterdir()) == kept
    assert np.array_equal(first.parts.parts[0], again.parts.parts[0])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("torn.ply", b"ply\nformat ascii 1.0\nelement vertex 9\n", "torn.ply"),
        ("empty.stl", b"", "empty"),
        ("flat.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n", "is flat"),
        ("point.obj", b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "no extent"),
    ],
)
def test_a_mesh_that_cannot_be_used_is_named(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    (tmp_path / name).write_bytes(content)
    source = open_pool([str(tmp_path)]).sources[0]
    refused(words, read_object, source, name, HULLS.pool)


def test_a_mesh_that_is_too_large_is_named_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "huge.stl").write_bytes(bytes(2_000_000))
    source = open_pool([str(tmp_path)]).sources[0]
    refused(r"2 MB; up to 1 MB", read_object, source, "huge.stl", PoolConfig(most_mb=1.0))
    _folder(tmp_path, ("mug",))
    refused("triangles; up to 100", read_object, source, "mug.ply", PoolConfig(most_faces=100))


def test_pools_that_cannot_be_opened_say_what_there_is(tmp_path: Path) -> None:
    for text in ("nowhere", "nowhere=2"):
        refused(r"no folder; 'pybullet'", open_pool, [text])
    for weight in ("0", "-1", "nan", "inf"):
        refused("not positive", open_pool, [f"pybullet={weight}"])
    refused(r"no mesh \(it holds nothing\)", open_pool, [str(tmp_path)])
    (tmp_path / "readme.md").write_text("x")
    refused(r"no mesh \(it holds readme.md\)", open_pool, [str(tmp_path)])


# --- The ten table models: closed, convex outlines, top at z = 0, feet on the floor.

FOOT_M = 0.005
"""The ends of slanted legs are cut square to the leg, so a corner dips below the floor [m]."""


def test_there_are_ten_kinds() -> None:
    assert len(table_names()) == 10


@pytest.mark.parametrize("name", table_names())
def test_a_table_is_closed_stands_on_the_floor_and_its_top_is_zero(name: str) -> None:
    made = table(name, np.random.default_rng(4))
    assert all(mass_properties(p.mesh, 1.0).is_watertight for p in made.parts)
    top = next(p for p in made.parts if p.role == "top")
    assert top.mesh.bounds[1, 2] == pytest.approx(0.0, abs=1e-12)
    lowest = min(p.mesh.bounds[0, 2] for p in made.parts)
    assert -made.height_m - FOOT_M <= lowest <= -made.height_m + 1e-9
    # What rises above the top surface is known to the physics.
    risen = max(p.mesh.bounds[1, 2] for p in made.parts)
    assert risen <= max((float(r[:, 2].max()) for r in made.rims), default=0.0) + 1e-9


@pytest.mark.parametrize("name", table_names())
def test_an_outline_is_convex_and_counter_clockwise(name: str) -> None:
    ring = table(name, np.random.default_rng(5)).outline
    edge = np.roll(ring, -1, axis=0) - ring
    after = np.roll(edge, -1, axis=0)
    assert np.all(edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0] > -1e-12)


@pytest.mark.parametrize("name", table_names())
def test_objects_may_lie_only_where_no_rim_is(name: str) -> None:
    made = table(name, np.random.default_rng(6))
    low, high = made.inside.min(axis=0), made.inside.max(axis=0)
    for rim in made.rims:
        a, b = rim[:, :2].min(axis=0), rim[:, :2].max(axis=0)
        assert np.any(a >= high - 1e-9) or np.any(b <= low + 1e-9)


def test_walls_stand_behind_the_farthest_camera() -> None:
    for seed in range(20):
        wall = walls(0.7, 2.0, np.random.default_rng(seed)).mesh
        # A wall is a box about one of the axes: its nearest point is its distance.
        planes = np.abs(wall.vertices[:, :2]).reshape(-1, 8, 2).min(axis=1)
        assert np.all(planes.max(axis=1) >= 2.0)
    assert floor(0.7).mesh.bounds[1, 2] == pytest.approx(-0.7)


def test_a_table_that_is_not_known_is_named_with_those_that_are() -> None:
    refused(r"no table 'desk'.*drawer_desk", table, "desk", np.random.default_rng(0))
