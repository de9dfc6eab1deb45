"""GraspIT's scene.yaml and grasps.hdf5 written: what is written is read again as it was."""

import dataclasses

import h5py
import numpy as np
import pytest

import placed_scenes
from file_trees import bytes_of
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspit.grasps import WorldGrasps, read_grasp_file
from realsim.formats.graspit.scene import read_graspit_scene
from realsim.formats.graspit.writing import paired_grasps, write_graspit
from realsim.geometry import se3
from refusals import refused
from tried_grasps import plain_grasps


def tried(instance, obj_id, middle, n=12):
    """Return grasps from above that close along the object's y about a point of it."""
    at = np.asarray(middle) + np.linspace(-0.005, 0.005, n)[:, None] * [0, 0, 1]
    Ts = se3.from_rt(np.tile(np.diag([-1.0, 1.0, -1.0]), (n, 1, 1)), at)
    return plain_grasps(
        Ts, obj_id=obj_id, instance=instance, scores=np.ones(n), base_scores=np.ones(n),
        slip_m=np.zeros((n, 4)), slip_rad=np.zeros((n, 4)),
    )  # fmt: skip


def grasps():
    first, box = tried(0, 1, [0.06, 0.02, 0.01]), tried(1, 2, [0.0, 0.0, 0.02])
    return [paired_grasps(s) for s in (first, box, tried(2, 1, [0.05, 0.02, 0.01], n=7))]


def write(scene, sets, folder):
    return placed_scenes.written(lambda s, out: write_graspit(s, sets, out), scene, folder)


def same(found, scene, sets):
    """Assert that poses, meshes (float32 in STL) and grasps are those of the scene."""
    assert found.order == "wxyz"
    for o, p in zip(scene.objects, found.scene.objects, strict=True):
        assert np.allclose(p.T_world_obj, o.T_world_obj, rtol=0, atol=1e-12)
        seen, mesh = found.models[p.obj_id].mesh, scene.body(o).model.mesh
        assert np.allclose(seen.vertices[seen.faces], mesh.vertices[mesh.faces], rtol=0, atol=1e-8)
    held_grasps(found, sets)


def held_grasps(found, sets):
    """Assert that the file beside a scene has these grasps, in world."""
    by_name = read_grasp_file(found.grasp_file)
    assert list(by_name) == sorted(found.names[s.instance] for s in sets)
    for s in sets:
        T_world_obj = found.scene.objects[s.instance].T_world_obj
        Ts = by_name[found.names[s.instance]]
        assert np.allclose(Ts, T_world_obj @ s.Ts_obj_grasp, rtol=0, atol=1e-12)


def test_what_is_written_is_read_again_with_the_grasps_of_each_instance(tmp_path):
    scene = placed_scenes.placed_scene()
    told = write(scene, grasps(), tmp_path / "s")
    found = read_graspit_scene(tmp_path / "s")
    same(found, scene, grasps())
    assert list(found.names.values()) == ["bracket_0", "_2_box", "bracket_2"]
    assert [o.obj_id for o in found.scene.objects] == [1, 2, 1]
    assert told.counts == {"meshes": 2, "grasps": 31}
    assert any("STL has no colours" in n for n in told.notes)
    height = found.scene.plane.T_world_table[2, 3]
    assert height == pytest.approx(scene.table.T_world_table[2, 3], abs=1e-6)


def test_the_pairs_are_a_grasp_and_its_half_turn_in_world(tmp_path):
    scene = placed_scenes.placed_scene()
    write(scene, grasps(), tmp_path / "s")
    with h5py.File(tmp_path / "s/grasps.hdf5") as file:
        assert sorted(file) == ["_2_box", "bracket_0", "bracket_2"]
        Ts = file["bracket_0"][()]
    assert Ts.shape == (12, 2, 4, 4) and Ts.dtype == np.float64
    half = se3.invert(Ts[:, 0]) @ Ts[:, 1]
    assert np.allclose(half, np.diag([-1.0, -1.0, 1.0, 1.0]), atol=1e-12)
    wanted = scene.objects[0].T_world_obj @ tried(0, 1, [0.06, 0.02, 0.01]).Ts_obj_grasp
    assert np.allclose(Ts[:, 0], wanted, atol=1e-12)


def test_a_table_that_leans_in_world_becomes_level(tmp_path):
    scene = placed_scenes.turned_to(placed_scenes.placed_scene())
    told = write(scene, grasps(), tmp_path / "s")
    found = read_graspit_scene(tmp_path / "s")
    assert any("table's frame" in n for n in told.notes)
    T = se3.invert(scene.table.T_world_table)
    for o, p in zip(scene.objects, found.scene.objects, strict=True):
        assert np.allclose(p.T_world_obj, T @ o.T_world_obj, atol=1e-12)
    held_grasps(found, grasps())


def test_the_same_scene_gives_the_same_bytes_and_several_go_into_one_export(tmp_path):
    scene = placed_scenes.placed_scene()
    for name in "ab":
        write(scene, grasps(), tmp_path / name)
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")
    out = ExportFolder.begin(tmp_path / "c", {})
    for k in range(2):
        write_graspit(scene, grasps(), out.below(f"scenes/scene_{k}"))
    out.finish({})
    same(read_graspit_scene(tmp_path / "c/scenes/scene_1"), scene, grasps())
    text = (tmp_path / "c/scenes/scene_1/scene.yaml").read_text()
    assert text.startswith("grasp_path: scenes/scene_1/grasps.hdf5\n")


def test_grasps_of_nothing_are_refused(tmp_path):
    stranger = dataclasses.replace(grasps()[0], instance=9)
    assert isinstance(stranger, WorldGrasps)
    refused("instance 9", write, placed_scenes.placed_scene(), [stranger], tmp_path / "s")
