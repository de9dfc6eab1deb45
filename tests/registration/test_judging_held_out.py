"""Held-out views: halves of the views find a right pose again and pull a wrong one apart."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.body import make_body
from realsim.registration.evidence import DepthNoise
from realsim.registration.judging.held_out import (
    HeldOutConfig,
    box_shift_m,
    half_fit,
    held_out,
    owned_points,
)
from realsim.registration.views import SampleConfig, sample_views
from table_scenes import named_scene

CONFIG = HeldOutConfig()
PLANE = SupportPlane(T_world_table=np.eye(4))
NOISE = DepthNoise(per_m=0.0069, floor_m=0.0002)


@pytest.fixture(scope="module")
def halved():
    """(bodies, true poses, a function poses -> HeldOut of each)."""
    scene = named_scene(5, ("wedge", "box", "mug"), 12)
    bodies = [make_body(p, scene.models[p.obj_id], 64, 300) for p in scene.truth]
    views = sample_views(scene.intrinsics, scene.frames, NOISE, SampleConfig(stride=1))

    def judge(poses):
        seen = (scene.intrinsics, views, scene.Ts_world_cam)
        owned = owned_points(bodies, poses, *seen, NOISE, PLANE, CONFIG)
        return held_out(bodies, owned, len(views), half_fit(bodies, poses, owned, CONFIG), CONFIG)

    return bodies, [p.T_world_obj for p in scene.truth], judge


def test_both_halves_find_a_right_pose(halved):
    bodies, poses, judge = halved
    for body, T, h in zip(bodies, poses, judge(poses), strict=True):
        assert h.shift_mm < 1.0
        assert h.agree > 0.97
        assert 1e3 * box_shift_m(body, T, h.Ts_world_obj[0]) < 1.0


def test_a_wrong_place_shows_on_unused_views(halved):
    _, poses, judge = halved
    right = judge(poses)[1]
    slid = se3.from_translation([0.02, 0.015, 0.01]) @ poses[1]
    wrong = judge([poses[0], slid, poses[2]])[1]
    assert not wrong.shift_mm < right.shift_mm or not wrong.agree >= right.agree
