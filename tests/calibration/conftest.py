from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, TagBoard
from realsim_calibration import BoardView, TagDetections

Array = NDArray[np.float64]
MODULES = 8  # of a 36h11 tag with its black border
TEXTURE = 12  # texture pixels per module
SUPER = 8  # supersampling of the renderer


def board_texture(board: TagBoard, margin_m: float) -> tuple[NDArray[np.uint8], float, float]:
    """Return the printed board, texture pixels per metre, and the margin [texture px]."""
    from cv2 import aruco

    tag_px = MODULES * TEXTURE
    per_m = tag_px / board.tag_size_m
    pitch = (board.tag_size_m + board.gap_m) * per_m
    assert abs(pitch - round(pitch)) < 1e-6, "choose a gap that is a whole number of texture px"
    margin = round(margin_m * per_m)
    w, h = (round(v * per_m) + 2 * margin for v in board.size_m)
    texture = np.full((h, w), 255, np.uint8)
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
    for k, tag in enumerate(board.ids):
        r, c = divmod(k, board.columns)
        y, x = margin + r * round(pitch), margin + c * round(pitch)
        marker = aruco.generateImageMarker(dictionary, int(tag), MODULES)
        texture[y : y + tag_px, x : x + tag_px] = np.kron(
            marker, np.ones((TEXTURE, TEXTURE), np.uint8)
        )
    return texture, per_m, margin


def render_homography(
    board: TagBoard,
    intrinsics: CameraIntrinsics,
    T_cam_board: Array,
    rng: np.random.Generator,
    blur_px: float,
    noise: float,
) -> NDArray[np.uint8]:
    """Return a photograph (no distortion): 8x supersampled, box filter, blur, noise."""
    import cv2

    texture, per_m, margin = board_texture(board, 0.02)
    # texture pixel k covers [k - 0.5, k + 0.5]; the board's origin is the tag's outer corner.
    to_texture = np.array([[per_m, 0, margin - 0.5], [0, per_m, margin - 0.5], [0, 0, 1]])
    H = intrinsics.K @ T_cam_board[:3, [0, 1, 3]] @ np.linalg.inv(to_texture)
    half = (SUPER - 1) / 2
    big = np.array([[SUPER, 0, half], [0, SUPER, half], [0, 0, 1.0]]) @ H
    paper = np.where(texture > 0, 215, 30).astype(np.uint8)
    size = (intrinsics.width * SUPER, intrinsics.height * SUPER)
    fine = cv2.warpPerspective(paper, big, size, flags=cv2.INTER_NEAREST, borderValue=120.0)
    image = cv2.resize(
        fine, (intrinsics.width, intrinsics.height), interpolation=cv2.INTER_AREA
    ).astype(np.float64)
    image = cv2.GaussianBlur(image, (0, 0), blur_px)
    image = image + rng.normal(scale=noise, size=image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def camera_at(
    rng: np.random.Generator, board: TagBoard, distance: float, max_tilt_deg: float
) -> Array:
    """Return T_cam_board of a camera that looks at the board's middle, tilted and rolled."""
    w, h = board.size_m
    tilt, azimuth = np.radians(rng.uniform(0, max_tilt_deg)), rng.uniform(0, 2 * np.pi)
    roll = rng.uniform(-np.pi, np.pi)
    middle = np.array([w / 2, h / 2, 0.0])
    # The board's z points into the paper, so the camera stands on its negative side.
    away = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    T_board_cam = se3.look_at(middle + distance * np.array(away), middle, roll)
    return se3.invert(T_board_cam)


class Simulation:
    """A robot with a camera in its hand that looks at a board; the truth is known."""

    def __init__(
        self,
        seed: int,
        views: int = 24,
        robot: tuple[float, float] = (0.3e-3, 0.3e-3),
        pixel: float = 0.1,
        roll: bool = True,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.board = TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01)
        self.intrinsics0 = CameraIntrinsics(
            width=1280, height=720, fx=640.0, fy=640.0, cx=639.5, cy=359.5
        )
        self.intrinsics = CameraIntrinsics(
            width=1280, height=720, fx=644.0, fy=643.0, cx=643.0, cy=356.0,
            distortion=np.array([-0.05, 0.04, 0.0006, -0.0004, 0, 0, 0, 0]),
        )  # fmt: skip
        self.T_ee_cam = se3.from_rt(
            se3.exp_so3([0.1, -0.05, 1.5]) @ se3.exp_so3(rng.normal(scale=0.1, size=3)),
            np.array([0.03, -0.06, 0.05]),
        )
        w, h = self.board.size_m
        down = np.diag([1.0, -1.0, -1.0])
        self.T_base_board = se3.from_rt(down, [0.4 - w / 2, 0.1 + h / 2, 0.02])
        self.truth_ee: list[Array] = []
        self.views: list[BoardView] = []
        rot, trans = robot
        for k in range(views):
            T_board_cam = se3.invert(camera_at(rng, self.board, rng.uniform(0.3, 0.5), 45.0))
            if not roll:
                T_board_cam = self._upright(T_board_cam)
            aim = rng.normal(scale=[0.08, 0.05, 0.0], size=3)
            T_base_cam = self.T_base_board @ T_board_cam @ se3.from_rt(se3.exp_so3(aim), [0, 0, 0])
            ee = T_base_cam @ se3.invert(self.T_ee_cam)
            noise = np.concatenate([rng.normal(scale=rot, size=3), rng.normal(scale=trans, size=3)])
            self.truth_ee.append(ee)
            self.views.append(
                BoardView(
                    index=k,
                    T_base_ee=ee @ se3.exp(noise),
                    detections=self.see(T_base_cam, rng, pixel),
                )
            )

    def _upright(self, T_board_cam: Array) -> Array:
        """Return the camera at the same place with the same line of sight, without roll."""
        eye, z = T_board_cam[:3, 3], T_board_cam[:3, 2]
        x = np.array([1.0, 0.0, 0.0])
        x = x - z * (x @ z)
        x = x / np.linalg.norm(x)
        return se3.from_rt(np.stack([x, np.cross(z, x), z], -1), eye)

    def see(self, T_base_cam: Array, rng: np.random.Generator, pixel: float) -> TagDetections:
        corners = se3.transform(
            se3.invert(T_base_cam) @ self.T_base_board, self.board.corners_board.reshape(-1, 3)
        )
        uv = camera.project(self.intrinsics, corners)
        uv = (uv + rng.normal(scale=pixel, size=uv.shape)).reshape(-1, 4, 2)
        limit = [self.intrinsics.width - 1, self.intrinsics.height - 1]
        inside = np.all((uv > 0) & (uv < limit), axis=(1, 2))
        return TagDetections(ids=self.board.ids[inside], corners_px=uv[inside])


@pytest.fixture
def render() -> Callable[..., NDArray[np.uint8]]:
    return render_homography


@pytest.fixture
def look() -> Callable[..., Array]:
    return camera_at


@pytest.fixture
def simulate() -> type[Simulation]:
    return Simulation
