"""Faults of views are named, and only those: every fault is done on purpose to simulated views."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.registration.body import make_body
from realsim.registration.evidence import DepthNoise
from realsim.registration.find_table import TableSearchConfig, find_table
from realsim.registration.simulated import table_scene
from realsim.registration.view_checks import ViewCheckConfig, check_views
from realsim.registration.views import SampleConfig, sample_views
from table_scenes import SMALL_LAB, part_models, small_scene

CONFIG = ViewCheckConfig()
NOISE = DepthNoise(per_m=0.008, floor_m=2e-4)
VIEWS = 16


@lru_cache(maxsize=4)
def views_of(seed: int):
    scene = small_scene(seed, 6, VIEWS)
    return sample_views(
        scene.intrinsics, scene.frames, NOISE, SampleConfig(stride=2, edge_reach_px=1)
    )


def findings(views, noise=NOISE, **more):
    plane = find_table(views, noise, TableSearchConfig()).plane
    return check_views(views, plane, noise, CONFIG, **more)


def with_pose(view, T):
    return replace(view, T_world_cam=T)


def off_by(view, mm: float, deg: float):
    T = se3.from_rt(se3.exp_so3(np.radians([deg, 0, 0])), [0, 0, mm / 1e3])
    return with_pose(view, view.T_world_cam @ T)


def kinds(found):
    return {f.index: f.kind for f in found}


@pytest.mark.parametrize(("seed", "views"), [(1, VIEWS), (1, 1), (1, 2)])
def test_sound_views_are_left_alone(seed, views):
    assert findings(views_of(seed)[:views]) == ()


def test_a_bad_hand_eye_is_no_fault_of_the_views():
    scene = small_scene(1, 6, VIEWS)
    config = replace(SMALL_LAB, views=VIEWS, hand_eye_mm=1.5, hand_eye_deg=0.4)
    bad = table_scene(part_models(), scene.truth, config, np.random.default_rng(4))
    views = sample_views(bad.intrinsics, bad.frames, NOISE, SampleConfig(stride=2, edge_reach_px=1))
    assert findings(views) == ()


def test_views_without_depth_are_named():
    views = list(views_of(1))
    none = replace(views[2], points=views[2].points[:0], pixels=views[2].pixels[:0])
    views[2] = replace(none, measured_share=0.0)
    views[5] = replace(
        views[5], points=views[5].points[:300], pixels=views[5].pixels[:300], measured_share=0.03
    )
    views[7] = replace(
        views[7], points=views[7].points[:20], pixels=views[7].pixels[:20], measured_share=0.01
    )
    found = findings(views)
    assert kinds(found) == {2: "no_depth", 5: "little_depth", 7: "little_depth"}
    assert [f.exclude for f in found] == [True, False, True]
    assert "empty" in found[0].words and "3.0 %" in found[1].words


@pytest.mark.parametrize(("mm", "deg"), [(15, 3)])
def test_a_view_with_a_displaced_camera_is_named(mm, deg):
    views = list(views_of(1))
    views[7] = off_by(views[7], mm, deg)
    found = findings(views)
    assert kinds(found) == {7: "table_off"} and found[0].exclude
    assert f"{deg:.0f}." in found[0].words  # the tilt is measured to the degree


def test_swapped_poses_are_named_with_their_partner():
    views = list(views_of(1))
    a, b = views[6], views[12]
    views[6], views[12] = with_pose(a, b.T_world_cam), with_pose(b, a.T_world_cam)
    found = findings(views)
    assert kinds(found) == {6: "pose_of_another", 12: "pose_of_another"}
    assert "that of view 12" in found[0].words and "that of view 6" in found[1].words


@pytest.mark.parametrize("wrong", [tuple(range(10, 16))])
def test_views_of_another_session_are_named(wrong):
    # The other session stood on the same table, its cameras where they are said to be.
    views = [views_of(2)[k] if k in wrong else v for k, v in enumerate(views_of(1))]
    found = findings(views)
    assert kinds(found) == dict.fromkeys(wrong, "foreign")
    assert all(f.exclude for f in found)


def test_two_views_that_disagree_are_not_told_apart():
    found = findings([views_of(1)[0], views_of(2)[1]])
    assert kinds(found) == {None: "all_disagree"} and not found[0].exclude
    assert "depth's unit" in found[0].words and "aligned to the colour" in found[0].words


def test_a_slipped_mount_is_named_with_the_view_it_begins_at():
    views = [off_by(v, 10, 3) if k >= 11 else v for k, v in enumerate(views_of(1))]
    found = findings(views)
    assert kinds(found) == dict.fromkeys(range(11, VIEWS), "slipped")
    assert "before view 11" in found[0].words


GL = np.diag([1.0, -1.0, -1.0, 1.0])


def in_mm(Ts):
    return se3.from_rt(Ts[:, :3, :3], 1e3 * Ts[:, :3, 3])


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (se3.invert, "world-to-camera: invert"),
        (lambda Ts: se3.invert(Ts @ GL), "world-to-camera with OpenGL's"),
        (in_mm, "camera poses seem to be in millimetres"),
        (lambda Ts: np.random.default_rng(0).permutation(Ts), "Neither inverted"),
    ],
)
def test_a_mistake_of_all_poses_is_named(mistake, words):
    wrong = mistake(np.stack([v.T_world_cam for v in views_of(1)]))
    found = findings([with_pose(v, T) for v, T in zip(views_of(1), wrong, strict=True)])
    assert kinds(found) == {None: "all_disagree"}
    assert words in found[0].words


@pytest.mark.parametrize(("factor", "words"), [(10.0, "too large")])
def test_a_wrong_depth_unit_is_named(factor, words):
    noise = DepthNoise(per_m=NOISE.per_m / factor, floor_m=NOISE.floor_m * factor)
    views = [replace(v, points=v.points * np.float32(factor)) for v in views_of(1)]
    found = findings(views, noise)
    assert kinds(found) == {None: "all_disagree"} and f"ten times {words}" in found[0].words


def test_after_registration_views_that_fit_no_object_are_named():
    scene = small_scene(1, 6, VIEWS)
    bodies = [make_body(p, scene.models[p.obj_id], 48, 200) for p in scene.truth]
    Ts = [p.T_world_obj for p in scene.truth]
    plane = find_table(views_of(1), NOISE, TableSearchConfig()).plane
    sound = check_views(views_of(1), plane, NOISE, CONFIG, bodies=bodies, Ts_world_obj=Ts)
    assert sound == ()
    # With the check against other views switched off, the objects alone tell.
    deaf = replace(CONFIG, partly_share=2.0, foreign_share=2.0)
    views = [*views_of(1)[:3], replace(views_of(2)[6], index=9)]
    found = check_views(views, plane, NOISE, deaf, bodies=bodies, Ts_world_obj=Ts)
    assert kinds(found) == {9: "objects_off"} and found[0].exclude


def test_senseless_calls_are_errors():
    with pytest.raises(InputError, match="no views"):
        check_views([], None, NOISE, CONFIG)
    with pytest.raises(InputError, match="0 objects have 1 poses"):
        check_views(views_of(1), None, NOISE, CONFIG, Ts_world_obj=[np.eye(4)])
