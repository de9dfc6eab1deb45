"""A frame of a plane and its simulated twin: the same plane before the same pixels.

Both are judged by the same figures, so that rounding, the size of the window and the errors that
are slower than noise have the same effect on both.
"""

from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_sensors.autocovariance import without_trend
from realsim.rendering.depth_sensors.plane import PlaneView
from realsim.rendering.depth_sensors.profiles import DepthProfile
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.rendering.stereo.camera import StereoCamera
from realsim.rendering.stereo.config import StereoConfig

WINDOW_PX = (288, 216)
"""Width and height of the piece of a frame that is simulated: it holds thousands of independent
places, and a search simulates it dozens of times."""
LEAST_SHARE = 0.25
"""Share of the window that the plane must fill."""
RIM_PX = 12
"""Simulated beyond the window on every side, because matching ends there."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaneFigures:
    """Noise and holes on a plane."""

    sigma_px: float
    """Standard deviation of the fast part of the disparity's residual [px]; NaN = unmeasured."""
    hole_share: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlaneTwin:
    """The window of a frame that is compared, and what is needed to simulate it."""

    name: str
    distance_m: float
    measured: PlaneFigures
    residual: Array32
    """(h, w) measured - plane [px] in the window, NaN where there is none."""
    disparity: Array32
    """(h, w) the plane's, exact [px]."""
    area: Mask
    """(h, w) the plane with its holes."""
    intrinsics: CameraIntrinsics
    """Intrinsics of the window with what lies around it."""
    corner: tuple[int, int]
    """Column and row of the window in that picture."""
    plane: PlacedMesh
    """In camera axes."""

    def simulated(
        self, config: StereoConfig, profile: DepthProfile, unit_m: float, seed: int
    ) -> tuple[PlaneFigures, Array32]:
        """Return the figures of the simulated window and its residual (h, w) [px]."""
        camera = StereoCamera([self.plane], profile, config)
        depth = camera.measure(self.intrinsics, np.eye(4), np.random.default_rng(seed)).depth_m
        column, row = self.corner
        height, width = self.area.shape
        depth = depth[row : row + height, column : column + width]
        if unit_m > 0:
            depth = np.round(depth / np.float32(unit_m)) * np.float32(unit_m)
        fB = np.float32(self.intrinsics.fx * profile.baseline_m)
        known = (depth > 0) & self.area
        found = fB / np.where(known, depth, 1)
        residual = np.where(known, found - self.disparity, np.nan).astype(np.float32)
        return _figures(residual, self.area, self.area & ~known), residual


def plane_twin(
    plane: PlaneView, intrinsics: CameraIntrinsics, baseline_m: float, name: str
) -> PlaneTwin:
    """Return the window of a frame that holds most of its plane, ready to be simulated.

    Args:
        plane: found in the frame.
        intrinsics: of the frame.
        baseline_m: of the sensor [m].
        name: of the frame, for messages.

    Raises:
        InputError: the plane fills too little of every window.
    """
    fB = intrinsics.fx * baseline_m
    band = int(np.ceil(float(np.nanmax(plane.disparity[plane.area]))))
    counted = plane.area & (plane.mask | plane.holes)
    rows, columns = _fullest(counted, band)
    if counted[rows, columns].mean() < LEAST_SHARE:
        raise InputError(
            f"{name}: the plane fills {100 * float(counted[rows, columns].mean()):.0f} % of the "
            f"best window of {WINDOW_PX[0]}x{WINDOW_PX[1]} px; {100 * LEAST_SHARE:.0f} % are "
            "needed to compare holes. Take frames in which the wall or table fills more."
        )
    area = counted[rows, columns]
    left, top = band + 2 * RIM_PX, RIM_PX
    height, width = area.shape
    crop = replace(
        intrinsics, width=width + left + RIM_PX, height=height + 2 * RIM_PX,
        cx=intrinsics.cx - columns.start + left, cy=intrinsics.cy - rows.start + top,
    )  # fmt: skip
    residual = np.where(area, plane.residual[rows, columns], np.nan).astype(np.float32)
    disparity = plane.disparity[rows, columns]
    return PlaneTwin(
        name=name,
        distance_m=fB / float(np.median(disparity[area])),
        measured=_figures(residual, area, plane.holes[rows, columns] & area),
        residual=residual, disparity=np.asarray(disparity, np.float32), area=area,
        intrinsics=crop, corner=(left, top), plane=_placed(plane.normal, crop),
    )  # fmt: skip


def _figures(residual: Array32, area: Mask, holes: Mask) -> PlaneFigures:
    """Return noise and holes of a window (h, w)."""
    measured = np.isfinite(residual)
    share = float(holes.sum()) / max(int(area.sum()), 1)
    if measured.sum() < 0.02 * area.size:
        return PlaneFigures(sigma_px=float("nan"), hole_share=share)
    return PlaneFigures(sigma_px=float(np.nanstd(without_trend(residual)[0])), hole_share=share)


def _fullest(counted: Mask, band: int) -> tuple[slice, slice]:
    """Return rows and columns of the window that holds most counted pixels.

    Left of `band` px the second eye sees nothing: no window begins there if there is room.
    """
    import cv2

    height, width = counted.shape
    w, h = min(WINDOW_PX[0], width), min(WINDOW_PX[1], height)
    share = np.asarray(cv2.blur(counted.astype(np.float32), (w, h), anchor=(0, 0)))
    share = share[: height - h + 1, : width - w + 1].copy()
    first = min(band, share.shape[1] - 1)
    share[:, :first] *= 0.5
    top, left = np.unravel_index(int(np.argmax(share)), share.shape)
    return slice(int(top), int(top) + h), slice(int(left), int(left) + w)


def _placed(normal: Array, i: CameraIntrinsics) -> PlacedMesh:
    """Return the plane n . X = 1 about what a camera sees of its middle, wider than its picture."""
    n = normal / np.linalg.norm(normal)
    ray = np.array([(i.width / 2 - i.cx) / i.fx, (i.height / 2 - i.cy) / i.fy, 1.0])
    middle = ray / float(ray @ normal)
    x = np.cross([0.0, 1.0, 0.0], n)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(n, x), n], 1), middle
    half = 4 * abs(float(middle[2])) * max(i.width / i.fx, i.height / i.fy)
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    paint = Material(base_color=(0.5, 0.5, 0.5), roughness=1.0, name="grey card")
    return PlacedMesh(BACKGROUND, mesh, T, paint)
