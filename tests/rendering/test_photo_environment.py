"""Views under a panorama and a sun: energy, known answers, and the same pixel grid as labels."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from plain_meshes import square
from realsim.geometry import camera, se3
from realsim.geometry.colors import srgb_encoded
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.photo import Lighting, LightSampling, PhotoRenderer, PlacedMesh, developed
from refusals import refused
from trimesh_solids import solid

LENS = np.array([-0.25, 0.09, 0.0006, -0.0009, 0.0])
WIDE = CameraIntrinsics(width=160, height=120, fx=110, fy=110, cx=79.2, cy=60.1, distortion=LENS)
SMALL = CameraIntrinsics(width=80, height=60, fx=55, fy=55, cx=39.5, cy=29.5)
SHARP = Lighting(psf_px=0.0)
WHITE = Material(base_color=(1.0, 1.0, 1.0), roughness=1.0, name="white")
ABOVE = se3.look_at([0, 0, 1.0], [0, 0, 0])


def even_sky(level: float = 1.0, rows: int = 16, **more: object) -> Environment:
    return Environment(panorama=np.full((rows, 2 * rows, 3), level, np.float32), **more)  # pyright: ignore[reportArgumentType]


def ball(radius: float, segments: int = 48) -> Mesh:
    return solid(trimesh.creation.uv_sphere(radius, count=[segments + 1, 2 * segments]))


def light_of(
    placed: list[PlacedMesh], sky: Environment, T: np.ndarray = ABOVE,
    intrinsics: CameraIntrinsics = WIDE, **sampling: object,
) -> np.ndarray:  # fmt: skip
    how = LightSampling(**sampling)  # pyright: ignore[reportArgumentType]
    return PhotoRenderer(placed, SHARP, sky, how).radiance(intrinsics, T)[0]


def pixel_of(
    x: float, y: float, T: np.ndarray = ABOVE, lens: CameraIntrinsics = WIDE
) -> tuple[int, int]:
    """Row and column where a camera sees a place of the table."""
    u, v = np.round(camera.project(lens, se3.transform(se3.invert(T), [[x, y, 0]]))[0])
    return int(v), int(u)


def cluttered() -> list[PlacedMesh]:
    """A table with a ball, a small plate in the air and a textured square."""
    texture = np.random.default_rng(0).integers(0, 255, (16, 16, 3), dtype=np.uint8)
    card = replace(square(0.08), texture=texture)
    return [
        PlacedMesh(-1, square(0.45), np.eye(4), WHITE),
        PlacedMesh(0, ball(0.1), se3.from_translation([0.2, 0.1, 0.1]),
                   Material(base_color=(0.8, 0.2, 0.1), roughness=0.3)),
        PlacedMesh(1, square(0.07), se3.from_translation([-0.1, 0.1, 0.12])),
        PlacedMesh(2, card, se3.from_translation([-0.05, -0.2, 0.001])),
    ]  # fmt: skip


@pytest.mark.parametrize(("roughness", "metallic"), [(0.05, 1.0), (1.0, 0.0)])
def test_white_surfaces_vanish_in_a_white_room(roughness: float, metallic: float) -> None:
    material = Material(base_color=(1.0, 1.0, 1.0), roughness=roughness, metallic=metallic)
    for mesh in (square(), ball(0.3)):
        light = light_of([PlacedMesh(0, mesh, np.eye(4), material)], even_sky(), ABOVE, SMALL)
        assert np.abs(light - 1).max() < 0.02


@pytest.mark.parametrize("tilt_deg", [45, 135])
def test_a_half_white_sky_lights_by_the_tilt(tilt_deg: float) -> None:
    # Matte white under a white upper half: (1 + cos tilt) / 2 of white (form factor of the sky).
    panorama = np.zeros((64, 128, 3), np.float32)
    panorama[:32] = 1.0
    T_world_obj = se3.from_rt(se3.exp_so3([np.radians(tilt_deg), 0, 0]), [0, 0, 0])
    T = se3.look_at(T_world_obj[:3, 2] + np.array([1e-3, 0, 0]), [0, 0, 0])
    placed = [PlacedMesh(0, square(2.0), T_world_obj, WHITE)]
    light = light_of(placed, Environment(panorama=panorama), T)
    expected = 0.5 + 0.5 * np.cos(np.radians(tilt_deg))
    # The coat (4 % reflectance) sees another part of the sky than the matte part does.
    assert light[50:70, 70:90].mean() == pytest.approx(expected, abs=0.035)


def test_everything_turned_together_looks_the_same() -> None:
    rng = np.random.default_rng(3)
    panorama = np.repeat(np.repeat(rng.uniform(0, 2, (8, 16, 3)), 8, 0), 8, 1).astype(np.float32)
    quarter = se3.from_rt(se3.exp_so3([0, 0, np.pi / 2]), [0, 0, 0])
    T = se3.look_at([0.4, -0.7, 0.6], [0, 0, 0])
    sun = (0.6, 0.3, 0.8)
    sky = Environment(panorama=panorama, sun=(1, 1, 1), sun_direction=sun)
    still = light_of(cluttered(), sky, T)
    x, y, z = sun
    rolled = np.roll(panorama, 32, axis=1)
    turned_sky = Environment(panorama=rolled, sun=(1, 1, 1), sun_direction=(-y, x, z))
    placed = [PlacedMesh(p.instance, p.mesh, quarter @ p.T_world_obj, p.material)
              for p in cluttered()]  # fmt: skip
    turned = light_of(placed, turned_sky, quarter @ T)
    assert np.mean(np.abs(turned - still)) < 0.01 * still.mean()
    assert np.quantile(np.abs(turned - still), 0.99) < 0.06


def test_the_sun_shadow_falls_where_geometry_says() -> None:
    # 45 degrees up in +x: the plate at z = 0.1 shades x' = x - 0.1, hard-edged.
    sky = even_sky(0.2, sun=(1, 1, 1), sun_direction=(1, 0, 1), sun_radius_deg=0.0)
    placed = [
        PlacedMesh(-1, square(0.5), np.eye(4), WHITE),
        PlacedMesh(0, square(0.05), se3.from_translation([0, 0, 0.1])),
    ]
    light = light_of(placed, sky, ambient_rays=0)
    open_light = light[pixel_of(0.3, 0.3)][0]
    assert open_light == pytest.approx(0.2 + np.sqrt(0.5), rel=0.05)
    for x, y, shaded in ((-0.13, 0, True), (-0.17, 0, False), (-0.1, 0.035, True),
                         (-0.1, 0.07, False)):  # fmt: skip
        assert (light[pixel_of(x, y)][0] < 0.5 * open_light) == shaded


def test_a_wide_sun_makes_a_penumbra_of_the_right_width() -> None:
    # A half plane's edge 0.2 m up, a sun of 4 deg radius overhead: penumbra 2 * 0.2 * tan 4 deg.
    half = replace(square(1.0), vertices=square(1.0).vertices + np.array([1.0, 0, 0]))
    sky = even_sky(0.0, sun=(1, 1, 1), sun_direction=(0, 0, 1), sun_radius_deg=4.0)
    view = CameraIntrinsics(width=120, height=40, fx=300, fy=300, cx=59.5, cy=19.5)
    T = se3.look_at([0, 0, 0.15], [0, 0, 0])
    placed = [PlacedMesh(-1, square(2.0), np.eye(4), WHITE),
              PlacedMesh(0, half, se3.from_translation([0, 0, 0.2]))]  # fmt: skip
    share = light_of(placed, sky, T, view, ambient_rays=0, edge_samples=32)[..., 0].mean(0)
    share = share / share[:20].mean()
    x = (np.arange(120) - 59.5) * 0.15 / 300
    radius = 0.2 * np.tan(np.radians(4.0))
    s = np.clip(x / radius, -1, 1)
    expected = (np.arccos(s) - s * np.sqrt(1 - s * s)) / np.pi
    assert np.abs(share - expected).max() < 0.08
    assert np.abs(share - expected).mean() < 0.02


def test_a_round_body_of_few_faces_has_a_round_terminator() -> None:
    # Of the light of a side sun a matte ball sends cos(angle to the sun), whatever its facets.
    sky = even_sky(0.0, sun=(1, 1, 1), sun_direction=(1, 0, 0), sun_radius_deg=0.0)
    view = CameraIntrinsics(width=120, height=120, fx=500, fy=500, cx=59.5, cy=59.5)
    T = se3.look_at([0, 0, 1.0], [0, 0, 0])
    few, many = (
        light_of([PlacedMesh(0, ball(0.1, n), np.eye(4), WHITE)], sky, T, view, ambient_rays=0,
                 reflections=False)[..., 0]
        for n in (9, 96)
    )  # fmt: skip
    middle = np.hypot(*(np.indices((120, 120)) - 59.5)) < 40
    assert np.abs(few - many)[middle].mean() < 0.02
    # Facets on the dark side of the terminator would be black where the ball is still lit.
    lit = middle & (many > 0.03)
    assert np.mean(few[lit] > 0.3 * many[lit]) > 0.98


def test_a_lamp_leaves_no_pattern_in_its_shadow() -> None:
    # A small strong lamp in a dark room: rays spread evenly would meet it once in 200 times.
    panorama = np.full((64, 128, 3), 0.1, np.float32)
    panorama[6:12, 20:36] = 30.0
    plate = PlacedMesh(0, square(0.12), se3.from_translation([0, 0, 0.15]), WHITE)
    placed = [PlacedMesh(-1, square(2.0), np.eye(4), WHITE), plate]
    sky = Environment(panorama=panorama)
    quick, exact = (light_of(placed, sky, ambient_rays=n)[..., 0] for n in (2, 64))
    table = PhotoRenderer(placed, SHARP, sky).render(WIDE, ABOVE).depth_m > 0.9
    differ = np.abs(quick - exact)[table] / np.median(exact[table])
    assert differ.mean() < 0.015 and np.quantile(differ, 0.99) < 0.12


def test_a_deep_corner_is_darker_than_the_open_table() -> None:
    wall = se3.from_rt(se3.exp_so3([np.pi / 2, 0, 0]), [0, 0.2, 0.5])
    placed = [
        PlacedMesh(-1, square(0.8), np.eye(4), WHITE),
        PlacedMesh(0, square(0.5), wall, Material(base_color=(0.0, 0.0, 0.0), roughness=1.0)),
    ]
    T = se3.look_at([0, -0.3, 1.2], [0, 0, 0])
    light = light_of(placed, even_sky(), T, ambient_rays=4)
    places = (pixel_of(0, y, T) for y in (0.19, 0.0, -0.5))
    seen = [light[v, u - 3 : u + 4].mean() for v, u in places]
    assert 0.4 < seen[0] < 0.7  # beside an endless black wall it would be half
    assert seen[0] < seen[1] < seen[2] and seen[2] > 0.8


def test_colour_bleeds_off_a_sunlit_neighbour() -> None:
    wall = se3.from_rt(se3.exp_so3([np.pi / 2, 0, 0]), [0, 0.1, 0.3])
    red = Material(base_color=(0.9, 0.05, 0.05), roughness=1.0)
    placed = [PlacedMesh(-1, square(0.8), np.eye(4), WHITE), PlacedMesh(0, square(0.3), wall, red)]
    T = se3.look_at([0, -0.5, 0.8], [0, 0, 0])
    light = light_of(placed, even_sky(0.3, sun=(1, 1, 1), sun_direction=(0, -1, 0.4)), T)
    ratio = []
    for y in (0.07, -0.3):
        v, u = pixel_of(0, y, T)
        patch = light[v - 1 : v + 2, u - 2 : u + 3].mean((0, 1))
        ratio.append(patch[0] / patch[1])
    assert ratio[0] > 1.15 and ratio[1] < 0.5 * ratio[0] + 0.6


def test_a_mirror_shows_the_thing_above_it() -> None:
    mirror = Material(base_color=(1, 1, 1), metallic=1.0, roughness=0.05)
    green = Material(base_color=(0.0, 0.6, 0.0), roughness=1.0)
    upright = se3.from_rt(se3.exp_so3([np.pi / 2, 0, 0]), [0, 0.3, 0.2])
    placed = [PlacedMesh(0, square(0.3), np.eye(4), mirror),
              PlacedMesh(1, square(0.2), upright, green)]  # fmt: skip
    T = se3.look_at([0, -0.6, 0.4], [0, 0.1, 0.0])
    at = pixel_of(0, 0.1, T)
    with_it = light_of(placed, even_sky(), T)[at]
    without = light_of(placed, even_sky(), T, reflections=False, ambient_rays=0)[at]
    assert with_it[1] > 3 * with_it[0] and without[0] == pytest.approx(1.0, abs=0.02)


def test_the_background_is_the_panorama() -> None:
    rng = np.random.default_rng(1)
    panorama = np.repeat(np.repeat(rng.uniform(0, 1, (8, 16, 3)), 8, 0), 8, 1).astype(np.float32)
    T = se3.look_at([0, 0, 0], [0.8, 0.5, 0.3])
    light = light_of([], Environment(panorama=panorama), T)
    table = camera.ray_table(WIDE)
    d = (table / np.linalg.norm(table, axis=-1, keepdims=True)) @ T[:3, :3].T
    phi = np.arctan2(d[..., 1], d[..., 0]) / (2 * np.pi) % 1.0
    theta = np.arccos(d[..., 2]) / np.pi
    column, row = (phi * 128).astype(int) % 128, np.minimum((theta * 64).astype(int), 63)
    differ = np.abs(light - panorama[row, column]).max(-1)
    assert np.median(differ) < 0.01  # but for the seams between its blocks


def test_exposure_brightens_the_picture_not_the_light() -> None:
    T = se3.look_at([0.4, -0.7, 0.6], [0, 0, 0])
    dark, bright = (
        PhotoRenderer(cluttered(), SHARP, even_sky(0.4, exposure=e)) for e in (1.0, 1.5)
    )
    assert np.median(np.abs(dark.radiance(WIDE, T)[0] - bright.radiance(WIDE, T)[0])) == 0
    assert bright.render(WIDE, T).rgb.mean() > 1.1 * dark.render(WIDE, T).rgb.mean()


def test_an_empty_scene_and_an_empty_view_show_the_sky() -> None:
    sky = even_sky(0.5)
    away = se3.look_at([0, 0, 1], [3, 0, 2])
    for placed in ([], cluttered()):
        photo = PhotoRenderer(placed, None, sky).render(WIDE, away)
        assert np.all(photo.depth_m == 0)
        assert np.ptp(photo.rgb) == 0 and photo.rgb[0, 0, 0] == 188  # sRGB of one half


def test_ray_counts_out_of_range_are_named() -> None:
    refused("ambient rays", LightSampling, ambient_rays=-1)
    refused("edge samples", LightSampling, edge_samples=0)


# --- Materials: images lie where coordinates say, in both lights, and what lacks them is named.

LENS_VIEW = CameraIntrinsics(
    width=161, height=121, fx=150, fy=150, cx=80, cy=60,
    distortion=np.array([-0.1, 0.05, 0.0005, -0.0005, 0.0]),
)  # fmt: skip
OVER = se3.look_at([0, 0, 1.2], [0, 0, 0])
WHITE_SKY = Environment(panorama=np.ones((8, 16, 3), np.float32))


def lit(mesh: Mesh, material: Material | None, sky: Environment | None = WHITE_SKY,
        T: np.ndarray = OVER) -> np.ndarray:  # fmt: skip
    placed = [PlacedMesh(0, mesh, np.eye(4), material)]
    return PhotoRenderer(placed, SHARP, sky).radiance(LENS_VIEW, T)[0]


def at(picture: np.ndarray, x: float, y: float, T: np.ndarray = OVER) -> np.ndarray:
    return picture[pixel_of(x, y, T, LENS_VIEW)]


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
    table = camera.ray_table(LENS_VIEW)[60].astype(float) @ T[:3, :3].T
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
