"""GraspIT's scene.yaml: the order of the quaternions is proven, the grasps' frame is checked.

GraspIT's scene.yaml and grasps.hdf5 written: what is written is read again as it was.
"""

import dataclasses

import h5py
import numpy as np
import pytest

import placed_scenes
from file_trees import bytes_of
from realsim.errors import InputError, NotRigidError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspit.grasps import WorldGrasps, read_grasp_file
from realsim.formats.graspit.scene import read_graspit_scene
from realsim.formats.graspit.writing import paired_grasps, write_graspit
from realsim.geometry import se3
from refusals import refused
from tried_grasps import plain_grasps

HEIGHT = 0.8
EXTENTS = {"brick": (0.06, 0.04, 0.1), "slab": (0.12, 0.05, 0.02), "post": (0.03, 0.03, 0.15)}


def write_stl(folder, name, extents):
    import trimesh

    (folder / f"{name}.stl").write_bytes(trimesh.creation.box(extents).export(file_type="stl"))


def standing_poses():
    """Return T_world_obj by name: each on the table, turned about the vertical, one lying."""
    poses = {}
    for k, (name, extents) in enumerate(EXTENTS.items()):
        lying = name == "post"
        R = se3.exp_so3([0.0, 0.0, 0.4 + k]) @ se3.exp_so3([lying * np.pi / 2, 0.0, 0.0])
        half = extents[1 if lying else 2] / 2
        poses[name] = se3.from_rt(R, [0.2 * k, -0.1 * k, HEIGHT + half])
    return poses


def grasps_of(T):
    """Return 20 grasps (N, 2, 4, 4) from above across the object's own x, beside its middle."""
    z = np.array([0.0, 0.0, -1.0])
    y = T[:3, 0] if abs(T[2, 0]) < 0.1 else T[:3, 1]
    R = np.stack([np.cross(y, z), y, z], axis=1)
    along = np.linspace(-0.005, 0.005, 20)[:, None] * z + 0.012 * np.cross(y, z)
    Ts = se3.from_rt(np.tile(R, (20, 1, 1)), T[:3, 3] + along)
    return np.stack([Ts, Ts @ np.diag([-1.0, -1.0, 1.0, 1.0])], axis=1)


def write_scene(folder, order="wxyz", poses=None, grasps=True, scale=1.0):
    poses = poses or standing_poses()
    lines = ["grasp_path: scenes/scene_0/grasps.hdf5"]
    for k, (name, T) in enumerate(poses.items()):
        q = se3.quaternion_wxyz(T[:3, :3])
        q = q if order == "wxyz" else np.roll(q, -1)
        write_stl(folder, name, np.array(EXTENTS[name]) / scale)
        lines += [
            f"object{k + 1}:",
            f"  file_path: assets/{name}.usd",
            f"  name: {name}",
            f"  orientation: {[float(v) for v in q]}",
            f"  position: {[float(v) for v in T[:3, 3]]}",
            f"  scale: {[scale] * 3}",
        ]
    lines += ["table:", "  file_path: assets/table.obj", "  name: table"]
    lines += ["  orientation: [0.0, 0.0, 0.0, 0.0]", "  position: [0.0, 0.0, 0.0]"]
    (folder / "scene.yaml").write_text("\n".join(lines))
    if grasps:
        with h5py.File(folder / "grasps.hdf5", "w") as file:
            for name, T in poses.items():
                file[name] = grasps_of(T)
    return folder


@pytest.mark.parametrize("grasps", [True, False])
@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_poses_come_back_whatever_the_order_of_the_quaternions(tmp_path, order, grasps):
    found = read_graspit_scene(write_scene(tmp_path, order, grasps=grasps))
    assert found.order == order
    for o, T in zip(found.scene.objects, standing_poses().values(), strict=True):
        assert np.allclose(o.T_world_obj, T, atol=1e-6)
    assert [m.name for m in found.models.values()] == list(EXTENTS)
    assert found.scene.plane.T_world_table[2, 3] == pytest.approx(HEIGHT, abs=1e-6)
    assert any("table" in n and "0.8000 m" in n for n in found.notes)


def test_an_order_that_the_content_does_not_prove_is_an_error_with_the_evidence(tmp_path):
    """A single cube without grasps stands in both orders."""
    EXTENTS["die"] = (0.05, 0.05, 0.05)
    try:
        poses = {"die": se3.from_rt(se3.exp_so3([0, 0, 0.3]), [0, 0, HEIGHT + 0.025])}
        folder = write_scene(tmp_path, poses=poses, grasps=False)
    finally:
        del EXTENTS["die"]
    refused(r"cannot be told.*wxyz.*xyzw.*order='wxyz'", read_graspit_scene, folder)
    for order in ("wxyz", "xyzw"):
        assert read_graspit_scene(folder, order=order).order == order


