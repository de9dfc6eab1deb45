"""A registered session as a scene for simulators: what their own programs read back."""

import numpy as np
import pytest

from realsim.formats.graspit.scene import read_graspit_scene
from school_sessions import registered, scene
from typed_commands import finished, refused


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return registered(tmp_path_factory.mktemp("scenes") / "scene_000007")


def exported(session, target, out):
    finished("export", session, "--to", target, "--out", out, "--quiet")
    return out / "scene_000007"


def test_mujoco_reads_the_poses(session, tmp_path):
    import mujoco

    folder = exported(session, "mjcf", tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    free = [b for b in range(model.nbody) if model.body_dofnum[b] == 6]
    assert len(free) == len(scene().objects)
    for body, o in zip(free, scene().objects, strict=True):
        np.testing.assert_allclose(data.xpos[body], o.T_world_obj[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.xmat[body].reshape(3, 3), o.T_world_obj[:3, :3], atol=1e-9)


def test_the_authors_scene_is_read_back(session, tmp_path):
    folder = exported(session, "graspit", tmp_path / "out")
    back = read_graspit_scene(folder / "scene.yaml", order="wxyz")
    assert len(back.scene.objects) == len(scene().objects)
    for a, b in zip(back.scene.objects, scene().objects, strict=True):
        np.testing.assert_allclose(a.T_world_obj, b.T_world_obj, atol=1e-9)


def test_a_scene_without_views_is_no_data_set(session, tmp_path):
    assert "no views" in refused("export", session, "--to", "bop", "--out", tmp_path / "o")
    assert not (tmp_path / "o").exists()
