"""The ellipsoid of a position and the sigmas of a turn: laws of covariances."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import ObjectPose
from realsim.review.placing.ellipsoid import ellipsoid_of, middle_of, pose_sigmas, unit_sphere
from refusals import refused

MUG = part("mug")
TUBE = replace(part("tube"), symmetry_axes=(((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),))


def covariance(seed: int) -> Array:
    A = np.random.default_rng(seed).normal(size=(6, 6))
    S = np.diag([0.02] * 3 + [0.001] * 3)
    return S @ A @ A.T @ S


def at(T: Array, C: Array | None) -> ObjectPose:
    return ObjectPose(obj_id=1, instance=0, T_world_obj=T, covariance=C)


def shape_of(placed: ObjectPose, **more: float) -> Array:
    """Return the ellipsoid's quadratic form (3, 3) in world: its axes' signs do not matter."""
    found = ellipsoid_of(placed, model=MUG, **more)
    assert found is not None
    A = found.T_world_ellipsoid[:3, :3] * found.radii_m
    return A @ A.T


def test_the_ellipsoid_is_the_spread_of_the_middle_of_sampled_poses() -> None:
    rng = np.random.default_rng(0)
    C = 1e-2 * covariance(1)  # small, so that the exponential is linear
    T = se3.random_transform(rng)
    xi = rng.multivariate_normal(np.zeros(6), C, size=60_000)
    c = middle_of(MUG)
    Ts = T @ se3.exp(xi)
    spread = np.cov((Ts[:, :3, :3] @ c + Ts[:, :3, 3]).T)
    found = shape_of(at(T, C), sigmas=1.0)
    np.testing.assert_allclose(found, spread, atol=0.02 * np.abs(spread).max())


def test_it_does_not_depend_on_where_the_object_s_frame_lies() -> None:
    """T exp(xi) = T D D^-1 exp(xi): the same uncertainty, told in the frame of a moved mesh."""
    T, D = se3.random_transform(np.random.default_rng(4), 2)
    C = covariance(4)
    shift = se3.from_translation(D[:3, 3])
    Ad = se3.adjoint(se3.invert(shift))
    mesh = replace(MUG.mesh, vertices=se3.transform(se3.invert(shift), MUG.mesh.vertices))
    moved = ellipsoid_of(at(T @ shift, Ad @ C @ Ad.T), model=replace(MUG, mesh=mesh))
    found = ellipsoid_of(at(T, C), model=MUG)
    assert found is not None and moved is not None
    np.testing.assert_allclose(moved.radii_m, found.radii_m, rtol=1e-9)
    off = moved.T_world_ellipsoid[:3, 3] - found.T_world_ellipsoid[:3, 3]
    np.testing.assert_allclose(off, 0.0, atol=1e-12)


def test_a_turn_about_the_own_axis_does_not_blur_the_middle_nor_count_as_a_turn() -> None:
    C = np.diag([0.01, 0.02, 0.0, 1e-4, 1e-4, 1e-4]) ** 2
    blurred = C.copy()
    blurred[2, 2] = 1.0
    # Off the axis by a mark, as bounds of scanned meshes are.
    v = np.concatenate([TUBE.mesh.vertices, [[0.05, 0.0, 0.0]]])
    model = replace(TUBE, mesh=replace(TUBE.mesh, vertices=v, colors=None, uv=None, texture=None))
    assert np.linalg.norm(model.mesh.bounds.mean(0)[:2]) > 1e-3
    sharp, same = (ellipsoid_of(at(np.eye(4), c), model=model) for c in (C, blurred))
    assert sharp is not None and same is not None
    np.testing.assert_allclose(same.radii_m, sharp.radii_m)
    turn = pose_sigmas(at(np.eye(4), blurred), model)
    assert turn is not None
    np.testing.assert_allclose(turn.sigmas_deg, np.degrees([0.02, 0.01]))
    assert "own axis" in turn.words and "left out" in turn.words
    plain = pose_sigmas(at(np.eye(4), blurred), replace(model, symmetry_axes=()))
    assert plain is not None
    np.testing.assert_allclose(plain.sigmas_deg, np.degrees([1.0, 0.02, 0.01]))


def test_without_a_covariance_there_is_none() -> None:
    placed = at(np.eye(4), None)
    assert ellipsoid_of(placed) is None
    assert pose_sigmas(placed, MUG) is None
    refused("positive", ellipsoid_of, at(np.eye(4), covariance(8)), sigmas=0.0)


@pytest.mark.parametrize("divisions", [0, 2])
def test_the_sphere_is_closed_and_turned_outwards(divisions: int) -> None:
    sphere = unit_sphere(divisions)
    assert len(sphere.faces) == 20 * 4**divisions
    np.testing.assert_allclose(np.linalg.norm(sphere.vertices, axis=1), 1.0)
    assert trimesh.Trimesh(sphere.vertices, sphere.faces, process=False).is_volume
    refused("0 to 5", unit_sphere, 9)
