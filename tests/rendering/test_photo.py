"""Photographs: every printed edge lies where it is projected, and the look stays.

Of moving bodies they are those of the ray caster, and only what moves is rendered again.
"""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from plain_meshes import box, square
from realsim.arrays import Array
from realsim.geometry import camera, se3
from realsim.geometry.mesh import box_mesh
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, Mesh, TagBoard
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.board import board_mesh
from realsim.rendering.casting.pixel_caster import (
    NOT_WANTED,
    PixelCaster,
    empty_buffers,
    enter,
    may_be_seen,
)
from realsim.rendering.embedded.sun_shadows import SunBodies, cast_shadows, sort_points
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.moving_scene import Moment, MovingScene
from realsim.rendering.photo import Lighting, PhotoRenderer, PlacedMesh
from refusals import refused

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


# --- Boards: every printed edge lies where it is projected.


BOARD = TagBoard(rows=3, columns=4, tag_size_m=0.03, gap_m=0.0087)
T_WORLD_BOARD = se3.from_rt(se3.exp_so3([np.pi, 0, 0]), [0.3, 0.06, 0.0])
"""Face up on the table: the board's z points down into it."""
BOARD_LENS = np.array([-0.05, 0.06, 0.0003, -0.0005, -0.02])
CAMERA = CameraIntrinsics(width=480, height=360, fx=450, fy=452, cx=241.3, cy=178.4,
                          distortion=BOARD_LENS)  # fmt: skip


def photo_of_board(
    eye: list[float], intrinsics: CameraIntrinsics = CAMERA
) -> tuple[np.ndarray, ...]:
    T = se3.look_at(eye, [0.37, 0.01, 0.0], 0.2)
    placed = [PlacedMesh(-1, board_mesh(BOARD), T_WORLD_BOARD)]
    rgb = PhotoRenderer(placed).render(intrinsics, T).rgb
    T_cam_board = se3.invert(T) @ T_WORLD_BOARD
    return rgb, camera.project(CAMERA, se3.transform(T_cam_board, BOARD.corners_board)), T_cam_board


def edge_offsets(rgb: np.ndarray, T_cam_board: np.ndarray) -> np.ndarray:
    """Return (edges, 3): how far outward each tag edge is seen [px], and its outward normal."""
    grey = rgb.mean(-1).astype(np.float32)
    s = np.linspace(-2.8, 2.8, 57)
    found: list[list[float]] = []
    for corners in BOARD.corners_board:
        for a, b in zip(corners, np.roll(corners, -1, 0), strict=True):
            on_edge = a + (b - a) * np.linspace(0.2, 0.8, 25)[:, None]
            outward = 1e-3 * (on_edge.mean(0) - corners.mean(0))
            uv = camera.project(CAMERA, se3.transform(T_cam_board, on_edge))
            n = camera.project(CAMERA, se3.transform(T_cam_board, on_edge + outward)) - uv
            along = np.gradient(uv, axis=0)
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            n -= along * np.sum(n * along, axis=1, keepdims=True)
            n /= np.linalg.norm(n, axis=1, keepdims=True)
            at = (uv[:, None] + s[None, :, None] * n[:, None]).astype(np.float32)
            profile = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR).mean(0)
            dark, white = profile[:5].mean(), profile[-5:].mean()
            # An edge at x leaves (end - x) of the profile white.
            step = s[1] - s[0]
            x = s[-1] + step / 2 - step * float(np.sum((profile - dark) / (white - dark)))
            found.append([x, *n.mean(0)])
    return np.array(found)


def common_shift(offsets: np.ndarray) -> np.ndarray:
    """Return the shift (2,) [px] of the whole picture that explains the edges' offsets best."""
    return np.linalg.lstsq(offsets[:, 1:], offsets[:, 0], rcond=None)[0]


@pytest.mark.parametrize("eye", [[0.37, -0.12, 0.28], [0.31, 0.1, 0.24]])
def test_printed_edges_lie_where_they_are_projected(eye: list[float]) -> None:
    rgb, _, T_cam_board = photo_of_board(eye)
    offsets = edge_offsets(rgb, T_cam_board)
    assert abs(offsets[:, 0].mean()) < 0.01  # tags neither grow nor shrink
    assert np.abs(common_shift(offsets)).max() < 0.01  # and nothing is shifted
    assert np.abs(offsets[:, 0]).max() < 0.1


