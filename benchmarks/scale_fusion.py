"""Benchmark of the fused scan: how near the mesh is to the true surface of a simulated object.

    uv run python benchmarks/scale_fusion.py [--quick] [--json FILE]

Objects of 8 to 15 cm, each scanned from 24 views of 1280x720 with the errors of a real lab. Errors
are of the measured part of the mesh against the true surface where the object truly stands.

Figures: tsdf_median_mm (median over the objects of their median error), tsdf_worst_mm (the worst
object's median), tsdf_aligned_mm (the same after rigid alignment to the truth: shape alone),
tsdf_within2mm (least share of the measured part within 2 mm), tsdf_complete_share (share of the
true surface that two cameras see within 2 mm of the mesh, mean), tsdf_complete_least,
tsdf_sigma_cover (share of errors within 2 sigma), tsdf_cpu_s (median), tsdf_peak_mb. Rivals on the
same frames: Open3D's own VoxelBlockGrid at the robot's poses (open3d_*), Poisson's surface of the
joined cloud (poisson_*).
"""

import argparse
import resource
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import blas_threads  # noqa: F401
import numpy as np
from figures import Figure, Found, Goal, run

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.distance_field import raycasting_scene
from realsim.geometry.mesh import sample_surface, to_trimesh, transformed
from realsim.geometry.parts import object_model
from realsim.interop import import_open3d
from realsim.records import Mesh
from realsim.scanning.fusion.fuse import FusedObject, FusionConfig, FusionFrame, fuse_object
from realsim.scanning.simulated import ScanLabConfig, ScanViews, scan_views, standing

PACKAGES = ("realsim", "numpy", "open3d-cpu")
OBJECTS: tuple[tuple[str, float, tuple[float, float, float]], ...] = (
    ("mug", 0.11, (0, 0, 0)),
    ("bunny", 0.12, (90, 0, 0)),
    ("l_bracket", 0.10, (0, 0, 0)),
    ("bottle", 0.15, (0, 0, 0)),
    ("duck", 0.10, (90, 0, 0)),
    ("flange", 0.09, (0, 0, 0)),
    ("bowl", 0.14, (0, 0, 0)),
    ("elbow", 0.12, (90, 0, 0)),
    ("teddy", 0.12, (90, 0, 0)),
)
"""Name, greatest extent [m], rotation vector of how it stands [deg]."""
QUICK = "bunny"
"""Object of the quick run."""
QUICK_LAB = ScanLabConfig(views=12, width=640, height=360, focal_px=324.0)
"""Half the resolution has twice the noise: the quick figures are worse."""
RIVAL_VOXEL_M = 0.001
RIVAL_TRUNCATION = 4.0
"""In voxels: the truncation of ours."""
SAMPLES = 20_000
"""Points on the true surface for completeness."""


def _signed_mm(mesh: Mesh, points: Array) -> Array:
    """Return the signed distance (N,) [mm] of points to a mesh's surface, outside positive."""
    tensor = import_open3d().core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
    distance = raycasting_scene(mesh).compute_signed_distance(tensor, 1, 5).numpy()
    return 1e3 * np.asarray(distance, dtype=np.float64)


def _seen(mesh: Mesh, cameras: Array, rng: np.random.Generator) -> Array:
    """Return points (N, 3) of a true surface that at least two cameras see (to 75 deg)."""
    core = import_open3d().core
    points, normals = sample_surface(mesh, SAMPLES, rng)
    scene = raycasting_scene(mesh)
    count = np.zeros(len(points), dtype=int)
    for T in cameras:
        to = T[:3, 3] - points
        to /= np.linalg.norm(to, axis=1, keepdims=True)
        start = points + 1e-4 * (normals + to)
        rays = np.concatenate([start, to], axis=1).astype(np.float32)
        hidden = scene.test_occlusions(core.Tensor(rays)).numpy()
        count += ~hidden & (np.sum(to * normals, axis=1) > np.cos(np.radians(75)))
    return points[count >= 2]


