"""What a configuration does on a plane: the three figures that a user's own plane frames give.

A fit searches over `StereoConfig` until these agree with the frames.
"""

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_sensors.profiles import DepthProfile
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.rendering.stereo.camera import StereoCamera
from realsim.rendering.stereo.config import StereoConfig

Array = NDArray[np.float64]
MARGIN = 0.05
"""Share of the picture's width and height at each border that does not count: windows end there."""
GREATEST_LAG_PX = 24
"""The correlation is looked for up to this distance [px]."""
LEAST_MEASURED = 100
"""Fewer measured pixels say nothing about noise."""


def plane_statistics(
    config: StereoConfig,
    profile: DepthProfile,
    intrinsics: CameraIntrinsics,
    distance_m: float,
    rng: np.random.Generator,
    tilt_deg: float = 0.0,
) -> tuple[float, float, float]:
    """Return the noise, holes and correlation of a grey matte plane with the micro texture.

    Args:
        config: what is tried.
        profile: the camera.
        intrinsics: its depth picture; a small one is quick and gives the same figures.
        distance_m: of the plane on the optical axis [m].
        rng: source of chance.
        tilt_deg: turn of the plane about the picture's x axis [deg].

    Returns:
        standard deviation of the disparity about its own fitted plane [px], share of pixels
        without depth where the right eye can see, and the Gaussian radius sigma [px] of the noise:
        its autocorrelation falls to exp(-1/4) at a lag of sigma, as that of white noise smoothed
        by a Gaussian of radius sigma. NaN where too little is measured.

    Raises:
        InputError: the distance is not positive.
    """
    if not distance_m > 0:
        raise InputError(f"the plane stands at {distance_m} m; a positive distance is accepted.")
    camera = StereoCamera([grey_plane(intrinsics, distance_m, tilt_deg)], profile, config)
    measured = camera.measure(intrinsics, np.eye(4), rng)
    return disparity_statistics(
        measured.disparity_px, intrinsics.fx * profile.baseline_m / distance_m
    )


def disparity_statistics(
    disparity_px: NDArray[np.floating], band_px: float
) -> tuple[float, float, float]:
    """Return the same three figures of a measured plane.

    Args:
        disparity_px: (H, W) disparity of a plane that fills the picture; 0 = none.
        band_px: the left columns that the right eye cannot see; they count in nothing.
    """
    height, width = disparity_px.shape
    top, side = int(MARGIN * height) + 1, int(MARGIN * width) + 1
    d = np.asarray(disparity_px[top:-top, side + int(np.ceil(band_px)) : -side], np.float64)
    valid = d > 0
    holes = 1.0 - float(valid.mean()) if d.size else float("nan")
    if np.count_nonzero(valid) < LEAST_MEASURED:
        return float("nan"), holes, float("nan")
    v, u = np.nonzero(valid)
    A = np.stack([np.ones(len(u)), u / width - 0.5, v / height - 0.5], -1)
    keep = np.ones(len(u), bool)
    rest = np.zeros(len(u))
    for _ in range(3):
        B = A[keep]
        normal = np.einsum("ni,nj->ij", B, B)
        right = np.einsum("ni,n->i", B, d[valid][keep])
        rest = d[valid] - (A * np.linalg.solve(normal, right)).sum(1)
        # Wrong matches are not noise.
        spread = 1.4826 * float(np.median(np.abs(rest[keep] - np.median(rest[keep]))))
        keep = np.abs(rest) <= max(5 * spread, 1e-6)
    sigma = float(rest[keep].std())
    noise, known = np.zeros(d.shape), np.zeros(d.shape)
    noise[v[keep], u[keep]], known[v[keep], u[keep]] = rest[keep], 1.0
    return sigma, holes, _correlation_radius(noise, known)


def _correlation_radius(noise: Array, known: Array) -> float:
    """Return the lag [px] at which the autocorrelation along rows falls to exp(-1/4)."""
    variance = float((noise * noise).sum() / known.sum())
    before = 1.0
    for lag in range(1, min(GREATEST_LAG_PX, noise.shape[1] - 1)):
        pairs = float((known[:, lag:] * known[:, :-lag]).sum())
        if pairs == 0 or variance == 0:
            return float("nan")
        value = float((noise[:, lag:] * noise[:, :-lag]).sum()) / pairs / variance
        if value <= np.exp(-0.25):
            return lag - 1 + (before - float(np.exp(-0.25))) / max(before - value, 1e-12)
        before = value
    return float(GREATEST_LAG_PX)


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
    corners = np.array(
        [[-half_x, -half_y, 0], [half_x, -half_y, 0], [half_x, half_y, 0], [-half_x, half_y, 0]]
    )
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    a, b = np.radians(tilt_deg), np.radians(turn_deg)
    T = np.eye(4)
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    T[:3, :3], T[2, 3] = about_x @ about_y, distance_m
    paint = Material(base_color=(0.5, 0.5, 0.5), roughness=1.0, name="grey card")
    return PlacedMesh(BACKGROUND, mesh, T, paint)
