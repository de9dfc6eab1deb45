"""A second lab: table scenes from a simulator that shares nothing with the first but the records.

Rays are Open3D's, shapes trimesh's. Depth comes from disparity: a bias that wanders from view to
view, noise that neighbours share, steps of 1/32 px, near edges that are too wide, points between
near and far, holes on dark and on grazing surfaces. The lens bends otherwise than the calibration
says, hand-eye and arm are off, the arm smoothly so. Every severity is a parameter; the defaults are
those of an independent check of this project.
"""

from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from outside_shapes import mesh_of, objects
from scipy.ndimage import gaussian_filter, grey_dilation
from scipy.spatial.transform import Rotation

from realsim.geometry.mesh import Mesh
from realsim.interop import import_open3d
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose
from realsim.registration.evidence import DepthFrame

o3d = import_open3d()
Array = NDArray[np.float64]
Image = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class Lab:
    """Severities of everything that is wrong in the lab."""

    views: int = 64
    width: int = 640
    height: int = 480
    focal_px: float = 440.0
    baseline_m: float = 0.018
    """Baseline of the stereo pair, the D405's."""
    step_px: float = 1.0 / 32.0
    """Disparities are multiples of this."""
    noise_px: float = 0.06
    """1-sigma of a pixel's disparity; neighbours within some 2 px share it."""
    bias_px: float = 0.05
    """1-sigma of a view's common error of disparity; it wanders from view to view."""
    bias_views: float = 8.0
    """How many views it lasts."""
    fattening_px: int = 2
    """Near surfaces are wider than they are by this in places."""
    flying_share: float = 0.5
    """Share of the pixels at an edge that lie between near and far."""
    holes_share: float = 0.01
    """Dropouts anywhere."""
    lens_px: float = 0.5
    """What the calibrated lens is off at the corners."""
    hand_eye_mm: float = 1.0
    hand_eye_deg: float = 0.2
    arm_mm: float = 0.3
    arm_deg: float = 0.05
    arm_smooth_share: float = 0.7
    """Share of the arm's error that changes smoothly with the place."""
    table: str = "flat"
    """'flat', 'wavy' (+-`wave_m`) or 'none'."""
    wave_m: float = 0.006
    mesh_scale: float = 1.0
    """The models are this times the objects."""
    distance_m: tuple[float, float] = (0.30, 0.45)
    highest_deg: float = 75.0
    lowest_deg: float = 25.0
    photos: bool = False
    """Whether every frame has a photograph, too."""
    grain: float = 2.0
    """1-sigma of its noise [of 255]."""
    blur_px: float = 0.7


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LabScene:
    """What the lab reports, and what is true. The world is the robot's base, the table z = 0."""

    intrinsics: CameraIntrinsics
    frames: tuple[DepthFrame, ...]
    models: dict[int, ObjectModel]
    truth: tuple[ObjectPose, ...]
    Ts_world_cam: Array = field(repr=False)
    """(V, 4, 4) where the camera really was [m]."""
    seen_share: dict[int, float]
    """Instance -> the largest share of its outline that a view sees unhidden."""


# --- the scene -----------------------------------------------------------------------------------


def _pose(turn: Rotation, at: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), at
    return T


@cache
def _stable(obj_id: int) -> tuple[Array, Array]:
    """Return the poses (S, 4, 4) in which an object can lie, and how likely each is (S,)."""
    stable, likely = objects()[obj_id][1].compute_stable_poses(n_samples=1, sigma=0.0)
    return np.asarray(stable), np.asarray(likely)


def _placed(ids: list[int], rng: np.random.Generator, lab: Lab) -> list[Array]:
    """Return poses (4, 4) on the table, in stable positions, boxes apart by some mm."""
    radius = 0.09
    while True:
        circles: list[tuple[Array, float]] = []
        poses: list[Array] = []
        for obj_id in ids:
            body = objects()[obj_id][1]
            stable, likely = _stable(obj_id)
            T0 = stable[rng.choice(len(stable), p=likely / likely.sum())]
            turned = body.copy().apply_transform(T0)
            middle, size = turned.bounds.mean(axis=0)[:2], np.ptp(turned.bounds, axis=0)[:2]
            r = 0.5 * float(np.hypot(*size)) * 0.92
            for _ in range(200):
                place = radius * np.sqrt(rng.uniform()) * _unit(rng.uniform(0, 2 * np.pi))
                if all(np.linalg.norm(place - c) > r + q for c, q in circles):
                    break
            else:
                break
            circles.append((place, r))
            yaw = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
            back = _pose(Rotation.identity(), np.array([-middle[0], -middle[1], 0.0]))
            at = np.array([*place, _height(place, lab)])
            poses.append(_pose(yaw, at) @ back @ T0)
        if len(poses) == len(ids):
            return poses
        radius += 0.01


