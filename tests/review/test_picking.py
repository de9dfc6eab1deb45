"""What a click meets: invariant under motions of the world, the nearer thing before the farther."""

import numpy as np
import pytest

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.distance_field import raycasting_scene
from realsim.geometry.parts import part
from realsim.interop import import_open3d
from realsim.review.placing.picking import ray_on_cloud, ray_on_mesh
from refusals import refused

MUG = part("mug")
WEDGE = part("wedge")


def rays_at(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Return rays from half a metre off towards about the origin."""
    away = rng.normal(size=(n, 3))
    origins = 0.5 * away / np.linalg.norm(away, axis=1, keepdims=True)
    return origins, rng.normal(scale=0.03, size=(n, 3)) - origins


def test_a_mesh_is_hit_where_open3d_hits_it() -> None:
    o3d = import_open3d()
    origins, directions = rays_at(np.random.default_rng(0), 120)
    rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
    t = raycasting_scene(MUG.mesh).cast_rays(o3d.core.Tensor(rays), 1)["t_hit"].numpy()
    hits = 0
    for o, d, u in zip(origins, directions, t, strict=True):
        found = ray_on_mesh(o, d, MUG.mesh, np.eye(4))
        assert (found is not None) == bool(np.isfinite(u))
        if found is not None:
            np.testing.assert_allclose(found, o + u * d, atol=2e-6)
            hits += 1
    assert 20 < hits < 120


def test_the_point_on_the_object_does_not_depend_on_where_the_world_is() -> None:
    rng = np.random.default_rng(1)
    T, W = se3.random_transform(rng, 2)
    for o, d in zip(*rays_at(rng, 40), strict=True):
        o_world, d_world = se3.transform(T, o[None])[0], T[:3, :3] @ d
        at = ray_on_mesh(o_world, d_world, MUG.mesh, T)
        moved = ray_on_mesh(
            se3.transform(W, o_world[None])[0], 7.0 * W[:3, :3] @ d_world, MUG.mesh, W @ T
        )
        assert (at is None) == (moved is None)
        if at is not None and moved is not None:
            np.testing.assert_allclose(moved, at, atol=1e-12)


def test_what_lies_behind_the_eye_is_not_met() -> None:
    eye = np.array([0.0, 0.0, 1.0])
    assert ray_on_mesh(eye, [0, 0, 1], WEDGE.mesh, np.eye(4)) is None
    assert ray_on_mesh(eye, [0, 0, -1], WEDGE.mesh, np.eye(4)) is not None


# --- clouds -----------------------------------------------------------------------------------


def sheet(z: float, slope: float = 0.0, n: int = 120) -> Array32:
    """Return a sheet of points 1 mm apart that rises along x."""
    x, y = np.meshgrid(np.arange(n) * 1e-3 - 0.06, np.arange(n) * 1e-3 - 0.06)
    return np.stack([x.ravel(), y.ravel(), (z + slope * x).ravel()], -1).astype(np.float32)


def test_the_nearer_sheet_is_clicked() -> None:
    cloud = np.concatenate([sheet(0.0), sheet(0.02)])
    found = ray_on_cloud([0.0003, 0.0003, 0.5], [0, 0, -1], cloud)
    assert found is not None and found[2] == pytest.approx(0.02)
    found = ray_on_cloud([0.0003, 0.0003, -0.5], [0, 0, 1], cloud)
    assert found is not None and found[2] == pytest.approx(0.0)


def test_on_a_slanted_sheet_the_point_under_the_ray_is_clicked() -> None:
    cloud = sheet(0.0, slope=2.0)
    for x in (-0.03, 0.0004, 0.02):
        found = ray_on_cloud([x, 0.0, 0.5], [0, 0, -1], cloud)
        assert found is not None
        assert abs(found[0] - x) < 0.0011 and abs(found[1]) < 0.0011


def test_a_click_beside_the_cloud_meets_nothing() -> None:
    cloud = sheet(0.0)
    assert ray_on_cloud([0.2, 0, 0.5], [0, 0, -1], cloud) is None
    assert ray_on_cloud([0, 0, 0.5], [0, 0, 1], cloud) is None
    assert ray_on_cloud([0, 0, 0.5], [0, 0, -1], np.zeros((0, 3), np.float32)) is None
    assert ray_on_cloud([0, 0, 0.5], [0, 0, -1], np.full((9, 3), np.nan, np.float32)) is None


def test_rays_that_are_none_are_refused() -> None:
    for o, d in (([0, 0, 0], [0, 0, 0]), ([0, 0, np.nan], [0, 0, 1]), ([0, 0], [0, 1])):
        refused("ray", ray_on_cloud, o, d, sheet(0.0))
        refused("ray", ray_on_mesh, o, d, WEDGE.mesh, np.eye(4))
    refused("shape", ray_on_cloud, [0, 0, 1], [0, 0, -1], np.zeros((4, 2), np.float32))
