"""What a replay is made of: the configuration read back, the watched engine, the fall.

Where it is seen from, and goals in words: met where the words say so, and nowhere else.
"""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import trimesh_solids
from held_boxes import held_box
from realsim.app.school.files import stored_grasps
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.mesh import mass_properties
from realsim_sim_bridge.demonstrations import front_view, placing
from realsim_sim_bridge.demonstrations.attempt_motion import fall
from realsim_sim_bridge.demonstrations.place_source import PlacingSource
from realsim_sim_bridge.demonstrations.records import ALL_PHASES
from realsim_sim_bridge.demonstrations.school_settings import school_config_of, tried_body
from realsim_sim_bridge.demonstrations.slip_replay import RecordedEngine, replay_grasp
from realsim_sim_bridge.school import run_school_results
from realsim_sim_bridge.school.shards import stand_of
from realsim_sim_bridge.school.sweep import SweepConfig
from realsim_sim_bridge.slip.engines import make_engine, settings_of
from refusals import refused
from school_scenes import CONFIG, at, model, scene, small_worlds
from tried_grasps import plain_grasps


def test_a_configuration_comes_back_from_the_parameters():
    slip = replace(CONFIG.slip, engine=settings_of("pybullet"))
    base = replace(CONFIG, slip=slip, second_engine=settings_of("mujoco"), sweep=SweepConfig())
    assert school_config_of(tried_with(stored_config(base))) == base


def stored_config(config):
    return json.loads(json.dumps(asdict(config)))


def tried_with(stored):
    return plain_grasps(0, parameters={"config": stored})


def test_a_configuration_of_another_version_is_refused():
    gone, new, other_type = (stored_config(CONFIG) for _ in range(3))
    del gone["slip"]
    new["slip"]["physics"]["glue"] = 1.0
    other_type["slip"]["physics"]["friction"] = "much"
    refused("slip is not there", school_config_of, tried_with(gone))
    refused("glue", school_config_of, tried_with(new))
    refused("friction is str", school_config_of, tried_with(other_type))


def test_a_field_that_a_version_did_not_have_takes_its_default():
    stored = stored_config(CONFIG)
    del stored["slip"]["headroom_m"], stored["sweep"]
    sizes = "max_opening_m finger_length_m tip_beyond_tcp_m finger_width_m finger_thickness_m"
    stored["hand"] = {n: stored["hand"][n] for n in [*sizes.split(), "mount_z_m"]}
    del stored["reach"]["arm"]  # the Panda's, before arms had names
    stored["reach"]["joint7_samples"] = stored["reach"].pop("held_values")
    # Franka's, before names.
    assert school_config_of(tried_with(stored)) == CONFIG
    stored["hand"]["mount_z_m"] = -0.15
    refused("without a name", school_config_of, tried_with(stored))


def test_a_box_that_is_dropped_lands_on_its_face():
    T = se3.from_translation([0.0, 0.0, 0.12])
    Ts = fall(held_box(0.1), T, np.zeros(6), [], np.array([0.0, 0.1, 1.0]))
    np.testing.assert_allclose(Ts[0], T, atol=1e-6)
    assert Ts[1, 2, 3] == pytest.approx(0.12 - 0.5 * 9.81 * 0.1**2, abs=3e-3)
    assert Ts[2, 2, 3] == pytest.approx(0.025, abs=1e-3)
    np.testing.assert_allclose(Ts[2, :3, :3], np.eye(3), atol=0.02)


def test_a_thrown_box_flies_on_and_lands_on_what_stands_there():
    twist = np.array([0, 0, 0, 0.5, 0, 0.0])
    block = trimesh_solids.box((0.2, 0.2, 0.05), (0.07, 0, 0.025)).vertices
    T = se3.from_translation([0.0, 0, 0.2])
    Ts = fall(held_box(0.1), T, twist, [block], np.array([0.1, 1.0]))
    assert Ts[0, 0, 3] == pytest.approx(0.05, abs=2e-3)
    assert Ts[1, 2, 3] == pytest.approx(0.075, abs=2e-3)


@pytest.mark.slow
def test_a_replay_in_bullet_ends_as_the_school_did():
    config = small_worlds(replace(CONFIG, max_candidates=4))
    physics = replace(config.slip.physics, friction=0.3, force_n=6.0)
    config = replace(config, slip=replace(config.slip, physics=physics))
    (result,) = run_school_results(scene(at(0.0, 0.0)), {1: model()}, config, workers=1)
    s, attempts = result.grasp_set, result.trajectories
    assert attempts is not None
    T_table_obj = se3.from_translation([0, 0, 0.025])
    engine = RecordedEngine(make_engine(config.slip.engine))
    body = tried_body(s, model(), T_table_obj, school_config_of(s), None, None)
    assert body.mass_kg == pytest.approx(mass_properties(model().mesh, 1000.0).mass_kg)
    stand = stand_of(config.slip, T_table_obj, body, [])
    for row in attempts.rows.tolist():
        lifted = attempts.joints_rad[attempts.attempt(row)][-1]
        replay = replay_grasp(s, row, lifted, T_table_obj, body, config, engine, stand)
        assert replay.agrees, replay.disagreement
        assert len(replay.stages) == int((~np.isnan(s.slip_m[row])).sum())
        for stage in replay.stages:
            assert np.all(np.diff(stage.times_s) > 0)
            np.testing.assert_allclose(np.linalg.det(stage.Ts_grasp_obj[:, :3, :3]), 1.0, atol=1e-6)
        ends = [st.Ts_grasp_obj[-1] for st in replay.stages[:-1]]
        for end, stage in zip(ends, replay.stages[1:], strict=True):
            np.testing.assert_array_equal(end, stage.Ts_grasp_obj[0])