def _unit(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def _height(place: Array, lab: Lab) -> float:
    """Return how high the table is at a place (2,) [m]."""
    if lab.table != "wavy":
        return 0.0
    x, y = 2 * np.pi * place / 0.25
    return float(lab.wave_m * np.sin(x) * np.cos(0.8 * y + 0.5))


def _table(lab: Lab) -> trimesh.Trimesh | None:
    """Return the top of the table."""
    if lab.table == "none":
        return None
    n = 121
    u = np.linspace(-0.6, 0.6, n)
    x, y = (a.ravel() for a in np.meshgrid(u, u, indexing="ij"))
    z = np.array([_height(np.array(p), lab) for p in zip(x, y, strict=True)])
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)])
    return trimesh.Trimesh(np.stack([x, y, z], axis=1), faces, process=False)


def _cameras(rng: np.random.Generator, lab: Lab) -> Array:
    """Return camera poses (V, 4, 4) on a spiral from above to the side, z forwards."""
    found = []
    for k in range(lab.views):
        share = k / max(lab.views - 1, 1)
        up = np.radians(lab.highest_deg + share * (lab.lowest_deg - lab.highest_deg))
        around = 2.399963 * k + rng.normal(0, 0.05)
        away = rng.uniform(*lab.distance_m)
        at = away * np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
        target = np.array([*rng.normal(0, 0.02, 2), 0.03])
        z = (target - at) / np.linalg.norm(target - at)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = (
            np.stack([x, np.cross(z, x), z], axis=1),
            at + np.array([0.0, 0.0, 0.03]),
        )
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0, 0, rng.uniform(-0.3, 0.3)]).as_matrix()
        found.append(T)
    return np.stack(found)


