"""What single views are worth: how they cover a cap, what they see of the scene, how precisely.

Everything here is geometry of camera poses, one number per view or per point; `metrics` sums it
up and the pictures draw it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics
from realsim.robots.shapes import Box
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig
from realsim_capture_plans.planning.viewpoints import board_roll, golden_cap, plane_axes

CAP_POINTS = 4000
"""Directions of a cap that are tried besides the exact corners of the views' cells."""
RIM_POINTS = 1440
"""Places on the rim of a cap, a quarter of a degree apart, between which the nearest view is taken
to change at most once."""
SCENE_GRID = (8, 8, 4)
"""Cells of the scene's volume whose centres stand for it: 4 cm in a box of 0.3 m."""
SPREAD_BATCH = 32
"""Points whose pairs of views are compared at a time: 256 views make 17 MB of them."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sensor:
    """A depth camera, as far as a plan depends on it."""

    name: str
    """Key of `SENSORS`, or what people call it."""
    intrinsics: CameraIntrinsics
    """The colour image that views are stored in."""
    depth_focal_px: float
    """Focal length of the depth imagers [px]: with the baseline it sets the noise."""
    baseline_m: float
    """Between the two depth imagers [m]."""
    disparity_noise_px: float = 0.08
    """Standard deviation of the disparity [px]; 0.05 on well-textured, 0.08 on ordinary things."""
    nearest_m: float = 0.0
    """Depth below which the sensor measures nothing [m]."""

    def depth_noise(self, depth_m: ArrayLike) -> Array:
        """Return the standard deviation (...) [m] of depth at depths (...) [m].

        sigma_z = z^2 s / (f B), the derivative of z = f B / disparity.
        """
        z = np.asarray(depth_m, dtype=np.float64)
        return z**2 * self.disparity_noise_px / (self.depth_focal_px * self.baseline_m)


def _sensor(
    name: str, color_px: float, depth_px: float, baseline_m: float, nearest_m: float
) -> Sensor:
    return Sensor(
        name=name,
        intrinsics=CameraIntrinsics(
            width=1280, height=720, fx=color_px, fy=color_px, cx=639.5, cy=359.5
        ),
        depth_focal_px=depth_px,
        baseline_m=baseline_m,
        nearest_m=nearest_m,
    )


D405 = _sensor("D405", 646.0, 646.0, 0.018, 0.10)
"""D405 at 1280x720: colour comes from the depth imagers (datasheet: 87 deg, 18 mm, 100 mm)."""
_D435 = _sensor("D435", 931.0, 674.0, 0.050, 0.28)
SENSORS = {
    "D405": D405,
    "D415": _sensor("D415", 931.0, 1005.0, 0.055, 0.45),
    "D435": _D435,
    "D435i": _D435,
}
"""Nominal sensors at 1280x720 by the datasheet's fields of view (colour 69 deg on the D4x5, depth
65 deg on the D415, 87 deg on the others); a device's own calibration is a per cent off."""


def sensor_of(plan: CapturePlan) -> Sensor:
    """Return the nominal sensor of the plan's mount.

    Raises:
        InputError: nothing is known about that camera.
    """
    if plan.mount.camera not in SENSORS:
        raise InputError(
            f"the plan's mount carries a '{plan.mount.camera}', whose field of view is not known; "
            f"known are {', '.join(SENSORS)}. Give a Sensor with its intrinsics and baseline."
        )
    return SENSORS[plan.mount.camera]


