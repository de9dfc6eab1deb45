"""The camera beside the table: it sees all that happens, as near and as little hidden as can be."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records.trajectories import PHASES
from realsim_sim_bridge.demonstrations.front_view import (
    BORDER,
    FINGERS_M,
    FrontView,
    Happening,
    hidden,
    nearest_camera,
    placed_front,
    view_intrinsics,
)

CAMERA = view_intrinsics(40.0)
TOWARDS = np.array([1.0, 0.4, 0.6])


def some(seed, n=40):
    return np.random.default_rng(seed).uniform([-0.2, -0.1, 0], [0.2, 0.3, 0.4], (n, 3))


def a_grasp(arms, away=(1.0, 0.0)):
    grasp = np.array([[0.0, 0.0, 0.05]])
    return Happening(
        standing=some(1) * [1, 1, 0.2], moving=some(2), grasps=grasp,
        hands=grasp[:, None] + [0.0, 0.0, 0.1], arms=np.array(arms, float).reshape(1, -1, 3),
        away_from_base=np.array(away),
    )  # fmt: skip


def test_the_nearest_camera_sees_all_and_no_nearer_one_does():
    points = some(0)
    T = nearest_camera(points, TOWARDS, CAMERA)
    p = se3.transform(se3.invert(T), points)
    uv = project(CAMERA, p)
    edge = BORDER * np.array([CAMERA.width, CAMERA.height])
    low, high = edge - 0.5, np.array([CAMERA.width, CAMERA.height]) - edge - 0.5
    assert p[:, 2].min() > 0 and (uv > low - 1e-6).all() and (uv < high + 1e-6).all()
    # It touches two opposite borders, so that no camera nearer along its axis has room for all.
    assert np.any(np.isclose(uv.min(axis=0), low) & np.isclose(uv.max(axis=0), high))


def test_a_scene_that_is_elsewhere_is_seen_alike():
    moved = se3.exp([0.0, 0.0, 0.7, 0.3, -0.2, 0.0])
    T = nearest_camera(some(0), TOWARDS, CAMERA)
    again = nearest_camera(se3.transform(moved, some(0)), moved[:3, :3] @ TOWARDS, CAMERA)
    np.testing.assert_allclose(again, moved @ T, atol=1e-9)


def test_an_arm_between_camera_and_grasp_hides_it_and_one_behind_does_not():
    eye = np.array([1.0, 0.0, 0.5])
    between, behind = a_grasp([[0.5, 0.02, 0.275]]), a_grasp([[-0.5, 0.0, -0.2]])
    assert hidden(between, eye).tolist() == [True]
    assert hidden(behind, eye).tolist() == [False]
    assert hidden(between, np.array([0.0, 1.0, 0.5])).tolist() == [False]


def test_the_camera_goes_to_the_side_that_the_arm_leaves_free():
    # An arm that reaches around: it comes from the side opposite its base, and from one more.
    line = np.linspace(0.1, 0.6, 12)[:, None]
    wall = [line * [np.cos(a), np.sin(a), 0.6] + [0, 0, 0.05] for a in np.radians([0, -30, -60])]
    seen = a_grasp(np.concatenate([np.add(w, [0, 0, up]) for w in wall for up in (0.0, 0.1)]))
    camera = placed_front(FrontView(), seen)
    assert camera.T_frame_cam[1, 3] > 0.2
    assert not hidden(seen, camera.T_frame_cam[:3, 3]).any()
    turned = placed_front(FrontView(), replace(seen, away_from_base=np.array([-1.0, 0.0])))
    assert turned.T_frame_cam[0, 3] < 0


@pytest.mark.slow
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
