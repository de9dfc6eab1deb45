"""`realsim school`: what it runs and writes, and its exit codes."""

import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import Result

import refusals
from grasp_files import read_acronym
from realsim.app.school.files import stored_grasps
from realsim.app.school.inputs import SchoolRequest, base_on_table, masses_of
from realsim.app.school.run import config_of
from realsim.formats.bop.models import save_models
from realsim.formats.grasps.hdf5 import read_grasps_hdf5
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import Mesh, ObjectModel
from realsim.robots.hand import find_hand
from realsim.store import SessionStore, load_grasps, save_scene
from school_sessions import GRASPS, NAMES, QUICK, T_WORLD_TABLE, finished, refused, run, scene

DATA = Path(os.environ.get("REALSIM_DATA", Path(__file__).parents[3] / "shared/data"))
GRASPIT = DATA / "school/graspit_assets/scene.yaml"


@pytest.fixture
def session(pristine: Path, tmp_path: Path) -> Path:
    """A registered session for one test."""
    return Path(shutil.copytree(pristine, tmp_path / "s"))


@pytest.fixture
def schooled(tried: tuple[Path, Result], tmp_path: Path) -> Path:
    """A session after a school for one test."""
    return Path(shutil.copytree(tried[0], tmp_path / "s"))


# --- a run --------------------------------------------------------------------------------------


def test_a_run_needs_no_name_and_all_files_hold_its_grasps(tried: tuple[Path, Result]) -> None:
    folder, result = tried
    assert result.exit_code == 0, result.output
    store = SessionStore.open(folder)
    sets = load_grasps(store)
    assert [s.instance for s in sets] == [0, 1] and all(len(s) == GRASPS for s in sets)
    assert any(s.good.any() for s in sets)
    for name in ("grasps/grasps.h5", "reports/school.html",
                 "reports/school.json", "reports/school_sheet.png"):  # fmt: skip
        assert store.has(name), name
    assert store.verify() == []
    physics = "70 N a finger, friction 1, pads of 200 kN/m, engine mujoco"
    for words in ("cube", "wedge", physics, "school.html"):
        assert words in result.output
    for found in (read_grasps_hdf5(folder / "grasps/grasps.h5"), stored_grasps(folder)[0]):
        assert found.T_world_table == pytest.approx(T_WORLD_TABLE)
        for s, other in zip(sets, found.sets, strict=True):
            assert np.array_equal(s.Ts_obj_grasp, other.Ts_obj_grasp)
            assert np.array_equal(s.scores, other.scores, equal_nan=True)
            assert s.failures == other.failures and set(s.measures) == set(other.measures)
            rows = found.trajectories[s.instance].rows
            assert np.array_equal(rows, np.nonzero(s.reachable)[0])


def test_a_second_run_computes_nothing_and_other_parameters_are_refused(schooled: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in (schooled / "grasps/cache").glob("instance_*")}
    finished(schooled, *QUICK)
    after = {p: p.stat().st_mtime_ns for p in (schooled / "grasps/cache").glob("instance_*")}
    assert after == before != {}
    message = refused(schooled, *QUICK, "--friction", "0.5")
    assert "friction: 1.0 -> 0.5" in message and "--restart" in message
    other = ("--hand", "parallel")
    assert 'hand.name: "franka_hand" -> "parallel"' in refused(schooled, *QUICK, *other)
    message = refused(schooled, *QUICK, *other, "--force", "200")
    assert "is more than A plain parallel gripper (parallel) can: 1 to 140 N" in message
    again = finished(schooled, *QUICK, "--friction", "0.5", "--restart")
    assert "friction 0.5" in again.output


@pytest.mark.slow
def test_a_hand_on_an_arc_goes_from_the_scene_to_the_exports(session: Path, tmp_path: Path) -> None:
    """The pads meet where the contacts are, the set keeps the hand, the exports speak of it."""
    finished(session, *QUICK, "--hand", "robotiq_2f85")
    hand = find_hand("robotiq_2f85")
    sets = stored_grasps(session)[0].sets
    assert any(s.good.any() for s in sets)
    for s in sets:
        assert s.hand == (hand.name, hand.digest)
        assert s.parameters["config"]["slip"]["physics"]["friction"] == hand.friction
        back = np.sum((s.Ts_obj_grasp - s.Ts_obj_pads)[:, :3, 3] * s.Ts_obj_grasp[:, :3, 2], axis=1)
        assert back == pytest.approx(-hand.z_pad(s.widths_m), abs=1e-12)
    for target in ("isaac", "graspgen", "hdf5", "parquet"):
        finished("export", session, "--to", target, "--out", tmp_path / target)
    acronym = ("--to", "acronym", "--out", tmp_path / "acronym")
    assert "Panda's hand alone" in refused("export", session, *acronym)