def _claimed(true: Array, rng: np.random.Generator, lab: Lab) -> Array:
    """Return where hand-eye and arm say that the cameras (V, 4, 4) are."""
    axis = rng.normal(size=(2, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    mount = _pose(Rotation.from_rotvec(np.radians(lab.hand_eye_deg) * axis[0]),
                  lab.hand_eye_mm / 1e3 * axis[1])  # fmt: skip
    smooth = np.sqrt(lab.arm_smooth_share)
    rough = np.sqrt(1.0 - lab.arm_smooth_share)
    waves, phases = rng.normal(0, 6.0, (6, 3)), rng.uniform(0, 2 * np.pi, 6)
    sigma = np.repeat([np.radians(lab.arm_deg), lab.arm_mm / 1e3], 3) / np.sqrt(3.0)
    found = []
    for T in true:
        slow = np.sqrt(2.0) * np.sin(waves @ T[:3, 3] + phases)
        error = sigma * (smooth * slow + rough * rng.normal(size=6))
        found.append(T @ mount @ _pose(Rotation.from_rotvec(error[:3]), error[3:]))
    return np.stack(found)


# --- the sensor ----------------------------------------------------------------------------------


def _rays(lab: Lab) -> Array:
    """Return the true directions (H, W, 3) of the pixels, z = 1: the lens is not the calibrated."""
    u, v = np.meshgrid(np.arange(lab.width), np.arange(lab.height))
    x = (u - (lab.width - 1) / 2) / lab.focal_px
    y = (v - (lab.height - 1) / 2) / lab.focal_px
    corner = np.hypot(lab.width, lab.height) / 2 / lab.focal_px
    r2 = (x**2 + y**2) / corner**2
    # Largest at the corners, with a zero at 0.7 of the way: a fit that balanced middle and rim.
    bent = 1.0 + lab.lens_px / (lab.focal_px * corner) * (r2 - 0.5) * 2.0
    return np.stack([x * bent, y * bent, np.ones_like(x)], axis=-1).astype(np.float64)


def _measured(
    z: Image, facing: Image, dark: NDArray[np.bool_], bias_px: float, lab: Lab,
    rng: np.random.Generator,
) -> NDArray[np.float32]:  # fmt: skip
    """Return what the sensor makes of depth (H, W) [m]; 0 = nothing there.

    Args:
        z: exact depth; inf = nothing.
        facing: cosine between ray and normal.
        dark: where the surface is dark.
        bias_px: the view's.
        lab: severities.
        rng: of the noise.
    """
    scale = lab.focal_px * lab.baseline_m
    d = np.where(np.isfinite(z), scale / z, 0.0)
    wide = grey_dilation(d, size=2 * lab.fattening_px + 1)
    edge = wide - d > 0.6
    patchy = gaussian_filter(rng.normal(size=d.shape), 3.0) > 0.0
    d = np.where(edge & patchy, wide, d)
    near = grey_dilation(d, size=3)
    between = (near - d > 0.6) & (rng.uniform(size=d.shape) < lab.flying_share)
    d = np.where(between, d + rng.uniform(size=d.shape) * (near - d), d)
    shared = gaussian_filter(rng.normal(size=d.shape), 1.0)
    noise = lab.noise_px * shared / shared.std()
    d = np.where(d > 0, d + noise * np.where(dark, 2.0, 1.0) + bias_px, 0.0)
    d = np.round(d / lab.step_px) * lab.step_px
    holes = rng.uniform(size=d.shape) < lab.holes_share
    spots = gaussian_filter(rng.normal(size=d.shape), 2.0)
    spots /= spots.std()
    holes |= dark & (spots > 0.5)
    holes |= rng.uniform(size=d.shape) < np.clip((0.30 - facing) / 0.25, 0.0, 1.0)
    depth = np.where((d > 0.5) & ~holes, scale / np.maximum(d, 0.5), 0.0)
    depth[depth > 1.5] = 0.0
    return (np.round(depth * 1e4) / 1e4).astype(np.float32)


def _photo(world: Any, T: Array, albedo: Array, lab: Lab, rng: np.random.Generator) -> Any:
    """Return a photograph (H, W, 3): four rays a pixel, a lamp and shadows, paint with stains.

    Args:
        world: everything, for casting.
        T: (4, 4) where the camera is.
        albedo: (G + 1, 3) by geometry; the last of what is nowhere.
        lab: severities.
        rng: of the grain.
    """
    rays = _rays(lab)
    image = np.zeros((lab.height, lab.width, 3))
    lamp = np.array([0.35, -0.25, 0.9]) / np.linalg.norm([0.35, -0.25, 0.9])
    step = np.array([[1.0 / lab.focal_px, 0, 0], [0, 1.0 / lab.focal_px, 0]])
    for du, dv in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        directions = (rays + du * step[0] + dv * step[1]) @ T[:3, :3].T
        origins = np.broadcast_to(T[:3, 3], directions.shape)
        hit = world.cast_rays(o3d.core.Tensor(np.concatenate([origins, directions], -1)
                                              .astype(np.float32)))  # fmt: skip
        z, normals = hit["t_hit"].numpy().astype(np.float64), hit["primitive_normals"].numpy()
        which = np.minimum(hit["geometry_ids"].numpy().astype(np.int64), len(albedo) - 1)
        normals = normals * -np.sign((normals * directions).sum(-1, keepdims=True))
        places = origins + np.where(np.isfinite(z), z, 0.0)[..., None] * directions
        stains = 1.0 + 0.08 * np.sin(places @ [70.0, 41.0, 55.0] + which) * np.cos(
            places @ [-33.0, 64.0, 20.0]
        )
        towards = np.concatenate(
            [places + 5e-4 * normals, np.broadcast_to(lamp, places.shape)], -1
        ).astype(np.float32)
        lit = ~world.test_occlusions(o3d.core.Tensor(towards)).numpy()
        light = 0.35 + 0.65 * lit * np.clip(normals @ lamp, 0.0, 1.0)
        image += 0.25 * albedo[which] * (light * stains)[..., None]
    image = gaussian_filter(image, (lab.blur_px, lab.blur_px, 0))
    return np.clip(image + rng.normal(0, lab.grain, image.shape), 0, 255).astype(np.uint8)


def make_scene(seed: int, lab: Lab | None = None, ids: list[int] | None = None,
               count: int = 10) -> LabScene:  # fmt: skip
    """Return a scene of the lab.

    Args:
        seed: of layout, views, errors and noise.
        lab: severities.
        ids: which objects; None = `count` of them, drawn.
        count: how many are drawn.
    """
    lab = lab or Lab()
    rng = np.random.default_rng([seed, 2026])
    known = objects()
    if ids is None:
        ids = [int(i) for i in rng.choice(sorted(known), count, replace=False)]
    poses = _placed(ids, rng, lab)
    true = _cameras(rng, lab)
    claimed = _claimed(true, rng, lab)
    world = o3d.t.geometry.RaycastingScene()
    dark_of: dict[int, bool] = {}
    instance_of: dict[int, int] = {}
    for instance, (obj_id, T) in enumerate(zip(ids, poses, strict=True)):
        body = known[obj_id][1].copy().apply_transform(T)
        number = world.add_triangles(mesh_of(body))
        dark_of[number], instance_of[number] = known[obj_id][2], instance
    table = _table(lab)
    if table is not None:
        dark_of[world.add_triangles(mesh_of(table))] = False
    paints = np.random.default_rng([seed, 5])
    albedo = np.full((len(dark_of) + 1, 3), 20.0)
    for number, black in dark_of.items():
        albedo[number] = paints.uniform(15, 45, 3) if black else paints.uniform(60, 245, 3)
    alone = [_alone(known[i][1], T) for i, T in zip(ids, poses, strict=True)]
    rays = _rays(lab)
    keep = np.exp(-1.0 / lab.bias_views)
    bias = rng.normal(0, lab.bias_px)
    frames: list[DepthFrame] = []
    seen = {k: 0.0 for k in range(len(ids))}
    for k, T in enumerate(true):
        directions = rays @ T[:3, :3].T
        origins = np.broadcast_to(T[:3, 3], directions.shape)
        both = o3d.core.Tensor(np.concatenate([origins, directions], -1).astype(np.float32))
        hit = world.cast_rays(both)
        z, which = hit["t_hit"].numpy().astype(np.float64), hit["geometry_ids"].numpy()
        normals = hit["primitive_normals"].numpy()
        length = np.linalg.norm(directions, axis=-1)
        facing = np.abs((normals * directions).sum(-1)) / length
        dark = np.isin(which, [n for n, black in dark_of.items() if black])
        # Noise has a generator of its own: the scene stays when the sensor changes.
        noise = np.random.default_rng([seed, 7, k])
        depth = _measured(z, facing, dark, float(bias), lab, noise)
        rgb = None
        if lab.photos:
            rgb = _photo(world, T, albedo, lab, np.random.default_rng([seed, 9, k]))
        frames.append(
            DepthFrame(index=k, depth_m=depth, T_world_cam=claimed[k],
                       read_rgb=None if rgb is None else partial(np.copy, rgb))
        )  # fmt: skip
        bias = keep * bias + np.sqrt(1 - keep**2) * rng.normal(0, lab.bias_px)
        if k % 8 == 0:
            for number, instance in instance_of.items():
                whole = np.isfinite(alone[instance].cast_rays(both)["t_hit"].numpy()).sum()
                share = float((which == number).sum()) / max(float(whole), 1.0)
                seen[instance] = max(seen[instance], share)
    models = {i: _resized(known[i][0], lab.mesh_scale) for i in ids}
    truth = tuple(
        ObjectPose(obj_id=i, instance=n, T_world_obj=T)
        for n, (i, T) in enumerate(zip(ids, poses, strict=True))
    )
    camera = CameraIntrinsics(
        width=lab.width, height=lab.height, fx=lab.focal_px, fy=lab.focal_px,
        cx=(lab.width - 1) / 2, cy=(lab.height - 1) / 2,
    )  # fmt: skip
    return LabScene(
        intrinsics=camera, frames=tuple(frames), models=models, truth=truth, Ts_world_cam=true,
        seen_share=seen,
    )  # fmt: skip


def _alone(body: trimesh.Trimesh, T: Array) -> Any:
    world = o3d.t.geometry.RaycastingScene()
    world.add_triangles(mesh_of(body.copy().apply_transform(T)))
    return world


def _resized(model: ObjectModel, scale: float) -> ObjectModel:
    """Return the model with all lengths times `scale`; origins are in the middle."""
    if scale == 1.0:
        return model
    mesh = Mesh(vertices=model.mesh.vertices * scale, faces=model.mesh.faces)
    return ObjectModel(
        obj_id=model.obj_id, name=model.name, mesh=mesh, symmetries=model.symmetries,
        symmetry_axes=model.symmetry_axes,
    )  # fmt: skip
