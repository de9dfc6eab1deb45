"""Materials look as the records say: images the right way up, paint, normals, projection."""

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.colors import srgb_decoded
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.embedded.materials import PLAIN_COLORS
from realsim.rendering.photoreal import PhotorealConfig, PhotorealRenderer
from realsim.rendering.rays import PlacedMesh

CAMERA = CameraIntrinsics(width=32, height=32, fx=32.0, fy=32.0, cx=15.5, cy=15.5)
FROM_ABOVE = se3.look_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
"""Looking straight down, the picture's right is the world's x and its top the world's y."""
WHITE_ROOM = Environment(panorama=np.full((4, 8, 3), 0.5, np.float32))
HUE = 0.12
"""The coat adds some white; a wrong image or paint is 0.3 or more off."""
COLORS = np.array([[[220, 30, 30], [30, 220, 30]], [[30, 30, 220], [220, 220, 30]]], np.uint8)


def square(uv: np.ndarray | None = None, **look: np.ndarray) -> Mesh:
    """The unit square in x and y, looking up; its texture coordinates are x + 0.5, y + 0.5."""
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    corners = np.column_stack([xy - 0.5, np.zeros(4)])
    return Mesh(vertices=corners, faces=np.array([[0, 1, 2], [0, 2, 3]]),
                uv=xy if uv is None else uv, **look)  # fmt: skip


def picture(placed: PlacedMesh, sky: Environment = WHITE_ROOM) -> np.ndarray:
    config = PhotorealConfig(variant="scalar", samples=16, denoise=False, psf_px=0)
    return PhotorealRenderer([placed], sky, config).render(CAMERA, FROM_ABOVE).rgb.astype(float)


def quadrants(rgb: np.ndarray) -> np.ndarray:
    return np.array([[rgb[4:12, 4:12].mean((0, 1)), rgb[4:12, 20:28].mean((0, 1))],
                     [rgb[20:28, 4:12].mean((0, 1)), rgb[20:28, 20:28].mean((0, 1))]])  # fmt: skip


def hues(colors: np.ndarray) -> np.ndarray:
    linear = srgb_decoded(np.asarray(colors, float) / 255.0)
    return linear / linear.sum(-1, keepdims=True)


def test_a_texture_s_first_row_is_at_the_top_of_v() -> None:
    image = np.repeat(np.repeat(COLORS, 16, 0), 16, 1)
    own = PlacedMesh(0, square(texture=image), np.eye(4))
    material = Material(base_color=(1, 1, 1), base_color_image=image, projection="uv")
    given = PlacedMesh(0, square(), np.eye(4), material)
    for placed in (own, given):
        seen = quadrants(picture(placed))
        assert np.abs(hues(seen) - hues(COLORS)).max() < HUE


def test_box_projection_repeats_the_image_every_period_along_the_face() -> None:
    image = np.repeat(np.repeat(COLORS, 16, 0), 16, 1)
    material = Material(base_color=(1, 1, 1), base_color_image=image, period_m=1.0)
    mesh = Mesh(vertices=square().vertices, faces=square().faces)
    # u = x and v = y: half a tile further the image begins anew, so quadrants change places.
    seen = quadrants(picture(PlacedMesh(0, mesh, np.eye(4), material)))
    assert np.abs(hues(seen) - hues(COLORS[::-1, ::-1])).max() < HUE
    halved = Material(base_color=(1, 1, 1), base_color_image=image, period_m=0.5)
    seen = quadrants(picture(PlacedMesh(0, mesh, np.eye(4), halved)))
    assert np.ptp(seen, axis=(0, 1)).max() < 12  # a whole tile in each quadrant


def test_vertex_colours_and_paints_are_seen_as_they_are() -> None:
    color = np.array([200, 60, 90], np.uint8)
    mesh = Mesh(vertices=square().vertices, faces=square().faces, colors=np.tile(color, (4, 1)))
    seen = picture(PlacedMesh(0, mesh, np.eye(4)))[8:24, 8:24].mean((0, 1))
    assert np.abs(hues(seen) - hues(color)).max() < HUE
    bare = Mesh(vertices=square().vertices, faces=square().faces)
    for instance in (13,):
        seen = picture(PlacedMesh(instance, bare, np.eye(4)))[8:24, 8:24].mean((0, 1))
        paint = np.array(PLAIN_COLORS[instance % len(PLAIN_COLORS)])
        assert np.abs(hues(seen) - hues(paint)).max() < HUE


def tilted(x: float, y: float) -> np.ndarray:
    normal = np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])
    return np.tile(np.round(128 + 127 * normal).astype(np.uint8), (4, 4, 1))


def lit_from(x: float, y: float) -> Environment:
    return Environment(panorama=np.zeros((4, 8, 3), np.float32), sun=(0.5, 0.5, 0.5),
                       sun_direction=(x, y, 1.0), sun_radius_deg=0)  # fmt: skip


@pytest.mark.parametrize(("axis", "mirrored"), [(0, True), (1, False)])
def test_a_normal_image_tilts_the_surface_towards_u_and_v(axis: int, mirrored: bool) -> None:
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    if mirrored:
        uv[:, 0] = 1 - uv[:, 0]
    tilt = np.eye(2)[axis] * 0.5
    material = Material(base_color=(0.8, 0.8, 0.8), roughness=1.0, projection="uv",
                        normal_image=tilted(*tilt))  # fmt: skip
    placed = PlacedMesh(0, square(uv), np.eye(4), material)
    along = tilt * (-1 if mirrored and axis == 0 else 1)
    facing = picture(placed, lit_from(*along))[8:24, 8:24].mean()
    averted = picture(placed, lit_from(*-along))[8:24, 8:24].mean()
    assert facing > 1.25 * averted


def test_metal_mirrors_the_room_in_its_own_colour() -> None:
    sky = np.zeros((16, 32, 3), np.float32)
    sky[:4] = 0.6  # the ceiling, which a level mirror shows to a camera above it
    metal = Material(base_color=(0.9, 0.45, 0.1), roughness=0.04, metallic=1.0)
    seen = picture(PlacedMesh(0, square(), np.eye(4), metal), Environment(panorama=sky))
    light = srgb_decoded(seen[10:22, 10:22].mean((0, 1)) / 255)
    assert np.abs(light - 0.6 * np.array(metal.base_color)).max() < 0.04


def test_a_material_that_needs_coordinates_on_a_mesh_without_is_named() -> None:
    mesh = Mesh(vertices=square().vertices, faces=square().faces)
    material = Material(base_color_image=COLORS, projection="uv", name="label")
    with pytest.raises(InputError, match=r"label.*box"):
        PhotorealRenderer([PlacedMesh(4, mesh, np.eye(4), material)], WHITE_ROOM,
                          PhotorealConfig(variant="scalar"))  # fmt: skip
