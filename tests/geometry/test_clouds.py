"""Depth images to points, voxel means, planes."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.clouds import fit_plane_ransac, plane_frame, voxel_mean
from realsim.geometry.depth import depth_noise_per_m, edge_mask, points_from_depth
from realsim.records import CameraIntrinsics
from refusals import refused

PINHOLE = CameraIntrinsics(width=80, height=60, fx=70.0, fy=72.0, cx=39.0, cy=30.5)
CAMERA = replace(PINHOLE, distortion=np.array([0.05, -0.02]))


def tilted_plane_depth(camera: CameraIntrinsics) -> np.ndarray:
    """Depth of the plane z = 0.5 + 0.4 x - 0.2 y in the camera."""
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return (0.5 / (1 - 0.4 * x + 0.2 * y)).astype(np.float32)


@pytest.mark.parametrize("stride", [1, 3])
def test_points_project_back_onto_their_pixels(stride):
    depth = np.random.default_rng(0).uniform(0.3, 0.6, (60, 80)).astype(np.float32)
    depth[::7, ::5] = 0
    points, pixels = points_from_depth(depth, CAMERA, stride)
    np.testing.assert_allclose(project(CAMERA, points), pixels, atol=1e-3)
    np.testing.assert_allclose(points[:, 2], depth[pixels[:, 1], pixels[:, 0]])
    assert len(points) == np.count_nonzero(depth[::stride, ::stride])


def test_depth_of_another_camera_or_in_counts_is_refused():
    refused("shape", points_from_depth, np.ones((61, 80), np.float32), CAMERA)
    refused("metres", points_from_depth, np.ones((60, 80), np.uint16), CAMERA)


def test_edges_are_found_and_slopes_are_not():
    depth = tilted_plane_depth(PINHOLE)
    assert not edge_mask(depth, 0.05).any()
    depth[20:30, 20:30] -= 0.1
    edges = edge_mask(depth, 0.05)
    assert edges[19:21, 20:30].all()
    assert not edges[22:28, 22:28].any()
    assert not edges[:15].any()


def test_noise_is_measured_from_the_images():
    rng = np.random.default_rng(1)
    z = tilted_plane_depth(PINHOLE)
    noisy = (z + rng.normal(size=z.shape) * 0.005 * z**2).astype(np.float32)
    assert depth_noise_per_m([noisy] * 3) == pytest.approx(0.005, rel=0.15)
    refused(".", depth_noise_per_m, [np.zeros((60, 80), np.float32)])


def test_voxel_mean_keeps_weight_and_centroid():
    rng = np.random.default_rng(2)
    p, w = rng.uniform(-0.1, 0.1, (500, 3)), rng.uniform(1, 3, 500)
    means = voxel_mean(p, 0.03, w, attributes=p)
    assert means.weights.sum() == pytest.approx(w.sum())
    assert means.counts.sum() == 500
    np.testing.assert_allclose(means.weights @ means.points, w @ p)
    np.testing.assert_allclose(means.attributes, means.points)
    order = rng.permutation(500)
    again = voxel_mean(p[order], 0.03, w[order])
    np.testing.assert_allclose(again.points, means.points, atol=1e-12)


def test_voxels_do_not_mix_labels():
    means = voxel_mean(np.zeros((4, 3)), 0.1, labels=np.array([0, 1, 1, 0]))
    np.testing.assert_array_equal(means.counts, [2, 2])
    assert len(voxel_mean(np.zeros((0, 3)), 0.1).points) == 0


def test_plane_is_found_among_outliers_and_moves_with_the_world():
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(-0.3, 0.3, (2000, 2)), rng.normal(size=2000) * 5e-4])
    clutter = rng.uniform(-0.3, 0.3, (1500, 3))
    T = se3.random_transform(rng)
    points = se3.transform(T, np.concatenate([flat, clutter]))
    normal, offset, inliers = fit_plane_ransac(points, rng, 0.002)
    assert abs(normal @ T[:3, 2]) > np.cos(np.radians(0.05))
    assert inliers[:2000].mean() > 0.99
    local = se3.transform(se3.invert(plane_frame(normal, offset, points[inliers])), points[:2000])
    assert abs(local[:, 2].mean()) < 1e-4
    assert np.linalg.norm(local.mean(0)) < 0.03


def test_a_line_is_no_plane():
    line = np.outer(np.arange(10.0), [1, 2, 3])
    refused(".", fit_plane_ransac, line * 0, np.random.default_rng(0), 0.01, error=DegenerateError)
    refused(".", fit_plane_ransac, line[:2], np.random.default_rng(0), 0.01, error=DegenerateError)