def _aligned_mm(mesh: Mesh, points: Array) -> Array:
    """Return distances (N,) [mm] after the rigid motion that makes them least (point to plane)."""
    core = import_open3d().core
    scene = raycasting_scene(mesh)
    p = points - points.mean(0)
    center = points.mean(0)
    T = np.eye(4)
    for _ in range(8):
        q = se3.transform(T, p) + center
        nearest = scene.compute_closest_points(core.Tensor(q.astype(np.float32)))
        r = _signed_mm(mesh, q) / 1e3
        n = nearest["primitive_normals"].numpy().astype(np.float64)
        w = np.abs(r) < 3e-3
        J = np.concatenate([np.cross(q - center, n), n], axis=1)[w]
        T = se3.exp(-np.linalg.lstsq(J, r[w], rcond=None)[0]) @ T
    return _signed_mm(mesh, se3.transform(T, p) + center)


def _score(truth: Mesh, seen: Array, mesh: Mesh, judged: Array) -> dict[str, float]:
    """Return the figures of one mesh; `judged` are its vertices on the measured part."""
    error = np.abs(_signed_mm(truth, judged))
    return {
        "median_mm": float(np.median(error)),
        "p95_mm": float(np.percentile(error, 95)),
        "aligned_mm": float(np.median(np.abs(_aligned_mm(truth, judged)))),
        "within2mm": float(np.mean(error < 2.0)),
        "complete": float(np.mean(np.abs(_signed_mm(mesh, seen)) < 2.0)),
    }


def _masked(views: ScanViews, fused: FusedObject) -> list[Array32]:
    """Return the depth of what is above the table near the object: the rivals get it for free."""
    rays = ray_table(views.intrinsics)
    T = se3.invert(fused.plane.T_world_table)
    local = se3.transform(T, fused.mesh.vertices)
    low, high = local.min(0) - 0.01, local.max(0) + 0.01
    low[2] = 0.003
    out: list[Array32] = []
    for f in views.frames:
        p = se3.transform(T @ f.T_world_cam, rays * f.depth_m[..., None])
        inside = np.all((p > low) & (p < high), axis=-1)
        out.append(np.where(inside, f.depth_m, np.float32(0)))
    return out


def _open3d_tsdf(views: ScanViews, depths: Sequence[Array32]) -> Mesh:
    """Return Open3D's own fusion at the robot's poses."""
    o3d = import_open3d()
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (o3d.core.float32, o3d.core.float32), ((1), (1)),
        RIVAL_VOXEL_M, 16, 4000,
    )  # fmt: skip
    K = o3d.core.Tensor(views.intrinsics.K)
    for f, depth in zip(views.frames, depths, strict=True):
        image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth)))
        T = o3d.core.Tensor(np.ascontiguousarray(se3.invert(f.T_world_cam)))
        blocks = grid.compute_unique_block_coordinates(image, K, T, 1.0, 1.0, RIVAL_TRUNCATION)
        grid.integrate(blocks, image, K, T, 1.0, 1.0, RIVAL_TRUNCATION)
    mesh = grid.extract_triangle_mesh(3.0)
    return Mesh(
        vertices=mesh.vertex.positions.numpy().astype(np.float64),
        faces=mesh.triangle.indices.numpy().astype(np.int32),
    )


def _poisson(views: ScanViews, depths: Sequence[Array32]) -> Mesh:
    """Return Poisson's surface of the joined cloud at the robot's poses, cut where it has none."""
    o3d = import_open3d()
    rays = ray_table(views.intrinsics)
    joined: Any = o3d.geometry.PointCloud()
    for f, depth in zip(views.frames, depths, strict=True):
        p = (rays * depth[..., None])[::2, ::2][depth[::2, ::2] > 0].astype(np.float64)
        if len(p) < 30:
            continue
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)).voxel_down_sample(0.0015)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(30))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        joined += cloud.transform(f.T_world_cam)
    joined = joined.voxel_down_sample(0.001)
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        joined, depth=8, n_threads=1
    )
    mesh.remove_vertices_by_mask(np.asarray(density) < np.quantile(np.asarray(density), 0.05))
    return Mesh(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.triangles))


