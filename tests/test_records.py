"""Records check once, at construction, and cannot be changed afterwards."""

import dataclasses

import numpy as np
import pytest

from realsim.errors import NotRigidError
from realsim.records import (
    CameraIntrinsics,
    CaptureSession,
    Mesh,
    ObjectModel,
    ObjectPose,
    Scene,
    TagBoard,
    View,
)
from refusals import refused
from tried_grasps import plain_grasps

CAMERA = CameraIntrinsics(width=64, height=48, fx=60, fy=60, cx=32, cy=24)
TRIANGLE = Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]]))


def test_arrays_are_private_read_only_copies():
    T = np.eye(4)
    view = View(index=0, T_base_ee=T)
    T[0, 3] = 5
    assert view.T_base_ee[0, 3] == 0
    with pytest.raises(ValueError, match="read-only"):
        view.T_base_ee[0, 3] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        view.index = 3


def test_records_can_be_compared_and_hashed_as_things():
    a, b = View(index=0, T_base_ee=np.eye(4)), View(index=0, T_base_ee=np.eye(4))
    assert a != b and a == a and len({a, b}) == 2


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: CameraIntrinsics(width=0, height=1, fx=1, fy=1, cx=0, cy=0), "image size"),
        (lambda: dataclasses.replace(CAMERA, width=1280.5), "size is 1280.5x48; whole numbers"),
        (lambda: dataclasses.replace(CAMERA, distortion=np.ones((2, 3))), r"shape \(2, 3\)"),
        (lambda: dataclasses.replace(CAMERA, distortion="plumb_bob"), "'plumb_bob'; numbers are"),
        (lambda: View(index="0"), "view is '0'; a whole number"),
        (lambda: View(index=0, joints="home"), "joints is 'home'; numbers are"),
        (lambda: ObjectPose(obj_id=5, instance=0, T_world_obj=np.eye(4), verdict="good"), "'good'"),
        (lambda: CameraIntrinsics(width=1, height=1, fx=-1, fy=1, cx=0, cy=0), "focal length fx"),
        (lambda: dataclasses.replace(CAMERA, distortion=np.ones(12)), "12 distortion coefficients"),
        (
            lambda: CaptureSession(name="s", intrinsics=CAMERA, depth_unit_m=1.0),
            "depth unit is 1.0",
        ),
        (
            lambda: CaptureSession(
                name="s", intrinsics=CAMERA, views=(View(index=1), View(index=1)), depth_unit_m=1e-3
            ),
            "two views",
        ),
        (lambda: TagBoard(rows=5, columns=7, tag_size_m=30, gap_m=6), "millimetres"),
        (lambda: TagBoard(rows=0, columns=7, tag_size_m=0.03, gap_m=0.01), "0x7"),
        (lambda: Mesh(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3))), "empty"),
        (lambda: Mesh(vertices=np.eye(3), faces=[[0, 1, 3]]), "vertex 3 of 3"),
        (lambda: Mesh(vertices=np.full((3, 3), np.nan), faces=[[0, 1, 2]]), "not finite"),
        (lambda: Mesh(vertices=np.eye(3), faces=[[0, 1, 2]], colors=np.ones((2, 3))), "colors"),
        (lambda: ObjectModel(obj_id=0, name="mug", mesh=TRIANGLE), "ids start at 1"),
        (lambda: ObjectModel(obj_id=1, name="mug", mesh=TRIANGLE, density=0), "density"),
        (lambda: plain_grasps(2, failures=("",)), "1 failure notes for 2 grasps"),
        (lambda: plain_grasps(2, widths_m=np.ones(3)), "widths_m"),
        (
            lambda: Scene(
                name="s",
                objects=tuple(
                    ObjectPose(obj_id=i, instance=0, T_world_obj=np.eye(4)) for i in (1, 2)
                ),
            ),
            "same instance number",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, says):
    refused(says, make)


def test_a_scaled_pose_is_not_a_pose():
    with pytest.raises(NotRigidError, match="T_world_obj of object 4"):
        ObjectPose(obj_id=4, instance=0, T_world_obj=np.diag([2.0, 2, 2, 1]))


def test_lookups_name_what_there_is():
    session = CaptureSession(
        name="s", intrinsics=CAMERA, views=(View(index=3), View(index=7)), depth_unit_m=1e-3
    )
    assert session.view(7).index == 7
    refused("3, 7", session.view, 4)
    scene = Scene(name="s", objects=(ObjectPose(obj_id=1, instance=2, T_world_obj=np.eye(4)),))
    assert scene.object(2).obj_id == 1
    refused("it has 2", scene.object, 0)


def test_tag_corners_are_where_the_board_says():
    board = TagBoard(rows=2, columns=3, tag_size_m=0.03, gap_m=0.01)
    assert board.ids.tolist() == [0, 1, 2, 3, 4, 5]
    corners = board.corners_board
    np.testing.assert_allclose(corners[0], [[0, 0, 0], [0.03, 0, 0], [0.03, 0.03, 0], [0, 0.03, 0]])
    np.testing.assert_allclose(corners[4, 0], [0.04, 0.04, 0])
    np.testing.assert_allclose(corners[-1].max(axis=0)[:2], board.size_m)


def test_only_scores_from_one_half_are_good():
    g = plain_grasps(4, scores=np.array([0.5, 0.49, np.nan, 1.0]))
    assert g.good.tolist() == [True, False, False, True]


def test_short_distortions_are_filled_with_zeros():
    c = dataclasses.replace(CAMERA, distortion=np.array([0.1, -0.2]))
    assert c.distortion.tolist() == [0.1, -0.2, 0, 0, 0, 0, 0, 0] and c.is_distorted
    assert not CAMERA.is_distorted
