"""Materials: images lie where coordinates say, in both lights, and what lacks them is named."""

from dataclasses import replace

import numpy as np
import pytest

from plain_meshes import square
from realsim.geometry import camera, se3
from realsim.geometry.colors import srgb_encoded
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.developing import developed
from realsim.rendering.photo import Lighting, PhotoRenderer, PlacedMesh

VIEW = CameraIntrinsics(
    width=161, height=121, fx=150, fy=150, cx=80, cy=60,
    distortion=np.array([-0.1, 0.05, 0.0005, -0.0005, 0.0]),
)  # fmt: skip
ABOVE = se3.look_at([0, 0, 1.2], [0, 0, 0])
SHARP = Lighting(psf_px=0.0)
WHITE_SKY = Environment(panorama=np.ones((8, 16, 3), np.float32))


def lit(mesh: Mesh, material: Material | None, sky: Environment | None = WHITE_SKY,
        T: np.ndarray = ABOVE) -> np.ndarray:  # fmt: skip
    placed = [PlacedMesh(0, mesh, np.eye(4), material)]
    return PhotoRenderer(placed, SHARP, sky).radiance(VIEW, T)[0]


def at(picture: np.ndarray, x: float, y: float, T: np.ndarray = ABOVE) -> np.ndarray:
    uv = camera.project(VIEW, se3.transform(se3.invert(T), [[x, y, 0]]))[0]
    u, v = np.round(uv).astype(int)
    return picture[v, u]


def four_colors() -> np.ndarray:
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4, :4], image[:4, 4:] = (255, 0, 0), (0, 255, 0)
    image[4:, :4], image[4:, 4:] = (0, 0, 255), (255, 255, 255)
    return image


@pytest.mark.parametrize("sky", [None, WHITE_SKY])
@pytest.mark.parametrize("projection", ["uv", "box"])
def test_an_image_lies_where_the_coordinates_say(sky: Environment | None, projection: str) -> None:
    # First row at v = 1; the box projection puts u = x, v = y, one tile each period.
    material = Material(
        base_color=(1, 1, 1), base_color_image=four_colors(), roughness=1.0, period_m=1.0,
        projection=projection,  # pyright: ignore[reportArgumentType]
    )  # fmt: skip
    mesh = replace(square(), uv=None) if projection == "box" else square()
    picture = lit(mesh, material, sky)
    shift = 0.5 if projection == "box" else 0.0  # the tile's corner is the mesh's origin
    for x, y, channel in ((-0.25, 0.25, 0), (0.25, 0.25, 1), (-0.25, -0.25, 2)):
        color = at(picture, (x + shift + 0.5) % 1 - 0.5, (y + shift + 0.5) % 1 - 0.5)
        assert int(np.argmax(color)) == channel and color.max() > 3 * np.median(color)


@pytest.mark.parametrize("sky", [None, WHITE_SKY])
def test_a_printed_edge_lies_where_it_is_projected(sky: Environment | None) -> None:
    image = np.full((256, 256, 3), 20, np.uint8)
    image[:, 96:160] = 230
    material = Material(base_color=(1, 1, 1), base_color_image=image, roughness=1.0,
                        projection="uv")  # fmt: skip
    T = se3.look_at([0.1, -0.2, 1.1], [0.02, 0.03, 0])
    row = lit(square(), material, sky, T)[60, :, 1]
    dark, bright = row[55:58].mean(), row[70:90].mean()
    share = (row - dark) / (bright - dark)
    found = share[40:80].sum(), share[80:125].sum()
    # Where the rays of this row meet the edges x = +-0.125.
    table = camera.ray_table(VIEW)[60].astype(float) @ T[:3, :3].T
    x = T[0, 3] - T[2, 3] / table[:, 2] * table[:, 0]
    left, right = (np.interp(e, x, np.arange(len(x))) for e in (-0.125, 0.125))
    assert abs(found[0] - (79.5 - left)) < 0.1 and abs(found[1] - (right - 79.5)) < 0.1


def test_far_away_a_pattern_becomes_its_mean() -> None:
    checks = np.kron(np.indices((64, 64)).sum(0) % 2, np.ones((2, 2)))
    image = np.repeat((255 * checks).astype(np.uint8)[..., None], 3, -1)
    material = Material(base_color=(1, 1, 1), base_color_image=image, roughness=1.0, period_m=0.02)
    inside = lit(square(), material)[50:70, 60:100]
    assert inside.mean() == pytest.approx(0.5, abs=0.04) and inside.std() < 0.01


def test_a_roughness_image_says_where_the_lamp_is_mirrored() -> None:
    panorama = np.full((64, 128, 3), 0.05, np.float32)
    panorama[:6] = 5.0
    image = np.full((16, 16), 255, np.uint8)
    image[:, :8] = 20
    material = Material(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=1.0,
                        roughness_image=image, projection="uv")  # fmt: skip
    light = lit(square(), material, Environment(panorama=panorama))
    assert at(light, -0.05, 0)[0] > 3 * at(light, 0.05, 0)[0]


def test_a_normal_image_turns_the_surface_towards_the_light() -> None:
    # The image leans all normals by 45 degrees towards +x, where the sky is white.
    panorama = np.zeros((16, 32, 3), np.float32)
    panorama[:, np.cos((np.arange(32) + 0.5) * np.pi / 16) > 0] = 1.0
    half = round(127.5 + 127.5 * np.sqrt(0.5))
    for first, expected in (
        (half, 0.5 + 0.5 * np.sqrt(0.5)),
        (255 - half, 0.5 - 0.5 * np.sqrt(0.5)),
    ):
        image = np.tile(np.array([first, 128, half], np.uint8), (8, 8, 1))
        material = Material(
            base_color=(1, 1, 1), roughness=1.0, normal_image=image, projection="uv"
        )
        light = lit(square(), material, Environment(panorama=panorama))
        assert at(light, 0, 0)[0] == pytest.approx(expected, abs=0.06)


def test_development_is_srgb_below_the_shoulder_and_never_falls() -> None:
    light = np.linspace(0, 5, 2001, dtype=np.float32)
    picture = developed(np.repeat(light[:, None, None], 3, -1))[:, 0, 0].astype(int)
    low = light < 0.8
    assert np.abs(picture[low] - np.round(255 * srgb_encoded(light[low]))).max() <= 1
    assert np.all(np.diff(picture) >= 0) and picture[-1] == 255