def test_the_measurement_would_see_half_a_pixel() -> None:
    moved = replace(CAMERA, cx=CAMERA.cx + 0.5)
    rgb, _, T_cam_board = photo_of_board([0.37, -0.12, 0.28], intrinsics=moved)
    assert np.allclose(common_shift(edge_offsets(rgb, T_cam_board)), [0.5, 0.0], atol=0.03)


def test_a_detector_reads_the_tags_upright() -> None:
    rgb, corners, _ = photo_of_board([0.37, -0.1, 0.26])
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 3
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(rgb)
    assert sorted(ids.ravel().tolist()) == BOARD.ids.tolist()
    error = np.array([c[0] - corners[k] for c, k in zip(found, ids.ravel(), strict=True)])
    assert np.abs(error).max() < 0.7
    assert np.abs(error.reshape(-1, 2).mean(0)).max() < 0.05


def test_board_mesh_faces_its_viewer_and_carries_its_corners() -> None:
    mesh = board_mesh(BOARD, margin_m=0.015)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert np.all(normal[:, 2] < 0) and np.allclose(normal[:, :2], 0)
    width, height = BOARD.size_m
    assert np.allclose(mesh.bounds[:, :2], [[-0.015] * 2, [width + 0.015, height + 0.015]])
    assert mesh.uv is not None and mesh.texture is not None
    size = np.array([mesh.texture.shape[1], mesh.texture.shape[0]])
    for corner in BOARD.corners_board.reshape(-1, 3):
        at = np.flatnonzero(np.linalg.norm(mesh.vertices - corner, axis=1) < 1e-12)
        assert len(at) == 1
        texel = (mesh.uv[at[0]] * [1, -1] + [0, 1]) * size
        assert np.allclose(texel, np.round(texel), atol=1e-9)
    # The first tag begins with its black border, and the margin is white.
    assert mesh.texture[0, 0].tolist() == [255, 255, 255]
    refused("margin", board_mesh, BOARD, margin_m=0.0)


def plates() -> list[PlacedMesh]:
    plate = replace(square(0.05), uv=None, colors=np.full((4, 3), (200, 40, 40), np.uint8))
    above = se3.from_translation([0, 0, 0.1])
    return [PlacedMesh(-1, square(), np.eye(4)), PlacedMesh(0, plate, above)]


SMALL = CameraIntrinsics(
    width=160, height=120, fx=120, fy=120, cx=79.5, cy=59.5, distortion=BOARD_LENS
)


def test_depth_is_that_of_the_labels() -> None:
    T = se3.look_at([0.3, -0.4, 0.5], [0, 0, 0])
    photo = PhotoRenderer(plates()).render(SMALL, T)
    assert np.array_equal(photo.depth_m, LabelRenderer(plates()).render(SMALL, T).depth_m)


def test_noise_comes_from_the_generator_only() -> None:
    T = se3.look_at([0.3, -0.4, 0.5], [0, 0, 0])
    renderer = PhotoRenderer(plates())
    clean = renderer.render(SMALL, T).rgb
    a, b, c = (renderer.render(SMALL, T, np.random.default_rng(s)).rgb for s in (1, 1, 2))
    assert np.array_equal(clean, renderer.render(SMALL, T).rgb)
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    level = clean.astype(float)
    light = Lighting()
    sd = 255 * np.sqrt(level / 255 * light.full_well + light.read_noise**2) / light.full_well
    z = (a.astype(float) - level) / np.sqrt(sd**2 + 1 / 12)
    assert z.std() == pytest.approx(1.0, abs=0.05) and abs(z.mean()) < 0.02


# --- what must not move ---------------------------------------------------------------------------


