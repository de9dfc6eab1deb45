"""Arms as data: what is read agrees with other software's reading, and what is wrong is named.

Hands as data: their law is the linkage's own, their boxes hold, and what is wrong is named.
"""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.errors import InputError, RealsimError
from realsim.geometry import se3
from realsim.robots.arm import ArmFile, find_arm, known_chains
from realsim.robots.check_arm import check_arm
from realsim.robots.check_hand import check_hand, pad_frames, path_error
from realsim.robots.compiled_chain import chain_numbers, follow_lines, frames_into, jacobian_into
from realsim.robots.hand import find_hand, hand_of_json
from realsim.robots.kinematics import dh_of_chain
from realsim.robots.robot_files import VARIABLE, names_of, robot_file
from refusals import refused
from robotiq_linkages import LOOPS, arc_error_mm, turned

ARMS = tuple(names_of("arm"))


def forward(steps: np.ndarray, q: np.ndarray) -> np.ndarray:
    T = steps[0]
    for angle, step in zip(q, steps[1:], strict=True):
        T = T @ se3.from_rt(se3.exp_so3([0.0, 0.0, angle]), np.zeros(3)) @ step
    return T


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 8), st.integers(0, 2**32 - 1))
def test_every_chain_of_turning_joints_has_dh_numbers(joints: int, seed: int) -> None:
    """Axes at any angle, parallel, intersecting or the same: the flange stays where it was."""
    rng = np.random.default_rng(seed)
    turns = rng.choice([0.0, np.pi / 2, -np.pi / 2, np.pi, 0.7], (joints + 1, 3))
    steps = se3.from_rt(se3.exp_so3(turns), rng.choice([0.0, 0.0, 0.1, -0.3], (joints + 1, 3)))
    arm = dh_of_chain("any", steps)
    for q in rng.uniform(-3, 3, (3, joints)):
        np.testing.assert_allclose(arm.forward(q), forward(steps, q), atol=1e-8)


@pytest.mark.parametrize("name", ARMS)
def test_every_arm_that_ships_is_right(name: str) -> None:
    """Frames as pinocchio reads them, free at home, poses reached: nothing is wrong."""
    _, findings = check_arm(name)
    assert not [f for f in findings if not f.is_right]


@pytest.mark.parametrize("name", ["ur5", "panda", "xarm6"])
def test_the_compiled_chain_says_what_the_other_says(name: str) -> None:
    arm = find_arm(name)
    n = arm.joints
    T_tool = se3.from_rt(se3.exp_so3([0.2, -0.4, 0.9]), [0.01, 0.02, 0.1])
    numbers = chain_numbers(arm.chain, T_tool)
    T_a_base = se3.from_rt(se3.exp_so3([0.3, 0.1, -2.0]), [1.0, 2.0, 3.0])
    q = arm.home + 0.3
    frames, J = np.empty((n + 2, 3, 4)), np.empty((6, n))
    frames_into(numbers, q, T_a_base, frames)
    links = T_a_base @ arm.chain.link_frames(q)
    np.testing.assert_allclose(frames[1:n], links[1:n, :3], atol=1e-12)
    np.testing.assert_allclose(frames[n + 1], (links[n] @ T_tool)[:3], atol=1e-12)
    jacobian_into(frames, J)
    for i in range(n):
        ends = [T_a_base @ arm.chain.forward(q + s * 1e-6 * np.eye(n)[i]) @ T_tool for s in (-1, 1)]
        np.testing.assert_allclose(J[3:, i], (ends[1] - ends[0])[:3, 3] / 2e-6, atol=1e-8)
    # Followed lines end where they should, for whatever number of joints.
    T = arm.chain.forward(arm.home) @ T_tool
    up, far = np.array([[0.0, 0.0, 1.0]]), np.linspace(0, 0.05, 4)
    path, _, worst = follow_lines(numbers, arm.home[None], T[None], up, far)
    assert worst[0] < 1e-9
    rise = (arm.chain.forward(path[0]) @ T_tool)[:, 2, 3] - T[2, 3]
    np.testing.assert_allclose(rise, far, atol=1e-9)


