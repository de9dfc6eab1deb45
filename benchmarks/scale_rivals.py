"""The rival of the scale benchmark: Open3D's point-to-point ICP with scaling, as it is used.

Imported by `scale.py`. Model to scene, which is the direction that works best: the other one runs
away upward in half of the cases. The rival gets the same rough start and the same images, the table
plane as it truly is, and three stages of falling reach.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scale_cases import Case, stream

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.mesh import sample_surface
from realsim.interop import import_open3d
from realsim.records import CameraIntrinsics, Mesh
from realsim.registration.evidence import DepthFrame
from realsim.scanning.scale.result import Similarity

ABOVE_M = 0.004
"""What is this low over the table is taken for table [m]."""
AROUND_M = 0.25
"""Points within this of the start's middle are the scene [m]; nothing else stands on the table."""
VOXEL_M = 0.0015
"""The scene's points are averaged over voxels of this size [m]."""
MODEL_POINTS = 8000
REACH_M = (0.02, 0.01, 0.004)
"""Correspondence distance of the stages [m]: the best of three sets that were tried."""
ITERATIONS = 60
COLLAPSED_PCT = 100.0
"""Error of a result that is no scale at all (ICP without correspondences, numbers not finite)."""


def scene_points(frames: Sequence[DepthFrame], camera: CameraIntrinsics, around: Array) -> Array:
    """Return the points (N, 3) [m] of depth images that are near a place and above the table."""
    rays = ray_table(camera).astype(np.float64)
    clouds: list[Array] = []
    for frame in frames:
        seen = frame.depth_m > 0
        cam = rays[seen] * frame.depth_m[seen][:, None].astype(np.float64)
        p = se3.transform(frame.T_world_cam, cam)
        near = np.linalg.norm(p[:, :2] - around[:2], axis=1) < AROUND_M
        clouds.append(p[near & (p[:, 2] > ABOVE_M)])
    return np.concatenate(clouds)


def _cloud(points: Array) -> Any:
    """Return an Open3D point cloud of points (N, 3)."""
    o3d = import_open3d()
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def icp_scale(mesh: Mesh, start: Similarity, scene: Array, rng: np.random.Generator) -> float:
    """Return the scale that Open3D's ICP with scaling finds for a mesh in a scene (N, 3) [m]."""
    registration = import_open3d().pipelines.registration
    points, _ = sample_surface(mesh, MODEL_POINTS, rng)
    target = _cloud(scene).voxel_down_sample(VOXEL_M)
    T = start.T_world_obj.copy()
    T[:3, :3] *= start.scale
    for reach in REACH_M:
        result = registration.registration_icp(
            _cloud(points), target, reach, T,
            registration.TransformationEstimationPointToPoint(with_scaling=True),
            registration.ICPConvergenceCriteria(max_iteration=ITERATIONS),
        )  # fmt: skip
        T = np.asarray(result.transformation)
    return float(np.cbrt(np.linalg.det(T[:3, :3])))


def rival_errors(case: Case) -> dict[str, float]:
    """Return the signed scale errors [%] of the rival on a case.

    Keys: 'fused' and 'topdown', each followed by '_exact' or '_distorted'.
    """
    camera = case.views.intrinsics
    errors: dict[str, float] = {}
    starts = {"exact": (case.given_exact, case.start_exact),
              "distorted": (case.given_distorted, case.start_distorted)}  # fmt: skip
    views = {"fused": case.views.frames, "topdown": case.views.frames[:1]}
    for view, frames in views.items():
        middle = case.start_exact.vertices(case.given_exact).mean(0)
        scene = scene_points(frames, camera, middle)
        for kind, (mesh, start) in starts.items():
            found = icp_scale(mesh, start, scene, stream(case.name, case.seed, "start"))
            error = 100 * (found / case.true_scale - 1)
            errors[f"{view}_{kind}"] = error if np.isfinite(error) else COLLAPSED_PCT
    return errors