def test_grasps_of_a_wrong_shape_are_refused(tmp_path):
    folder = write_scene(tmp_path)
    for Ts, says, error in (
        (np.zeros((3, 4, 4)), r"shape \(3, 4, 4\)", InputError),
        (np.ones((3, 2, 4, 4)), "brick", NotRigidError),
    ):
        with h5py.File(folder / "grasps.hdf5", "a") as file:
            del file["brick"]
            file["brick"] = Ts
        refused(says, read_graspit_scene, folder, error=error)
    (folder / "grasps.hdf5").write_bytes(b"no hdf5")
    refused("no HDF5", read_graspit_scene, folder)


AT = "name: a, position: [0, 0, 0]"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("object1: {file_path: a.usd, name: a}", "orientation, position"),
        ("- 1\n- 2", "no named objects"),
        ("a: !!python/object/apply:os.system ['true']", "no objects of a program"),
        (f"o: {{file_path: brick.usd, orientation: [1, 0, 0, .nan], {AT}}}", "has to be finite"),
        (f"o: {{file_path: brick.usd, orientation: [2, 0, 0, 0], {AT}}}", "length 2"),
        (f"o: {{file_path: gone.usd, orientation: [1, 0, 0, 0], {AT}}}", r"gone\.stl"),
        (f"o: {{file_path: brick.usd, orientation: [1, 0, 0, 0], {AT}, scale: [1, -1, 1]}}",
         "scale"),
    ],
)  # fmt: skip
def test_a_bad_file_is_named(tmp_path, text, what):
    write_stl(tmp_path, "brick", EXTENTS["brick"])
    (tmp_path / "scene.yaml").write_text(text)
    refused(what, read_graspit_scene, tmp_path)


def test_meshes_in_millimetres_need_a_scale_and_are_named_without_one(tmp_path):
    write_scene(tmp_path)
    write_stl(tmp_path, "brick", [1e3 * side for side in EXTENTS["brick"]])
    refused(r"'brick' .*scale: \[0.001, 0.001, 0.001\]", read_graspit_scene, tmp_path)
    write_scene(tmp_path, scale=0.001)
    models = read_graspit_scene(tmp_path).models
    sides = {m.name: np.ptp(m.mesh.vertices, axis=0) for m in models.values()}
    assert all(np.allclose(sides[name], extents, atol=1e-6) for name, extents in EXTENTS.items())


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


def test_what_is_written_is_read_again_with_the_grasps_of_each_instance(scene, tmp_path):
    told = write(scene, grasps(), tmp_path / "s")
    found = read_graspit_scene(tmp_path / "s")
    same(found, scene, grasps())
    assert list(found.names.values()) == ["bracket_0", "_2_box", "bracket_2"]
    assert [o.obj_id for o in found.scene.objects] == [1, 2, 1]
    assert told.counts == {"meshes": 2, "grasps": 31}
    assert any("STL has no colours" in n for n in told.notes)
    height = found.scene.plane.T_world_table[2, 3]
    assert height == pytest.approx(scene.table.T_world_table[2, 3], abs=1e-6)


def test_the_pairs_are_a_grasp_and_its_half_turn_in_world(scene, tmp_path):
    write(scene, grasps(), tmp_path / "s")
    with h5py.File(tmp_path / "s/grasps.hdf5") as file:
        assert sorted(file) == ["_2_box", "bracket_0", "bracket_2"]
        Ts = file["bracket_0"][()]
    assert Ts.shape == (12, 2, 4, 4) and Ts.dtype == np.float64
    half = se3.invert(Ts[:, 0]) @ Ts[:, 1]
    assert np.allclose(half, np.diag([-1.0, -1.0, 1.0, 1.0]), atol=1e-12)
    wanted = scene.objects[0].T_world_obj @ tried(0, 1, [0.06, 0.02, 0.01]).Ts_obj_grasp
    assert np.allclose(Ts[:, 0], wanted, atol=1e-12)


def test_a_table_that_leans_in_world_becomes_level(scene, tmp_path):
    scene = placed_scenes.turned_to(scene)
    told = write(scene, grasps(), tmp_path / "s")
    found = read_graspit_scene(tmp_path / "s")
    assert any("table's frame" in n for n in told.notes)
    T = se3.invert(scene.table.T_world_table)
    for o, p in zip(scene.objects, found.scene.objects, strict=True):
        assert np.allclose(p.T_world_obj, T @ o.T_world_obj, atol=1e-12)
    held_grasps(found, grasps())


def test_the_same_scene_gives_the_same_bytes_and_several_go_into_one_export(scene, tmp_path):
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


def test_grasps_of_nothing_are_refused(scene, tmp_path):
    stranger = dataclasses.replace(grasps()[0], instance=9)
    assert isinstance(stranger, WorldGrasps)
    refused("instance 9", write, scene, [stranger], tmp_path / "s")
