"""The simulated lab: objects put on a table, camera poses over it, and their errors.

Everything that simulates depth views shares it: one object that is scanned, a table full of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.models.resting import Resting, resting_orientations
from realsim.models.symmetry import SymmetryConfig, find_symmetries
from realsim.records import CameraIntrinsics, Mesh, ObjectModel, ObjectPose
from realsim.rendering.depth_sensors.model import DepthSensorModel

T_EE_CAM = se3.from_translation([0.0, -0.065, 0.035])
"""(4, 4) the camera on the hand as drawn [m]."""
LOWEST_DEG = 25.0
"""Least elevation of a view over the table [deg]."""
AIM_M = 0.01
"""A view looks at a point this far from the middle at most, along each axis [m]."""
ROLL_RAD = 0.3
"""A view is turned about its own axis by this much at most [rad]."""
TABLE_HALF_M = 0.6
"""Half the width of the table [m]."""
FULL_FOCAL_PX = 648.0
"""Focal length of a D405 at 1280x720, the image that sensor models speak of [px]."""
FULL_WIDTH_PX = 1280
"""Width of that image [px]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TableLabConfig:
    """Views and errors of a simulated table.

    Images are half the size of a D405's by default: `sensor_of` says why nothing is lost.
    """

    views: int = 32
    """Views on a hemisphere; view 0 looks straight down, as the paper's single view does."""
    distance_m: tuple[float, float] = (0.25, 0.50)
    """Least and greatest distance of the camera from the middle [m]: nearer it sees one object
    only, farther a D405's noise exceeds a millimetre."""
    top_distance_m: float = 0.45
    """Distance of view 0 [m]: all of the disc is in the image."""
    clearance_m: float = 0.10
    """No camera is nearer than this to an object [m]: it is moved back along its view."""
    width: int = 640
    """[px]; half a D405's."""
    height: int = 360
    """[px]; half a D405's."""
    focal_px: float = FULL_FOCAL_PX / 2
    """[px]; half a D405's."""
    hand_eye_mm: float = 0.5
    """Constant error of the hand-eye [mm], in a random direction: a usual calibration's."""
    hand_eye_deg: float = 0.1
    """Constant error of the hand-eye [deg], about a random axis: a usual calibration's."""
    arm_mm: float = 0.2
    """Error of every robot pose along each axis, 1-sigma [mm]; forward kinematics of a UR5."""
    arm_deg: float = 0.03
    """Error of every robot pose about each axis, 1-sigma [deg]; forward kinematics of a UR5."""
    bias_px: float = 0.0
    """Constant error of the disparity [px of an image 1280 px wide]; 0.02 is what a check on a
    board leaves."""
    disc_m: float = 0.18
    """Objects are scattered with their centres in a disc of this radius [m]: 14 or 15 are tight."""
    gap_m: float = 0.0005
    """Their footprints are at least so far apart [m]: close enough to touch in a depth image."""
    sensor: DepthSensorModel = field(default_factory=DepthSensorModel)
    """The depth camera, in pixels of its full image (1280 px wide, f = 648 px)."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        near, far = self.distance_m
        if self.views < 1 or not 0 < near <= far or not self.top_distance_m > 0:
            raise InputError(
                f"{self.views} views at {near} to {far} m and {self.top_distance_m} m make no lab; "
                "at least one view, at 0 < near <= far, is needed."
            )
        if min(self.width, self.height) < 1 or not self.focal_px > 0 or not self.disc_m > 0:
            raise InputError(
                f"images of {self.width}x{self.height} px with f = {self.focal_px} px over a disc "
                f"of {self.disc_m} m are not possible; all must be positive."
            )


def resized(config: TableLabConfig, width: int) -> TableLabConfig:
    """Return the same lab with images of another width [px]: same field of view, same sigma_z."""
    scale = width / config.width
    return replace(
        config, width=width, height=round(config.height * scale), focal_px=config.focal_px * scale
    )


def full_size(config: TableLabConfig) -> TableLabConfig:
    """Return the same lab with the D405's own images: 1280x720, f = 648 px, 0.08 px of noise."""
    return resized(config, FULL_WIDTH_PX)


def camera_of(config: TableLabConfig) -> CameraIntrinsics:
    """Return the lab's camera: no distortion, the principal point in the middle."""
    return CameraIntrinsics(
        width=config.width, height=config.height, fx=config.focal_px, fy=config.focal_px,
        cx=(config.width - 1) / 2, cy=(config.height - 1) / 2,
    )  # fmt: skip


