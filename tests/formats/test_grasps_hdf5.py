"""HDF5 files of grasps: what is written is read bit for bit, and nothing else is read at all.

Parquet tables of grasps: what is written stands there bit for bit, and anybody can query it.

GRASPA's trials of a real robot: its frame, its layout, and what is wrong with a folder.
"""

import json
import re
from dataclasses import replace

import h5py
import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspa_folders import T_BOARD_BOX, box_grasps, trials_xml, write_graspa
from real_data import DATA, needs
from realsim.formats.grasps.graspa import read_graspa
from realsim.formats.grasps.hdf5 import (
    COLUMNS,
    grasps_hdf5_bytes,
    read_grasps_hdf5,
    write_grasps_hdf5,
)
from realsim.formats.grasps.parquet import write_grasps_parquet
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.geometry import se3
from realsim.records import STAGES
from realsim.records.grasps import MEASURES
from realsim.robots.hand import find_hand
from refusals import refused
from tried_grasps import assert_same, tried_scene, tried_set

SET = "sets/000004_obj000009"


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
def test_grasps_written_and_read_are_the_same_bit_for_bit(tmp_path_factory, seed, poses, attempts):
    scene = tried_scene(seed, with_poses=poses, with_attempts=attempts)
    path = write_grasps_hdf5(tmp_path_factory.mktemp("h5") / "deep" / "grasps.h5", scene)
    assert_same(scene, read_grasps_hdf5(path))
    assert path.read_bytes() == grasps_hdf5_bytes(scene)  # the same grasps, the same bytes


def test_a_stranger_finds_units_meanings_and_poses(tmp_path):
    scene = tried_scene(3)
    with h5py.File(write_grasps_hdf5(tmp_path / "g.h5", scene)) as file:
        group, s = file[SET], scene.sets[-2]
        assert s.instance == 4 and group.attrs["name"] == "mug"
        names: list[str] = []
        file.visit(names.append)
        for values in (file[n] for n in names if isinstance(file[n], h5py.Dataset)):
            assert {"unit", "meaning"} <= set(values.attrs), values.name
        for name, values in group["measures"].items():
            assert values.attrs["unit"] == MEASURES[name].unit
        T_world_obj = group["T_world_obj"][()]
        np.testing.assert_array_equal(group["T_world_grasp"][()], T_world_obj @ s.Ts_obj_grasp)
        table = file["T_world_table"][()] @ group["T_table_grasp"][()]
        np.testing.assert_allclose(table, group["T_world_grasp"][()], atol=1e-12)
        assert tuple(group["failure"].asstr()[()]) == s.failures
        assert json.loads(group["parameters"].asstr()[()]) == s.parameters
        attempts, found = scene.trajectories[4], group["trajectories"]
        a, b = found["starts"][1:3]
        np.testing.assert_array_equal(found["joints_rad"][a:b], attempts.joints_rad[a:b])


SIX = tried_set(np.random.default_rng(0), 6)


def fourth(values, value):
    """Return a column of the six with another value in its fourth row."""
    values = np.array(values)
    values[3] = value
    return values


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"widths_m": fourth(SIX.widths_m, -0.01)}, "a width"),
        ({"scores": fourth(SIX.scores, 1.5)}, "a score"),
        ({"base_scores": fourth(SIX.base_scores, 0.3)}, "a base score"),
        ({"slip_m": fourth(SIX.slip_m, -1e-9)}, "slip_m"),
        ({"failures": ("nul\0", *[""] * 5)}, "no plain text"),
        ({"parameters": {"x": float("nan")}}, "not plain JSON"),
    ],
)
def test_what_no_grasp_has_or_no_file_can_give_back_is_not_written(changed, words):
    refused(words, SceneGrasps, sets=(replace(SIX, **changed),))


# --- hostile files ----------------------------------------------------------------------------


