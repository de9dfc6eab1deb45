"""Projection: the way back is exact, the derivatives are the derivatives, OpenCV agrees.

Depth images to points, voxel means, planes.
"""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import DegenerateError, InputError
from realsim.geometry import camera, se3
from realsim.geometry.camera import project
from realsim.geometry.clouds import fit_plane_ransac, plane_frame, voxel_mean
from realsim.geometry.depth import depth_noise_per_m, edge_mask, points_from_depth
from realsim.records import CameraIntrinsics
from refusals import refused

LENSES = {
    "pinhole": [],
    "brown": [-0.055, 0.066, 0.0004, -0.0007, -0.021],
    "rational": [0.31, 0.09, -0.0002, 0.0003, 0.004, 0.36, 0.15, 0.02],
    "strong": [-0.28, 0.09, 0.001, -0.002, -0.012],
}


def lens(name):
    return CameraIntrinsics(
        width=1280, height=720, fx=900.0, fy=898.0, cx=640.3, cy=358.7,
        distortion=np.array(LENSES[name]),
    )  # fmt: skip


def points_in_view(n=400):
    rng = np.random.default_rng(1)
    z = rng.uniform(0.2, 0.8, n)
    return np.stack([rng.uniform(-0.65, 0.65, n) * z, rng.uniform(-0.36, 0.36, n) * z, z], -1)


@pytest.mark.parametrize("name", LENSES)
def test_undistort_undoes_project(name):
    p = points_in_view()
    xy, valid = camera.undistort(lens(name), camera.project(lens(name), p))
    assert valid.all()
    np.testing.assert_allclose(xy, p[:, :2] / p[:, 2:], atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_project_undoes_undistort_over_the_whole_image(name):
    uv = camera.pixel_grid(1280, 720)[::24, ::24].reshape(-1, 2)
    xy, valid = camera.undistort(lens(name), uv)
    assert valid.all()
    back = camera.project(lens(name), np.concatenate([xy, np.ones((len(xy), 1))], -1))
    np.testing.assert_allclose(back, uv, atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_opencv_projects_to_the_same_pixels(name):
    import cv2

    i, p = lens(name), points_in_view()
    theirs, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), i.K, i.distortion)
    np.testing.assert_allclose(camera.project(i, p), theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_jacobians_are_finite_differences(name):
    i, p = lens(name), points_in_view(30)
    uv, d_point, d_cam = camera.projection_jacobian(i, p)
    np.testing.assert_allclose(uv, camera.project(i, p), atol=1e-10)
    h = 1e-6
    for k in range(3):
        e = h * np.eye(3)[k]
        numeric = (camera.project(i, p + e) - camera.project(i, p - e)) / (2 * h)
        np.testing.assert_allclose(d_point[:, :, k], numeric, atol=2e-4, rtol=1e-6)
    start = np.concatenate([[i.fx, i.fy, i.cx, i.cy], i.distortion])

    def moved(k, step):
        x = start.copy()
        x[k] += step
        return camera.project(replace(i, fx=x[0], fy=x[1], cx=x[2], cy=x[3], distortion=x[4:]), p)

    for k in range(12):
        numeric = (moved(k, h) - moved(k, -h)) / (2 * h)
        np.testing.assert_allclose(d_cam[:, :, k], numeric, atol=1e-5, rtol=1e-6)


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(camera.project(lens("pinhole"), [[0, 0, -1.0], [0.1, 0, 0.0]])).all()


def test_pixels_beyond_the_fold_are_reported_not_guessed():
    # k1 = -0.5 folds the image back at r = sqrt(2/3): nothing is seen beyond 0.544 f.
    i = CameraIntrinsics(
        width=2000, height=2000, fx=900, fy=900, cx=1000, cy=1000, distortion=np.array([-0.5])
    )
    xy, valid = camera.undistort(i, [[1000.0, 1000.0], [1400.0, 1000.0], [1999.0, 1000.0]])
    assert valid.tolist() == [True, True, False]
    assert np.isnan(xy[2]).all() and np.isfinite(xy[:2]).all()


def test_rays_have_depth_one_and_go_through_pixel_centres():
    i = lens("brown")
    rays = camera.ray_table(i)
    assert rays.shape == (720, 1280, 3) and rays.dtype == np.float32
    assert (rays[..., 2] == 1).all()
    uv = camera.project(i, rays[100, 200].astype(float))
    np.testing.assert_allclose(uv, [200, 100], atol=1e-3)
    assert camera.ray_table(i) is rays


def test_the_centre_pixel_of_a_known_camera():
    i = CameraIntrinsics(width=640, height=480, fx=600, fy=500, cx=320, cy=240)
    np.testing.assert_allclose(camera.project(i, [0.1, -0.2, 2.0]), [350, 190])


def test_a_camera_matrix_with_skew_is_refused():
    with pytest.raises(InputError, match="camera matrix"):
        CameraIntrinsics.from_K([[600, 1, 320], [0, 600, 240], [0, 0, 1]], 640, 480)


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
