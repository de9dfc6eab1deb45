"""Laws and accuracy of the joint registration on synthetic scenes."""

import json
from dataclasses import replace

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.metrics import mssd
from realsim.records import ObjectPose
from realsim.registration.blind import CovarianceConfig
from realsim.registration.register import DepthFrame, register_scene
from table_scenes import QUICK

CONFIG = replace(QUICK, covariance=CovarianceConfig(correlation_area_px=1.0))


def errors_mm(scene, objects):
    return [
        1e3
        * float(
            mssd(
                t.T_world_obj,
                o.T_world_obj,
                scene.models[t.obj_id].mesh.vertices,
                scene.models[t.obj_id].symmetries,
            )
        )
        for t, o in zip(scene.truth, objects, strict=True)
    ]


def run(scene, starts, frames=None, config=CONFIG, **kwargs):
    frames = scene.frames if frames is None else frames
    return register_scene("s", scene.intrinsics, frames, scene.models, starts, config, **kwargs)


@pytest.fixture(scope="module")
def starts(clutter):
    return clutter.starts(np.random.default_rng(0))


@pytest.fixture(scope="module")
def result(clutter, starts):
    return run(clutter, starts, config=replace(CONFIG, with_single_view=True))


def test_rough_start_ends_at_the_truth_and_beats_one_view(clutter, result):
    joint = errors_mm(clutter, result.scene.objects)
    single = errors_mm(clutter, result.single_view.objects)
    assert max(joint) < 0.5
    assert np.median(single) > 3 * np.median(joint)
    assert all(o.verdict == "accepted" for o in result.scene.objects)
    json.dumps(result.report)


@pytest.mark.slow
def test_the_answer_moves_with_the_world(clutter, starts, result):
    T = se3.random_transform(np.random.default_rng(3))
    frames = [
        DepthFrame(index=f.index, depth_m=f.depth_m, T_world_cam=T @ f.T_world_cam)
        for f in clutter.frames
    ]
    moved = [
        ObjectPose(obj_id=s.obj_id, instance=s.instance, T_world_obj=T @ s.T_world_obj)
        for s in starts
    ]
    there = run(clutter, moved, frames)
    for a, b in zip(result.scene.objects, there.scene.objects, strict=True):
        vertices = clutter.models[a.obj_id].mesh.vertices
        assert 1e3 * mssd(T @ a.T_world_obj, b.T_world_obj, vertices) < 0.05


@pytest.mark.slow
def test_order_of_frames_and_objects_does_not_matter(clutter, starts, result):
    other = run(clutter, starts[::-1], clutter.frames[::-1])
    for a in result.scene.objects:
        b = other.scene.object(a.instance)
        np.testing.assert_allclose(a.T_world_obj, b.T_world_obj, atol=1e-6)


def test_covariance_is_of_the_size_of_the_errors(clutter, result):
    ratios = []
    for t, o in zip(clutter.truth, result.scene.objects, strict=True):
        xi = se3.log(se3.invert(t.T_world_obj) @ o.T_world_obj)
        assert o.covariance is not None
        assert np.all(np.linalg.eigvalsh(o.covariance) > 0)
        ratios.append(float(xi @ np.linalg.solve(o.covariance, xi)) / 6)
    # Six degrees of freedom: 1 on average; the floor and the 0.6 mm make it careful, not careless.
    assert np.mean(ratios) < 3.0
    assert np.max(ratios) > 0.005
