"""Robot School as a whole: sets, resumption, and the objects that cannot be tried."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.records.grasps import MEASURES
from realsim_sim_bridge.school import recompute_scores, run_school, run_school_results
from refusals import refused
from school_scenes import CONFIG, at, model, same_result, scene


@pytest.fixture(scope="module")
def one_result():
    return run_school_results(scene(at(0, 0)), {1: model()}, CONFIG, workers=1)[0]


@pytest.fixture(scope="module")
def one_set(one_result):
    return one_result.grasp_set


def test_a_box_gets_good_grasps_and_scores_that_follow_from_the_set(one_set):
    assert len(one_set) == 6 and one_set.good.sum() >= 2
    base, scores = recompute_scores(one_set)
    assert np.array_equal(scores, one_set.scores) and np.array_equal(base, one_set.base_scores)
    assert all(bool(f) == (s < 1) for f, s in zip(one_set.failures, one_set.scores, strict=True))
    assert np.all(one_set.scores[~one_set.reachable] == 0)
    stand = one_set.parameters["stand"]
    assert stand["table_height_m"] == pytest.approx(0.0, abs=1e-9)
    assert stand["neighbour_parts"] == 0 and "lost or a finger" in one_set.parameters["score_rule"]


def test_the_same_scene_elsewhere_in_the_world_gives_the_same_grasps(one_set):
    T = se3.exp([0.3, -0.2, 1.0, 0.5, 0.1, 0.4])
    there = replace(at(0, 0), T_world_obj=T @ at(0, 0).T_world_obj)
    moved = replace(scene(there), plane=SupportPlane(T_world_table=T))
    again = run_school(moved, {1: model()}, CONFIG, workers=1)[0]
    assert np.allclose(again.Ts_obj_grasp, one_set.Ts_obj_grasp, atol=1e-9)
    assert np.array_equal(again.reachable, one_set.reachable)


def test_every_grasp_that_was_tested_has_a_trajectory_and_measures(one_result):
    grasp_set, trajectories = one_result.grasp_set, one_result.trajectories
    assert np.array_equal(trajectories.rows, np.flatnonzero(grasp_set.reachable))
    joints = np.array(grasp_set.parameters["joints_rad"], dtype=float)
    for row in trajectories.rows:
        ways = trajectories.joints_rad[trajectories.attempt(row)]
        assert np.abs(ways - joints[row]).max(axis=1).min() < 1e-6
    found = list(grasp_set.measures)
    assert found == [name for name in MEASURES if name in found]
    wanted = {"force_n", "duration_s", "ferrari_canny", "closure_friction", "dexnet_closure"}
    assert wanted | {"score_paper", "p_hold"} <= set(found)
    # What is sure was not simulated: its slip is exactly 0.
    executed = grasp_set.slip_m > 0
    assert np.all(grasp_set.measures["force_n"][executed & (grasp_set.slip_m < 1)] > 1)
    assert np.all(np.isnan(grasp_set.measures["duration_s"][~executed]))
    assert one_result.unfinished == ()


def test_a_second_run_takes_everything_from_the_cache(tmp_path, one_result):
    def run():
        seen = []
        result = run_school_results(
            scene(at(0, 0)), {1: model()}, CONFIG, workers=1, cache=tmp_path,
            progress=lambda *report: seen.append(report),
        )[0]  # fmt: skip
        return result, seen

    first, seen = run()
    assert seen[0] == (0, 6) and seen[-1] == (6, 6)
    files = sorted(p.name for p in tmp_path.glob("instance_*"))
    assert files == ["instance_000000.grasps.npz"]
    made = (tmp_path / files[0]).stat().st_mtime_ns
    again, seen = run()
    assert seen == [(6, 6)] and (tmp_path / files[0]).stat().st_mtime_ns == made
    for result in (first, again):
        assert same_result(result, one_result)


def test_rejected_objects_are_obstacles_but_not_grasped():
    objects = scene(at(0, 0), at(0.06, 0, instance=1, verdict="rejected"))
    sets = run_school(objects, {1: model()}, CONFIG, workers=1)
    assert [s.instance for s in sets] == [0]
    assert sets[0].parameters["counts"]["hand_in_neighbour"] > 0
    stand = sets[0].parameters["stand"]
    assert stand["neighbour_parts"] == 1 and stand["neighbours_as_hulls"] == [1]


def test_objects_that_cannot_be_tried_say_why():
    boxes = model(1, density=1.0), model(2, density=1e6), model(3, size=0.3, density=100.0)
    models = {m.obj_id: m for m in boxes}
    objects = scene(at(0, 0), at(0.3, 0, 1, 2), at(-0.5, 0, 2, 3, 0.3))
    light, heavy, large = run_school(objects, models, CONFIG, workers=1)
    for grasp_set in (light, heavy):
        assert "kg is accepted" in grasp_set.parameters["not_tried"]
        assert len(grasp_set) and all("weighs" in f for f in grasp_set.failures)
        assert np.isnan(grasp_set.scores).all() and np.isnan(recompute_scores(grasp_set)[1]).all()
    assert len(large) == 0 and large.parameters["counts"]["too_wide"] > 0


def test_what_is_missing_is_named():
    bare = scene(at(0, 0), plane=False)
    refused("no supporting plane", run_school, bare, {1: model()}, CONFIG, workers=1)
    others = r"object 1 .* no model; there are: box2 \(2\)"
    refused(others, run_school, scene(at(0, 0)), {2: model(2)}, CONFIG, workers=1)
