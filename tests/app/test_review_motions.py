"""Motions of a session's grasps: the school's own arm, home to the end, in world."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.app.review.motions import FIXED_IN_HAND, NO_TRAJECTORY, SessionMotions
from realsim.app.school.files import stored_grasps
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.geometry import se3
from realsim.records import ObjectModel
from realsim.records.grasps import PHASES
from realsim.robots.hand import find_hand
from realsim_sim_bridge.arm.reach_config import base_on_table, grasping_arm, home_joints
from realsim_sim_bridge.demonstrations.lerobot_episodes import LeRobotDemonstrations
from realsim_sim_bridge.demonstrations.school_settings import school_config_of
from realsim_sim_bridge.demonstrations.source import DemonstrationSource
from school_sessions import WEAK, refused, registered, run

Stored = tuple[SceneGrasps, dict[int, ObjectModel]]
CLOSE = PHASES.index("close")
SAME = 1e-5
"""The school follows poses to 1e-6 m; files round."""


@pytest.fixture(scope="module")
def stored(weak_school: Path) -> Stored:
    return stored_grasps(weak_school)


@pytest.fixture(scope="module", params=["tried again", "as stored"])
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def school(kind: str, stored: Stored) -> Stored:
    """A school, or one whose attempts cannot be tried again: its matter is another."""
    grasps, models = stored
    if kind == "tried again":
        return stored
    sets = tuple(
        replace(s, parameters={k: v for k, v in s.parameters.items() if k != "density"})
        for s in grasps.sets
    )
    heavier = {i: replace(m, density=2.0 * m.density) for i, m in models.items()}
    return replace(grasps, sets=sets), heavier


@pytest.fixture(scope="module")
def motions(kind: str, school: Stored, weak_school: Path) -> SessionMotions:
    if kind == "tried again":
        return SessionMotions.of_session(weak_school, with_arm=False)
    return SessionMotions(*school, with_arm=False)


def attempts(grasps: SceneGrasps) -> list[tuple[int, int]]:
    """Return some instances and rows with a trajectory."""
    pairs = [(i, int(r)) for i, t in grasps.trajectories.items() for r in t.rows]
    assert pairs, "the school has reached nothing"
    return pairs[:3]


def test_the_hand_comes_from_home_and_closes_in_the_grasp_and_the_object_goes_along_from_then(
    kind: str, motions: SessionMotions, school: Stored
) -> None:
    grasps, _ = school
    sets = {s.instance: s for s in grasps.sets}
    carried = 0
    for instance, row in attempts(grasps):
        motion, s = motions.motion(instance, row), sets[instance]
        assert motion is not None
        assert any(FIXED_IN_HAND in n for n in motion.notes) is (kind == "as stored")
        assert np.all(np.diff(motion.time_s) > 0)
        before, closing, lifted = (f(motion.phase, CLOSE) for f in (np.less, np.equal, np.greater))
        T_world_obj = grasps.Ts_world_obj[instance]
        for Ts, T, atol in (
            (motion.Ts_world_hand[closing], T_world_obj @ s.Ts_obj_grasp[row], SAME),
            (motion.Ts_world_obj[before], T_world_obj, 1e-9),
        ):
            np.testing.assert_allclose(Ts, np.broadcast_to(T, Ts.shape), atol=atol)
        x, y = s.parameters["middle_xy_m"]
        reach = school_config_of(s).reach
        arm = grasping_arm(reach, find_hand())
        T_world_base = grasps.T_world_table @ base_on_table((x, y), reach, arm)
        home = T_world_base @ arm.forward(home_joints(reach, arm, (x, y)))
        np.testing.assert_allclose(motion.Ts_world_hand[0], home, atol=SAME)
        assert motion.phase_name(0) == "reach"
        carried += float(np.ptp(motion.Ts_world_obj[:, 2, 3])) > 0.05
        if kind == "as stored" and lifted.any():
            Ts_hand_obj = se3.invert(motion.Ts_world_hand[lifted]) @ motion.Ts_world_obj[lifted]
            assert np.ptp(Ts_hand_obj, axis=0).max() < 1e-9
    assert carried, "no attempt lifts its object: the law was not tried"


def test_the_replay_moves_with_the_world(motions: SessionMotions, school: Stored) -> None:
    grasps, models = school
    T = se3.random_transform(np.random.default_rng(8))
    assert grasps.T_world_table is not None
    moved = replace(
        grasps,
        Ts_world_obj={i: T @ P for i, P in grasps.Ts_world_obj.items()},
        T_world_table=T @ grasps.T_world_table,
    )
    attempt = attempts(grasps)[0]
    a, b = (m.motion(*attempt) for m in (motions, SessionMotions(moved, models, with_arm=False)))
    assert a is not None and b is not None
    np.testing.assert_array_equal(a.time_s, b.time_s)
    np.testing.assert_array_equal(a.phase, b.phase)
    np.testing.assert_allclose(b.Ts_world_hand, T @ a.Ts_world_hand, atol=1e-9)
    # The engine's last bits depend on those of the pose; contacts make them larger.
    np.testing.assert_allclose(b.Ts_world_obj, T @ a.Ts_world_obj, atol=1e-3)


def test_a_grasp_without_a_trajectory_shows_the_approach_and_says_so(stored: Stored) -> None:
    grasps, models = stored
    bare = SessionMotions(replace(grasps, trajectories={}), models, with_arm=False)
    s = grasps.sets[0]
    motion = bare.motion(s.instance, 0)
    assert motion is not None and motion.notes == (NO_TRAJECTORY,)
    T_world_grasp = grasps.Ts_world_obj[s.instance] @ s.Ts_obj_grasp[0]
    np.testing.assert_allclose(motion.Ts_world_hand[-1], T_world_grasp, atol=1e-12)
    assert bare.motion(s.instance, len(s)) is None and bare.motion(99, 0) is None


@pytest.mark.slow
def test_arm_and_hand_are_drawn_where_the_kinematics_have_them(
    weak_school: Path, stored: Stored
) -> None:
    instance, row = attempts(stored[0])[0]
    motion = SessionMotions.of_session(weak_school).motion(instance, row)
    assert motion is not None
    assert len(motion.link_meshes) == 11, "links 0 to 7, hand, two fingers"
    assert motion.arm_links == 8
    assert motion.Ts_world_link.shape == (len(motion), 11, 4, 4)
    base = motion.Ts_world_link[:, 0]
    np.testing.assert_allclose(base, np.tile(base[0], (len(motion), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(motion.Ts_world_hand, motion.Ts_world_link[:, 8], atol=1e-9)
    palm = motion.link_meshes[8].vertices
    assert abs(palm[:, 2].max() - find_hand().palm_face_z_m) < 0.002 and np.ptp(palm[:, 1]) > 0.19
    apart = np.linalg.norm(
        motion.Ts_world_link[:, 9, :3, 3] - motion.Ts_world_link[:, 10, :3, 3], axis=1
    )
    np.testing.assert_allclose(apart, motion.opening_m, atol=1e-9)


@pytest.mark.slow
def test_a_ur5_with_another_hand_is_tried_replayed_drawn_exported_and_not_mixed(
    tmp_path: Path,
) -> None:
    folder = registered(tmp_path / "session")
    arm = ("--arm", "ur5", "--hand", "parallel")
    result = run("run", folder, *(w for w in WEAK if w != "--quiet"), *arm)
    assert result.exception is None, result.output
    grasps, models = stored_grasps(folder)
    reach = school_config_of(grasps.sets[0]).reach
    assert (reach.arm.name, len(reach.arm.digest)) == ("ur5", 64)
    for index, (instance, row) in enumerate(attempts(grasps)[:2]):
        motion = SessionMotions.of_session(folder).motion(instance, row)
        assert motion is not None and not any(FIXED_IN_HAND in n for n in motion.notes)
        assert motion.arm_links == len(motion.link_meshes) > 6  # the UR5's own bodies
        moved = np.ptp(motion.Ts_world_link[..., :3, 3], axis=0).max(axis=1)
        assert moved[0] == 0.0 and moved.max() > 0.2, index
    source = DemonstrationSource(grasps, models)
    episodes = LeRobotDemonstrations(source, "ur5", (0,))
    names = episodes.features["action"].names
    assert episodes.robot_type == "ur5" and names is not None and len(names) == 6 + 1
    assert episodes.features["observation.state"].names == (*names[:-1], "opening")
    assert source[0].motion.joints_rad.shape[1] == 6
    assert source[0].step(0).look("front").std() > 10
    message = refused("run", folder, *WEAK, "--hand", "parallel")
    assert 'config.reach.arm.name: "ur5" -> "panda"' in message
    assert "no arm 'puma'" in refused("run", folder, *WEAK, "--arm", "puma")