# --- an arm of one's own, and its mistakes --------------------------------------------------------

SIX = """<robot name="six"><link name="base"><collision><geometry>
<cylinder radius="0.05" length="0.1"/></geometry></collision></link>
{links}
{joints}
</robot>"""
BALL = '<sphere radius="0.03"/>'
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
PLACES = ("0 0 0.2", "0 0 0.1", "0 0 0.35", "0.1 0 0", "0.25 0 0", "0.08 0 0")
TOML = """kind = "arm"
name = "six"
payload_kg = 2.0
home_rad = [0.0, 0.3, 0.6, 0.0, 0.7, 0.0]
[urdf]
file = "six.urdf"
base = "base"
flange = "flange"
[limits]
acceleration_rad_s2 = [5.0, 5.0, 5.0, 5.0, 5.0, 5.0]
"""


def six_joints(folder: Path) -> Path:
    """Write an arm of six joints that is in no package."""
    parents = ("base", *(f"l{i + 1}" for i in range(5)))
    joints = "".join(
        f'<joint name="j{i + 1}" type="revolute"><parent link="{parents[i]}"/>'
        f'<child link="l{i + 1}"/><origin xyz="{PLACES[i]}"/><axis xyz="{AXES[i]}"/>'
        f'<limit lower="-2.9" upper="2.9" velocity="2" effort="50"/></joint>'
        for i in range(6)
    )
    joints += (
        '<joint name="face" type="fixed"><parent link="l6"/><child link="flange"/>'
        '<origin xyz="0.05 0 0" rpy="0 1.5707963 0"/></joint>'
    )
    links = "".join(
        f'<link name="l{i + 1}"><collision><geometry><sphere radius="0.03"/></geometry>'
        "</collision></link>"
        for i in range(6)
    )
    folder.mkdir(parents=True)
    links += '<link name="flange"/>'
    (folder / "six.urdf").write_text(SIX.format(links=links, joints=joints))
    (folder / "robot.toml").write_text(TOML)
    return folder


def test_an_arm_of_ones_own_needs_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = six_joints(tmp_path / "robots" / "one_of_six")
    arm, findings = check_arm(str(folder))
    assert not [f for f in findings if not f.is_right]
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (20, 6))
    found, of = arm.chain.inverse_branches(arm.chain.forward(q))
    assert set(of) == set(range(20))
    np.testing.assert_allclose(arm.chain.forward(found), arm.chain.forward(q)[of], atol=1e-8)
    # Found by name once its shelf is known, whatever the capitals, beside one that is broken.
    (six_joints(folder.parent / "broken") / "six.urdf").write_text("<robot")
    broken = (folder.parent / "broken" / "robot.toml").read_text()
    (folder.parent / "broken" / "robot.toml").write_text(broken.replace('"six"', '"other"'))
    monkeypatch.setenv(VARIABLE, str(folder.parent))
    assert "one_of_six" in names_of("arm")
    assert find_arm("One-of-Six").name == "six"
    assert "UR5" in known_chains() and "other" not in known_chains()
    # Plans and sessions keep the name that stands in the file: it is found by that, too.
    monkeypatch.setattr("realsim.robots.arm._found", {})
    assert find_arm("six").folder.name == "one_of_six"
    six_joints(folder.parent / "two")
    refused("more than one arm is called 'six'", robot_file, "six", ArmFile)