def test_sets_and_attempts_that_do_not_fit_together_are_refused():
    scene = tried_scene(0)
    s, t = scene.sets[0], scene.trajectories[4]
    refused("more than one grasp set", SceneGrasps, sets=(s, s))
    refused("instance 99", SceneGrasps, sets=(s,), Ts_world_obj={99: np.eye(4)})
    for changed, says in (
        ({"rows": t.rows + 1000}, "increasing rows"),
        ({"time_s": -t.time_s}, "back in time"),
    ):
        refused(says, SceneGrasps, sets=scene.sets, trajectories={4: replace(t, **changed)})


def with_dataset(name, **how):
    def change(file):
        del file[f"{SET}/{name}"]
        file[SET].create_dataset(name, **how)

    return change


def external_link(file):
    del file[f"{SET}/score"]
    file[f"{SET}/score"] = h5py.ExternalLink("/etc/passwd", "/x")


def virtual(file):
    n = len(file[f"{SET}/score"])
    del file[f"{SET}/score"]
    layout = h5py.VirtualLayout(shape=(n,), dtype="f8")
    layout[:] = h5py.VirtualSource("other.h5", "x", shape=(n,))
    file[SET].create_virtual_dataset("score", layout)


def external_storage(file):
    n = len(file[f"{SET}/score"])
    raw = [("raw.bin", 0, 8 * n)]
    with_dataset("score", shape=(n,), dtype="f8", external=raw)(file)


def with_value(name, at, value):
    def change(file):
        file[f"{SET}/{name}"][at] = value

    return change


def with_attribute(where, name, value):
    return lambda file: file[where].attrs.__setitem__(name, value)


def scaled(file):
    Ts = file[f"{SET}/T_obj_grasp"]
    Ts[0, :3, :3] = 2 * Ts[0, :3, :3]


def unknown_measure(file):
    file[f"{SET}/measures"]["goodness"] = np.zeros(len(file[f"{SET}/score"]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (external_link, "points elsewhere"),
        (virtual, "in another file"),
        (external_storage, "in another file"),
        (with_dataset("score", data=np.zeros(1)), "the shape"),
        (with_dataset("T_obj_grasp", shape=(2**40, 4, 4), dtype="f8", chunks=(1, 4, 4)), "GB"),
        (with_dataset("T_obj_grasp", data=np.zeros((3, 4, 4)), compression="lzf"), "filter"),
        (scaled, "not rigid"),
        (with_value("T_obj_grasp", (1, 0, 3), np.nan), "NaN"),
        (unknown_measure, "no measure"),
        (with_attribute("/", "format_version", 99), "version is 99"),
        (with_value("trajectories/starts", -1, 10**9), "samples"),
    ],
)
def test_a_file_that_is_not_ours_alone_is_refused(tmp_path, change, words):
    path = write_grasps_hdf5(tmp_path / "g.h5", tried_scene(1))
    with h5py.File(path, "r+") as file:
        change(file)
    refused(words, read_grasps_hdf5, path)


