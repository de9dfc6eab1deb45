"""How far an estimate is from the truth: rotation, translation, surfaces, pixels, mask overlap.

Rotation is in degrees, translation in millimetres, MSSD and ADD-S in metres; they are never summed.
Functions that take an `ObjectModel` know its symmetries, those about axes exactly; `mssd` takes a
list of them.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3, symmetric_poses
from realsim.geometry.camera import project
from realsim.geometry.mesh_shape import hull_vertices, sample_surface
from realsim.geometry.symmetric_poses import nearest_symmetry
from realsim.interop import import_open3d
from realsim.records import CameraIntrinsics, Mesh, ObjectModel

CHUNK = 2_000_000
"""Symmetries times vertices that are held at once (48 MB)."""
SURFACE_SAMPLES = 4000
"""Points of the surface whose mean distance is ADD-S: 1 % of it at most is chance."""


def rotation_error_deg(T_true: ArrayLike, T_estimated: ArrayLike) -> Any:
    """Return the angle (...) [deg] between two rotations or transforms (..., 3, 3) or (..., 4, 4).

    Symmetries are not considered; `mssd` is the error that knows them.
    """
    R_true = np.asarray(T_true, dtype=np.float64)[..., :3, :3]
    R_estimated = np.asarray(T_estimated, dtype=np.float64)[..., :3, :3]
    return np.degrees(se3.angle(np.swapaxes(R_true, -1, -2) @ R_estimated))


def translation_error_mm(T_true: ArrayLike, T_estimated: ArrayLike) -> Any:
    """Return the distance (...) [mm] between the origins of transforms (..., 4, 4) [m]."""
    t_true = np.asarray(T_true, dtype=np.float64)[..., :3, 3]
    t_estimated = np.asarray(T_estimated, dtype=np.float64)[..., :3, 3]
    return 1e3 * np.linalg.norm(t_true - t_estimated, axis=-1)


def mssd(
    T_true: ArrayLike,
    T_estimated: ArrayLike,
    vertices: ArrayLike,
    symmetries: ArrayLike | None = None,
) -> float:
    """Return the Maximum Symmetry-Aware Surface Distance [m].

    e = min over S of max over v of |T_estimated v - T_true S v| (Hodan et al., BOP Challenge 2020,
    section 2.2). For one S the distance is the norm of an affine map of v, so it is convex and its
    maximum over the mesh is reached at a vertex of the convex hull: only these are looked at.

    Args:
        T_true: (4, 4) true pose of the object.
        T_estimated: (4, 4) estimated pose, in the same frame.
        vertices: (V, 3) of the mesh [m].
        symmetries: (S, 4, 4) T_obj_obj, the identity among them; None = no symmetry.
    """
    v = hull_vertices(vertices)
    S = np.eye(4)[None] if symmetries is None else np.asarray(symmetries, dtype=np.float64)
    if S.ndim != 3 or S.shape[1:] != (4, 4) or len(S) == 0:
        raise InputError(f"symmetries have shape {S.shape}; (S, 4, 4) with S >= 1 is expected.")
    # |T_e v - T_t S v| = |(T_t^-1 T_e - S) v|: the difference itself is an affine map.
    D = (se3.invert(T_true) @ np.asarray(T_estimated, dtype=np.float64))[None] - S
    step = max(1, CHUNK // len(v))
    best = math.inf
    for start in range(0, len(D), step):
        part = D[start : start + step]
        moved = v @ np.swapaxes(part[:, :3, :3], -1, -2) + part[:, None, :3, 3]
        worst_squared = np.einsum("svi,svi->sv", moved, moved).max(axis=1)
        best = min(best, float(np.sqrt(worst_squared.min())))
    return best


def aligned_pose(T_true: ArrayLike, T_estimated: ArrayLike, model: ObjectModel) -> Array:
    """Return the pose (4, 4) that looks like the estimated one and is nearest to the true one.

    Nearest by `mssd_symmetric`. Errors of rotation and translation, of points and of pixels mean
    something only after it.

    Args:
        T_true: (4, 4) true pose of the object.
        T_estimated: (4, 4) estimated pose, in the same frame.
        model: the object, with its symmetries.
    """
    return symmetric_poses.aligned_pose(
        T_true, T_estimated, model.mesh.vertices, model.symmetries, model.symmetry_axes
    )


def mssd_symmetric(T_true: ArrayLike, T_estimated: ArrayLike, model: ObjectModel) -> float:
    """Return the Maximum Symmetry-Aware Surface Distance [m], exact for continuous symmetries.

    As `mssd`, but the best turn about an axis is computed instead of picked from samples: its
    distance from the best sample would be counted as error. Of a sphere (axes that meet) only the
    distance of the centres is left. Arguments as of `aligned_pose`.
    """
    nearest = nearest_symmetry(
        T_true, T_estimated, model.mesh.vertices, model.symmetries, model.symmetry_axes
    )
    return nearest.distance_m


def add_s(T_true: ArrayLike, T_estimated: ArrayLike, model: ObjectModel) -> float:
    """Return ADD-S [m]: mean distance of the estimated surface to the true surface.

    ADD-S as published (Hinterstoisser et al. 2012) looks for the nearest of the true object's
    points, so it never falls below the spacing of these points. Here it is the nearest point of
    the true triangles: a right pose has 0. It knows every symmetry by itself, declared or not.
    Arguments as of `aligned_pose`.
    """
    o3d = import_open3d()
    scene, samples = _surface(model.mesh)
    T_obj_obj = se3.invert(T_true) @ np.asarray(T_estimated, dtype=np.float64)
    points = se3.transform(T_obj_obj, samples).astype(np.float32)
    return float(scene.compute_distance(o3d.core.Tensor(points), 1).numpy().mean())


def reprojection_px(
    intrinsics: CameraIntrinsics,
    T_cam_obj_true: ArrayLike,
    T_cam_obj_estimated: ArrayLike,
    points: ArrayLike,
    model: ObjectModel | None = None,
) -> Any:
    """Return how far (...) [px] model points are from their true place in the image, on average.

    Points behind the camera do not count; where all are, the result is NaN.

    Args:
        intrinsics: the camera.
        T_cam_obj_true: (..., 4, 4) true poses of the object in the camera.
        T_cam_obj_estimated: (..., 4, 4) estimated ones.
        points: (N, 3) of the model [m].
        model: the object, to align every estimated pose by its symmetries first; None = it has no
            symmetry, or `aligned_pose` was called before, once for all views.
    """
    true = np.asarray(T_cam_obj_true, dtype=np.float64)
    estimated = np.asarray(T_cam_obj_estimated, dtype=np.float64)
    true, estimated = np.broadcast_arrays(true, estimated)
    shape = true.shape[:-2]
    true, estimated = true.reshape(-1, 4, 4), estimated.reshape(-1, 4, 4)
    if model is not None:
        pairs = zip(true, estimated, strict=True)
        estimated = np.stack([aligned_pose(a, b, model) for a, b in pairs])
    p = np.asarray(points, dtype=np.float64)
    off = [
        np.linalg.norm(
            project(intrinsics, se3.transform(a, p)) - project(intrinsics, se3.transform(b, p)),
            axis=-1,
        )
        for a, b in zip(true, estimated, strict=True)
    ]
    means = [float(o[np.isfinite(o)].mean()) if np.isfinite(o).any() else math.nan for o in off]
    return np.array(means).reshape(shape)[()]


def mask_iou(a: ArrayLike, b: ArrayLike) -> float:
    """Return intersection over union of two masks (H, W); NaN if both are empty.

    Raises:
        InputError: the masks have different sizes.
    """
    mask_a, mask_b = np.asarray(a) != 0, np.asarray(b) != 0
    if mask_a.shape != mask_b.shape:
        raise InputError(f"masks of the sizes {mask_a.shape} and {mask_b.shape} have no overlap.")
    union = int(np.count_nonzero(mask_a | mask_b))
    return int(np.count_nonzero(mask_a & mask_b)) / union if union else math.nan


@lru_cache(maxsize=64)
def _surface(mesh: Mesh) -> tuple[Any, Array]:
    """Return the ray-casting scene of a mesh and points (S, 3) on it; meshes go by identity."""
    from realsim.geometry.distance_field import raycasting_scene  # brings numba

    return raycasting_scene(mesh), sample_surface(mesh, SURFACE_SAMPLES, np.random.default_rng(0))[
        0
    ]