def sensor_of(config: TableLabConfig) -> DepthSensorModel:
    """Return the depth sensor in pixels of the lab's own images.

    Stereo noise is correlated over a matching window, a Gaussian of 2 px or about 4 px across in
    the full image: neighbours say nothing new. With every length in pixels scaled by s,
    sigma_z = z^2 sigma_d / (f B) stays (sigma_d and f both shrink by s), and so does the number of
    independent measurements, pixels / (4 pi correlation^2), of any piece of surface. So an image
    of half the width carries the same information as the full one at a quarter of the cost.
    """
    s = config.focal_px / FULL_FOCAL_PX
    full = config.sensor
    return replace(
        full,
        disparity_noise_px=s * full.disparity_noise_px,
        correlation_px=s * full.correlation_px,
        quantum_px=s * full.quantum_px,
        bias_px=s * (full.bias_px + config.bias_px),
        edge_jump_px=s * full.edge_jump_px,
        edge_width_px=max(1, round(s * full.edge_width_px)) if full.edge_width_px else 0,
        blobs_per_megapixel=full.blobs_per_megapixel / s**2,
        blob_radius_px=s * full.blob_radius_px,
    )


def hemisphere(
    middle: Array,
    views: int,
    distance_m: tuple[float, float],
    first_m: float,
    rng: np.random.Generator,
) -> Array:
    """Return camera poses (F, 4, 4) that look at the middle; a spiral, jittered, the first down.

    Args:
        middle: (3,) what they look at [m].
        views: how many.
        distance_m: least and greatest distance from it [m].
        first_m: distance of the first [m].
        rng: of the spiral's start, the distances and the jitter.
    """
    n = views
    k = np.arange(n)
    lowest = np.sin(np.radians(LOWEST_DEG))
    height = 1 - (1 - lowest) * k / max(n - 1, 1)
    around = k * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi)
    out = np.sqrt(np.clip(1 - height**2, 0, None))
    directions = np.stack([out * np.cos(around), out * np.sin(around), height], -1)
    near, far = distance_m
    distances = rng.uniform(near, far, n)
    distances[0] = first_m
    poses: list[Array] = []
    for direction, distance in zip(directions, distances, strict=True):
        z = -direction
        x = np.cross(np.array([0.0, 0.0, 1.0]), z)
        x = np.array([1.0, 0, 0]) if np.linalg.norm(x) < 1e-6 else x / np.linalg.norm(x)
        roll = se3.exp_so3([0, 0, rng.uniform(-ROLL_RAD, ROLL_RAD)])
        R = np.stack([x, np.cross(z, x), z], -1) @ roll
        aim = middle + rng.uniform(-AIM_M, AIM_M, 3)
        poses.append(se3.from_rt(R, aim + distance * direction))
    return np.stack(poses)


def offset(rng: np.random.Generator, distance_m: float, angle_rad: float) -> Array:
    """Return a transform (4, 4) of this distance and angle in random directions."""
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return se3.from_rt(se3.exp_so3(angle_rad * axes[0]), distance_m * axes[1])


def arm_error(rng: np.random.Generator, arm_mm: float, arm_deg: float) -> Array:
    """Return the twist (6,) by which one robot pose is off, of these sigmas per axis."""
    return np.concatenate([
        np.radians(arm_deg) * rng.standard_normal(3),
        arm_mm / 1e3 * rng.standard_normal(3),
    ])  # fmt: skip


