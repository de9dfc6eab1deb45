"""Light comes from where the environment says, as strong as it says."""

import numpy as np
import pytest

from plain_meshes import square
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.developing import developed
from realsim.rendering.photoreal import PhotorealConfig, PhotorealRenderer
from realsim.rendering.rays import PlacedMesh

CAMERA = CameraIntrinsics(width=40, height=30, fx=40.0, fy=40.0, cx=19.5, cy=14.5)
WHITE = Material(base_color=(1.0, 1.0, 1.0), roughness=1.0)
SUN = (0.5, 0.5, 0.5)


def octahedron(radius: float) -> Mesh:
    corners = radius * np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return Mesh(vertices=corners, faces=np.array(faces))


def panorama(rows: int, value: float = 0.0) -> np.ndarray:
    return np.full((rows, 2 * rows, 3), value, np.float32)


def toward(row: int, column: int, rows: int) -> np.ndarray:
    elevation = np.pi / 2 - np.pi * (row + 0.5) / rows
    azimuth = np.pi * (column + 0.5) / rows
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def plain(samples: int = 64) -> PhotorealConfig:
    return PhotorealConfig(variant="scalar", samples=samples, denoise=False, psf_px=0)


def test_a_bright_texel_is_seen_where_it_is() -> None:
    row, column = 7, 20
    sky = panorama(32)
    sky[row, column] = 1.0
    at = toward(row, column, 32)
    T = se3.look_at([0.3, -0.2, 0.1], np.array([0.3, -0.2, 0.1]) + at + [0.12, -0.1, 0.07])
    rgb = PhotorealRenderer([], Environment(panorama=sky), plain(32)).render(CAMERA, T).rgb
    expected = camera.project(CAMERA, se3.invert(T)[:3, :3] @ at)
    light = rgb[..., 1].astype(float) ** 2.2
    v, u = np.indices(light.shape)
    center = np.array([np.sum(light * u), np.sum(light * v)]) / light.sum()
    assert np.all(np.abs(center - expected) < 0.25)  # a texel is about 4 px wide


def test_a_bright_patch_lights_the_side_that_faces_it() -> None:
    at = np.array([0.0, -1.0, 0.0])
    rows = 32
    cosine = np.stack([[toward(r, c, rows) @ at for c in range(2 * rows)] for r in range(rows)])
    sky = panorama(rows)
    sky[cosine > 0.93] = 12.0
    placed = [PlacedMesh(0, octahedron(0.1), np.eye(4), WHITE)]
    renderer = PhotorealRenderer(placed, Environment(panorama=sky), plain(16))
    tilt = np.roll(at, 1) * 0.6  # the camera itself is beside the patch
    lit = renderer.render(CAMERA, se3.look_at(0.4 * at + 0.5 * tilt, [0, 0, 0]))
    dark = renderer.render(CAMERA, se3.look_at(-0.4 * at + 0.5 * tilt, [0, 0, 0]))
    assert np.median(lit.rgb[lit.depth_m > 0]) > 100
    assert np.median(dark.rgb[dark.depth_m > 0]) == 0


@pytest.mark.parametrize("radius_deg", [0.0, 8.0])
def test_the_sun_adds_what_it_says_to_a_white_surface(radius_deg: float) -> None:
    direction = np.array([0.6, 0.0, 0.8])
    sky = Environment(panorama=panorama(4), sun=SUN, sun_direction=(0.6, 0.0, 0.8),
                      sun_radius_deg=radius_deg)  # fmt: skip
    placed = [PlacedMesh(-1, square(2.0), np.eye(4), WHITE)]
    T = se3.look_at([0.0, 0.0, 0.5], [0.0, 0.0, 0.0])
    rgb = PhotorealRenderer(placed, sky, plain(16)).render(CAMERA, T).rgb
    expected = developed(np.full((1, 1, 3), SUN[0] * direction[2], np.float32))
    assert abs(float(rgb.mean()) - float(expected.mean())) < 4  # of 255


def test_a_white_matte_object_in_a_white_room_is_hardly_seen() -> None:
    placed = [PlacedMesh(0, octahedron(0.1), np.eye(4), WHITE)]
    T = se3.look_at([0.2, 0.3, 0.25], [0, 0, 0])
    config = plain(32)
    photo = PhotorealRenderer(placed, Environment(panorama=panorama(8, 0.5)), config).render(
        CAMERA, T
    )
    inside = photo.rgb[photo.depth_m > 0].astype(float).mean()
    around = photo.rgb[photo.depth_m == 0].astype(float).mean()
    assert abs(inside - around) < 0.06 * around
