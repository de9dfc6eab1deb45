"""Shadows of a second eye: by rays, by brute force, and by the scan of a depth image."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.shadow import half_occluded, shadow_mask
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import PlacedMesh, RayScene
from trimesh_solids import ball, box

CAMERA = CameraIntrinsics(width=96, height=72, fx=90, fy=90, cx=47.5, cy=35.5)
SMALL = CameraIntrinsics(width=48, height=36, fx=45, fy=45, cx=23.5, cy=17.5)
LENS = replace(SMALL, distortion=np.array([-0.12, 0.05, 0.001, -0.002, 0.0]))


def placed(behind: bool = False) -> list[PlacedMesh]:
    """Return a ball and a turned box before a wall; a second wall behind the camera."""
    turned, wall = se3.exp_so3([0.5, 0.4, 0.3]), box((3.0, 3.0, 0.01))
    things = [
        PlacedMesh(0, ball(0.07, 2), se3.from_translation([-0.06, 0.02, 0.5])),
        PlacedMesh(1, box((0.1, 0.06, 0.08)), se3.from_rt(turned, [0.12, -0.03, 0.42])),
        PlacedMesh(-1, wall, se3.from_translation([0, 0, 0.8])),
    ]
    return [*things, PlacedMesh(-1, wall, se3.from_translation([0, 0, -0.3]))] if behind else things


def brute_force_hidden(points: np.ndarray, eye: np.ndarray, things: list[PlacedMesh]) -> np.ndarray:
    """Return which points have a triangle between themselves and the eye (Moeller-Trumbore)."""
    corners = np.concatenate(
        [se3.transform(p.T_world_obj, p.mesh.vertices)[p.mesh.faces] for p in things]
    )
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    hidden = np.zeros(len(points), bool)
    for k, x in enumerate(points):
        d = x - eye
        h = np.cross(d, e2)
        det = np.einsum("ij,ij->i", e1, h)
        f = 1 / np.where(np.abs(det) < 1e-14, np.inf, det)
        s = eye - a
        q = np.cross(s, e1)
        u, v = f * np.einsum("ij,ij->i", s, h), f * (q @ d)
        t = f * np.einsum("ij,ij->i", e2, q)
        hidden[k] = np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & (t < 1 - 5e-4))
    return hidden


@pytest.mark.parametrize("offset", [0.0, -0.03])
def test_the_shadow_is_what_a_search_through_all_triangles_finds(offset: float) -> None:
    camera = LENS
    things = placed()
    depth = LabelRenderer(things).render(camera, np.eye(4)).depth_m
    mask = shadow_mask(
        RayScene(things), depth, camera, np.eye(4),
        baseline_m=0.05, eye_offset_m=offset, border=False,
    )  # fmt: skip
    points = (ray_table(camera) * depth[..., None]).reshape(-1, 3).astype(np.float64)
    expected = np.zeros(len(points), bool)
    for x in {offset, offset + 0.05} - {0.0}:
        expected |= brute_force_hidden(points, np.array([x, 0, 0]), things)
    assert 0.02 < mask.mean() < 0.5
    # Where the line of sight grazes a surface (the rim of the ball) float32 decides.
    assert np.sum(mask.ravel() != expected) <= 3


def test_a_wall_behind_the_camera_hides_nothing() -> None:
    depth = LabelRenderer(placed()).render(CAMERA, np.eye(4)).depth_m
    masks = [
        shadow_mask(RayScene(placed(b)), depth, CAMERA, np.eye(4), baseline_m=0.05)
        for b in (False, True)
    ]
    assert np.array_equal(masks[0], masks[1])


def test_the_scan_of_the_picture_finds_nearly_the_same() -> None:
    depth = LabelRenderer(placed()).render(CAMERA, np.eye(4)).depth_m
    model = replace(DepthSensorModel.noiseless(), occlusion=True, baseline_m=0.05)
    rng = np.random.default_rng
    scanned = model.measure(depth, CAMERA, rng(0)) == 0
    exact = model.measure(
        depth, CAMERA, rng(0), scene=RayScene(placed()), T_world_cam=np.eye(4)
    ) == 0  # fmt: skip
    assert np.mean(scanned != exact) < 0.02
    assert exact.mean() == pytest.approx(scanned.mean(), rel=0.1)


def test_an_eye_on_the_left_casts_the_mirrored_shadow() -> None:
    disparity = np.full((4, 60), 5.0, np.float32)
    disparity[:, 20:30] = 15.0
    right = half_occluded(disparity, border=False)
    left = half_occluded(disparity[:, ::-1], second_eye=-1.0, border=False)[:, ::-1]
    assert np.array_equal(right, left)
    assert np.flatnonzero(right[0]).tolist() == list(range(11, 20))


def test_a_given_shadow_is_lost_and_mistakes_are_named() -> None:
    depth = np.full((72, 96), 0.5, np.float32)
    shadow = np.zeros((72, 96), bool)
    shadow[10:20, 30:40] = True
    model = replace(DepthSensorModel.noiseless(), occlusion=True)
    out = model.measure(depth, CAMERA, np.random.default_rng(0), shadow=shadow)
    assert np.array_equal(out == 0, shadow)
    with pytest.raises(InputError, match="give T_world_cam"):
        model.measure(depth, CAMERA, np.random.default_rng(0), scene=RayScene(placed()))
    with pytest.raises(InputError, match="the camera 96x72"):
        model.measure(depth, CAMERA, np.random.default_rng(0), shadow=shadow[:10])
