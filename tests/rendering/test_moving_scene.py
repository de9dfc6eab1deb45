"""Pictures of moving bodies: those of the ray caster, and only what moves is rendered again."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.moving_scene import Moment, MovingScene
from realsim.rendering.photo import Lighting, PhotoRenderer, PlacedMesh

LENS = np.array([-0.2, 0.06, 0.0004, -0.0007, 0.0])
VIEW = CameraIntrinsics(width=96, height=72, fx=90, fy=90, cx=47.3, cy=35.8, distortion=np.zeros(5))
T_WORLD_CAM = se3.look_at([0.3, -0.45, 0.35], [0, 0, 0.03])
LIGHT = Lighting(gamma=2.2, samples=2, psf_px=0.4)
WEDGE, CUBE = 1, 2
"""Numbers of the two bodies that move."""


def table() -> Mesh:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-0.02, 0)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return Mesh(vertices=corners.astype(float), faces=np.array(faces))


def printed() -> Mesh:
    """An open square with a print, standing upright."""
    image = np.random.default_rng(2).integers(0, 256, (32, 32, 3)).astype(np.uint8)
    corners = np.array([[-1, 0, 0], [1, 0, 0], [1, 0, 1.5], [-1, 0, 1.5]]) * 0.06
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return Mesh(vertices=corners, faces=np.array([[0, 1, 2], [0, 2, 3]]), uv=uv, texture=image)


def coloured() -> Mesh:
    mesh = part("cube").mesh
    shades = np.random.default_rng(1).integers(0, 256, (len(mesh.vertices), 3)).astype(np.uint8)
    return Mesh(vertices=mesh.vertices, faces=mesh.faces, colors=shades)


def placed(shift: float = 0.0) -> list[PlacedMesh]:
    turned = se3.exp_so3([0.3 * shift, 0.0, 0.4 + 2 * shift])
    return [
        PlacedMesh(-1, table(), np.eye(4)),
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
    apart = np.abs(found.rgb.astype(int) - expected.rgb).max(-1)
    assert np.mean(apart > 1) <= 0.002
