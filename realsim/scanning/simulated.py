"""Depth views of one object alone on a table, with the errors of a real lab and a known truth.

What a scan can be worth is found out here before anyone holds a camera: the same views with the
same errors serve the tests, the benchmark, and whoever asks which accuracy a shape allows.
"""

from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim.geometry.mesh import transformed
from realsim.records import CameraIntrinsics, Mesh
from realsim.registration.evidence import DepthFrame
from realsim.registration.simulated_lab import (
    LOWEST_DEG,
    T_EE_CAM,
    arm_error,
    hemisphere,
    offset,
    table_square,
)
from realsim.rendering.depth_sensors.model import DepthSensorModel

__all__ = [
    "DISC_M", "EDGES_PER_LENGTH", "FIELD_POINTS", "LOWEST_DEG", "T_EE_CAM", "ScanLabConfig",
    "ScanViews", "distorted", "scan_views", "standing",
]  # fmt: skip
DISC_M = 0.04
"""The object stands up to this far from the middle of the views [m]."""
FIELD_POINTS = 20_000
"""Points of the surface over which a shape error is freed of shift, turn and scale."""
EDGES_PER_LENGTH = 16
"""A distorted mesh has edges of at most this part of its length: ten to the shortest wave."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanLabConfig:
    """Views and errors of a simulated scan."""

    views: int = 24
    """Views on a hemisphere; the first looks straight down."""
    distance_m: tuple[float, float] = (0.25, 0.45)
    """Least and greatest distance of the camera from the middle [m]."""
    width: int = 1280
    """[px]."""
    height: int = 720
    """[px]."""
    focal_px: float = 648.0
    """[px]; the D405's at 1280 px of width."""
    hand_eye_mm: float = 0.5
    """Constant error of the hand-eye [mm], in a random direction."""
    hand_eye_deg: float = 0.1
    """Constant error of the hand-eye [deg], about a random axis."""
    arm_mm: float = 0.2
    """Error of every robot pose along each axis, 1-sigma [mm]."""
    arm_deg: float = 0.03
    """Error of every robot pose about each axis, 1-sigma [deg]."""
    sensor: DepthSensorModel = field(default_factory=DepthSensorModel)
    """The depth camera."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScanViews:
    """What the lab reports, and what is true."""

    intrinsics: CameraIntrinsics
    frames: tuple[DepthFrame, ...]
    """Depth images with the camera poses that forward kinematics and hand-eye claim."""
    Ts_world_cam: Array
    """(F, 4, 4) where the camera really was [m]."""
    T_world_obj: Array
    """(4, 4) where the object really stands; its mesh is in metres."""


def scan_views(
    mesh: Mesh, T_world_obj: Array, config: ScanLabConfig, rng: np.random.Generator
) -> ScanViews:
    """Return depth views of a mesh [m] that stands on the table z = 0 of the world.

    Args:
        mesh: the object as it really is, at its real size [m].
        T_world_obj: (4, 4) where it stands.
        config: views and errors.
        rng: of the views, the errors and the sensor's noise.
    """
    from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene

    camera = CameraIntrinsics(
        width=config.width, height=config.height, fx=config.focal_px, fy=config.focal_px,
        cx=(config.width - 1) / 2, cy=(config.height - 1) / 2,
    )  # fmt: skip
    placed = transformed(mesh, T_world_obj)
    middle = placed.bounds.mean(0)
    true = hemisphere(middle, config.views, config.distance_m, config.distance_m[1], rng)
    hand_eye = offset(rng, config.hand_eye_mm / 1e3, np.radians(config.hand_eye_deg))
    T_ee_cam_true = T_EE_CAM @ hand_eye
    scene = RayScene([
        PlacedMesh(0, mesh, T_world_obj),
        PlacedMesh(BACKGROUND, table_square(placed.bounds.mean(0)[:2]), np.eye(4)),
    ])  # fmt: skip
    frames: list[DepthFrame] = []
    for index, T_world_cam in enumerate(true):
        exact = scene.view(camera, T_world_cam).depth_m
        xi = arm_error(rng, config.arm_mm, config.arm_deg)
        T_base_ee = T_world_cam @ se3.invert(T_ee_cam_true) @ se3.exp(xi)
        frames.append(
            DepthFrame(
                index=index,
                depth_m=config.sensor.measure(exact, camera, rng),
                T_world_cam=T_base_ee @ T_EE_CAM,
            )
        )
    return ScanViews(
        intrinsics=camera, frames=tuple(frames), Ts_world_cam=true, T_world_obj=T_world_obj.copy()
    )


def standing(mesh: Mesh, R: Array, rng: np.random.Generator) -> Array:
    """Return T_world_obj (4, 4) of a mesh turned by R (3, 3), then by any yaw, put on z = 0."""
    yaw = se3.exp_so3([0.0, 0.0, rng.uniform(0, 2 * np.pi)])
    turned = mesh.vertices @ (yaw @ R).T
    low, high = turned.min(0), turned.max(0)
    foot = np.array([*(low + high)[:2] / 2, low[2]])
    place = np.array([*rng.uniform(-DISC_M, DISC_M, 2), 0.0])
    return se3.from_rt(yaw @ R, place - foot)


def distorted(mesh: Mesh, amplitude: float, rng: np.random.Generator, waves: int = 6) -> Mesh:
    """Return the mesh with a smooth random shape error that is not a change of scale or pose.

    The displacement is a sum of `waves` random plane waves per axis, half to one and a half waves
    along the object; what of it is a shift, a turn or a change of scale is projected out, weighted
    by area, and the rest is scaled to the wanted size. Edges that are long against the waves are
    split first: the large faces of a box would stay flat, and moving their corners alone changes
    the scale by up to 0.6 % at 2 %.

    Args:
        mesh: the true shape.
        amplitude: RMS displacement as a share of the largest extent (0.02 = 2 %).
        rng: of the waves.
        waves: plane waves per axis.
    """
    from dataclasses import replace

    from realsim.geometry.mesh import sample_surface

    length = float(mesh.extent.max())
    k = rng.standard_normal((waves, 3, 3))
    k *= rng.uniform(0.5, 1.5, (waves, 3, 1)) / np.linalg.norm(k, axis=2, keepdims=True)
    phase = rng.uniform(0, 2 * np.pi, (waves, 3))
    gain = rng.standard_normal((waves, 3))

    def field_at(points: Array) -> Array:
        angle: Array = 2 * np.pi / length * np.einsum("nc,wac->nwa", points, k) + phase
        moved: Array = np.einsum("nwa,wa->na", np.sin(angle), gain)
        return moved

    points, _ = sample_surface(mesh, FIELD_POINTS, np.random.default_rng(0))
    center = points.mean(0)

    def modes(p: Array) -> Array:
        q = p - center
        shifts = [np.tile(e, (len(q), 1)) for e in np.eye(3)]
        turns = [np.asarray(np.cross(e, q), np.float64) for e in np.eye(3)]
        return np.stack([*shifts, *turns, q], -1)

    d = field_at(points)
    A = modes(points).reshape(-1, 7)
    x, *_ = np.linalg.lstsq(A, d.ravel(), rcond=None)
    rest = d - (A @ x).reshape(-1, 3)
    factor = amplitude * length / np.sqrt(np.mean(np.sum(np.square(rest), axis=1)))
    fine = _short_edged(mesh, length / EDGES_PER_LENGTH)
    moved = field_at(fine.vertices) - (modes(fine.vertices).reshape(-1, 7) @ x).reshape(-1, 3)
    return replace(fine, vertices=fine.vertices + factor * moved)


def _short_edged(mesh: Mesh, longest: float) -> Mesh:
    """Return the same surface with no edge longer than `longest` [m], as closed as it was.

    Too long edges are halved, in both of their faces, until there is none.
    """
    columns = [mesh.vertices, mesh.colors, mesh.uv]
    widths = [0 if c is None else c.shape[1] for c in columns]
    rows = np.concatenate([np.asarray(c, np.float64) for c in columns if c is not None], axis=1)
    faces = mesh.faces.astype(np.int64)
    while True:
        edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), axis=2)
        long = np.linalg.norm(rows[edges[..., 0], :3] - rows[edges[..., 1], :3], axis=-1) > longest
        if not long.any():
            break
        pairs, index = np.unique(edges[long], axis=0, return_inverse=True)
        middle = np.full(faces.shape, -1)
        middle[long] = len(rows) + index.reshape(-1)
        rows = np.concatenate([rows, (rows[pairs[:, 0]] + rows[pairs[:, 1]]) / 2])
        faces = _halved(faces, middle)
    vertices, colors, uv = np.split(rows, np.cumsum(widths)[:-1], axis=1)
    return Mesh(
        vertices=vertices,
        faces=faces.astype(np.int32),
        colors=None if mesh.colors is None else np.round(colors).astype(np.uint8),
        uv=None if mesh.uv is None else uv,
        texture=mesh.texture,
    )


def _halved(faces: Int64, middle: Int64) -> Int64:
    """Return triangles cut at the middles (F, 3) of their edges ab, bc, ca; -1 = not cut."""
    cuts = np.sum(middle >= 0, axis=1)
    # Turned so that one cut is on ab, two are on ab and bc.
    first = np.where(cuts == 2, (np.argmin(middle, axis=1) + 1) % 3, np.argmax(middle, axis=1))
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, 1).T
    ab, bc, ca = np.take_along_axis(middle, order, 1).T
    one, two, three = cuts == 1, cuts == 2, cuts == 3

    def pick(which: Mask, *corners: Int64) -> Int64:
        return np.stack([x[which] for x in corners], -1)

    return np.concatenate([
        faces[cuts == 0],
        pick(one, a, ab, c), pick(one, ab, b, c),
        pick(two, ab, b, bc), pick(two, a, ab, bc), pick(two, a, bc, c),
        pick(three, a, ab, ca), pick(three, ab, b, bc), pick(three, ca, bc, c),
        pick(three, ab, bc, ca),
    ])  # fmt: skip
