"""Robot School as a whole: sets, resumption, and the objects that cannot be tried."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import Mesh, ObjectModel, ObjectPose, Scene, SupportPlane
from realsim_sim_bridge.school import SchoolConfig, recompute_scores, run_school
from realsim_sim_bridge.grasping.candidates import CandidateConfig

CONFIG = SchoolConfig(max_candidates=6, candidates=CandidateConfig(surface_points=200))


def box(size=0.05):
    import trimesh

    shape = trimesh.creation.box((size, size, size))
    return Mesh(vertices=np.array(shape.vertices), faces=np.array(shape.faces))


def model(obj_id=1, size=0.05, **kwargs):
    return ObjectModel(obj_id=obj_id, name=f"box{obj_id}", mesh=box(size), **kwargs)


def at(x, y, instance=0, obj_id=1, size=0.05, **kwargs):
    T = se3.from_translation([x, y, size / 2])
    return ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T, **kwargs)


def scene(*objects, plane=True):
    table = SupportPlane(T_world_table=np.eye(4)) if plane else None
    return Scene(name="test", objects=objects, plane=table)


def same(a, b):
    return all(
        np.array_equal(getattr(a, f), getattr(b, f), equal_nan=True)
        for f in ("Ts_obj_grasp", "scores", "base_scores", "slip_m", "slip_rad")
    ) and (a.failures, a.parameters) == (b.failures, b.parameters)


@pytest.fixture(scope="module")
def one_set():
    return run_school(scene(at(0, 0)), {1: model()}, CONFIG, workers=1)[0]


def test_a_box_gets_good_grasps_and_scores_that_follow_from_the_set(one_set):
    assert len(one_set) == 6 and one_set.good.sum() >= 2
    base, scores = recompute_scores(one_set)
    assert np.array_equal(scores, one_set.scores) and np.array_equal(base, one_set.base_scores)
    assert all(bool(f) == (s < 1) for f, s in zip(one_set.failures, one_set.scores, strict=True))
    assert np.all(one_set.scores[~one_set.reachable] == 0)


def test_all_parameters_stand_beside_the_grasps(one_set):
    p = one_set.parameters
    assert p["config"]["slip"]["physics"]["force_n"] == 70.0
    assert p["config"]["slip"]["motion"]["lift_height_m"] == 0.2
    assert p["mass_kg"] == pytest.approx(0.125) and p["counts"]["kept"] == 6
    assert len(p["openings_m"]) == 6 and len(p["joints_rad"]) == 6


def test_the_same_scene_elsewhere_in_the_world_gives_the_same_grasps(one_set):
    T = se3.exp([0.3, -0.2, 1.0, 0.5, 0.1, 0.4])
    moved = Scene(
        name="moved",
        objects=(ObjectPose(obj_id=1, instance=0, T_world_obj=T @ at(0, 0).T_world_obj),),
        plane=SupportPlane(T_world_table=T),
    )
    again = run_school(moved, {1: model()}, CONFIG, workers=1)[0]
    assert np.allclose(again.Ts_obj_grasp, one_set.Ts_obj_grasp, atol=1e-9)
    assert np.array_equal(again.reachable, one_set.reachable)


def test_a_second_run_takes_everything_from_the_cache(tmp_path, one_set, monkeypatch):
    from realsim_sim_bridge.school import school

    objects = scene(at(0, 0))
    first = run_school(objects, {1: model()}, CONFIG, workers=1, cache=tmp_path)[0]
    assert same(first, one_set)
    assert [p.name.split(".")[1] for p in tmp_path.glob("instance_*")] == ["grasps"]

    def never(*_):
        raise AssertionError("the work was done again")

    monkeypatch.setattr(school, "prepare", never)
    seen = []
    again = run_school(
        objects,
        {1: model()},
        CONFIG,
        workers=1,
        cache=tmp_path,
        progress=lambda d, n: seen.append((d, n)),
    )
    assert same(again[0], one_set) and seen[-1] == (6, 6)
    with pytest.raises(AssertionError, match="again"):
        other = replace(CONFIG, seed=1)
        run_school(objects, {1: model()}, other, workers=1, cache=tmp_path)


def test_a_run_that_died_in_the_slip_test_goes_on_after_it(tmp_path, one_set, monkeypatch):
    from realsim_sim_bridge.school import object_task, school

    def dies(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as m, pytest.raises(KeyboardInterrupt):
        m.setattr(school, "slips_of_rows", dies)
        run_school(scene(at(0, 0)), {1: model()}, CONFIG, workers=1, cache=tmp_path)
    assert [p.name.split(".")[1] for p in tmp_path.glob("instance_*")] == ["prepared"]
    monkeypatch.setattr(object_task, "sample_candidates", dies)
    resumed = run_school(scene(at(0, 0)), {1: model()}, CONFIG, workers=1, cache=tmp_path)[0]
    assert same(resumed, one_set)


def test_rejected_objects_are_obstacles_but_not_grasped():
    objects = scene(at(0, 0), at(0.06, 0, instance=1, verdict="rejected"))
    sets = run_school(objects, {1: model()}, CONFIG, workers=1)
    assert [s.instance for s in sets] == [0]
    assert sets[0].parameters["counts"]["hand_in_neighbour"] > 0


def test_objects_that_cannot_be_tried_say_why():
    models = {
        1: model(1, density=1.0),
        2: model(2, density=1e6),
        3: model(3, size=0.3, density=100.0),
    }
    objects = scene(at(0, 0), at(0.3, 0, 1, 2), at(-0.5, 0, 2, 3, 0.3))
    light, heavy, large = run_school(objects, models, CONFIG, workers=1)
    for grasp_set in (light, heavy):
        assert "kg is accepted" in grasp_set.parameters["not_tried"]
        assert len(grasp_set) and all("weighs" in f for f in grasp_set.failures)
        assert np.isnan(grasp_set.scores).all() and np.isnan(recompute_scores(grasp_set)[1]).all()
    assert len(large) == 0 and large.parameters["counts"]["too_wide"] > 0


def test_what_is_missing_is_named():
    with pytest.raises(InputError, match="no supporting plane"):
        run_school(scene(at(0, 0), plane=False), {1: model()}, CONFIG, workers=1)
    with pytest.raises(InputError, match=r"object 1 .* no model; there are: box2 \(2\)"):
        run_school(scene(at(0, 0)), {2: model(2)}, CONFIG, workers=1)


@pytest.mark.slow
def test_two_processes_give_the_same_as_one(one_set):
    objects = scene(at(0, 0), at(0.2, 0.1, instance=1))
    serial = run_school(objects, {1: model()}, CONFIG, workers=1)
    parallel = run_school(objects, {1: model()}, CONFIG, workers=2)
    assert all(same(a, b) for a, b in zip(serial, parallel, strict=True))