@pytest.mark.slow
def test_margins_and_a_second_engine_come_with_the_same_grasps(schooled: Path) -> None:
    alone = load_grasps(schooled)
    result = finished(schooled, *QUICK, "--sweep", "--cross-check", "--restart")
    assert "Two engines agree" in result.output
    measures = "margin least_friction least_force_n stiffness_share second_score confidence"
    for s, before in zip(load_grasps(schooled), alone, strict=True):
        assert np.array_equal(s.scores, before.scores, equal_nan=True)
        tested, held = ~np.isnan(s.slip_m[:, 0]), s.base_scores >= 1.0
        for name in measures.split():
            assert np.array_equal(~np.isnan(s.measures[name]), tested)
        assert np.all(s.measures["least_friction"][held] <= 1.0)
        assert np.all(s.measures["margin"][held] > 0.0)
    assert (schooled / "reports/school_margins.png").is_file()
    assert "by force" in (schooled / "reports/school.html").read_text()


def test_a_weighed_object_has_its_mass_and_the_others_the_density(session: Path) -> None:
    options = ("--weighed", "cube=0.31", "--density", "500")
    assert run(session, *QUICK, "--grasps", "2", *options).exit_code in (0, 1)
    cube, wedge = load_grasps(session)
    assert cube.parameters["mass_kg"] == pytest.approx(0.31)
    lighter = 500 / part("wedge").density
    assert wedge.parameters["mass_kg"] == pytest.approx(lighter * _mass("wedge"), rel=1e-3)


def _mass(name: str) -> float:
    """Return the mass of a part at its own density [kg]."""
    from realsim.geometry.mesh import mass_properties

    return mass_properties(part(name).mesh, part(name).density).mass_kg


# --- other commands -----------------------------------------------------------------------------


def test_grasps_are_exported(tried: tuple[Path, Result], tmp_path: Path) -> None:
    for target in ("acronym", "graspgen", "isaac", "hdf5", "parquet"):
        result = finished("export", tried[0], "--to", target, "--out", tmp_path / target)
        for line in result.output.split():
            assert Path(line).stat().st_size > 100
    _, held, scale = read_acronym(tmp_path / "acronym/000000_obj000002.h5")
    s = load_grasps(tried[0])[0]
    tested = ~np.isnan(s.slip_m[:, 0])
    assert np.array_equal(held, np.isfinite(s.slip_m).all(axis=1)[tested])
    with h5py.File(tmp_path / "acronym/000000_obj000002.h5") as file:
        assert (tmp_path / "acronym" / file["object/file"][()].decode()).is_file()
        assert file["object/mass"][()] == pytest.approx(_mass("cube"), rel=1e-3)
    assert scale == 1e-3


def test_the_summary_counts_every_session_once(tried: tuple[Path, Result], schooled: Path) -> None:
    file = schooled.parent / "summary.json"
    assert "2,275,352" in finished("summary", tried[0], schooled, "--json-file", file).output
    found = json.loads(file.read_text())
    assert found["scenes"] == 2 and found["candidates"] == 4 * GRASPS
    assert "twice" in refused("summary", schooled, schooled)


def test_things_that_stand_settle_and_one_in_the_air_does_not(
    session: Path, tmp_path: Path
) -> None:
    finished("settle", session, "--quiet")
    assert (session / "reports/settle.png").is_file()
    there = scene()
    cube, wedge = there.objects
    lifted = replace(cube, T_world_obj=se3.from_translation([0, 0, 0.03]) @ cube.T_world_obj)
    save_scene(SessionStore.open(session), replace(there, objects=(lifted, wedge)))
    words = ("settle", session, "--quiet", "--out", tmp_path)
    result = run(*words, "--json-file", tmp_path / "settle.json")
    assert result.exit_code == 1 and "floats" in result.output
    told = json.loads((tmp_path / "settle.json").read_text())
    assert [o["verdict"] for o in told["objects"]] == ["floats", "stands"]
    assert run(*words).exit_code == 1  # its own picture is replaced, another one is not
    (tmp_path / "settle.png").write_bytes(b"a photograph")
    assert "not replaced" in refused(*words)
    assert (tmp_path / "settle.png").read_bytes() == b"a photograph"


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.skipif(not GRASPIT.is_file(), reason=f"no {GRASPIT} (set REALSIM_DATA)")
def test_the_paper_authors_scene_is_tried_and_stays_as_it_is(tmp_path: Path) -> None:
    before = sorted(p.name for p in GRASPIT.parent.iterdir())
    result = finished(GRASPIT, "--out", tmp_path, *QUICK)
    assert sorted(p.name for p in GRASPIT.parent.iterdir()) == before
    found, models = stored_grasps(tmp_path)
    names = "banana bottle cup gelatin_box motor pipe pipe2".split()
    assert sorted(m.name for m in models.values()) == names
    assert sum(int(s.good.sum()) for s in found.sets) > 0
    assert "parts are 1.3" in result.stderr  # the bottle's
    exported = finished("export", tmp_path, "--to", "isaac", "--out", tmp_path / "isaac")
    assert len(exported.output.split()) == 7


