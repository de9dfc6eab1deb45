"""Attempts of the school as demonstrations: they are the attempts, and arm and object agree."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from realsim.app.school.files import stored_grasps
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records.grasps import PHASES
from realsim_sim_bridge.demonstrations.front_view import FINGERS_M, FrontView, wrist_camera
from realsim_sim_bridge.demonstrations.records import DemonstrationConfig
from realsim_sim_bridge.demonstrations.source import DemonstrationSource
from refusals import refused
from scanned_objects import scaled

pytestmark = pytest.mark.slow  # the school of all of them takes long

LIFT = PHASES.index("lift")
SMALL = (64, 48)


@pytest.fixture(scope="module")
def source(weak_school):
    """The attempts of one school that succeed, slip and are lost, with small pictures."""
    cameras = (FrontView(size_px=SMALL), wrist_camera(None, SMALL))
    return sourced(weak_school, cameras=cameras)


def sourced(school, grasps=None, **options):
    """A school's attempts, or those of its grasps as a test has changed them."""
    stored, models = stored_grasps(school)
    cache = school / "grasps/cache"
    return DemonstrationSource(grasps or stored, models, cache=cache, **options)


@pytest.fixture(scope="module")
def all_of_them(source):
    return list(source)


@pytest.fixture(scope="module")
def good(all_of_them):
    return next(d for d in all_of_them if d.outcome.success)


@pytest.fixture(scope="module")
def lost(all_of_them):
    return [d for d in all_of_them if "lost" in d.outcome.failure or "touch" in d.outcome.failure]


def test_an_attempt_tells_its_p_hold(weak_school):
    grasps, _ = stored_grasps(weak_school)
    told = [
        replace(s, measures={"p_hold": np.arange(len(s)) / len(s), "safety": np.ones((len(s), 4))})
        for s in grasps.sets
    ]
    d = sourced(weak_school, replace(grasps, sets=tuple(told)), cameras=())[0]
    count = next(len(s) for s in told if s.instance == d.name.instance)
    assert d.outcome.labels == {"p_hold": d.name.grasp / count, "safety": [1.0] * 4}


def lowest_m(d, k):
    """Return the height of the object's lowest vertex over the table."""
    mesh = d.scenery.models[d.name.instance].mesh
    return float(se3.transform(d.motion.Ts_table_obj[k], mesh.vertices)[:, 2].min())


def test_every_attempt_is_there_and_ends_as_it_is_stored(source, all_of_them, weak_school):
    grasps = stored_grasps(weak_school)[0]
    assert len(all_of_them) == len(source) == sum(len(t) for t in grasps.trajectories.values())
    for d in all_of_them:
        assert d.outcome.agrees, d.name
        assert d.outcome.disagreement == "", d.name
    kinds = {d.outcome.failure.partition(":")[0] for d in all_of_them}
    assert kinds >= {"", "close", "lift"}, "the school holds successes and two kinds of failures"


def test_an_action_is_what_the_next_step_has(good):
    steps = list(good)
    for now, after in itertools.pairwise(steps):
        np.testing.assert_array_equal(now.action.joints_rad, after.joints_rad)
        assert now.action.opening_m == good.motion.command_m[after.index]
        moved = now.T_base_ee @ now.action.T_ee_next
        np.testing.assert_allclose(moved, after.T_base_ee, atol=1e-12)
    np.testing.assert_array_equal(steps[-1].action.joints_rad, steps[-1].joints_rad)


def test_an_object_that_is_held_moves_with_the_hand_and_is_lifted(good):
    m = good.motion
    held = np.nonzero(m.held & (m.phase >= LIFT))[0]
    in_hand = se3.invert(good.scenery.T_table_base @ m.Ts_base_ee[held]) @ m.Ts_table_obj[held]
    spread = np.linalg.norm(in_hand[:, :3, 3] - in_hand[0, :3, 3], axis=1)
    assert spread.max() < 0.02
    lifted = m.Ts_table_obj[m.phase > LIFT][0, 2, 3] - m.Ts_table_obj[0, 2, 3]
    assert lifted == pytest.approx(0.20, abs=0.01)


def test_a_lost_object_falls_onto_the_table_and_stays_there(lost):
    assert lost
    for d in lost:
        m = d.motion
        assert not m.held[-1]
        assert lowest_m(d, -1) == pytest.approx(0.0, abs=2e-3)
        assert min(lowest_m(d, k) for k in range(len(m))) > -4e-3


