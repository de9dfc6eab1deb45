"""`realsim school`: what it refuses, and how it says so."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from realsim.app.school.inputs import SchoolRequest, base_on_table, masses_of
from realsim.app.school.run import config_of
from realsim.errors import InputError
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.store import load_grasps
from school_sessions import NAMES, QUICK, T_WORLD_TABLE, refused, run, scene


def test_physics_that_cannot_be_is_refused(pristine: Path) -> None:
    for option, value in (
        ("--force", "0"),
        ("--friction", "nan"),
        ("--density", "-1"),
        ("--stiffness", "0"),
        ("--stiffness", "inf"),
        ("--stiffness", "6e5"),
    ):
        assert option in refused(pristine, *QUICK, option, value)
    assert not (pristine / "grasps").exists()


def test_p_hold_of_one_draw_or_of_a_negative_error_is_refused(pristine: Path) -> None:
    assert "2 draws or more" in refused(pristine, *QUICK, "--draws", "1")
    assert "has -10 for yaw" in refused(pristine, *QUICK, "--cell-error", "8", "3", "-10", "3")
    assert not (pristine / "grasps").exists()


def test_trials_of_another_layout_are_refused(tmp_path: Path) -> None:
    message = refused("reality", tmp_path)
    assert "layouts" in message and "GRASPA" in message


@pytest.mark.parametrize(
    ("mass", "words"),
    [("mug=0.3", "no object of this scene"), ("cube=heavy", "NAME=KG"), ("cube=0", "NAME=KG")],
)
def test_a_mass_of_nothing_or_of_no_object_is_refused(
    pristine: Path, mass: str, words: str
) -> None:
    message = refused(pristine, *QUICK, "--weighed", mass)
    assert words in message and mass in message


def test_masses_are_told_by_name_or_number_and_once() -> None:
    models = {part(n).obj_id: part(n) for n in NAMES}
    assert masses_of(["cube=0.3", "8=1e-1"], models) == {2: 0.3, 8: 0.1}
    with pytest.raises(InputError, match="twice"):
        masses_of(["cube=0.3", "2=0.4"], models)


def test_a_base_pose_is_taken_from_world_or_table(tmp_path: Path) -> None:
    T = se3.from_rt(se3.exp_so3(np.array([0.1, 0.2, 0.3])), [-0.4, 0.1, 0.0])
    file = tmp_path / "base.json"
    file.write_text(json.dumps({"T_table_base": T.tolist()}))
    assert base_on_table(file, scene()) == pytest.approx(T)
    config = config_of(SchoolRequest(base_pose=file), scene())
    assert np.array(config.reach.T_table_base) == pytest.approx(T)
    file.write_text(json.dumps({"T_world_base": (T_WORLD_TABLE @ T).tolist()}))
    assert base_on_table(file, scene()) == pytest.approx(T)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "is no file"),
        ('{"T_base_world": []}', "no pose"),
        ('{"T_world_base": [], "T_table_base": []}', "exactly one"),
        ('{"T_table_base": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "T_table_base"),
    ],
)
def test_a_base_pose_that_is_none_is_refused(
    pristine: Path, tmp_path: Path, content: str | None, words: str
) -> None:
    file = tmp_path / "base.json"
    if content is not None:
        file.write_text(content)
    message = refused(pristine, *QUICK, "--base-pose", file)
    assert words in message and str(file) in message


def test_an_engine_that_is_not_installed_is_named_before_anything_runs(
    pristine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    assert "realsim[mujoco]" in refused(pristine, "--engine", "mujoco", "--quiet")
    assert "realsim[mujoco]" in refused(pristine, "--cross-check", "--quiet")
    assert "realsim[mujoco]" in refused("validate", "--engine", "both", "--quiet")


def test_a_mesh_without_volume_is_named_and_the_others_are_tried(
    pristine: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(pristine, tmp_path / "s"))
    flat = part("cube")
    sheet = flat.mesh.vertices.copy()
    sheet[:, 2] = 0.0
    mesh = type(flat.mesh)(vertices=sheet, faces=flat.mesh.faces)
    models = {2: type(flat)(obj_id=2, name="cube", mesh=mesh), 8: part("wedge")}
    save_models(folder / "models", models)
    result = run(folder, *QUICK)
    assert result.exit_code == 0, result.output
    assert "0 cube: not tried" in result.stderr
    cube, wedge = load_grasps(folder)
    assert not cube.good.any() and wedge.reachable.any()


def test_sources_that_are_none_are_refused(pristine: Path, tmp_path: Path) -> None:
    assert "no session.json" in refused(tmp_path, *QUICK)
    assert "does not exist" in refused(tmp_path / "nowhere", *QUICK)
    assert str(pristine) in refused(pristine.parent, *QUICK)
    assert "--out" in refused(pristine, *QUICK, "--out", tmp_path)
    assert "is a session" in refused(tmp_path, *QUICK, "--out", pristine)
    assert "scene" in refused(tmp_path, *QUICK, "--out", tmp_path / "o")
    assert "no grasps yet" in refused("export", pristine, "--to", "hdf5", "--out", tmp_path / "o")
    assert "no results" in refused("summary", tmp_path)


SLAB = """<robot name="slab"><link name="base"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 {z}"/><geometry><box size="2 2 0.02"/></geometry></collision>
</link></robot>"""


@pytest.mark.slow
def test_a_support_that_objects_stand_in_moves_them_and_one_below_the_table_does_not(
    pristine: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(pristine, tmp_path / "s"))
    for z, code in ((-0.3, 0), (0.01, 1)):  # far below the table; in the objects' lowest 2 cm
        slab = tmp_path / "slab.urdf"
        slab.write_text(SLAB.format(z=z))
        result = run("settle", folder, "--support", slab, "--quiet")
        assert result.exit_code == code, result.output
