"""Points of views: which pixels are trusted, and that they lie where the surface is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.records import CameraIntrinsics
from realsim.registration.evidence import DepthFrame, DepthNoise
from realsim.registration.views import SampleConfig, sample_view, sample_views, world_cloud

CAMERA = CameraIntrinsics(width=160, height=90, fx=115.0, fy=112.0, cx=80.3, cy=44.1)
NOISE = DepthNoise(per_m=0.007, floor_m=2e-4)


def frame(depth: NDArray, T: Array | None = None, index: int = 0) -> DepthFrame:
    return DepthFrame(
        index=index, depth_m=np.asarray(depth, np.float32),
        T_world_cam=np.eye(4) if T is None else T,
    )  # fmt: skip


def plane_depth(camera: CameraIntrinsics, T_world_cam: Array) -> Array32:
    """Exact depth of the plane z = 0 of the world (no lens distortion)."""
    down = ray_table(camera) @ T_world_cam[2, :3]
    return np.where(down < 0, -T_world_cam[2, 3] / down, 0).astype(np.float32)


def trusted_by_definition(depth: NDArray, config: SampleConfig) -> list[tuple[int, int]]:
    """(column, row) of the pixels that a reader of the config would keep."""
    known = np.isfinite(depth) & (depth > 0)
    pitch = config.edge_slope / min(CAMERA.fx, CAMERA.fy)
    kept: list[tuple[int, int]] = []
    reach = config.edge_reach_px
    for i in range(0, depth.shape[0], config.stride):
        for j in range(0, depth.shape[1], config.stride):
            if not known[i, j]:
                continue
            window = tuple(slice(max(0, k - reach), k + reach + 1) for k in (i, j))
            near = depth[window][known[window]]
            z = float(depth[i, j])
            allowed = config.edge_jump_m + pitch * z + config.edge_sigmas * NOISE.sigma(np.array(z))
            if float(near.max()) - float(near.min()) <= allowed:
                kept.append((j, i))
    return kept


@pytest.mark.parametrize("stride, reach", [(1, 3), (3, 2)])
def test_trusted_pixels_are_those_of_the_definition(stride: int, reach: int):
    rng = np.random.default_rng(stride)
    steps = np.kron(rng.uniform(0.3, 0.45, (6, 8)), np.ones((15, 20)))
    depth = (steps + rng.normal(0, 1e-3, steps.shape)).astype(np.float32)
    for wrong, share in ((0, 0.2), (np.nan, 0.01), (np.inf, 0.01), (-0.3, 0.01)):
        depth[rng.random(depth.shape) < share] = wrong
    config = SampleConfig(stride=stride, edge_reach_px=reach)
    view = sample_view(CAMERA, frame(depth), NOISE, config)
    expected = trusted_by_definition(depth, config)
    assert 50 < len(expected) < len(depth[::stride, ::stride].ravel())
    assert [(int(u), int(v)) for u, v in view.pixels] == expected
    sampled = depth[::stride, ::stride]
    measured = np.isfinite(sampled) & (sampled > 0)
    assert view.measured_share == pytest.approx(measured.mean())
    assert view.area_px == stride**2


def test_a_point_is_seen_where_its_pixel_is():
    camera = replace(CAMERA, distortion=np.array([-0.05, 0.02, 0.001, -0.002, 0.0]))
    depth = np.full((90, 160), 0.4, np.float32)
    view = sample_view(camera, frame(depth), NOISE, SampleConfig(stride=7))
    assert len(view.points) > 200 and view.points.dtype == np.float32
    np.testing.assert_allclose(view.points[:, 2], 0.4, rtol=1e-6)
    uv = project(camera, view.points.astype(np.float64))
    np.testing.assert_allclose(uv, view.pixels, atol=1e-3)


def test_cloud_looks_back_at_the_cameras_with_their_noise():
    Ts = [se3.look_at([0.2, 0, 0.4], [0, 0, 0]), se3.look_at([0, -0.3, 0.9], [0, 0, 0])]
    frames = [frame(plane_depth(CAMERA, T), T, k) for k, T in enumerate(Ts)]
    views = sample_views(CAMERA, frames, NOISE, SampleConfig(stride=5))
    cloud = world_cloud(views, NOISE)
    n = len(views[0].points)
    assert len(cloud.points) == n + len(views[1].points)
    np.testing.assert_allclose(np.linalg.norm(cloud.towards, axis=1), 1)
    for part, T, view in ((slice(0, n), Ts[0], views[0]), (slice(n, None), Ts[1], views[1])):
        far = np.linalg.norm(T[:3, 3] - cloud.points[part], axis=1, keepdims=True)
        back = cloud.points[part] + far * cloud.towards[part]
        np.testing.assert_allclose(back, np.tile(T[:3, 3], (len(far), 1)), atol=1e-9)
        z = view.points[:, 2].astype(np.float64)
        np.testing.assert_allclose(cloud.sigmas[part], np.maximum(2e-4, 0.007 * z**2), rtol=1e-6)
