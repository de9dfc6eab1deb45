"""One object instance as the fit sees it: distance field, surface samples, ray-casting scene."""

from dataclasses import dataclass, replace
from dataclasses import field as derived
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.geometry.distance_field import DistanceField, raycasting_scene
from realsim.geometry.mesh import box_corners, sample_surface
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose

SAMPLE_SEED = 0
"""Surface samples are part of the model: always the same."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Body:
    """An object instance with everything that is derived from its mesh once."""

    start: ObjectPose
    """Where the search starts."""
    model: ObjectModel
    field: DistanceField
    samples: Array
    """(S, 3) points on the surface, evenly spread [m]."""
    normals: Array
    """(S, 3) outward normals of the samples."""
    ray_scene: Any
    """Open3D RaycastingScene of the mesh in its own frame."""
    bounds_obj: Array = derived(init=False)
    """(2, 3) least and greatest corner in the object's frame [m]."""
    center_obj: Array = derived(init=False)
    """(3,) centre of the bounding box in the object's frame [m]."""
    radius_m: float = derived(init=False)
    """Half the diagonal of the bounding box [m]."""

    def __post_init__(self) -> None:
        """Measure the box once: a fit asks for it thousands of times."""
        low, high = bounds = self.model.mesh.bounds
        object.__setattr__(self, "bounds_obj", bounds)
        object.__setattr__(self, "center_obj", 0.5 * (low + high))
        object.__setattr__(self, "radius_m", float(0.5 * np.linalg.norm(high - low)))

    @property
    def T_start(self) -> Array:
        """(4, 4) the start pose T_world_obj."""
        return self.start.T_world_obj

    def center(self, T_world_obj: Array) -> Array:
        """Return the centre of the bounding box (3,) in world [m]."""
        return T_world_obj[:3, :3] @ self.center_obj + T_world_obj[:3, 3]


def moved_body(body: Body, T_world_obj: Array) -> Body:
    """Return the body with another start (4, 4)."""
    return replace(body, start=replace(body.start, T_world_obj=T_world_obj))


def moved_about_center(body: Body, T_world_obj: Array, motion: Array) -> Array:
    """Return a pose moved by a motion (6,): about the box's centre, turns times the radius [m]."""
    c = se3.from_translation(body.center_obj)
    step = se3.exp(motion * np.repeat([1.0 / body.radius_m, 1.0], 3))
    return T_world_obj @ c @ step @ se3.invert(c)


def make_body(
    start: ObjectPose, model: ObjectModel, cells: int, samples: int, folder: Path | None = None
) -> Body:
    """Return the body of an object instance.

    Args:
        start: the pose the search starts from.
        model: the object.
        cells: cells of the distance field along the longest side.
        samples: surface samples.
        folder: where distance fields are kept between runs; None = in memory.
    """
    points, normals = sample_surface(model.mesh, samples, np.random.default_rng(SAMPLE_SEED))
    return Body(
        start=start,
        model=model,
        field=DistanceField.from_mesh(model.mesh, cells, folder),
        samples=points,
        normals=normals,
        ray_scene=raycasting_scene(model.mesh),
    )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Footprint:
    """The pixels at which one object would be seen, were nothing in front of it."""

    rows: Int64
    """(N,) image rows, multiples of the stride."""
    columns: Int64
    """(N,) image columns, multiples of the stride."""
    z: Array
    """(N,) depth of the surface along the camera's z [m]."""


def pixel_box(
    body: Body, intrinsics: CameraIntrinsics, T_cam_obj: Array
) -> tuple[int, int, int, int]:
    """Return the image box (left, top, right, bottom; the last two exclusive) that holds the body.

    The whole image if a corner of the body's box lies behind the camera; empty if it is outside.
    """
    corners_cam = se3.transform(T_cam_obj, box_corners(*body.bounds_obj))
    if corners_cam[:, 2].max() <= 0:
        return 0, 0, 0, 0
    if corners_cam[:, 2].min() < 1e-3:
        return 0, 0, intrinsics.width, intrinsics.height
    uv = project(intrinsics, corners_cam)
    left, top = np.floor(uv.min(0)).astype(int) - 2
    right, bottom = np.ceil(uv.max(0)).astype(int) + 3
    width, height = intrinsics.width, intrinsics.height
    box = np.clip([left, top, right, bottom], 0, [width, height, width, height])
    return int(box[0]), int(box[1]), int(box[2]), int(box[3])


def footprint(body: Body, intrinsics: CameraIntrinsics, T_cam_obj: Array, stride: int) -> Footprint:
    """Return where the body is seen, by ray casting every `stride`-th pixel of its image box."""
    from realsim.interop import import_open3d

    o3d = import_open3d()
    left, top, right, bottom = pixel_box(body, intrinsics, T_cam_obj)
    rows = np.arange(-(-top // stride) * stride, bottom, stride)
    columns = np.arange(-(-left // stride) * stride, right, stride)
    if len(rows) == 0 or len(columns) == 0:
        return Footprint(rows=rows[:0], columns=columns[:0], z=np.zeros(0))
    directions = ray_table(intrinsics)[rows[0] : bottom : stride, columns[0] : right : stride]
    T_obj_cam = se3.invert(T_cam_obj)
    rays = np.empty((*directions.shape[:2], 6), dtype=np.float32)
    rays[..., :3] = T_obj_cam[:3, 3]
    # Rays have z = 1 in the camera, so the parameter of the hit is the depth; NaN hits nothing.
    rays[..., 3:] = np.nan_to_num(directions.reshape(-1, 3) @ T_obj_cam[:3, :3].T).reshape(
        directions.shape
    )
    t = body.ray_scene.cast_rays(o3d.core.Tensor(rays), 1)["t_hit"].numpy()
    v, u = np.nonzero(np.isfinite(t))
    return Footprint(rows=rows[v], columns=columns[u], z=t[v, u].astype(np.float64))
