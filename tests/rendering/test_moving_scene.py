"""Pictures of moving bodies: those of the ray caster, and only what moves is rendered again."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import camera, se3
from realsim.geometry.mesh import box_mesh
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.casting.pixel_caster import (
    NOT_WANTED,
    PixelCaster,
    empty_buffers,
    enter,
    may_be_seen,
)
from realsim.rendering.embedded.sun_shadows import SunBodies, cast_shadows, sort_points
from realsim.rendering.moving_scene import Moment, MovingScene
from realsim.rendering.photo import Lighting, PhotoRenderer, PlacedMesh

LENS = np.array([-0.2, 0.06, 0.0004, -0.0007, 0.0])
VIEW = CameraIntrinsics(width=96, height=72, fx=90, fy=90, cx=47.3, cy=35.8, distortion=np.zeros(5))
T_WORLD_CAM = se3.look_at([0.3, -0.45, 0.35], [0, 0, 0.03])
LIGHT = Lighting(gamma=2.2, samples=2, psf_px=0.4)
WEDGE, CUBE = 1, 2
"""Numbers of the two bodies that move."""


def printed() -> Mesh:
    """An open square with a print, standing upright."""
    image = np.random.default_rng(2).integers(0, 256, (32, 32, 3)).astype(np.uint8)
    corners = np.array([[-1, 0, 0], [1, 0, 0], [1, 0, 1.5], [-1, 0, 1.5]]) * 0.06
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return Mesh(vertices=corners, faces=np.array([[0, 1, 2], [0, 2, 3]]), uv=uv, texture=image)


def coloured() -> Mesh:
    mesh = part("cube").mesh
    shades = np.random.default_rng(1).integers(0, 256, (len(mesh.vertices), 3)).astype(np.uint8)
    return replace(mesh, colors=shades)


def placed(shift: float = 0.0) -> list[PlacedMesh]:
    turned = se3.exp_so3([0.3 * shift, 0.0, 0.4 + 2 * shift])
    return [
        PlacedMesh(-1, box_mesh((-1, -1, -0.02), (1, 1, 0)), np.eye(4)),
        PlacedMesh(0, part("wedge").mesh, se3.from_rt(turned, [0.06 - shift, 0.0, 0.05 + shift])),
        PlacedMesh(1, coloured(), se3.from_translation([-0.07, 0.02 - shift, 0.03])),
        PlacedMesh(-1, printed(), se3.from_translation([0.0, 0.12, 0.0])),
    ]


def moved(scene: MovingScene, shift: float) -> Moment:
    there = placed(shift)
    return scene.moment({k: there[k].T_world_obj for k in (WEDGE, CUBE)})


@pytest.fixture(scope="module")
def scene() -> MovingScene:
    return MovingScene(placed(), LIGHT)


@pytest.mark.parametrize("shift", (0.0, 0.03, 0.08))
@pytest.mark.parametrize("lens", (np.zeros(5), LENS))
def test_pictures_are_those_of_the_ray_caster(
    scene: MovingScene, shift: float, lens: Array
) -> None:
    view = replace(VIEW, distortion=lens)
    found = scene.picture(moved(scene, shift), view, T_WORLD_CAM)
    expected = PhotoRenderer(placed(shift), LIGHT).render(view, T_WORLD_CAM)
    apart = np.abs(found.rgb.astype(int) - expected.rgb).max(-1)
    assert np.mean(apart > 1) <= 0.001, (np.mean(apart > 1), apart.max())
    np.testing.assert_array_equal(found.depth_m, expected.depth_m)


def test_the_ray_caster_would_tell_a_missing_shadow(scene: MovingScene) -> None:
    """The bound above is no empty one: a body that is elsewhere shows."""
    found = scene.picture(moved(scene, 0.03), VIEW, T_WORLD_CAM)
    other = PhotoRenderer(placed(0.031), LIGHT).render(VIEW, T_WORLD_CAM)
    assert np.mean(np.abs(found.rgb.astype(int) - other.rgb).max(-1) > 1) > 0.002


@pytest.mark.parametrize("shift", (0.0, 0.01, 0.05, 0.2))
def test_what_is_renewed_is_the_whole_picture(scene: MovingScene, shift: float) -> None:
    still = scene.still(VIEW, T_WORLD_CAM, [0, 3])
    moment = moved(scene, shift)
    renewed, whole = scene.renewed(moment, still), scene.picture(moment, VIEW, T_WORLD_CAM)
    np.testing.assert_array_equal(renewed.rgb, whole.rgb)
    np.testing.assert_array_equal(renewed.depth_m, whole.depth_m)


def test_where_nothing_moves_the_picture_stays(scene: MovingScene) -> None:
    still = scene.still(VIEW, T_WORLD_CAM, [0, 3])
    first, second = (scene.renewed(moved(scene, shift), still).rgb for shift in (0.0, 0.02))
    alone = MovingScene([placed()[0], placed()[3]], LIGHT)
    without = alone.picture(alone.moment({}), VIEW, T_WORLD_CAM).rgb
    same = np.all(first == second, axis=-1)
    assert 0.3 < same.mean() < 0.99
    # Away from bodies and their shadows both are the picture of what stands still.
    assert np.mean(np.all(first == without, axis=-1)[same]) > 0.6
    assert np.any(first != without)


def test_a_camera_among_the_bodies_sees_what_the_ray_caster_sees(scene: MovingScene) -> None:
    """Triangles that reach behind the camera are bounded where they pass it."""
    T = se3.look_at([0.055, 0.0, 0.052], [-0.07, 0.03, 0.02])
    found = scene.picture(moved(scene, 0.0), VIEW, T)
    expected = PhotoRenderer(placed(), LIGHT).render(VIEW, T)
    assert np.mean(np.abs(found.rgb.astype(int) - expected.rgb).max(-1) > 1) <= 0.002


@pytest.mark.parametrize("lens", (np.zeros(5), LENS))
def test_some_pixels_cast_are_those_of_all_cast(lens: Array) -> None:
    view, caster = replace(VIEW, distortion=lens), PixelCaster(placed())
    rays = camera.ray_table(view)
    among = np.random.default_rng(4).random(rays.shape[:2]) < 0.3
    every, some = empty_buffers(rays), empty_buffers(rays)
    for k in range(len(placed())):
        mesh = caster.project(k, view, T_WORLD_CAM)
        enter(mesh, k, rays, every, NOT_WANTED)
        enter(mesh, k, rays, some, NOT_WANTED, among)
    for found, whole, nothing in zip(some, every, empty_buffers(rays), strict=True):
        np.testing.assert_array_equal(found, np.where(among, whole, nothing))


def test_what_cannot_be_seen_meets_no_ray_and_most_of_it_is_found() -> None:
    cube, rng = part("cube").mesh, np.random.default_rng(5)
    corners = np.array(np.meshgrid(*cube.bounds.T)).reshape(3, -1).T
    Ts = [se3.from_rt(se3.exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in range(300)]
    may = may_be_seen(VIEW, np.tile(corners, (len(Ts), 1, 1)), np.array(Ts))
    caster, rays = PixelCaster([PlacedMesh(0, cube, T) for T in Ts]), camera.ray_table(VIEW)
    met = [enter(caster.project(k, VIEW, np.eye(4)), k, rays, empty_buffers(rays),
                 np.zeros(rays.shape[:2], np.bool_)).count > 0 for k in range(len(Ts))]  # fmt: skip
    assert not np.any(np.array(met) & ~may)
    assert 0 < np.sum(met) <= may.sum() < 1.5 * np.sum(met)
    assert may_be_seen(replace(VIEW, distortion=LENS), corners[None], np.array(Ts[:1])).all()


@pytest.mark.parametrize("count", (1, 15, 16, 17, 3000))
def test_shadows_by_the_block_are_those_of_each_point_and_triangle(count: int) -> None:
    rng = np.random.default_rng(count)
    points = rng.random((count, 3)).astype(np.float32)
    points[rng.random(count) < 0.1] = np.nan
    corners = rng.random((60, 1, 3)) + rng.normal(size=(60, 3, 3)) * 0.25
    bodies = SunBodies(corners.reshape(-1, 3), np.arange(180, dtype=np.int32).reshape(-1, 3),
                       np.array([0, 20, 40, 60]), np.array([False, True, False]))  # fmt: skip
    lit = np.ones(count, np.bool_)
    cast_shadows(sort_points(points), bodies, np.array([0, 1]), lit)
    # The weights of the corners under which each point lies, and the triangle's height there.
    a, b, c = np.moveaxis(corners[:40], 1, 0)
    M = np.linalg.inv(np.stack([b - a, c - a], -1)[:, :2])
    v = np.einsum("fij,fpj->fpi", M, points[None, :, :2] - a[:, None, :2])
    weights = np.concatenate([1 - v.sum(-1, keepdims=True), v], -1)
    above = np.einsum("fpk,fk->fp", weights, corners[:40, :, 2]) - points[:, 2]
    under = (weights > 0).all(-1) & (above > 0)
    under[20:] &= (np.linalg.det(M) > 0)[20:, None]
    near = (np.abs(weights).min(-1) < 1e-4) | (np.abs(above) < 1e-4)
    sure = ~near.any(0) & ~np.isnan(points[:, 0])
    np.testing.assert_array_equal(lit[sure], ~under.any(0)[sure])
    assert lit[np.isnan(points[:, 0])].all()
    assert count < 3000 or (sure.mean() > 0.8 and 0.2 < lit.mean() < 0.8)
