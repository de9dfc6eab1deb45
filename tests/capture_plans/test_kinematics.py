"""Laws of the arm: forward and inverse undo each other, the Jacobian is the derivative."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from given_plans import calibrated
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.robots.arm import UR5, UR5E, find_arm
from realsim.robots.controller_file import (
    LINKS,
    LISTS,
    PLACES,
    dh_of_links,
    flange_gap_m,
    read_controller_calibration,
    ur_arms,
)
from realsim.robots.kinematics import DhChain
from realsim.robots.robot_files import names_of
from refusals import refused

CHAINS = [UR5E, calibrated(UR5, 1)]
IDS = ["UR5e", "UR5 calibrated"]


def regular_joints(chain: DhChain, n: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (3 * n, 6))
    return q[chain.sigma_min(q) > 0.05][:n]


@pytest.mark.parametrize("chain", CHAINS, ids=IDS)
def test_inverse_finds_the_joints_that_made_the_pose(chain: DhChain) -> None:
    for q in regular_joints(chain, 20, seed=3):
        found = chain.inverse(chain.forward(q))
        assert chain.limits.contains(q)  # the draw stays within half a turn, which all limits allow
        assert np.abs(found - q).max(-1).min() < 1e-6
        assert np.all(chain.limits.contains(found))


def test_whole_turns_are_all_distinct_and_all_reach_the_pose() -> None:
    q = np.array([0.3, -1.2, 1.4, -0.8, 1.5, 0.2])
    found = UR5.inverse(UR5.forward(q))
    assert np.abs(UR5.forward(found) - UR5.forward(q)).max() < 1e-9
    assert len(np.unique(np.round(found, 6), axis=0)) == len(found)
    # Each joint but the elbow has exactly one other whole turn inside +-2 pi.
    assert len(found) % 32 == 0


@pytest.mark.parametrize("chain", CHAINS, ids=IDS)
def test_jacobian_is_the_derivative_of_forward(chain: DhChain) -> None:
    q = regular_joints(chain, 40, seed=5)
    J = chain.jacobian(q)
    h = 1e-6
    for i in range(6):
        step = np.eye(6)[i] * h
        twist = se3.log(se3.invert(chain.forward(q - step)) @ chain.forward(q + step)) / (2 * h)
        assert np.abs(J[..., i] - twist).max() < 1e-8


def test_known_poses_of_the_nominal_ur5() -> None:
    # At zero the arm lies along -x: x = a2 + a3, y = -(d4 + d6), z = d1 - d5.
    T = UR5.forward(np.zeros(6))
    assert T[:3, 3] == pytest.approx([-0.81725, -0.19145, -0.005491], abs=1e-12)
    # Turning the base turns the whole pose.
    turned = UR5.forward([0.7, 0, 0, 0, 0, 0])
    assert turned[:3, :3] == pytest.approx(se3.exp_so3([0, 0, 0.7]) @ T[:3, :3])
    # A UR5e is not a UR5.
    q = np.array([0.1, -1.5, 1.6, -1.6, -1.6, 0.0])
    assert 40 < 1e3 * np.linalg.norm(UR5E.forward(q)[:3, 3] - UR5.forward(q)[:3, 3]) < 100


def test_an_arm_without_a_closed_form_is_solved_all_the_same() -> None:
    general = replace(UR5, alpha=UR5.alpha + np.array([0.01, 0.02, -0.015, 0.02, 0.01, 0.0]))
    T = general.forward([0.1, -1.2, 1.3, -0.5, -1.4, 0.2])
    found = general.inverse(T)
    assert len(found)
    np.testing.assert_allclose(general.forward(found), np.tile(T, (len(found), 1, 1)), atol=1e-8)


def test_poses_of_every_arm_that_ships_are_reached_inside_its_limits() -> None:
    """What a dense search finds is found: poses of random joints, of six joints and of seven."""
    for name in names_of("arm"):
        chain = find_arm(name).chain
        limits = chain.limits
        low, high = np.maximum(limits.lower, -np.pi), np.minimum(limits.upper, np.pi)
        Ts = chain.forward(np.random.default_rng(8).uniform(low, high, (200, chain.joints)))
        q, of = chain.inverse_branches(Ts)
        assert len(np.unique(of)) >= 199, name
        assert np.all(limits.contains(q)), name
        np.testing.assert_allclose(chain.forward(q), Ts[of], atol=1e-8)


# --- Calibrations of real arms: read without loss, wrong robots named, the inverse still exact.
# The numbers are of real robots, as their owners posted them: a UR10-size arm's calibration.conf
# (forum.universal-robots.com/t/18921), a UR5's and a UR5e's kinematics as ROS's ur_calibration
# wrote them.

UR10 = DhChain.of(ur_arms()["UR10"], UR5.limits)
CONF = {
    "theta": [-8.20642406610186392e-05, -0.103609197138685979, 0.673631891251821102,
              -0.57016974724960845, -4.59636351675856217e-05, 9.74999561134540574e-07],
    "a": [-0.000161187342296687116, 0.00304003843792177708, 0.0916468555721788314,
          -9.62964975953143595e-05, -2.97595340762196176e-05, 0],
    "d": [0.000505390894843998906, 11.1984514757821039, -92.5270326908668181,
          81.3282683520703529, -0.000212852818740727479, -0.000126145560998547346],
    "alpha": [-0.00032142399895862539, -0.00565024518540147101, -0.00378922621833689211,
              -0.00106533274011644252, 0.000999586303470856308, 0],
}  # fmt: skip
ROS = {
    "UR5": [
        [0, 0, 0.089201138580847966, -0.0, 0, 1.5413963267648517e-05],
        [8.28481932000539e-05, 0, 0, 1.5702793305568989, 0, 9.4248239648454113e-05],
        [-0.42514603197027351, 0, 0,
         0.00027727163297603633, 0.00074181659174685764, 8.2061777589927939e-05],
        [-0.39231335412023205, 0.00070367842866065884, 0.11004902881674888,
         3.1351985141209435, -3.1400954402443415, 3.1415185610293745],
        [3.6501405590628345e-05, -0.094721186124807052, 0.0001791428279527357,
         1.5689050644312028, 0, -1.320607040336194e-05],
        [0.00015399008043081661, 0.082421327089370319, 0.00012632686207930083,
         1.5723290218826846, 3.1415926535897931, -3.14158677108863],
    ],
    "UR5e": [
        [0, 0, 0.1627122445743823, -0.0, 0, 5.707382499074709e-08],
        [0.0001820110310317555, 0, 0, 1.571314866107557, 0, 1.12157791523139e-06],
        [-0.425170344631444, 0, 0,
         0.001444320579376547, -0.0004261037597356073, 4.642343028998144e-06],
        [-0.392646598028507, -0.0004030322688786401, 0.1331063119537431,
         0.003027888244224887, -0.001185722601572754, -2.569771029137183e-06],
        [-7.071306960874342e-06, -0.09960359635829828, -3.198591184007791e-07,
         1.570799538115874, 0, 1.304820282092834e-06],
        [1.369362273278849e-05, 0.09958483828527664, 9.521789789182917e-05,
         1.571752475045119, 3.141592653589793, 3.141592510837143],
    ],
}  # fmt: skip
NOMINAL = {"UR5": UR5, "UR5e": UR5E}


def conf(lists: dict[str, list[float]], more: str = "") -> str:
    rows = [f"delta_{k} = [ {', '.join(map(repr, v))}]" for k, v in lists.items()]
    return "\n".join(["[mounting]", *rows, "joint_checksum = [ 0x6e0f7bf, 0xa32a713f]", more, ""])


def ros_yaml(rows: list[list[float]]) -> str:
    lines = ["kinematics:"]
    for link, row in zip(LINKS, rows, strict=True):
        lines.append(f"  {link}:")
        lines += [f"    {place}: {value!r}" for place, value in zip(PLACES, row, strict=True)]
    return "\n".join([*lines, "  hash: calib_15200003067234149431", ""])


def link_transforms(rows: list[list[float]]) -> np.ndarray:
    """URDF: translation, then Rz(yaw) Ry(pitch) Rx(roll)."""
    Ts = []
    for x, y, z, roll, pitch, yaw in rows:
        axes = ([0, 0, yaw], [0, pitch, 0], [roll, 0, 0])
        Ts.append(se3.from_rt(np.linalg.multi_dot([se3.exp_so3(w) for w in axes]), [x, y, z]))
    return np.stack(Ts)


def by_links(links: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Forward kinematics as a URDF does it."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    for i, link in enumerate(links):
        turn = se3.exp_so3(q[:, i, None] * [0, 0, 1])
        T = T @ link @ se3.from_rt(turn, np.zeros((len(q), 3)))
    return T


def spread(n: int = 200, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, 6))


def read(text: str, chain: DhChain, tmp_path: Path, name: str = "calibration.conf") -> DhChain:
    (tmp_path / name).write_text(text)
    return read_controller_calibration(tmp_path / name, chain)


def test_deltas_of_tens_of_metres_are_added_as_they_are(tmp_path: Path) -> None:
    text = conf(CONF, "calibration_status = 2 # 0 == notInitialized / 2 == Linearised")
    chain = read(text, UR10, tmp_path)
    for name in LISTS:
        assert np.array_equal(getattr(chain, f"delta_{name}"), CONF[name])
    assert chain.name == "UR10" and np.array_equal(chain.limits.lower, UR10.limits.lower)
    # 92 metres that cancel to what a factory calibration is.
    assert 0.001 < flange_gap_m(chain, UR10) < 0.005
    # Reading on top of a calibrated chain replaces, it does not add twice.
    assert np.array_equal(read(text, chain, tmp_path).delta_d, chain.delta_d)


@pytest.mark.parametrize("name", ["UR5", "UR5e"])
def test_the_ros_file_gives_its_own_forward_kinematics(name: str, tmp_path: Path) -> None:
    chain = read(ros_yaml(ROS[name]), NOMINAL[name], tmp_path, "robot.yaml")
    q = spread()
    assert np.abs(chain.forward(q) - by_links(link_transforms(ROS[name]), q)).max() < 1e-9
    assert 0.0005 < flange_gap_m(chain, NOMINAL[name]) < 0.005
    assert np.abs(chain.delta_d).max() > 10.0  # the parallel axes' common normals lie far away


def test_any_arm_of_six_axes_comes_back_from_its_dh_numbers() -> None:
    """The law behind the ROS file: links of random DH numbers give the same arm again."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        rows = rng.uniform(-1, 1, (6, 6))
        rows[0, [0, 1, 3, 4]] = 0.0
        links = link_transforms(rows.tolist())
        numbers = dh_of_links(links, UR5)
        chain = DhArm(name="x", **{k: numbers[k] for k in LISTS})
        q = spread(20)
        assert np.abs(chain.forward(q) - by_links(links, q)).max() < 1e-9


