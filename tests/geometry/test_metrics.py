"""Errors that know symmetries: laws, and agreement with the definition by brute force."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import trimesh_solids
from realsim.geometry import metrics, se3
from realsim.geometry.mesh import hull_vertices, sample_surface, symmetry_transforms
from realsim.geometry.parts import part
from realsim.geometry.symmetric_poses import nearest_symmetry
from realsim.records import CameraIntrinsics, ObjectModel
from refusals import refused

FINE_RAD = np.radians(0.01)
CAMERA = CameraIntrinsics(width=640, height=360, fx=324.0, fy=324.0, cx=319.5, cy=179.5)


def ring(radius: float, height: float, sides: int = 720) -> np.ndarray:
    """Return the rims of a cylinder about z (2 sides, 3)."""
    angles = 2 * np.pi * np.arange(sides) / sides
    rim = np.stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles], -1)
    return np.concatenate([rim - np.array([0, 0, height / 2]), rim + np.array([0, 0, height / 2])])


def ball(radius: float, center: np.ndarray) -> ObjectModel:
    """Return a sphere as the symmetry finder describes it: three axes through its centre."""
    at = (float(center[0]), float(center[1]), float(center[2]))
    axes = tuple((axis, at) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    mesh = trimesh_solids.ball(radius, at=at)
    return ObjectModel(obj_id=1, name="ball", mesh=mesh, symmetry_axes=axes)


def small_motion(rng: np.random.Generator, deg: float = 3.0, mm: float = 3.0) -> np.ndarray:
    turn = np.radians(deg) * rng.standard_normal(3)
    return se3.exp(np.concatenate([turn, mm / 1e3 * rng.standard_normal(3)]))


@pytest.mark.parametrize("name", ["cube", "gear", "bowl", "mug"])
def test_every_symmetry_of_a_part_costs_nothing(name: str):
    rng = np.random.default_rng(1)
    model, T = part(name), se3.random_transform(rng)
    group = symmetry_transforms(model, 0.37)
    for S in group[rng.choice(len(group), min(4, len(group)), replace=False)]:
        assert metrics.mssd_symmetric(T, T @ S, model) < 1e-8
        np.testing.assert_allclose(metrics.aligned_pose(T, T @ S, model), T, atol=1e-6)
    # Nothing is declared here, and the surface still falls on itself: to the flatness of a facet.
    assert metrics.add_s(T, T @ group[-1], model) < 1e-4


@pytest.mark.parametrize(("name", "deg", "mm"), [("cylinder_can", 80.0, 60.0), ("bowl", 0.5, 1.0)])
def test_an_axis_gives_what_sampling_every_hundredth_of_a_degree_gives(
    name: str, deg: float, mm: float
):
    rng = np.random.default_rng(2)
    model = part(name)
    v = hull_vertices(model.mesh.vertices)
    group = symmetry_transforms(model, FINE_RAD)
    for _ in range(2):
        T, E = np.eye(4), small_motion(rng, deg, mm)
        exact = metrics.mssd_symmetric(T, E, model)
        # Screened: all turns by the 20 corners that are worst, then the best of them by all.
        rough = np.stack([np.linalg.norm(
            se3.transform(E, p) - (group[:, :3, :3] @ p + group[:, :3, 3]), axis=1
        ) for p in v[rng.choice(len(v), 20)]]).max(axis=0)  # fmt: skip
        sampled = metrics.mssd(T, E, v, group[np.argsort(rough)[:3000]])
        radius = np.linalg.norm(v[:, :2], axis=1).max()
        assert sampled - FINE_RAD * radius <= exact <= sampled + 1e-9


def test_known_answers_of_a_cylinder():
    v, axis = ring(0.03, 0.1), [((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))]
    for shift in ([0.002, 0, 0], [0, 0, 0.004], [0.003, 0, 0.004]):
        turned = se3.from_rt(se3.exp_so3([0, 0, 1.234]), shift)
        near = nearest_symmetry(np.eye(4), turned, v, None, axis)
        assert near.distance_m == pytest.approx(np.linalg.norm(shift), rel=1e-6)
    # Tilted by a about x, every rim point moves by 2 sin(a/2) of its distance from the x axis.
    a = np.radians(2.0)
    tilted = se3.from_rt(se3.exp_so3([0, 0, 2.0]) @ se3.exp_so3([a, 0, 0]), np.zeros(3))
    near = nearest_symmetry(np.eye(4), tilted, v, None, axis)
    assert near.distance_m == pytest.approx(2 * np.sin(a / 2) * np.hypot(0.05, 0.03), rel=1e-5)
    # Upside down it is another object, unless it flips.
    flip = se3.from_rt(se3.exp_so3([np.pi, 0, 0]), np.zeros(3))
    upright = v + np.array([0, 0, 0.02])
    assert nearest_symmetry(np.eye(4), flip, upright, None, axis).distance_m > 0.039
    near = nearest_symmetry(np.eye(4), turned @ flip, v, np.stack([np.eye(4), flip]), axis)
    assert near.distance_m == pytest.approx(0.005, rel=1e-6)


def test_an_axis_off_the_origin_turns_about_its_own_point():
    point = np.array([0.07, -0.02, 0.01])
    v = ring(0.03, 0.1) + point
    R = se3.exp_so3([0, 0, 2.2])
    turn = se3.from_rt(R, point - R @ point)
    near = nearest_symmetry(np.eye(4), turn, v, None, [((0, 0, -3.0), tuple(point))])
    assert near.distance_m < 1e-8
    assert nearest_symmetry(np.eye(4), turn, v).distance_m > 0.05


def test_of_a_ball_only_the_distance_of_the_centres_counts():
    rng = np.random.default_rng(3)
    center = np.array([0.01, 0.02, -0.03])
    model = ball(0.04, center)
    for _ in range(20):
        T, E = se3.random_transform(rng), se3.random_transform(rng)
        apart = np.linalg.norm(se3.transform(T, center[None]) - se3.transform(E, center[None]))
        assert metrics.mssd_symmetric(T, E, model) == pytest.approx(apart, rel=1e-9)
        aligned = metrics.aligned_pose(T, E, model)
        assert metrics.rotation_error_deg(T, aligned) < 1e-5
        assert metrics.translation_error_mm(T, aligned) == pytest.approx(1e3 * apart, rel=1e-9)


def test_axes_that_coincide_are_one_and_axes_that_pass_each_other_are_refused():
    rng = np.random.default_rng(4)
    v = ring(0.03, 0.1)
    E = small_motion(rng)
    one = nearest_symmetry(np.eye(4), E, v, None, [((0, 0, 1), (0, 0, 0))])
    same = [((0, 0, 1), (0, 0, 0)), ((0, 0, -2), (0, 0, 0.4))]
    assert nearest_symmetry(np.eye(4), E, v, None, same).distance_m == one.distance_m
    for second in (((0, 0, 1), (0.01, 0, 0)), ((1, 0, 0), (0, 0.01, 0))):
        refused("apart", nearest_symmetry, np.eye(4), E, v, None, [((0, 0, 1), (0, 0, 0)), second])
    refused("no line", nearest_symmetry, np.eye(4), E, v, None, [((0, 0, 0), (0, 0, 0))])
    refused("S >= 1", nearest_symmetry, np.eye(4), E, v, np.zeros((0, 4, 4)))


@pytest.mark.parametrize("name", ["hex_nut", "bowl"])
def test_errors_belong_to_the_pair_of_poses_not_to_the_frame_or_the_symmetric_twin(name: str):
    rng = np.random.default_rng(5)
    model = part(name)
    group = symmetry_transforms(model, 0.7)
    for _ in range(4):
        T, C = se3.random_transform(rng), se3.random_transform(rng)
        E = T @ small_motion(rng, 20.0, 20.0)
        S = group[rng.integers(len(group))]
        e = metrics.mssd_symmetric(T, E, model)
        # Vertices of a ring lie a little inside a circle: turned, they are not quite themselves.
        rough = pytest.approx(e, rel=2e-3)
        assert metrics.mssd_symmetric(C @ T, C @ E, model) == pytest.approx(e, rel=1e-6)
        assert metrics.mssd_symmetric(T, E @ S, model) == rough
        assert metrics.mssd_symmetric(T @ S, E, model) == rough
        assert metrics.mssd_symmetric(E, T, model) == rough
        assert metrics.mssd(T, metrics.aligned_pose(T, E, model), model.mesh.vertices) == rough
        expected = pytest.approx(metrics.add_s(T, E, model), rel=1e-3)
        assert metrics.add_s(C @ T, C @ E, model) == expected


def test_without_axes_it_is_the_mssd_of_the_list_and_never_more_than_without_symmetry():
    rng = np.random.default_rng(6)
    for name in ("cube", "gear", "l_bracket"):
        model = part(name)
        v = model.mesh.vertices
        for _ in range(5):
            T, E = se3.random_transform(rng), se3.random_transform(rng)
            e = metrics.mssd_symmetric(T, E, model)
            assert e == pytest.approx(metrics.mssd(T, E, v, model.symmetries), rel=1e-12)
            assert e <= metrics.mssd(T, E, v) * (1 + 1e-12)


def test_a_way_is_never_shorter_than_the_error_between_its_ends():
    rng = np.random.default_rng(7)
    for name in ("cylinder_can", "cube", "mug"):
        model = part(name)
        way = [se3.random_transform(rng)]
        for _ in range(4):
            way.append(way[-1] @ small_motion(rng, 20.0, 20.0))
        steps = sum(metrics.mssd_symmetric(a, b, model) for a, b in pairwise(way))
        assert metrics.mssd_symmetric(way[0], way[-1], model) <= steps * 1.002


def test_add_s_has_no_floor_and_is_the_distance_of_parallel_faces():
    model = part("box")
    T = se3.random_transform(np.random.default_rng(8))
    assert metrics.add_s(T, T, model) < 1e-7
    assert metrics.add_s(T, T @ model.symmetries[1], model) < 1e-7
    # Pushed along its longest side nearly all faces slide in themselves: far below the push.
    k = int(np.argmax(model.mesh.extent))
    push = 0.001 * np.eye(3)[k]
    pushed = metrics.add_s(T, T @ se3.from_translation(push), model)
    normals = sample_surface(model.mesh, 20000, np.random.default_rng(1))[1]
    assert pushed == pytest.approx(0.001 * float(np.mean(np.abs(normals[:, k]))), rel=0.1)
    assert pushed <= metrics.mssd_symmetric(T, T @ se3.from_translation(push), model)


def test_pixels_of_a_known_shift_and_of_a_symmetric_twin():
    model = part("cylinder_can")
    points = sample_surface(model.mesh, 200, np.random.default_rng(9))[0]
    flat = points * [1, 1, 0]  # all of one depth
    T = se3.from_translation([0.02, -0.01, 0.4])
    shifted = se3.from_translation([0.001, 0, 0]) @ T
    assert metrics.reprojection_px(CAMERA, T, shifted, flat) == pytest.approx(324 * 0.001 / 0.4)
    turned = shifted @ symmetry_transforms(model, 0.1)[17]
    assert metrics.reprojection_px(CAMERA, T, turned, flat) > 5
    known = metrics.reprojection_px(CAMERA, T, turned, flat, model)
    assert known == pytest.approx(324 * 0.001 / 0.4, rel=1e-3)
    many = metrics.reprojection_px(CAMERA, T, np.stack([[T, shifted, shifted]]), flat)
    np.testing.assert_allclose(many, [[0, 0.81, 0.81]], atol=1e-9)
    behind = se3.from_translation([0, 0, -1])
    assert np.isnan(metrics.reprojection_px(CAMERA, behind, behind, flat))


def test_a_declared_symmetry_can_only_lower_the_error():
    model = part("bottle")
    rng = np.random.default_rng(10)
    T = se3.random_transform(rng)
    E = T @ small_motion(rng, 30.0, 5.0)
    bare = replace(model, symmetry_axes=())
    assert metrics.mssd_symmetric(T, E, model) < metrics.mssd_symmetric(T, E, bare)