# --- The camera beside the table: it sees all that happens, as near and as little hidden as can be.


CAMERA = front_view.view_intrinsics(40.0)
TOWARDS = np.array([1.0, 0.4, 0.6])


def some(seed, n=40):
    return np.random.default_rng(seed).uniform([-0.2, -0.1, 0], [0.2, 0.3, 0.4], (n, 3))


def a_grasp(arms, away=(1.0, 0.0)):
    grasp = np.array([[0.0, 0.0, 0.05]])
    return front_view.Happening(
        standing=some(1) * [1, 1, 0.2], moving=some(2), grasps=grasp,
        hands=grasp[:, None] + [0.0, 0.0, 0.1], arms=np.array(arms, float).reshape(1, -1, 3),
        away_from_base=np.array(away),
    )  # fmt: skip


def test_the_nearest_camera_sees_all_and_no_nearer_one_does():
    points = some(0)
    T = front_view.nearest_camera(points, TOWARDS, CAMERA)
    p = se3.transform(se3.invert(T), points)
    uv = project(CAMERA, p)
    edge = front_view.BORDER * np.array([CAMERA.width, CAMERA.height])
    low, high = edge - 0.5, np.array([CAMERA.width, CAMERA.height]) - edge - 0.5
    assert p[:, 2].min() > 0 and (uv > low - 1e-6).all() and (uv < high + 1e-6).all()
    # It touches two opposite borders, so that no camera nearer along its axis has room for all.
    assert np.any(np.isclose(uv.min(axis=0), low) & np.isclose(uv.max(axis=0), high))


def test_a_scene_that_is_elsewhere_is_seen_alike():
    moved = se3.exp([0.0, 0.0, 0.7, 0.3, -0.2, 0.0])
    T = front_view.nearest_camera(some(0), TOWARDS, CAMERA)
    again = front_view.nearest_camera(
        se3.transform(moved, some(0)), moved[:3, :3] @ TOWARDS, CAMERA
    )
    np.testing.assert_allclose(again, moved @ T, atol=1e-9)


def test_an_arm_between_camera_and_grasp_hides_it_and_one_behind_does_not():
    eye = np.array([1.0, 0.0, 0.5])
    between, behind = a_grasp([[0.5, 0.02, 0.275]]), a_grasp([[-0.5, 0.0, -0.2]])
    assert front_view.hidden(between, eye).tolist() == [True]
    assert front_view.hidden(behind, eye).tolist() == [False]
    assert front_view.hidden(between, np.array([0.0, 1.0, 0.5])).tolist() == [False]


def test_the_camera_goes_to_the_side_that_the_arm_leaves_free():
    # An arm that reaches around: it comes from the side opposite its base, and from one more.
    line = np.linspace(0.1, 0.6, 12)[:, None]
    wall = [line * [np.cos(a), np.sin(a), 0.6] + [0, 0, 0.05] for a in np.radians([0, -30, -60])]
    seen = a_grasp(np.concatenate([np.add(w, [0, 0, up]) for w in wall for up in (0.0, 0.1)]))
    camera = front_view.placed_front(front_view.FrontView(), seen)
    assert camera.T_frame_cam[1, 3] > 0.2
    assert not front_view.hidden(seen, camera.T_frame_cam[:3, 3]).any()
    back = replace(seen, away_from_base=np.array([-1.0, 0.0]))
    turned = front_view.placed_front(front_view.FrontView(), back)
    assert turned.T_frame_cam[0, 3] < 0


# --- Goals in words: met where the words say so, and nowhere else.


MUG, BOWL = 3, 7
NAMES = {MUG: "mug", BOWL: "bowl"}
OPPOSITE = {"left": "right", "right": "left", "front": "behind", "behind": "front"}
MIRRORED = {"left": [0, 1], "right": [0, -1], "front": [-1, 0], "behind": [1, 0]}
"""Directions of the relations for a robot that looks along x."""


def box(x: float, y: float, half: float, height: float = 0.1) -> np.ndarray:
    return trimesh_solids.box((2 * half, 2 * half, height), (x, y, height / 2)).vertices


def standing(turn: float = 0.0, gap: float = 0.02) -> placing.Standing:
    """A mug before the robot and a bowl left of it, the whole scene turned."""
    R = se3.exp_so3([0.0, 0.0, turn])
    return placing.Standing(
        corners={MUG: box(0.0, 0.0, 0.03) @ R.T, BOWL: box(0.02, 0.08 + gap, 0.05) @ R.T},
        names=NAMES,
        ahead=(R @ [1.0, 0.0, 0.0])[:2],
    )


