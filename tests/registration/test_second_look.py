"""A joint fit is looked at again: what it shows to be wrong with its inputs leaves it."""

from dataclasses import replace

import numpy as np
import pytest

from fault_sessions import load_benchmark
from realsim.geometry import se3
from realsim.records import Mesh, ObjectPose
from realsim.registration.second_look import far_moved
from table_scenes import QUICK, errors_mm, named_scene, register

NAMES = ("gear", "box", "mug")
shapes = load_benchmark("outside_shapes")
lab = load_benchmark("outside_lab")


@pytest.fixture(scope="module")
def scene():
    return named_scene(3, NAMES, 9)


def registered(scene, *starts, **other):
    near = [
        replace(t, T_world_obj=t.T_world_obj @ se3.exp([0.02, 0, 0.03, 0.003, -0.002, 0.002]))
        for t in scene.truth
    ]
    return register(scene, [*near, *starts], **other)


def worst_mm(scene, found):
    errors = errors_mm(scene, found.scene.objects)
    return max(errors[t.instance] for t in scene.truth)


def with_a_larger(scene, obj_id, factor, about):
    """Return the models, one of them that many times as large."""
    model = scene.models[obj_id]
    larger = Mesh(vertices=(model.mesh.vertices - about) * factor + about, faces=model.mesh.faces)
    return {**scene.models, obj_id: replace(model, mesh=larger)}


@pytest.fixture(scope="module")
def plain(scene):
    return registered(scene)


@pytest.mark.slow
def test_a_view_whose_depth_lies_beside_its_image_is_named_and_left_out(scene, plain):
    frames = [*scene.frames]
    frames[5] = replace(frames[5], depth_m=np.roll(frames[5].depth_m, 9, axis=1))
    found = registered(scene, frames=frames)
    number = scene.frames[5].index
    said = [f.words for f in found.findings if getattr(f, "index", None) == number]
    assert any("left out" in words for words in said) and number not in found.cameras
    assert worst_mm(scene, found) < worst_mm(scene, plain) + 0.2


def test_an_object_that_is_not_there_does_not_pull_the_cameras(scene, plain):
    far = scene.truth[0].T_world_obj @ se3.from_translation([0.02, 0.02, 0.0])
    double = ObjectPose(obj_id=scene.truth[0].obj_id, instance=99, T_world_obj=far)
    found = registered(scene, double)
    assert len([o for o in found.scene.objects if o.instance != 99]) == len(NAMES)
    assert worst_mm(scene, found) < worst_mm(scene, plain) + 0.2
    for o in found.scene.objects:
        if o.instance == 99:
            assert o.verdict == "rejected" and "no part in the fit" in o.reasons[-1]


@pytest.mark.slow
def test_a_model_of_the_wrong_size_is_told_so(scene):
    big = scene.truth[1].obj_id
    found = registered(scene, models=with_a_larger(scene, big, 1.09, np.zeros(3)))
    of = {o.obj_id: o for o in found.scene.objects}
    assert of[big].verdict != "accepted"
    assert any("smaller than its model's" in r for r in of[big].reasons), of[big].reasons


def test_cameras_that_follow_a_model_of_the_wrong_size_leave_no_pose_accepted():
    pair = named_scene(3, ("tube", "knob"), 8)
    tube, knob = pair.truth
    middle = pair.models[tube.obj_id].mesh.vertices.mean(axis=0)
    found = registered(pair, models=with_a_larger(pair, tube.obj_id, 1.07, middle))
    by = {o.instance: o for o in found.scene.objects}
    off_mm = errors_mm(pair, found.scene.objects)[knob.instance]
    assert off_mm < 3.0 or {o.verdict for o in by.values()} <= {"doubtful", "rejected"}
    assert by[tube.instance].verdict != "accepted"


def test_cameras_are_moved_too_far_only_where_no_arm_explains_it():
    def kinds(moved_mm, arm_mm):
        config = replace(QUICK, arm_sigma_mm=arm_mm)
        return [f.kind for f in far_moved(np.full(8, moved_mm / 1e3), config)]

    assert kinds(1.0, None) == []
    assert kinds(2.0, None) == kinds(8.0, 3.0) == ["cameras_moved"]
    assert kinds(8.0, None) == kinds(8.0, 0.1) == ["cameras_far"]


@pytest.mark.slow
def test_a_plane_on_objects_alone_is_no_table():
    ids = {name: i for i, (name, *_) in enumerate(shapes.SHAPES.items(), start=1)}
    picked = [ids[n] for n in ("plate_5", "lid", "can", "stairs")]
    bare = lab.make_scene(4, lab.Lab(table="none", views=10), ids=picked)
    rng = np.random.default_rng(0)
    near = np.repeat([np.radians(3.0), 0.003], 3)
    starts = [
        replace(t, T_world_obj=t.T_world_obj @ se3.exp(near * rng.normal(size=6)))
        for t in bare.truth
    ]
    found = register(bare, starts)
    assert found.scene.plane is None
    assert not [f for f in found.findings if "sink" in f.words or "float" in f.words]
    assert len(found.scene.objects) == len(picked)
