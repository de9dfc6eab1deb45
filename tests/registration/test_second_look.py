"""A joint fit is looked at again: what it shows to be wrong with its inputs leaves it."""

from dataclasses import replace

import numpy as np
import pytest

from fault_sessions import load_benchmark
from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.records import Mesh, ObjectPose
from realsim.registration.register import register_scene
from realsim.registration.second_look import far_moved
from table_scenes import QUICK, named_scene

NAMES = ("gear", "box", "mug")
shapes = load_benchmark("outside_shapes")
lab = load_benchmark("outside_lab")


@pytest.fixture(scope="module")
def scene():
    return named_scene(3, NAMES, 9)


def registered(scene, frames, models=None, starts=()):
    near = [
        replace(t, T_world_obj=t.T_world_obj @ se3.exp([0.02, 0, 0.03, 0.003, -0.002, 0.002]))
        for t in scene.truth
    ]
    return register_scene(
        "x", scene.intrinsics, frames, models or scene.models, [*near, *starts], QUICK
    )


def worst_mm(scene, found):
    by = {o.instance: o.T_world_obj for o in found.scene.objects}
    return 1e3 * max(
        mssd_symmetric(t.T_world_obj, by[t.instance], scene.models[t.obj_id]) for t in scene.truth
    )


@pytest.fixture(scope="module")
def plain(scene):
    return registered(scene, scene.frames)


@pytest.mark.slow
def test_a_view_whose_depth_lies_beside_its_image_is_named_and_left_out(scene, plain):
    aside = np.roll(scene.frames[5].depth_m, 9, axis=1)
    frames = [*scene.frames]
    frames[5] = replace(frames[5], depth_m=aside)
    found = registered(scene, frames)
    number = scene.frames[5].index
    said = [f.words for f in found.findings if getattr(f, "index", None) == number]
    assert any("left out" in words for words in said) and number not in found.cameras
    assert worst_mm(scene, found) < worst_mm(scene, plain) + 0.2


def test_an_object_that_is_not_there_does_not_pull_the_cameras(scene, plain):
    far = scene.truth[0].T_world_obj @ se3.from_translation([0.02, 0.02, 0.0])
    double = ObjectPose(obj_id=scene.truth[0].obj_id, instance=99, T_world_obj=far)
    found = registered(scene, scene.frames, starts=[double])
    others = [o for o in found.scene.objects if o.instance != 99]
    assert len(others) == len(NAMES)
    assert worst_mm(scene, found) < worst_mm(scene, plain) + 0.2
    for o in found.scene.objects:
        if o.instance == 99:
            assert o.verdict == "rejected" and "no part in the fit" in o.reasons[-1]


@pytest.mark.slow
def test_a_model_of_the_wrong_size_is_told_so(scene):
    big = scene.truth[1].obj_id
    models = dict(scene.models)
    mesh = models[big].mesh
    models[big] = replace(
        models[big], mesh=Mesh(vertices=mesh.vertices * 1.09, faces=mesh.faces)
    )  # fmt: skip
    found = registered(scene, scene.frames, models)
    of = {o.obj_id: o for o in found.scene.objects}
    assert of[big].verdict != "accepted"
    assert any("smaller than its model's" in r for r in of[big].reasons), of[big].reasons


def test_cameras_that_follow_a_model_of_the_wrong_size_leave_no_pose_accepted():
    pair = named_scene(3, ("tube", "knob"), 8)
    tube, knob = pair.truth
    models = dict(pair.models)
    mesh = models[tube.obj_id].mesh
    middle = mesh.vertices.mean(axis=0)
    large = Mesh(vertices=(mesh.vertices - middle) * 1.07 + middle, faces=mesh.faces)
    models[tube.obj_id] = replace(models[tube.obj_id], mesh=large)
    found = registered(pair, pair.frames, models)
    by = {o.instance: o for o in found.scene.objects}
    placed = by[knob.instance].T_world_obj
    off_mm = 1e3 * mssd_symmetric(knob.T_world_obj, placed, pair.models[knob.obj_id])
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
    found = register_scene("x", bare.intrinsics, bare.frames, bare.models, starts, QUICK)
    assert found.scene.plane is None
    assert not [f for f in found.findings if "sink" in f.words or "float" in f.words]
    assert len(found.scene.objects) == len(picked)
