"""Photoreal pictures lie on the labels' pixel grid, under every lens."""

import numpy as np
import pytest

from llvm_library import NEEDS_LLVM
from plain_meshes import box, square
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.photo import developed
from realsim.rendering.photoreal import PhotorealConfig, PhotorealRenderer
from realsim.rendering.rays import PlacedMesh
from trimesh_solids import ball

LENSES = {
    "brown": np.array([-0.28, 0.11, 0.0012, -0.0009, -0.02, 0, 0, 0]),
    "rational": np.array([0.4, -0.2, 0.0003, 0.0006, 0.03, 0.7, -0.05, 0.02]),
}


def lens(name: str, width: int, height: int) -> CameraIntrinsics:
    return CameraIntrinsics(
        width=width, height=height, fx=0.6 * width, fy=0.61 * width,
        cx=0.49 * width, cy=0.52 * height, distortion=LENSES[name],
    )  # fmt: skip


def clutter(origin: np.ndarray) -> list[PlacedMesh]:
    rng = np.random.default_rng(3)
    placed = [PlacedMesh(-1, box((1.0, 1.0, 0.02)), se3.from_translation(origin - [0, 0, 0.01]))]
    for i in range(7):
        mesh = ball(0.04) if i % 2 else box((0.06, 0.04, 0.09))
        # Apart, and off the table: where two faces coincide either answer is right.
        at = [0.09 * (i % 3 - 1), 0.1 * (i // 3 - 1), 0.051]
        T = se3.from_rt(se3.exp_so3([0, 0, rng.uniform(0, 6)]), origin + at)
        placed.append(PlacedMesh(3 * i, mesh, T))
    return placed


def grey_sky(radiance: float = 0.7) -> Environment:
    return Environment(panorama=np.full((8, 16, 3), radiance, np.float32), sun=(0.5, 0.5, 0.5))


@pytest.mark.parametrize(
    ("variant", "name", "origin"),
    [
        pytest.param("llvm", "rational", np.array([130.0, -70.0, 12.0]), marks=NEEDS_LLVM),
        ("scalar", "brown", np.zeros(3)),
    ],
)
def test_the_path_tracer_meets_what_the_labels_say(
    variant: str, name: str, origin: np.ndarray
) -> None:
    scale = 3 if variant == "llvm" else 1
    intrinsics = lens(name, 160 * scale, 90 * scale)
    placed = clutter(origin)
    T = se3.look_at(origin - np.array([0.25, 0.3, -0.3]), origin + np.array([0, 0, 0.03]))
    labels = LabelRenderer(placed).render(intrinsics, T)
    renderer = PhotorealRenderer(placed, grey_sky(), PhotorealConfig(variant=variant))
    traced = renderer.first_hits(intrinsics, T)
    objects = (labels.ids >= 0) | (traced.instance >= 0)
    assert np.count_nonzero(labels.ids >= 0) > 1000
    different = np.count_nonzero((labels.ids != traced.instance)[objects])
    assert different <= 1e-4 * np.count_nonzero(objects)
    same = (labels.depth_m > 0) & (labels.geometry == traced.geometry)
    assert np.count_nonzero(same) >= (1 - 1e-4) * np.count_nonzero(labels.depth_m > 0)
    error = np.abs(labels.depth_m - traced.depth_m)[same] / labels.depth_m[same]
    # Rays that graze a face may differ by more: float32 rounds where they begin.
    assert np.count_nonzero(error >= 1e-5) <= 1e-4 * len(error)
    assert np.median(error) < 2e-7


def test_the_picture_s_edges_lie_on_the_labels_edges() -> None:
    intrinsics = lens("rational", 80, 45)
    dark = Material(base_color=(0.0, 0.0, 0.0), roughness=1.0)
    placed = [PlacedMesh(0, ball(0.08), np.eye(4), dark)]
    T = se3.look_at([0.02, -0.2, 0.15], [0.01, 0.0, 0.0])
    # Against a white sky a black ball darkens a pixel by the share of it that it covers.
    sky = Environment(panorama=np.full((8, 16, 3), 0.5, np.float32))
    config = PhotorealConfig(samples=36, denoise=False, psf_px=0)
    rgb = PhotorealRenderer(placed, sky, config).render(intrinsics, T).rgb[..., 1] / 255.0
    light = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    known = np.isfinite(light) & (light > 0)
    cover = 1 - light / 0.5

    k = 8  # the labels of the same lens with 8 x 8 pixels for each
    fine = CameraIntrinsics(
        width=intrinsics.width * k, height=intrinsics.height * k,
        fx=intrinsics.fx * k, fy=intrinsics.fy * k,
        cx=(intrinsics.cx + 0.5) * k - 0.5, cy=(intrinsics.cy + 0.5) * k - 0.5,
        distortion=intrinsics.distortion,
    )  # fmt: skip
    ids = LabelRenderer(placed).render(fine, T).ids >= 0
    expected = ids.reshape(intrinsics.height, k, intrinsics.width, k).mean((1, 3))
    gy, gx = np.gradient(expected)
    known &= (np.abs(gx) + np.abs(gy) > 0.05) & (expected + np.abs(gx) > 0)
    slopes = np.stack([gx[known], gy[known]], -1)
    shift, *_ = np.linalg.lstsq(slopes, (cover - expected)[known], rcond=None)
    assert np.count_nonzero(known) > 80
    assert np.abs(shift).max() < 0.03  # [px]; half a pixel is the trap


def test_pixels_that_the_lens_cannot_reach_are_black_without_depth() -> None:
    intrinsics = CameraIntrinsics(
        width=64, height=48, fx=30.0, fy=30.0, cx=31.5, cy=23.5,
        distortion=np.array([-0.6, 0.05, 0, 0, 0, 0, 0, 0]),
    )  # fmt: skip
    placed = clutter(np.zeros(3))
    T = se3.look_at([0, -0.3, 0.4], [0, 0, 0])
    labels = LabelRenderer(placed).render(intrinsics, T)
    config = PhotorealConfig(variant="scalar", samples=8, psf_px=0, denoise=False)
    photo = PhotorealRenderer(placed, grey_sky(), config).render(intrinsics, T)
    assert 0 < np.count_nonzero(labels.unknown) < labels.unknown.size
    assert np.all(photo.rgb[labels.unknown] == 0)
    assert np.all(photo.depth_m[labels.unknown] == 0)
    assert np.all(photo.rgb[~labels.unknown].max(-1) > 0)


def test_a_scene_without_meshes_or_light_is_an_empty_picture() -> None:
    intrinsics = lens("brown", 32, 18)
    T = se3.look_at([0.3, 0, 0.3], [0, 0, 0])
    dark = Environment(panorama=np.zeros((4, 8, 3), np.float32))
    config = PhotorealConfig(variant="scalar", samples=2)
    photo = PhotorealRenderer([], dark, config).render(intrinsics, T)
    assert photo.rgb.shape == (18, 32, 3) and photo.rgb.max() == 0
    assert photo.depth_m.max() == 0
    lit = PhotorealRenderer([], grey_sky(), config).render(intrinsics, T)
    assert lit.rgb.min() > 100 and lit.depth_m.max() == 0


# --- Light comes from where the environment says, as strong as it says.

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
    room = Environment(panorama=panorama(8, 0.5))
    photo = PhotorealRenderer(placed, room, config).render(CAMERA, T)
    inside = photo.rgb[photo.depth_m > 0].astype(float).mean()
    around = photo.rgb[photo.depth_m == 0].astype(float).mean()
    assert abs(inside - around) < 0.06 * around