def put(goal: placing.PlaceGoal) -> np.ndarray:
    return se3.from_translation([*goal.shift_m, 0.0])


@pytest.mark.parametrize("turn", (0.0, 0.9, 2.8))
def test_goals_are_met_where_they_lead_and_not_where_they_do_not(turn: float) -> None:
    there = standing(turn)
    goals = list(placing.goals_of(there, MUG, 0))
    assert {g.relation for g in goals} == set(placing.PHRASES) - {"right"}  # it is there already
    for goal in goals:
        assert placing.unmet(goal, there, MUG, np.eye(4), put(goal)) == ""
        moved = se3.transform(put(goal), there.corners[MUG])
        assert placing.distance(moved, [there.corners[BOWL]]) >= 0.02
        if goal.relation == placing.FREE:
            continue
        for other in goals:
            if other.relation == OPPOSITE[goal.relation]:
                assert "is not" in placing.unmet(goal, there, MUG, np.eye(4), put(other))
        assert "is not" in placing.unmet(goal, there, MUG, np.eye(4), np.eye(4))
        # Where the words lead, by hand.
        R = se3.exp_so3([0.0, 0.0, turn])
        apart = moved.mean(axis=0) - there.corners[BOWL].mean(axis=0)
        x, y, _ = R.T @ apart
        assert np.dot(MIRRORED[goal.relation], [x, y]) > 0.05


def test_what_leans_hangs_or_is_too_near_does_not_meet_its_goal() -> None:
    there = standing()
    goal = next(g for g in placing.goals_of(there, MUG, 0) if g.relation == "left")
    tipped = se3.from_rt(se3.exp_so3([np.pi / 2, 0.0, 0.0]), [0.0, 0.03, 0.03])
    assert "leans 90 deg" in placing.unmet(goal, there, MUG, np.eye(4), put(goal) @ tipped)
    hanging = se3.from_translation([0.0, 0.0, 0.02]) @ put(goal)
    assert "on the table" in placing.unmet(goal, there, MUG, np.eye(4), hanging)
    free = next(g for g in placing.goals_of(there, MUG, 0) if g.relation == placing.FREE)
    near = se3.from_translation([0.02, 0.01, 0.0])
    assert "10 mm from another" in placing.unmet(free, there, MUG, np.eye(4), near)


def test_phrasings_are_taken_in_turn_and_name_both_things() -> None:
    said = [next(placing.goals_of(standing(), MUG, k)).language for k in range(4)]
    assert len(set(said[:3])) == 3
    assert said[3] == said[0]
    assert all("mug" in words and "bowl" in words for words in said)


def test_things_of_one_name_are_no_reference_to_each_other() -> None:
    there = standing()
    same = replace(there, names={MUG: "mug", BOWL: "mug"})
    assert [g.relation for g in placing.goals_of(same, MUG, 0)] == [placing.FREE]
    apart = standing(gap=0.1)
    # Nothing is near it.
    assert placing.FREE not in [g.relation for g in placing.goals_of(apart, MUG, 0)]


def test_overlap_is_no_distance() -> None:
    assert placing.distance(box(0, 0, 0.05), [box(0.02, 0, 0.01)]) == 0.0
    assert placing.distance(box(0, 0, 0.05), [box(0.2, 0, 0.05)]) == pytest.approx(0.1, abs=1e-9)
    assert placing.distance(box(0, 0, 0.05), []) == np.inf


@pytest.mark.slow
def test_an_object_is_carried_let_go_and_where_its_task_says(weak_school: Path) -> None:
    grasps, models = stored_grasps(weak_school)
    cameras = (front_view.FrontView(size_px=(64, 48)), front_view.wrist_camera(None, (64, 48)))
    source = PlacingSource(grasps, models, cameras=cameras, cache=weak_school / "grasps/cache")
    done = [source[k] for k in range(len(source))]
    good = [d for d in done if d.outcome.success]
    assert good
    assert len(good) < len(done)  # the weak hand loses some
    for d in done:
        place = d.goal.place
        assert place is not None
        assert d.outcome.success == (d.outcome.failure == "")
        instance = d.name.instance
        T0, T = source.scenery.Ts_table_obj[instance], d.motion.Ts_table_obj[-1]
        if d.outcome.success:
            assert placing.unmet(place, source.standing, instance, T0, T) == ""
            phases = [ALL_PHASES[p] for p in np.unique(d.motion.phase)]
            assert phases[-4:] == ["carry", "lower", "release", "withdraw"]
            # What hangs askew in the weak hand comes down askew, and turns as it lands.
            np.testing.assert_allclose(T[:2, 3] - T0[:2, 3], place.shift_m, atol=0.05)
            # It rests, and the hand has gone.
            np.testing.assert_allclose(d.motion.Ts_table_obj[-3], T, atol=1e-3)
            assert not d.motion.held[-1]
            steps = np.abs(np.diff(d.motion.joints_rad, axis=0)).max()
            assert steps < 0.25  # nothing jumps [rad in 50 ms]
