"""Boards and photographs: every printed edge lies where it is projected."""

from dataclasses import replace

import numpy as np
import pytest

from plain_meshes import square
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, TagBoard
from realsim.rendering.board import board_mesh
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.photo import Lighting, PhotoRenderer, PlacedMesh
from refusals import refused

BOARD = TagBoard(rows=3, columns=4, tag_size_m=0.03, gap_m=0.0087)
T_WORLD_BOARD = se3.from_rt(se3.exp_so3([np.pi, 0, 0]), [0.3, 0.06, 0.0])
"""Face up on the table: the board's z points down into it."""
LENS = np.array([-0.05, 0.06, 0.0003, -0.0005, -0.02])
CAMERA = CameraIntrinsics(width=480, height=360, fx=450, fy=452, cx=241.3, cy=178.4,
                          distortion=LENS)  # fmt: skip


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
    import cv2

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
    import cv2

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


def scene() -> list[PlacedMesh]:
    plate = replace(square(0.05), uv=None, colors=np.full((4, 3), (200, 40, 40), np.uint8))
    above = se3.from_translation([0, 0, 0.1])
    return [PlacedMesh(-1, square(), np.eye(4)), PlacedMesh(0, plate, above)]


SMALL = CameraIntrinsics(width=160, height=120, fx=120, fy=120, cx=79.5, cy=59.5, distortion=LENS)


def test_depth_is_that_of_the_labels() -> None:
    T = se3.look_at([0.3, -0.4, 0.5], [0, 0, 0])
    photo = PhotoRenderer(scene()).render(SMALL, T)
    assert np.array_equal(photo.depth_m, LabelRenderer(scene()).render(SMALL, T).depth_m)


def test_noise_comes_from_the_generator_only() -> None:
    T = se3.look_at([0.3, -0.4, 0.5], [0, 0, 0])
    renderer = PhotoRenderer(scene())
    clean = renderer.render(SMALL, T).rgb
    a, b, c = (renderer.render(SMALL, T, np.random.default_rng(s)).rgb for s in (1, 1, 2))
    assert np.array_equal(clean, renderer.render(SMALL, T).rgb)
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    level = clean.astype(float)
    light = Lighting()
    sd = 255 * np.sqrt(level / 255 * light.full_well + light.read_noise**2) / light.full_well
    z = (a.astype(float) - level) / np.sqrt(sd**2 + 1 / 12)
    assert z.std() == pytest.approx(1.0, abs=0.05) and abs(z.mean()) < 0.02
