"""GRASPA's trials of a real robot: its frame, its layout, and what is wrong with a folder."""

import re

import numpy as np
import pytest

from graspa_folders import T_BOARD_BOX, box_grasps, trials_xml, write_graspa
from real_data import DATA, needs
from realsim.formats.grasps.graspa import read_graspa
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from refusals import refused

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