def _one(
    name: str, extent: float, turn_deg: Sequence[float], lab: ScanLabConfig
) -> dict[str, float]:
    """Return the figures of one object."""
    raw = object_model(name).mesh
    mesh = replace(raw, vertices=raw.vertices * (extent / float(raw.extent.max())))
    rng = np.random.default_rng(sum(name.encode()))
    T_world_obj = standing(mesh, se3.exp_so3(np.radians(turn_deg)), rng)
    views = scan_views(mesh, T_world_obj, lab, rng)
    frames = [
        FusionFrame(index=f.index, depth_m=f.depth_m, T_world_cam=f.T_world_cam)
        for f in views.frames
    ]
    truth = transformed(mesh, T_world_obj)
    seen = _seen(truth, views.Ts_world_cam, rng)
    fused = fuse_object(views.intrinsics, frames, FusionConfig())
    judged = fused.mesh.vertices[fused.measured]
    figures = _score(truth, seen, fused.mesh, judged)
    error = np.abs(_signed_mm(truth, judged)) / 1e3
    figures["sigma_cover"] = float(np.mean(error < 2 * fused.sigma_m[fused.measured]))
    figures["measured"] = fused.coverage.measured_above_cut
    figures["accepted"] = float(fused.verdict == "accepted")
    figures["closed"] = float(to_trimesh(fused.mesh).is_watertight)
    figures["cpu_s"] = fused.cpu_s
    depths = _masked(views, fused)
    for rival, build in (("open3d", _open3d_tsdf), ("poisson", _poisson)):
        started = time.process_time()
        other = build(views, depths)
        figures[f"{rival}_cpu_s"] = time.process_time() - started
        scored = _score(truth, seen, other, other.vertices)
        figures |= {f"{rival}_{key}": value for key, value in scored.items()}
    return figures


def measured(arguments: argparse.Namespace) -> Found:
    """Return the figures over all objects (one from half as many views of 640x360 if quick)."""
    quick = arguments.quick
    objects = [o for o in OBJECTS if not quick or o[0] == QUICK]
    if not quick:
        # Compiled code is loaded before anything is timed.
        _one("cube", 0.08, (0, 0, 0), QUICK_LAB)
    rows: list[dict[str, float]] = []
    for name, extent, turn in objects:
        rows.append(_one(name, extent, turn, QUICK_LAB if quick else ScanLabConfig()))
        print(name.ljust(10), " ".join(f"{k} {v:.3g}" for k, v in rows[-1].items()), flush=True)
    table = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    out = {
        "tsdf_median_mm": np.median(table["median_mm"]),
        "tsdf_worst_mm": table["median_mm"].max(),
        "tsdf_p95_mm": np.median(table["p95_mm"]),
        "tsdf_aligned_mm": np.median(table["aligned_mm"]),
        "tsdf_within2mm": table["within2mm"].min(),
        "tsdf_complete_share": table["complete"].mean(),
        "tsdf_complete_least": table["complete"].min(),
        "tsdf_sigma_cover": table["sigma_cover"].mean(),
        "tsdf_closed_share": table["closed"].mean(),
        "tsdf_accepted_share": table["accepted"].mean(),
        "tsdf_cpu_s": np.median(table["cpu_s"]),
        "tsdf_peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    for rival in ("open3d", "poisson"):
        out |= {
            f"{rival}_tsdf_median_mm" if rival == "open3d" else "poisson_median_mm": np.median(
                table[f"{rival}_median_mm"]
            ),
            f"{rival}_worst_mm": table[f"{rival}_median_mm"].max(),
            f"{rival}_p95_mm": np.median(table[f"{rival}_p95_mm"]),
            f"{rival}_complete_share": table[f"{rival}_complete"].mean(),
            f"{rival}_cpu_s": np.median(table[f"{rival}_cpu_s"]),
        }
    return Found(figures={key: float(value) for key, value in out.items()})


if __name__ == "__main__":
    figure = Figure(unit="mm", goal=Goal(high=0.8))
    run("scale_fusion", __doc__, PACKAGES, {"tsdf_median_mm": figure}, {"tsdf": measured})