@pytest.mark.parametrize(
    ("nominal", "text"), [(UR10, conf(CONF)), (UR5E, ros_yaml(ROS["UR5e"]))], ids=["UR10", "UR5e"]
)
def test_the_inverse_is_complete_on_real_calibrations(
    nominal: DhChain, text: str, tmp_path: Path
) -> None:
    chain = read(text, nominal, tmp_path)
    q = regular_joints(nominal, 100)
    Ts = chain.forward(q)
    found, owner = chain.inverse_branches(Ts)
    assert np.abs(chain.forward(found) - Ts[owner]).max() < 1e-9
    for i, row in enumerate(q):
        assert np.abs(np.exp(1j * found[owner == i]) - np.exp(1j * row)).max(-1).min() < 1e-6
    # No branch of the nominal arm is lost.
    _, nominal_owner = nominal.inverse_branches(Ts)
    assert np.array_equal(np.bincount(owner), np.bincount(nominal_owner))


def test_the_wrong_robot_is_named_with_the_right_one(tmp_path: Path) -> None:
    refused(r"UR5 by 1\d\d mm.*belongs to a UR10", read, conf(CONF), UR5, tmp_path)
    refused("belongs to a UR5e", read, ros_yaml(ROS["UR5e"]), UR5, tmp_path)
    refused(r"belongs to a UR5\. ", read, ros_yaml(ROS["UR5"]), UR5E, tmp_path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no calibration"),
        (conf({k: v for k, v in CONF.items() if k != "alpha"}), "lacks delta_alpha"),
        (conf(CONF | {"a": [0, 1, 2]}), r"line 3.*6 finite numbers"),
        (conf(CONF, "delta_a = [0, 0, 0, 0, 0, 0]"), "twice"),
        (conf(CONF, "calibration_status = 0"), "holds no calibration"),
        ("kinematics:\n  shoulder: {x: 0, y: 0}\n", "'shoulder'"),
        ("kinematics:\n  shoulder: [\n", "not YAML"),
        (ros_yaml(ROS["UR5"]).replace("0.0892", ".nan #"), "not finite"),
        (ros_yaml([[0, 0, 0.1, 0, 0.1, 0], *ROS["UR5"][1:]]), "base's z"),
    ],
)
def test_damaged_files_are_named(text: str, says: str, tmp_path: Path) -> None:
    assert "calibration.conf" in refused(says, read, text, UR5, tmp_path)
