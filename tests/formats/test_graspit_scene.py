"""GraspIT's scene.yaml: the order of the quaternions is proven, the grasps' frame is checked."""

import h5py
import numpy as np
import pytest

from realsim.errors import InputError, NotRigidError
from realsim.formats.graspit.scene import read_graspit_scene
from realsim.geometry import se3
from refusals import refused

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
