"""A grey plane before a stereo camera, and the noise of its disparity."""

import numpy as np
from numpy.typing import NDArray

from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_sensors.profiles import DepthProfile
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.rendering.stereo import StereoCamera, StereoConfig

MARGIN = 0.05
"""Share of the picture's width and height at each border that does not count: windows end there."""


def plane_noise(
    config: StereoConfig, profile: DepthProfile, intrinsics: CameraIntrinsics, distance_m: float,
    rng: np.random.Generator,
) -> float:  # fmt: skip
    """Return the standard deviation of a plane's disparity about its own fitted plane [px]."""
    camera = StereoCamera([grey_plane(intrinsics, distance_m)], profile, config)
    measured = camera.measure(intrinsics, np.eye(4), rng).disparity_px
    return disparity_noise(measured, intrinsics.fx * profile.baseline_m / distance_m)


def disparity_noise(disparity_px: NDArray[np.floating], band_px: float) -> float:
    """Return the same of a measured disparity (H, W), 0 = none.

    The left `band_px` columns, which the right eye cannot see, do not count.
    """
    height, width = disparity_px.shape
    top, side = int(MARGIN * height) + 1, int(MARGIN * width) + 1
    d = np.asarray(disparity_px[top:-top, side + int(np.ceil(band_px)) : -side], np.float64)
    v, u = np.nonzero(d > 0)
    A = np.stack([np.ones(len(u)), u, v], -1)
    keep = np.ones(len(u), bool)
    rest = np.zeros(len(u))
    for _ in range(3):
        rest = d[v, u] - A @ np.linalg.lstsq(A[keep], d[v, u][keep], rcond=None)[0]
        # Wrong matches are not noise.
        spread = 1.4826 * float(np.median(np.abs(rest[keep] - np.median(rest[keep]))))
        keep = np.abs(rest) <= max(5 * spread, 1e-6)
    return float(rest[keep].std())


def grey_plane(
    intrinsics: CameraIntrinsics, distance_m: float, tilt_deg: float = 0.0, turn_deg: float = 0.0
) -> PlacedMesh:
    """Return a matte plane before a camera at the origin, larger than what it sees.

    Args:
        intrinsics: the camera.
        distance_m: on the optical axis [m].
        tilt_deg: turn about the picture's x axis [deg]: depth changes along columns.
        turn_deg: turn about its y axis [deg]: depth changes along rows.
    """
    i = intrinsics
    half_x = 2 * distance_m * max(i.cx, i.width - i.cx) / i.fx
    half_y = 2 * distance_m * max(i.cy, i.height - i.cy) / i.fy
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [half_x, half_y, 0]
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    a, b = np.radians(tilt_deg), np.radians(turn_deg)
    T = np.eye(4)
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    T[:3, :3], T[2, 3] = about_x @ about_y, distance_m
    paint = Material(base_color=(0.5, 0.5, 0.5), roughness=1.0, name="grey card")
    return PlacedMesh(BACKGROUND, mesh, T, paint)