def table_square(at: Sequence[float] | Array) -> Mesh:
    """Return a square of the plane z = 0, 1.2 m wide, about a point (2,)."""
    x, y = float(at[0]), float(at[1])
    a = TABLE_HALF_M
    corners = [[-a, -a, 0.0], [a, -a, 0.0], [a, a, 0.0], [-a, a, 0.0]]
    vertices = np.array(corners) + np.array([x, y, 0.0])
    return Mesh(vertices=vertices, faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


LEAST_PROBABILITY = 0.01
"""Resting poses rarer than this are not simulated: nobody sets an object down that way."""
TRIES = 1500
"""Random places that are tried for one object: more fill no tighter disc."""
POSES_PER_PLACE = 10
"""Places that are tried before the object is turned over to another resting pose and yaw."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Scattered:
    """Objects that found room on the table."""

    objects: tuple[ObjectPose, ...]
    """Where they stand on the plane z = 0; instances are numbered in the order asked for."""
    left_out: tuple[ObjectPose, ...] = ()
    """Those that found none: id and instance count, the pose is the identity."""


def scatter_objects(
    meshes: Mapping[int, Mesh],
    wanted: Sequence[int],
    config: TableLabConfig,
    rng: np.random.Generator,
) -> Scattered:
    """Return objects put on the table z = 0 at random, so close that they nearly touch.

    Each rests in a stable pose of its hull (chosen by probability; those under 1 % are dropped),
    turned by any yaw, with the middle of its shadow in a disc about the origin. The shadows of two
    hulls are at least `config.gap_m` apart, so no two objects can touch.

    Args:
        meshes: the objects' meshes [m], by object id.
        wanted: object ids, one per instance; an id may come several times.
        config: the disc and the gap.
        rng: of poses and places.

    Raises:
        InputError: an id has no mesh.
    """
    unknown = sorted(set(wanted) - set(meshes))
    if unknown:
        raise InputError(
            f"there is no mesh for the object ids {unknown}; there are meshes for {sorted(meshes)}."
        )
    placed: list[ObjectPose] = []
    left_out: list[ObjectPose] = []
    shadows: list[Array] = []
    for instance, obj_id in enumerate(wanted):
        found = _place(meshes[obj_id], shadows, config, rng)
        if found is None:
            left_out.append(ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=np.eye(4)))
            continue
        T_world_obj, shadow = found
        shadows.append(shadow)
        placed.append(ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T_world_obj))
    return Scattered(objects=tuple(placed), left_out=tuple(left_out))


def with_found_symmetries(model: ObjectModel) -> ObjectModel:
    """Return the model with the symmetries that are found in its mesh, as of a scan."""
    found = _found_symmetries(model.mesh)
    return replace(model, symmetries=found[0], symmetry_axes=found[1])


@lru_cache(maxsize=128)
def _found_symmetries(
    mesh: Mesh,
) -> tuple[Array, tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]]:
    """Return the symmetries of a mesh; meshes are told apart by identity."""
    found = find_symmetries(mesh, SymmetryConfig())
    return found.discrete, found.axes


@lru_cache(maxsize=128)
def _resting(mesh: Mesh) -> tuple[Resting, ...]:
    """Return the likely resting poses of a mesh; meshes are told apart by identity."""
    every = resting_orientations(mesh)
    likely = tuple(r for r in every if r.probability >= LEAST_PROBABILITY)
    return likely or every[:1]


def _place(
    mesh: Mesh, shadows: Sequence[Array], config: TableLabConfig, rng: np.random.Generator
) -> tuple[Array, Array] | None:
    """Return T_world_obj (4, 4) where there is room, and the shadow (K, 2) there; else None."""
    resting = _resting(mesh)
    chances = np.array([r.probability for r in resting])
    discs = [_disc(s) for s in shadows]
    for _ in range(TRIES // POSES_PER_PLACE):
        yaw = se3.exp_so3([0.0, 0.0, rng.uniform(0, 2 * np.pi)])
        R = yaw @ resting[int(rng.choice(len(resting), p=chances / chances.sum()))].R
        turned = mesh.vertices @ R.T
        shadow = _hull(turned[:, :2])
        middle, radius = _disc(shadow)
        shape = shadow - middle
        places = (
            config.disc_m
            * np.sqrt(rng.random((POSES_PER_PLACE, 1)))
            * _circle(rng.uniform(0, 2 * np.pi, POSES_PER_PLACE))
        )
        for place in places:
            near = [
                other
                for other, (at, reach) in zip(shadows, discs, strict=True)
                if np.linalg.norm(place - at) < radius + reach + config.gap_m
            ]
            if all(_gap(shape + place, other) >= config.gap_m for other in near):
                t = np.array([*(place - middle), -turned[:, 2].min()])
                return se3.from_rt(R, t), shape + place
    return None


def _circle(angles: Array) -> Array:
    """Return points (N, 2) of the unit circle."""
    return np.stack([np.cos(angles), np.sin(angles)], -1)


def _hull(points: Array) -> Array:
    """Return the corners (K, 2) of the convex hull of points (N, 2), counter-clockwise."""
    from scipy.spatial import ConvexHull

    return points[ConvexHull(points).vertices]


def _disc(polygon: Array) -> tuple[Array, float]:
    """Return the middle (2,) of a polygon's box and the radius of the disc that holds it."""
    middle = (polygon.min(0) + polygon.max(0)) / 2
    return middle, float(np.linalg.norm(polygon - middle, axis=1).max())


def _gap(a: Array, b: Array) -> float:
    """Return by how much convex polygons (K, 2), counter-clockwise, are apart at least.

    The greatest gap between their projections on the normals of all edges: their distance, or a
    little less where two corners are nearest; negative if they overlap (separating axis theorem).
    """
    return max(_gap_over(a, b), _gap_over(b, a))


def _gap_over(a: Array, b: Array) -> float:
    """Return the greatest distance of `b` beyond an edge of `a`."""
    edges = np.roll(a, -1, axis=0) - a
    normals = np.stack([edges[:, 1], -edges[:, 0]], -1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    beyond = b @ normals.T - np.sum(a * normals, axis=1)
    return float(beyond.min(axis=0).max())
