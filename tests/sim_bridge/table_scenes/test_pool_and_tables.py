"""Pools of objects: a fixed order, weights, what is broken is named."""

import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from realsim.geometry.mesh import mass_properties, save_ply
from realsim.geometry.parts import part
from realsim.models.convex_hulls import hull_volume
from realsim_sim_bridge.table_scenes.config import PoolConfig
from realsim_sim_bridge.table_scenes.pool import open_pool, read_object
from realsim_sim_bridge.table_scenes.table_shapes import table, table_names
from realsim_sim_bridge.table_scenes.tables import floor, walls
from refusals import refused

HULLS = PoolConfig(hull_only=True)


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
    assert len({read_object(s, k, HULLS).name for s in pool.sources for k in s.keys}) == 6
    assert read_object(open_pool([second]).sources[0], "cube.ply", HULLS).name == "cube"


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
    refused(words, read_object, source, name, HULLS)


def test_a_mesh_that_is_too_large_is_named_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "huge.stl").write_bytes(bytes(2_000_000))
    source = open_pool([str(tmp_path)]).sources[0]
    refused(r"2 MB; up to 1 MB", read_object, source, "huge.stl", PoolConfig(most_mb=1.0))
    _folder(tmp_path, ("mug",))
    refused("triangles; up to 100", read_object, source, "mug.ply", PoolConfig(most_faces=100))


def test_a_pool_that_is_not_there_is_refused() -> None:
    for text in ("nowhere", "nowhere=2"):
        refused(r"no folder; 'pybullet'", open_pool, [text])


def test_a_folder_without_meshes_is_refused_and_says_what_it_holds(tmp_path: Path) -> None:
    refused(r"no mesh \(it holds nothing\)", open_pool, [str(tmp_path)])
    (tmp_path / "readme.md").write_text("x")
    refused(r"no mesh \(it holds readme.md\)", open_pool, [str(tmp_path)])


def test_a_weight_that_is_not_positive_is_refused() -> None:
    for weight in ("0", "-1", "nan", "inf"):
        refused("not positive", open_pool, [f"pybullet={weight}"])


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