def test_a_missing_file_and_one_of_another_kind_are_named(tmp_path):
    refused("does not exist", read_grasps_hdf5, tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("no HDF5")
    refused("no HDF5 file", read_grasps_hdf5, tmp_path / "text.h5")


def test_an_export_that_fails_leaves_the_earlier_file(tmp_path, monkeypatch):
    path = write_grasps_hdf5(tmp_path / "g.h5", tried_scene(1))
    before = path.read_bytes()
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    refused("full", write_grasps_hdf5, path, tried_scene(2), error=OSError)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["g.h5"]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
def test_every_number_stands_in_the_table_bit_for_bit(tmp_path_factory, seed, poses, attempts):
    scene = tried_scene(seed, with_poses=poses, with_attempts=attempts)
    folder = tmp_path_factory.mktemp("pq")
    path = write_grasps_parquet(folder, scene)
    first, table = path.read_bytes(), pq.read_table(path)
    head = json.loads(table.schema.metadata[b"realsim"])
    assert [e["instance"] for e in head["sets"]] == [s.instance for s in scene.sets]
    for s, entry in zip(scene.sets, head["sets"], strict=True):
        mine = table.filter(pc.equal(table["instance"], s.instance))
        assert entry["parameters"] == s.parameters and mine.num_rows == len(s) == entry["grasps"]
        assert mine["failure"].to_pylist() == list(s.failures)
        assert mine["reachable"].to_pylist() == s.reachable.tolist()
        Ts = np.array(mine["T_obj_grasp"].to_pylist()).reshape(-1, 4, 4)
        assert np.array_equal(Ts, s.Ts_obj_grasp)
        named = {name: getattr(s, field) for name, (field, _, _) in COLUMNS.items()} | s.measures
        for name, values in named.items():
            stages = [f"{name}_{stage}" for stage in STAGES] if values.ndim == 2 else [name]
            for column, known in zip(stages, np.atleast_2d(values.T), strict=True):
                assert mine[column].null_count == 0
                assert np.array_equal(mine[column].to_numpy(), known, equal_nan=True)
    for instance, known in scene.trajectories.items():
        every = pq.read_table(folder / "trajectories.parquet")
        mine = every.filter(pc.equal(every["instance"], instance))
        assert mine["grasp"].to_pylist() == known.rows.tolist()
        for name in ("time_s", "opening_m", "phase"):
            flat = pc.list_flatten(mine[name]).to_numpy()
            assert np.array_equal(flat, getattr(known, name))
        angles = pc.list_flatten(pc.list_flatten(mine["joints_rad"])).to_numpy()
        assert np.array_equal(angles, known.joints_rad.ravel())
    assert write_grasps_parquet(folder, scene).read_bytes() == first


def test_a_stranger_can_ask_the_table(tmp_path):
    scene = tried_scene(4)
    table = pq.read_table(write_grasps_parquet(tmp_path, scene))
    assert table.num_rows == sum(len(s) for s in scene.sets)
    good = table.filter(pc.greater_equal(table["score"], 0.5))
    assert good.num_rows == sum(int(s.good.sum()) for s in scene.sets)
    field = table.schema.field("slip_m_lift")
    assert field.metadata[b"unit"] == b"m" and b"lost" in field.metadata[b"meaning"]
    # A measure that was not taken is null; NaN stays a number.
    with_margin = [s for s in scene.sets if "margin" in s.measures]
    assert table["margin"].null_count == table.num_rows - sum(len(s) for s in with_margin)
    assert np.isnan(table["margin"].drop_null().to_numpy()).any()
    s = next(s for s in scene.sets if s.instance == 4)
    mine = table.filter(pc.equal(table["instance"], 4))
    poses = np.array(mine["T_world_grasp"].to_pylist()).reshape(-1, 4, 4)
    np.testing.assert_array_equal(poses, scene.Ts_world_obj[4] @ s.Ts_obj_grasp)
    attempts = pq.read_table(tmp_path / "trajectories.parquet")
    row = attempts.filter(pc.equal(attempts["instance"], 4)).slice(1, 1).to_pylist()[0]
    part = scene.trajectories[4].attempt(row["grasp"])
    np.testing.assert_array_equal(row["joints_rad"], scene.trajectories[4].joints_rad[part])
    np.testing.assert_array_equal(row["time_s"], scene.trajectories[4].time_s[part])


def test_attempts_of_an_earlier_run_do_not_stay(tmp_path):
    write_grasps_parquet(tmp_path, tried_scene(1))
    write_grasps_parquet(tmp_path, tried_scene(1, with_attempts=False))
    assert [p.name for p in tmp_path.iterdir()] == ["grasps.parquet"]


OPEN = DATA / "school/graspa_open"


@pytest.fixture
def folder(tmp_path):
    Ts, held = box_grasps()
    write_graspa(tmp_path, "gelatin_box", Ts, held)
    return tmp_path


def trials_of(folder):
    return next(folder.glob("results/*/grasps_data/*/*_grasp.xml"))


def test_what_was_written_is_read(folder):
    Ts, held = box_grasps()
    (box,) = read_graspa(folder)
    assert (box.name, box.layout, box.mass_kg) == ("gelatin_box", "layout_0", 0.097)
    np.testing.assert_allclose(box.T_board_obj, T_BOARD_BOX, atol=1e-12)
    np.testing.assert_allclose(box.Ts_obj_grasp, Ts, atol=1e-12)
    np.testing.assert_array_equal(box.held, held)
    np.testing.assert_allclose(box.mesh.extent, [0.04, 0.04, 0.06], atol=1e-7)
    assert set(box.planners) == {"panda-test"} and box.trials[7] == "Grasp 7"
    assert read_graspa(folder, {"gelatin_box": 0.2})[0].mass_kg == 0.2
    no_trial = "'gelatine', which no trial is of; there are gelatin_box"
    refused(no_trial, read_graspa, folder, {"gelatine": 0.2})
    refused("mass of gelatin_box", read_graspa, folder, {"gelatin_box": -0.2})


def test_numbers_may_end_in_an_equals_sign_and_rotations_be_rounded(folder):
    T = T_BOARD_BOX @ se3.from_rt(se3.exp_so3([0.3, 0.2, 0.1]), [0.0, 0.01, 0.02])
    rounded = np.round(T, 3)
    trials_of(folder).write_text(trials_xml([rounded], ["1="], ending="="))
    (box,) = read_graspa(folder)
    R = box.Ts_board_grasp[0, :3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(box.Ts_board_grasp[0], T, atol=1e-3)


def in_metres(file):
    position = re.compile(r'c4="([^"]+)"/><row')
    mm = file.read_text()
    file.write_text(position.sub(lambda m: f'c4="{float(m[1]) / 1e3}"/><row', mm))


def test_boards_and_hands_in_metres_are_refused(folder):
    in_metres(folder / "layouts/layout_0.xml")
    refused(r"YcbGelatinBox.*layout_0 are up to 0.* away.*millimetres", read_graspa, folder)
    in_metres(trials_of(folder))
    refused(r"within 2 mm of the board's origin.*in metres", read_graspa, folder)


def test_a_planner_without_a_grasp_is_no_trial(folder):
    Ts, held = box_grasps()
    file = write_graspa(folder, "tennis_ball", Ts, held)
    file.write_text(trials_xml([], []))
    assert [obj.name for obj in read_graspa(folder)] == ["gelatin_box"]
    file.unlink()
    trials_of(folder).unlink()
    refused("no trials", read_graspa, folder)


ENTITIES = '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><grasp_data>&x;</grasp_data>'
SKEWED = se3.from_rt(np.array([[1.0, 0.2, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])
GOOD, TWO = trials_xml([np.eye(4)], [1]), trials_xml([np.eye(4)] * 2, [1, 1])
FILES = {
    "results without poses": (trials_xml([], [1, 0]), "2 results and no poses"),
    "poses without results": (trials_xml([np.eye(4)], []), "'Grasp 0' has no result"),
    "a result too many": (trials_xml([np.eye(4)], [1, 1]), "'Grasp 1' has a result and no pose"),
    "a pose without matrix": (GOOD.replace("Matrix4x4", "Matrix"), "Transform/Matrix4x4"),
    "half a result": (trials_xml([np.eye(4)], [0.5]), "'Grasp 0' is 0.5; 0 or 1"),
    "a word for a number": (GOOD.replace('c2="0.0"', 'c2="far"', 1), "row 1, column 2 is 'far'"),
    "not a number": (GOOD.replace('c4="0.0"', 'c4="nan"', 1), "row 1, column 4 is nan"),
    "a row too few": (re.sub("<row3 .*?/>", "", GOOD), "row 3, column 1 is None"),
    "sheared": (trials_xml([SKEWED], [1]), "off by 0.2.. from a rotation"),
    "mirrored": (trials_xml([MIRRORED], [1]), "mirrored"),
    "one name twice": (TWO.replace("Grasp 1", "Grasp 0"), "'Grasp 0' twice"),
    "entities": (ENTITIES, "doctype"),
    "cut off": (GOOD[:-20], "not XML"),
}


@pytest.mark.parametrize(("text", "told"), FILES.values(), ids=FILES)
def test_a_bad_file_of_trials_is_named_with_what_is_wrong(folder, text, told):
    file = trials_of(folder)
    file.write_text(text)
    assert str(file) in refused(told, read_graspa, folder)


@pytest.mark.parametrize("need", ["layouts", "results", "objects"])
def test_a_missing_folder_is_named(folder, need):
    (folder / need).rename(folder / "elsewhere")
    refused(f"no folder '{need}'", read_graspa, folder)


def test_a_bad_board_or_mesh_is_named(folder):
    board, mesh = folder / "layouts/layout_0.xml", folder / "objects/gelatin_box/nontextured.stl"
    good = board.read_text()
    mesh.rename(folder / "nontextured.stl")
    refused(r"gelatin_box.nontextured\.stl is missing", read_graspa, folder)
    for file in ("../nontextured.xml", "a/../../nontextured.xml", "/nontextured.xml", "a b/c.xml"):
        board.write_text(good.replace("data/objects/YCB/gelatin_box/nontextured.xml", file))
        refused(re.escape(repr(file)), read_graspa, folder)
    for text, told in (
        (good.replace("YcbGelatinBox", "YcbPear"), "'YcbGelatinBox' is not on its board.*YcbPear"),
        (good.replace("File>", "Place>"), "no name or no File"),
        (re.sub("<GlobalPose>.*?</GlobalPose>", "", good), "'YcbGelatinBox' has no pose"),
        ("<Scene/>", "no ManipulationObject"),
    ):
        board.write_text(text)
        refused(told, read_graspa, folder)
    board.unlink()
    refused(r"layout_0\.xml", read_graspa, folder)


# --- the real trials ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real():
    return read_graspa(OPEN)


@pytest.mark.real
@needs(OPEN)
def test_the_open_trials_are_330_of_eight_objects_and_64_percent_held(real):
    held = np.concatenate([obj.held for obj in real])
    assert len(held) == 330 and held.mean() == pytest.approx(0.642, abs=5e-4)
    assert len({obj.name for obj in real}) == 8 and all(obj.mass_kg for obj in real)


@pytest.mark.real
@needs(OPEN)
@pytest.mark.slow
def test_the_fingers_close_along_y(real):
    """Between pads that close along y lies the object; along x it lies in fewer hands."""
    from realsim_sim_bridge.grasping.antipodal import RaySurface
    from realsim_sim_bridge.grasping.limit_analysis import pad_patches

    surfaces = {id(obj.mesh): RaySurface(obj.mesh) for obj in real}
    hand, along_x = find_hand(), se3.from_rt(se3.exp_so3([0.0, 0.0, np.pi / 2]), np.zeros(3))

    def share(offset):
        both = []
        for obj in real:
            open_m = np.full(len(obj.held), hand.max_opening_m)
            Ts = obj.Ts_obj_grasp @ offset
            both.append(pad_patches(surfaces[id(obj.mesh)], Ts, open_m, hand, 0.002).both)
        return np.concatenate(both).mean()

    y, x = share(np.eye(4)), share(along_x)
    assert y >= 0.9 and x < 0.85, (y, x)
    for dz in (-0.02, 0.02):  # nor is the hand's point deeper or less deep
        assert share(se3.from_translation([0.0, 0.0, dz])) < y