def test_nothing_jumps(weak_school):
    for d in sourced(weak_school, config=DemonstrationConfig(rate_hz=100)):
        m = d.motion
        center = d.scenery.models[d.name.instance].mesh.vertices.mean(axis=0)
        moved = np.diff(se3.transform(m.Ts_table_obj, center[None])[:, 0], axis=0)
        assert np.linalg.norm(moved, axis=1).max() * 100 < 3.0, d.name
        assert np.abs(np.diff(m.joints_rad, axis=0)).max() * 100 < 5.0


def test_half_the_rate_is_every_second_step(weak_school, source):
    slow = sourced(weak_school, config=DemonstrationConfig(rate_hz=10))
    for k in (1, 4):
        a, b = slow[k].motion, source[k].motion
        for name in ("time_s", "joints_rad", "opening_m", "command_m", "phase", "held"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name)[::2], atol=1e-12)
        np.testing.assert_allclose(a.Ts_table_obj, b.Ts_table_obj[::2], atol=1e-9)


def test_a_step_is_seen_the_same_each_time_and_steps_are_seen_differently(good):
    middle = len(good) // 2
    for camera in ("front", "wrist"):
        first, again = good.step(middle).look(camera), good.step(middle).look(camera)
        assert first.shape == (48, 64, 3)
        assert first.tobytes() == again.tobytes()
        assert np.abs(first.astype(int) - good.step(0).look(camera)).mean() > 2.0


def test_a_grasp_without_an_attempt_is_refused_with_its_reason(source):
    none = source.not_attempted[0]
    said = refused(r"collides|kinematics", source.number_of, none.instance, none.grasp)
    there = [a.grasp for a in source.attempts if a.instance == none.instance]
    assert f"Attempts there are at its grasps {there[0] if there else '(none)'}" in said
    refused("no grasp 99", source.number_of, 0, 99)
    for k, name in enumerate(source.attempts):
        assert source.number_of(name.instance, name.grasp) == k


def test_a_scene_that_was_moved_or_weighed_since_is_refused(weak_school):
    grasps, models = stored_grasps(weak_school)
    moved = {i: T @ se3.from_translation([0.01, 0, 0]) for i, T in grasps.Ts_world_obj.items()}
    elsewhere = DemonstrationSource(replace(grasps, Ts_world_obj=moved), models)
    refused(r"moved by 10\.0 mm", elsewhere.__getitem__, 0)
    large = {i: replace(m, mesh=scaled(m.mesh, 1.05)) for i, m in models.items()}
    refused("weighs", DemonstrationSource(grasps, large).__getitem__, 0)


def test_grasps_that_do_not_say_how_they_were_tried_are_refused(weak_school):
    grasps, models = stored_grasps(weak_school)
    bare = tuple(replace(s, parameters={}) for s in grasps.sets)
    untold = replace(grasps, sets=bare)
    refused("do not say what they were tried with", DemonstrationSource, untold, models)
    refused("without trajectories", DemonstrationSource, replace(grasps, trajectories={}), models)


def test_fingers_and_objects_are_in_the_picture_from_pre_grasp_to_lift(source):
    camera = source.scenery.cameras["front"]
    i, T_cam_table = camera.intrinsics, se3.invert(camera.T_frame_cam)
    shown = [PHASES.index(p) for p in ("approach", "close", "lift")]
    for d in source[: len(source)]:
        m = d.motion
        for k in np.nonzero(np.isin(m.phase, shown) & ((m.phase < shown[-1]) | m.held))[0]:
            points = [se3.transform(d.scenery.T_table_base @ m.Ts_base_ee[k], FINGERS_M)]
            points += [
                se3.transform(m.Ts_table_obj[k] if n == d.name.instance else T, o.mesh.vertices)
                for (n, o), T in zip(
                    d.scenery.models.items(), d.scenery.Ts_table_obj.values(), strict=True
                )
            ]
            u, v = project(i, se3.transform(T_cam_table, np.concatenate(points))).T
            assert u.min() >= -0.5 and u.max() <= i.width - 0.5, (d.name, k)
            assert v.min() >= -0.5 and v.max() <= i.height - 0.5, (d.name, k)
