"""Where a printed target is in a view that has depth, and what inverse depth it should have."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import project, projection_jacobian
from realsim.records import CameraIntrinsics, Target
from realsim_calibration.fit.view_system import planar_poses
from realsim_calibration.results import BoardShape
from realsim_calibration.views import TargetDetection, target_middle

NEWTON_STEPS = 4
"""A lift of millimetres over a decimetre converges in two."""
MIN_POINTS = 4
"""Fewest detected points of a planar pose."""
MIN_CORNER_SD_PX = 0.05
"""Least 1-sigma of a detected point [px]: corners are not better than that, whatever the
residuals of one view say."""
TWIN_RATIO = 2.0
"""The mirror twin of a planar pose is considered up to this many times the reprojection; the
measured tilt decides."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthBoardView:
    """A depth image of the target, and where the target was in it."""

    index: int
    depth_m: NDArray[np.floating]
    """(H, W) depth along z [m], 0 or NaN = none; or (frames, H, W) of one stop, for the temporal
    noise."""
    detection: TargetDetection | None = None
    """The target's points in the colour image; its pose is found from them."""
    T_cam_board: Array | None = None
    """(4, 4) target in the colour camera [m]; None = from the detection."""
    covariance: Array | None = None
    """(6, 6) of the right perturbation of T_cam_board [rad, m]; None = from the detection."""
    name: str = ""
    """File name, for messages; the index where it is empty."""

    def __post_init__(self) -> None:
        """Check the depth image and that a pose can be had."""
        if self.depth_m.ndim not in (2, 3) or self.depth_m.dtype.kind != "f":
            raise InputError(
                f"the depth image of view {self.label} has shape {self.depth_m.shape} and type "
                f"{self.depth_m.dtype}; floating metres (H, W) or (frames, H, W) are accepted. "
                "Multiply the raw counts by the depth unit."
            )
        if self.detection is None and self.T_cam_board is None:
            raise InputError(
                f"view {self.label} has neither detected points nor a board pose; give one."
            )
        if self.T_cam_board is not None:
            T = se3.check_rigid(self.T_cam_board, f"T_cam_board of view {self.label}")
            object.__setattr__(self, "T_cam_board", T)

    @property
    def label(self) -> str:
        """The name, or the index where there is none."""
        return self.name or str(self.index)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthSetup:
    """What all views share."""

    target: Target
    shape: BoardShape | None
    color: CameraIntrinsics
    depth: CameraIntrinsics
    """The depth image's camera; the colour camera itself where depth is aligned to it."""
    T_color_depth: Array
    """(4, 4) depth camera in the colour camera [m]; the identity where aligned."""

    @property
    def middle(self) -> Array:
        """(3,) middle of the target [m]."""
        return target_middle(self.target)

    def lift(self, xy: Array) -> tuple[Array, Array]:
        """Return height (...) [m] along the board's z at true places (..., 2), and its slope."""
        b = self.shape
        if b is None:
            return np.zeros(xy.shape[:-1]), np.zeros_like(xy)
        L = b.half_extent_m
        local = (xy - self.middle[:2]) / (b.scale * np.array([1.0, 1.0 + b.aspect]))
        x, y = local[..., 0] / L, local[..., 1] / L
        w1, w2, w3 = b.warp
        height = b.scale * L * (w1 * x * x + w2 * x * y + w3 * y * y)
        slope = np.stack([2 * w1 * x + w2 * y, (w2 * x + 2 * w3 * y) / (1 + b.aspect)], -1)
        return height, slope

    def places(self, points: Array) -> Array:
        """Return where drawn points (n, 3) really are on the printed target (n, 3) [m]."""
        if self.shape is None:
            return points
        stretch = self.shape.scale * np.array([1.0, 1.0 + self.shape.aspect])
        xy = self.middle[:2] + stretch * (points[:, :2] - self.middle[:2])
        return np.concatenate([xy, self.lift(xy)[0][:, None]], -1)

    def inverse_depth(self, T_cam_board: Array, xy: Array) -> tuple[Array, Array]:
        """Return 1/z (n,) [1/m] where rays (x, y, 1) (n, 2) of the depth camera meet the target.

        Also the places (n, 2) on the target [m]. NaN where a ray does not meet it.
        """
        T_board_depth = se3.invert(T_cam_board) @ self.T_color_depth
        rays = np.concatenate([xy, np.ones((len(xy), 1))], -1) @ T_board_depth[:3, :3].T
        eye = T_board_depth[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -eye[2] / rays[:, 2]
            for _ in range(NEWTON_STEPS if self.shape is not None else 0):
                p = eye + t[:, None] * rays
                height, slope = self.lift(p[:, :2])
                t = t - (p[:, 2] - height) / (rays[:, 2] - (slope * rays[:, :2]).sum(-1))
            t = np.where(t > 0, t, np.nan)
            return 1.0 / t, (eye + t[:, None] * rays)[:, :2]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PosedBoard:
    """A pose of the target in one view, and the points that gave it."""

    T: Array
    """(4, 4) target in the colour camera [m]."""
    points: Array
    """(n, 3) places on the target that gave the pose [m]."""
    sd_px: float
    """1-sigma of a point's coordinate [px]."""
    covariance: Array
    """(6, 6) of the right perturbation of T [rad, m]."""


def board_poses(view: DepthBoardView, setup: DepthSetup) -> list[PosedBoard] | str:
    """Return the target's pose and perhaps its twin, or why there is none."""
    if view.detection is None:
        points = setup.places(setup.target.points_board)
        T, C = view.T_cam_board, view.covariance
        assert T is not None
        sd = MIN_CORNER_SD_PX
        return [
            PosedBoard(
                T=T, points=points, sd_px=sd, covariance=np.zeros((6, 6)) if C is None else C
            )
        ]
    detection, camera = view.detection, setup.color
    if detection.image_size != (camera.width, camera.height):
        raise InputError(
            f"the points of view {view.label} were found in an image of {detection.image_size[0]}x"
            f"{detection.image_size[1]}, the colour camera has {camera.width}x{camera.height}. "
            "Give the intrinsics of the resolution at which the images were taken."
        )
    if len(detection) < MIN_POINTS:
        return f"only {len(detection)} points of the target were found"
    drawn = detection.points(setup.target)
    points = setup.places(drawn)
    if view.T_cam_board is not None:
        found = [(_rms(view.T_cam_board, points, detection.uv, camera), view.T_cam_board)]
    else:
        found = planar_poses(points, detection.uv, camera, drawn)
    if not found:
        return "no pose of the target in front of the camera fits its points"
    poses: list[PosedBoard] = []
    for rms, T in found:
        if rms > TWIN_RATIO * found[0][0]:
            break
        sd = max(rms / np.sqrt(2.0), MIN_CORNER_SD_PX)
        C = view.covariance
        if C is None:
            J = pose_jacobian(T, points, camera)[0]
            C = sd**2 * np.linalg.pinv(J.T @ J)
        poses.append(PosedBoard(T=T, points=points, sd_px=sd, covariance=C))
    return poses


def _rms(T: Array, points: Array, uv: Array, camera: CameraIntrinsics) -> float:
    error = project(camera, se3.transform(T, points)) - uv
    return float(np.sqrt(np.mean(np.sum(error**2, -1))))


def pose_jacobian(T: Array, points: Array, camera: CameraIntrinsics) -> tuple[Array, Array]:
    """Return d uv / d pose (2n, 6), right perturbation, and d uv / d camera (2n, 12)."""
    _, d_point, d_cam = projection_jacobian(camera, se3.transform(T, points))
    eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    moved = T[:3, :3] @ np.concatenate([-se3.hat(points), eye], -1)
    return (d_point @ moved).reshape(-1, 6), d_cam.reshape(-1, 12)