STILL_VIEW = CameraIntrinsics(width=96, height=64, fx=80, fy=80, cx=47.3, cy=31.8, distortion=LENS)
BESIDE = se3.look_at([0.35, -0.7, 0.6], [0, 0, 0.03])
GOLDEN_MEANS = np.array([
    [[77.4, 78.6, 82.3], [76.5, 77.3, 80.7], [75.6, 76.7, 80.4], [77.4, 78.7, 82.4]],
    [[93.0, 86.5, 81.2], [138.6, 119.0, 97.1], [124.4, 90.4, 73.7], [99.1, 90.8, 83.2]],
    [[159.9, 131.5, 99.9], [130.0, 100.3, 82.1], [159.9, 124.4, 92.8], [142.9, 119.4, 93.9]],
    [[82.6, 75.5, 69.3], [156.7, 128.7, 97.5], [170.4, 139.1, 104.1], [135.7, 114.5, 91.5]],
])  # fmt: skip
"""Mean colours of 4 x 4 blocks of the still life, 16 rows and 24 columns each [0, 255]."""
GOLDEN_STD, GOLDEN_STEP = 38.07, 2.873
"""Spread of all values, and mean difference of horizontal neighbours."""


def still_life() -> list[PlacedMesh]:
    """A wooden table with a painted, a coloured and a printed box."""
    print_ = np.zeros((8, 8, 3), np.uint8)
    print_[::2, ::2], print_[1::2, 1::2] = (220, 40, 30), (30, 60, 200)
    label = Material(base_color_image=print_, period_m=0.1, roughness=0.3)
    cube, paint = box((0.1, 0.1, 0.1)), (np.arange(24).reshape(8, 3) * 10).astype(np.uint8)
    turned = se3.exp_so3([0, 0, 0.4])
    return [
        PlacedMesh(-1, box((1.0, 0.8, 0.04)), se3.from_translation([0, 0, -0.02])),
        PlacedMesh(0, box((0.12, 0.1, 0.16)), se3.from_rt(turned, [0.12, 0.05, 0.08])),
        PlacedMesh(1, replace(cube, colors=paint), se3.from_translation([-0.12, 0.1, 0.05])),
        PlacedMesh(2, box((0.14, 0.08, 0.06)), se3.from_translation([-0.05, -0.13, 0.03]), label),
    ]


def room() -> Environment:
    panorama = np.full((32, 64, 3), 0.2, np.float32)
    panorama[2:6, 10:20] = 15.0  # a lamp
    return Environment(panorama=panorama, sun=(0.5, 0.5, 0.4), sun_direction=(0.4, 0.3, 0.8))


@cache
def digests() -> list[str]:
    """Digests of the noisy picture in the even room and under an environment."""
    out = []
    for sky in (None, room()):
        renderer, rng = PhotoRenderer(still_life(), None, sky), np.random.default_rng(3)
        photo = renderer.render(STILL_VIEW, BESIDE, rng)
        out.append(hashlib.sha256(photo.rgb.tobytes() + photo.depth_m.tobytes()).hexdigest())
    return out


def test_the_look_without_an_environment_stays() -> None:
    rgb = PhotoRenderer(still_life(), Lighting()).render(STILL_VIEW, BESIDE).rgb.astype(float)
    assert np.abs(rgb.reshape(4, 16, 4, 24, 3).mean((1, 3)) - GOLDEN_MEANS).max() < 0.5
    assert rgb.std() == pytest.approx(GOLDEN_STD, abs=0.3)
    assert np.abs(np.diff(rgb, axis=1)).mean() == pytest.approx(GOLDEN_STEP, abs=0.1)


def test_where_nothing_stands_the_room_is_seen() -> None:
    photo = PhotoRenderer([]).render(STILL_VIEW, BESIDE)
    assert np.all(photo.geometry == -1) and photo.rgb.min() > 30


@pytest.mark.slow
def test_the_bytes_do_not_depend_on_the_number_of_threads() -> None:
    threads, here = "3", Path(__file__)
    limits = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")
    paths = os.pathsep.join(map(str, (here.parent, here.parents[1] / "support")))
    script = (
        f"import json, cv2; cv2.setNumThreads({threads}); import {here.stem} as t;"
        "print(json.dumps(t.digests()))"
    )
    env = os.environ | dict.fromkeys(limits, threads) | {"PYTHONPATH": paths}
    text = subprocess.check_output([sys.executable, "-c", script], env=env, text=True)
    assert json.loads(text.splitlines()[-1]) == digests()