# --- `realsim school`: what it refuses, and how it says so.

IMPOSSIBLE = ("--force 0", "--friction nan", "--density -1", "--stiffness 0", "--stiffness inf",
              "--stiffness 6e5")  # fmt: skip


@pytest.mark.parametrize(
    ("options", "words"),
    [
        *((option, [option.split()[0]]) for option in IMPOSSIBLE),
        ("--draws 1", ["2 draws or more"]),
        ("--cell-error 8 3 -10 3", ["has -10 for yaw"]),
        ("--weighed mug=0.3", ["no object of this scene", "mug=0.3"]),
        ("--weighed cube=heavy", ["NAME=KG", "cube=heavy"]),
        ("--weighed cube=0", ["NAME=KG", "cube=0"]),
    ],
)
def test_what_cannot_be_is_refused(pristine: Path, options: str, words: list[str]) -> None:
    message = refused(pristine, *QUICK, *options.split())
    assert all(w in message for w in words)
    assert not (pristine / "grasps").exists()


def test_masses_are_told_by_name_or_number_and_once() -> None:
    models = {part(n).obj_id: part(n) for n in NAMES}
    assert masses_of(["cube=0.3", "8=1e-1"], models) == {2: 0.3, 8: 0.1}
    refusals.refused("twice", masses_of, ["cube=0.3", "2=0.4"], models)


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
    monkeypatch.setitem(sys.modules, "mujoco", None)
    asks = (pristine, "--engine", "mujoco"), (pristine, "--cross-check")
    for words in (*asks, ("validate", "--engine", "both")):
        assert "realsim[mujoco]" in refused(*words, "--quiet")


def test_a_mesh_without_volume_is_named_and_the_others_are_tried(session: Path) -> None:
    mesh = part("cube").mesh
    sheet = Mesh(vertices=mesh.vertices * [1, 1, 0], faces=mesh.faces)
    models = {2: ObjectModel(obj_id=2, name="cube", mesh=sheet), 8: part("wedge")}
    save_models(session / "models", models)
    assert "0 cube: not tried" in finished(session, *QUICK).stderr
    cube, wedge = load_grasps(session)
    assert not cube.good.any() and wedge.reachable.any()


def test_sources_that_are_none_are_refused(pristine: Path, tmp_path: Path) -> None:
    assert "no session.json" in refused(tmp_path, *QUICK)
    assert "does not exist" in refused(tmp_path / "nowhere", *QUICK)
    assert str(pristine) in refused(pristine.parent, *QUICK)
    assert "--out" in refused(pristine, *QUICK, "--out", tmp_path)
    assert "is a session" in refused(tmp_path, *QUICK, "--out", pristine)
    assert "scene" in refused(tmp_path, *QUICK, "--out", tmp_path / "o")
    assert "has no grasps" in refused("export", pristine, "--to", "hdf5", "--out", tmp_path / "o")
    assert "no results" in refused("summary", tmp_path)


SLAB = """<robot name="slab"><link name="base"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 {z}"/><geometry><box size="2 2 0.02"/></geometry></collision>
</link></robot>"""


@pytest.mark.slow
def test_a_support_that_objects_stand_in_moves_them_and_one_below_the_table_does_not(
    session: Path,
) -> None:
    for z, code in ((-0.3, 0), (0.01, 1)):  # far below the table; in the objects' lowest 2 cm
        slab = session.parent / "slab.urdf"
        slab.write_text(SLAB.format(z=z))
        result = run("settle", session, "--support", slab, "--quiet")
        assert result.exit_code == code, result.output