def nearest_deg(directions: Array, target: Array) -> Array:
    """Return the angle (M,) [deg] from targets (M, 3) to the nearest of unit vectors (N, 3)."""
    cosine = np.max(target @ directions.T, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def hole_deg(directions: Array, elevation_deg: tuple[float, float]) -> float:
    """Return the greatest angle [deg] from anywhere in a cap to the nearest view (N, 3).

    Exact, and so the same however the plan is turned: the farthest place is a corner of the views'
    cells (their convex hull's triangles), or on the rim where two cells meet. Evenly spread places
    are tried as well; they carry the few views whose hull has no triangles.

    Args:
        directions: (N, 3) unit vectors from the centre to the cameras.
        elevation_deg: least and greatest elevation of the cap.
    """
    low, high = np.sin(np.radians(elevation_deg))
    corners = _cell_corners(directions)
    corners = corners[(corners[:, 2] >= low) & (corners[:, 2] <= high)]
    places = [golden_cap(CAP_POINTS, elevation_deg), corners]
    places += [_rim_corners(directions, float(np.radians(e))) for e in elevation_deg]
    return float(nearest_deg(directions, np.concatenate(places)).max())


def _cell_corners(directions: Array) -> Array:
    """Return the unit vectors (K, 3) of the spherical Voronoi cells' corners, and their opposites.

    The normal of a triangle of views is at the same angle from all three.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(directions) < 4:
        return np.zeros((0, 3))
    try:
        triangles = directions[ConvexHull(directions).simplices]
    except QhullError:  # all in one plane
        return np.zeros((0, 3))
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = (normal / np.where(length > 0, length, 1.0))[length[:, 0] > 0]
    return np.concatenate([normal, -normal])


def _rim_corners(directions: Array, elevation: float) -> Array:
    """Return the unit vectors (K, 3) of a circle of elevation [rad] where the nearest view changes.

    cos(angle to view) = A cos(azimuth) + B sin(azimuth) + C; two views are equally near where the
    difference of their curves is zero.
    """
    azimuth = np.arange(RIM_POINTS) * (2 * np.pi / RIM_POINTS)
    c, s = np.cos(elevation), np.sin(elevation)
    rim = np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.full(RIM_POINTS, s)], -1)
    nearest = np.argmax(rim @ directions.T, axis=1)
    after = np.roll(nearest, -1)
    change = np.flatnonzero(nearest != after)
    gap = directions[nearest[change]] - directions[after[change]]
    size = np.hypot(gap[:, 0], gap[:, 1]) * c
    offset = np.where(size > 0, -gap[:, 2] * s / np.where(size > 0, size, 1.0), 2.0)
    ok = np.abs(offset) <= 1.0
    middle, half = np.arctan2(gap[ok, 1], gap[ok, 0]), np.arccos(offset[ok])
    at = np.concatenate([middle + half, middle - half, azimuth])
    return np.stack([c * np.cos(at), c * np.sin(at), np.full(len(at), s)], -1)


def spacing_deg(directions: Array) -> Array:
    """Return the angle (N,) [deg] from each of at least two unit vectors to the nearest other."""
    gram = directions @ directions.T - 3.0 * np.eye(len(directions))
    return np.degrees(np.arccos(np.clip(gram.max(axis=1), -1.0, 1.0)))


def scene_box(plan: CapturePlan) -> Box:
    """Return the volume that the views are to see: the keep-out box, from the table up.

    Where the plan's box is endless (an imported plan without a scene), a box of
    `PlanConfig.keep_out_m` about the centre.
    """
    low, high = np.array(plan.cell.keep_out.lower), np.array(plan.cell.keep_out.upper)
    low[2] = max(low[2], plan.cell.table.upper[2])
    if not np.all(np.isfinite([low, high])) or np.any(low >= high):
        half = np.array(PlanConfig().keep_out_m) / 2
        low, high = plan.center_world - half, plan.center_world + half
    (x0, y0, z0), (x1, y1, z1) = low.tolist(), high.tolist()
    return Box(lower=(x0, y0, z0), upper=(x1, y1, z1))


def scene_points(plan: CapturePlan) -> Array:
    """Return points (P, 3) [m], evenly spread over the scene's volume, that stand for it."""
    box = scene_box(plan)
    axes = [
        low + (np.arange(n) + 0.5) * ((high - low) / n)
        for low, high, n in zip(box.lower, box.upper, SCENE_GRID, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    return np.asarray(grid.reshape(-1, 3), dtype=np.float64)


def seen(plan: CapturePlan, points: Array, sensor: Sensor) -> Mask:
    """Return (N, P) whether each view has each point (P, 3) [m] in its image.

    Nothing hides anything: the scene's objects are not known when a plan is made.
    """
    camera = sensor.intrinsics
    points_cam = se3.transform(se3.invert(plan.Ts_base_cam), points)
    uv = project(camera, points_cam)
    inside = np.all((uv >= -0.5) & (uv <= [camera.width - 0.5, camera.height - 0.5]), axis=-1)
    return inside & (points_cam[..., 2] > 0)


def centre_depth(plan: CapturePlan) -> Array:
    """Return the depth (N,) [m] of the scene's centre along each view's optical axis."""
    return depth_of(plan, plan.center_world[None])[:, 0]


def depth_of(plan: CapturePlan, points: Array) -> Array:
    """Return the depth (N, P) [m] of points (P, 3) [m] along each view's optical axis."""
    axis = plan.Ts_base_cam[:, :3, 2]
    at = np.sum(axis * plan.Ts_base_cam[:, :3, 3], axis=-1)[:, None]
    return np.asarray(axis @ points.T - at, dtype=np.float64)


def direction_spread_deg(plan: CapturePlan, points: Array, visible: Mask) -> Array:
    """Return the greatest angle (P,) [deg] between two views that see each point; 0 below two."""
    to_camera = plan.Ts_base_cam[None, :, :3, 3] - points[:, None]
    unit = to_camera / np.linalg.norm(to_camera, axis=-1, keepdims=True)
    rays = np.where(visible.T[..., None], unit, 0.0)
    least = np.ones(len(points))
    for first in range(0, len(points), SPREAD_BATCH):
        batch, mask = rays[first : first + SPREAD_BATCH], visible.T[first : first + SPREAD_BATCH]
        cosine = batch @ np.swapaxes(batch, -1, -2)
        both = mask[:, :, None] & mask[:, None, :]
        least[first : first + SPREAD_BATCH] = np.where(both, cosine, 1.0).min(axis=(1, 2))
    return np.degrees(np.arccos(np.clip(least, -1.0, 1.0)))


def parallax_deg(plan: CapturePlan) -> Array:
    """Return the angle (N-1,) [deg] at the scene's centre between consecutive views."""
    d = plan.directions()
    return np.degrees(np.arccos(np.clip(np.sum(d[1:] * d[:-1], axis=-1), -1.0, 1.0)))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardViews:
    """How a flat board through the centre is seen."""

    roll_deg: Array
    """(N,) of the board about the optical axis, in (-180, 180]."""
    tilt_deg: Array
    """(N,) between the optical axis and the board's normal."""
    distance_m: Array
    """(N,) along the optical axis to the board's plane [m]."""

    @property
    def roll_gap_deg(self) -> float:
        """Widest gap between neighbouring rolls."""
        roll = np.sort(self.roll_deg)
        return float(np.diff(np.append(roll, roll[0] + 360.0)).max())


def board_views(plan: CapturePlan, normal: ArrayLike = (0.0, 0.0, 1.0)) -> BoardViews:
    """Return how each view sees a board about the plan's centre with normal (3,) in base.

    Raises:
        InputError: the normal is not a direction.
    """
    n = np.asarray(normal, dtype=np.float64)
    if n.shape != (3,) or not np.linalg.norm(n) > 0:
        raise InputError(f"the board's normal is {n.tolist()}; a direction (3,) is needed.")
    n = n / np.linalg.norm(n)
    cosine = np.clip(-plan.Ts_base_cam[:, :3, 2] @ n, -1.0, 1.0)
    height = (plan.Ts_base_cam[:, :3, 3] - plan.center_world) @ n
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = height / cosine
    return BoardViews(
        roll_deg=np.degrees(board_roll(plan.Ts_base_cam, plane_axes(n))),
        tilt_deg=np.degrees(np.arccos(cosine)),
        distance_m=distance,
    )
