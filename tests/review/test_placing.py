"""Placing by hand: steps that undo each other, points that agree, objects that touch the table."""

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import SupportPlane
from realsim.review.placing import placing
from refusals import refused

MUG = part("mug").mesh
MIDDLE = placing.middle_of(MUG)
KINDS: tuple[placing.Kind, ...] = ("move", "turn")
FRAMES: tuple[placing.Frame, ...] = ("table", "object", "camera")
STEPS = [(k, f, "y") for k in KINDS for f in FRAMES]


def random_poses(seed: int) -> tuple[Array, Array, Array]:
    T = se3.random_transform(np.random.default_rng(seed), 3)
    return T[0], T[1], T[2]


def step(
    T: Array,
    how: tuple[placing.Kind, placing.Frame, placing.Axis],
    amount: float,
    T_world_table: Array,
    T_world_cam: Array,
) -> Array:
    kind, frame, axis = how
    return placing.nudged(
        T, axis, amount, kind, frame, T_world_table=T_world_table, T_world_cam=T_world_cam,
        pivot_obj=MIDDLE,
    )  # fmt: skip


@pytest.mark.parametrize("how", STEPS)
def test_a_step_there_and_back_is_no_step(
    how: tuple[placing.Kind, placing.Frame, placing.Axis],
) -> None:
    T, table, cam = random_poses(1)
    there = step(T, how, 0.3, table, cam)
    assert np.abs(there - T).max() > 0.01
    np.testing.assert_allclose(step(there, how, -0.3, table, cam), T, atol=1e-14)


@pytest.mark.parametrize("how", STEPS)
def test_a_step_commutes_with_a_change_of_world(
    how: tuple[placing.Kind, placing.Frame, placing.Axis],
) -> None:
    T, table, cam = random_poses(2)
    W = se3.random_transform(np.random.default_rng(3))
    moved = step(W @ T, how, 0.2, W @ table, W @ cam)
    np.testing.assert_allclose(moved, W @ step(T, how, 0.2, table, cam), atol=1e-14)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_turn_leaves_the_middle_where_it_is(frame: placing.Frame) -> None:
    T, table, cam = random_poses(4)
    found = placing.moved(T, step(T, ("turn", frame, "y"), np.radians(5.0), table, cam), MUG)
    assert found.mm < 1e-10
    assert found.deg == pytest.approx(5.0)


def test_moves_go_along_the_named_axis() -> None:
    T, table, cam = random_poses(6)
    for frame, F in zip(FRAMES, (table, T, cam), strict=True):
        for k, axis in enumerate(placing.AXES):
            moved = step(T, ("move", frame, axis), 0.01, table, cam)
            np.testing.assert_allclose(moved[:3, 3] - T[:3, 3], 0.01 * F[:3, k], atol=1e-15)


def test_a_thousand_small_turns_leave_a_rigid_pose() -> None:
    T, table, cam = random_poses(7)
    for _ in range(1000):
        T = step(T, ("turn", "camera", "z"), 0.01, table, cam)
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-14)


def test_steps_that_are_none_are_refused() -> None:
    refused("camera", placing.nudged, np.eye(4), "x", 0.001, "move", "camera")
    refused("middle", placing.nudged, np.eye(4), "x", 0.001, "turn", "object")
    refused("finite", placing.nudged, np.eye(4), "x", float("nan"), "move", "object")
    for bad in (("w", "move", "table"), ("x", "stretch", "table"), ("x", "move", "moon")):
        axis, kind, frame = bad
        refused("accepted", placing.nudged, np.eye(4), axis, 0.1, kind, frame, pivot_obj=MIDDLE)


# --- points -----------------------------------------------------------------------------------

TRIANGLE = np.array([[0.04, 0.0, 0.0], [-0.03, 0.03, 0.01], [0.0, -0.03, 0.05]])


def test_exact_pairs_give_the_exact_pose() -> None:
    for n in (3, 4, 10):
        rng = np.random.default_rng(n)
        points = np.concatenate([TRIANGLE, rng.normal(scale=0.03, size=(n - 3, 3))])
        T = se3.random_transform(rng)
        found = placing.from_points(points, se3.transform(T, points))
        np.testing.assert_allclose(found.T_world_obj, T, atol=1e-12)
        assert found.rms_m < 1e-12


def test_points_are_equivariant_under_rigid_motions_of_either_side() -> None:
    rng = np.random.default_rng(8)
    T, A, B = se3.random_transform(rng, 3)
    world = se3.transform(T, TRIANGLE) + rng.normal(scale=5e-4, size=(3, 3))
    found = placing.from_points(TRIANGLE, world)
    moved = placing.from_points(se3.transform(A, TRIANGLE), se3.transform(B, world))
    np.testing.assert_allclose(moved.T_world_obj, B @ found.T_world_obj @ se3.invert(A), atol=1e-12)
    assert moved.rms_m == pytest.approx(found.rms_m)


def test_points_on_a_line_are_refused() -> None:
    line = np.outer([0.0, 0.02, 0.05], [1.0, 2.0, 0.5])
    refused(r"one line.*wide triangle", placing.from_points, line, line)
    refused("in the scene", placing.from_points, TRIANGLE, line)
    refused("one line", placing.from_points, np.zeros((3, 3)), np.zeros((3, 3)))


def test_the_pair_that_disagrees_is_named() -> None:
    world = TRIANGLE.copy()
    world[2] += 1.5 * (world[2] - world[0])
    refused(r"points 1 and 3 lie 70\.7 mm apart .* 176\.8 mm", placing.from_points, TRIANGLE, world)


def test_too_few_and_unequal_points_are_refused() -> None:
    refused("at least 3", placing.from_points, TRIANGLE[:2], TRIANGLE[:2])
    refused("no pairs", placing.from_points, TRIANGLE, TRIANGLE[:2])
    refused("finite", placing.from_points, TRIANGLE, TRIANGLE * np.nan)


# --- the table --------------------------------------------------------------------------------


def test_what_is_put_on_the_table_touches_it() -> None:
    T, table, _ = random_poses(10)
    plane = SupportPlane(T_world_table=table)
    down = placing.on_table(T, MUG, plane)
    assert abs(se3.transform(se3.invert(table) @ down, MUG.vertices)[:, 2].min()) < 1e-12
    np.testing.assert_array_equal(down[:3, :3], T[:3, :3])
    np.testing.assert_allclose(table[:3, :2].T @ (down[:3, 3] - T[:3, 3]), 0, atol=1e-12)
    np.testing.assert_allclose(placing.on_table(down, MUG, plane), down, atol=1e-14)