def test_an_mjcf_is_read_as_the_urdf_of_the_same_arm(tmp_path: Path) -> None:
    """Reference angles, a site as the flange, a mesh and a capsule; a slide is refused."""
    of_urdf = find_arm(str(six_joints(tmp_path / "urdf")))
    text = '<site name="face" pos="0.05 0 0" euler="0 90 0"/>'
    for i in reversed(range(6)):
        turned, ref = (' euler="0 20 0"', ' ref="20"') if i == 2 else ("", "")
        text = (
            f'<body name="l{i + 1}" pos="{PLACES[i]}"{turned}>'
            f'<joint name="j{i + 1}" type="hinge" axis="{AXES[i]}" range="-166 166"{ref}/>'
            f'<geom type="capsule" size="0.03 0.02"/>{text}</body>'
        )
    folder = tmp_path / "mjcf"
    folder.mkdir()
    base = '<body name="base"><geom type="box" size=".05 .05 .05"/>'
    xml = f"<mujoco><worldbody>{base}{text}</body></worldbody></mujoco>"
    (folder / "six.xml").write_text(xml)
    toml = TOML.replace("[urdf]", "[mjcf]").replace("six.urdf", "six.xml")
    toml = toml.replace('"flange"', '"face"') + f"speed_rad_s = {[2.0] * 6}\n"
    (folder / "robot.toml").write_text(toml)
    of_mjcf = find_arm(str(folder))
    q = np.random.default_rng(0).uniform(-2, 2, (20, 6))
    np.testing.assert_allclose(of_mjcf.chain.forward(q), of_urdf.chain.forward(q), atol=1e-6)
    assert [s.kind for s in of_mjcf.shapes] == ["box", *["capsule"] * 6]
    (folder / "six.xml").write_text(xml.replace('"hinge"', '"slide"', 1))
    refused("is no hinge", find_arm, str(folder))


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("six.urdf", 'link name="flange"', 'link name="flansch"', "which is no link of this file"),
        ("six.urdf", 'upper="2.9"', 'upper="166"', r"Are these degrees\?"),
        ("six.urdf", 'upper="2.9"', 'upper="-3"', r"joint 'j\d' of .*lower must be below upper"),
        ("six.urdf", 'type="revolute"', 'type="prismatic"', "are revolute, continuous or fixed"),
        ("six.urdf", BALL, '<mesh filename="gone.stl"/>', "gone.stl.*not there"),
        ("six.urdf", "<axis", '<mimic joint="j9"/><axis', "mimics 'j9', which is no joint"),
        ("six.urdf", '<axis xyz="1', '<mimic joint="j1"/><axis xyz="1', "follows another joint"),
        ("six.urdf", '<child link="l6"/>', '<child link="l5"/>', "hangs on two joints"),
        ("robot.toml", "payload_kg = 2.0", "payload_kg = nan", "kilograms above 0"),
        ("robot.toml", '"six"', '"../six"', "name is '../six'"),
        ("robot.toml", "home_rad = [0.0, ", "home_rad = [0.0, 0.0, ", "6 angles within the limits"),
        ("robot.toml", "payload_kg", "payload_lb", "payload_lb"),
        ("robot.toml", '"flange"', '"tool0"', "no link 'tool0'"),
        ("robot.toml", 'kind = "arm"', 'kind = "hand"', "is a 'hand'"),
        ("robot.toml", "[limits]", "[limits]\nlower_rad = [-170, -170, -170, -170, -170, -170]",
         r"Are these degrees\?"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_an_arm_is_named(
    tmp_path: Path, file: str, old: str, new: str, said: str
) -> None:
    folder = six_joints(tmp_path / f"a{abs(hash((old, new)))}")
    (folder / file).write_text((folder / file).read_text().replace(old, new, 1))
    with pytest.raises(RealsimError, match=said):
        find_arm(str(folder)).shapes  # noqa: B018 - meshes are read here


def test_a_description_that_can_be_read_and_is_wrong_is_told(tmp_path: Path) -> None:
    folder = six_joints(tmp_path / "wrong")
    text = (folder / "six.urdf").read_text().replace('velocity="2"', 'velocity="120"')
    (folder / "six.urdf").write_text(text.replace(BALL, '<sphere radius="0.4"/>'))
    wrong = {f.what for f in check_arm(str(folder))[1] if not f.is_right}
    assert {"joint speeds", "self-collision at home"} <= wrong


def test_a_folder_that_is_no_robot_is_told(tmp_path: Path) -> None:
    refused(r"has no robot\.toml", find_arm, str(tmp_path) + "/")
    refused("called None", find_arm, None)
    refused(r"no arm 'ur55'\. There are: .*ur5,", find_arm, "ur55")


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
        ("robot.toml", "radius_m = 0.05715", "radius_m = 57.15", "write 0.05715 if 57"),
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
