"""Hands as data: their law is the linkage's own, their boxes hold, and what is wrong is named."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from realsim.errors import InputError
from realsim.robots.check_hand import check_hand, pad_frames, path_error
from realsim.robots.hand import find_hand, hand_of_json
from realsim.robots.robot_files import names_of
from robotiq_linkages import LOOPS, arc_error_mm, turned

HANDS = {name: find_hand(name) for name in names_of("hand")}


@pytest.mark.parametrize("name", sorted(LOOPS))
def test_the_arc_is_the_linkage_s_own(name):
    assert arc_error_mm(name) < 0.05


@pytest.fixture
def own_2f85(tmp_path):
    """A folder of the 2F-85 with airo-models' URDF, which has a prefix that XML does not allow."""
    text = Path(pytest.importorskip("airo_models").get_urdf_path("robotiq_2f_85")).read_text()
    text = "\n".join(line for line in text.splitlines() if "drake:" not in line)
    (tmp_path / "hand.urdf").write_text(text)
    told = (names_of("hand")["robotiq_2f85"] / "robot.toml").read_text()
    links = 'urdf = "hand.urdf"\nurdf_pads = ["right_inner_finger_pad", "left_inner_finger_pad"]\n'
    links += "urdf_pad_face_m = [0.0, -0.0034797, 0.0]\n"  # 25.5 mm inside the crank's end
    (tmp_path / "robot.toml").write_text(told.replace("[arc]", links + "[arc]"))
    return tmp_path


def test_the_arc_is_the_urdf_s_through_its_mimic_joints(own_2f85):
    hand, findings = check_hand(str(own_2f85))
    assert all(f.is_right for f in findings), findings
    Ts = pad_frames(own_2f85 / "hand.urdf", ("right_inner_finger_pad", "left_inner_finger_pad"))
    faces = Ts[..., :3, 3] - 0.0034797 * Ts[..., :3, 1]
    assert path_error(hand, faces)[1] < 0.2e-3
    assert path_error(replace(hand, arc_radius_m=0.08), faces)[1] > 1e-3


@pytest.mark.parametrize(
    ("file", "old", "new", "told"),
    [
        ("hand.urdf", 'mimic joint="finger_joint"', 'mimic joint="thumb"', "mimics 'thumb'"),
        ("hand.urdf", 'multiplier="-1"', 'multiplier="-0.9"', "pads turn by"),
        ("robot.toml", "max_opening_m = 0.085", "max_opening_m = 85.0", "write 0.085 if"),
        ("robot.toml", "max_opening_m = 0.085", "max_opening_m = 8.5", "0.085 if 8.5 is in cent"),
        ("robot.toml", "radius_m = 0.05715", "radius_m = 0.070", "mm of the law"),
        ("robot.toml", "usual_n = 70.0", "usual_n = 7.0", "least of 20 N"),
        ("robot.toml", "distance_m = 0.155046", "distance_m = 0.1", "into the arm"),
        ("robot.toml", "distance_m = 0.155046", "distance_m = 155.046", "no hand in metres"),
        ("robot.toml", "mass_kg = 0.925", "mass_kg = 0.15", "of it 0.1 kg"),
        ("robot.toml", "length_m = 0.0375\nfriction", "length_m = 0.05\nfriction", "beyond"),
        ("robot.toml", "max_opening_m", "max_opening", "max_opening"),
        ("robot.toml", "friction = 0.7", "normal_stiffness_n_per_m = 0", "0 N/m; 1000 to 500000"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(own_2f85, file, old, new, told):
    text = (own_2f85 / file).read_text()
    assert old in text
    (own_2f85 / file).write_text(text.replace(old, new))
    try:
        said = [f"{f.what}: {f.found}" for f in check_hand(str(own_2f85))[1] if not f.is_right]
    except InputError as error:
        said = [str(error)]
    assert any(told in line for line in said), said


def test_pads_that_never_meet_are_named_with_the_gap(tmp_path):
    four = "max_opening_m = 0.06\nfinger_length_m = 0.04\nfinger_width_m = 0.02\n"
    text = f'kind = "hand"\nname = "mine"\n{four}finger_thickness_m = 0.01\n'
    (tmp_path / "robot.toml").write_text(text)
    hand, findings = check_hand(str(tmp_path))
    assert all(f.is_right for f in findings) and hand.name == tmp_path.name
    finger = "[[finger]]\nlow_m = [-0.01, -0.004, -0.03]\nhigh_m = [0.01, 0.01, 0.01]\n"
    (tmp_path / "robot.toml").write_text(text + finger)
    wrong = [f for f in check_hand(str(tmp_path))[1] if not f.is_right]
    assert [f.what for f in wrong] == ["pads meet"] and "8.0 mm inside" in wrong[0].found


@pytest.mark.parametrize("name", sorted(HANDS))
def test_every_hand_that_ships_is_right_and_goes_through_json(name):
    hand, findings = check_hand(name)
    assert all(f.is_right for f in findings), findings
    assert hand_of_json(json.loads(json.dumps(asdict(hand))), "a file") == hand == find_hand(name)
    older = asdict(hand)  # of each of six points
    older["stiffness_n_per_m"] = older.pop("pad_stiffness_n_per_m") / 6
    found = hand_of_json(older, "a file").pad_stiffness_n_per_m
    assert np.isclose(found, hand.pad_stiffness_n_per_m)
    T = hand.T_ee_grasp
    assert np.allclose(T[:3, 3], [0, 0, -hand.mount_z_m]) and np.isclose(np.linalg.det(T), 1)


@given(st.sampled_from(sorted(HANDS)), st.integers(0, 2**32 - 1))
def test_what_is_swept_holds_every_opening_on_the_way(name, seed):
    hand, rng = HANDS[name], np.random.default_rng(seed)
    near, far = np.sort(rng.uniform(0.0, hand.max_opening_m, (2, 50)), axis=0)
    between = near + (far - near) * rng.uniform(size=50)
    swept, one = hand.swept_boxes(near, far), hand.boxes(between)
    assert np.all(swept[:, :, 0] <= one[:, :, 0] + 1e-12)
    assert np.all(swept[:, :, 1] >= one[:, :, 1] - 1e-12)
    y, h = between / 2, 1e-6
    slope = (hand.z_pad(2 * (y + h)) - hand.z_pad(2 * (y - h))) / (2 * h)
    inside = (y > h) & (y < hand.max_opening_m / 2 - h)
    np.testing.assert_allclose(hand.slope(y)[inside], slope[inside], atol=1e-6)


def test_bars_of_a_linkage_are_inside_their_boxes():
    """Points of the 2F-85's knuckles, turned with the crank, stay in the boxes at every opening."""
    hand = find_hand("robotiq_2f85")
    w = np.linspace(0.0, hand.max_opening_m, 40)
    z = hand.z_pad(w) + np.sqrt(hand.arc_radius_m**2 - hand.arc_axis_y_m**2)
    crank = np.arctan2(z, w / 2 - hand.arc_axis_y_m)
    boxes = hand.bar_boxes(w)[:, len(hand.bars) :]
    for k, bar in enumerate(hand.bars):
        pivot = np.array(bar[:2])
        for share in (0.0, 0.4, 1.0):
            at = (1 - share) * np.array(bar[2:4]) + share * np.array(bar[4:6]) - pivot
            points = np.array([pivot + turned(at, a - crank[0]) for a in crank])
            assert np.all(points >= boxes[:, k, 0, 1:] + bar[7] - 1e-12)
            assert np.all(points <= boxes[:, k, 1, 1:] - bar[7] + 1e-12)
