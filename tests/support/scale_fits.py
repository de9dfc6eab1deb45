"""Scale fits with known truth: depth views of a part, and what a right fit of them would say.

Nothing is fitted here. Scale and pose are the lab's truth (or off by a wanted factor); residuals
and agreement are computed from the very depth images that a fit would see.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.depth import points_from_depth
from realsim.geometry.mesh import vertex_normals
from realsim.geometry.parts import object_model
from realsim.records import Mesh, SupportPlane
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.rays import PlacedMesh, RayScene, rotated
from realsim.scanning.scale.result import Limit, ScaleFit, Similarity, ViewAgreement
from realsim.scanning.simulated import ScanLabConfig, ScanViews, scan_views, standing

UNIT_M = 3.0
"""Metres per unit of the scans made here: a mug of 0.03 units."""
# A quarter of the pixels with a quarter of the disparity's noise: the depth is as good as a D405's.
SENSOR = DepthSensorModel(disparity_noise_px=0.02, correlation_px=0.5, quantum_px=1 / 128)
SMALL = ScanLabConfig(views=6, width=320, height=180, focal_px=162.0, sensor=SENSOR)


@dataclass(frozen=True)
class KnownScan:
    """A scan without scale, the views of the real thing, and where it is."""

    real: Mesh
    """At its size [m]."""
    scan: Mesh
    """The same, turned and without scale."""
    views: ScanViews
    scale: float
    T_world_scan: Any
    """(4, 4) where the scaled scan stands."""


def known_scan(name: str = "mug", seed: int = 0, config: ScanLabConfig = SMALL) -> KnownScan:
    """Return a scan of an object that stands on a table, and views of it."""
    rng = np.random.default_rng(seed)
    real = object_model(name).mesh
    T_world_obj = standing(real, np.eye(3), rng)
    views = scan_views(real, T_world_obj, config, rng)
    T_scan_obj = se3.from_rt(se3.random_rotation(rng), rng.uniform(-0.05, 0.05, 3))
    scan = replace(real, vertices=se3.transform(T_scan_obj, real.vertices) / UNIT_M)
    return KnownScan(real, scan, views, UNIT_M, T_world_obj @ se3.invert(T_scan_obj))


def fit_of(known: KnownScan, factor: float = 1.0, **changes: Any) -> ScaleFit:
    """Return the fit that has the scale `factor` times the true one, honestly judged."""
    scale = known.scale * factor
    T = known.T_world_scan @ se3.from_translation((known.scale - scale) * known.scan.bounds.mean(0))
    vertices = se3.transform(T, scale * known.scan.vertices)
    residual = residuals_mm(known.views, vertices, vertex_normals(known.scan) @ T[:3, :3].T)
    views = agreements(known, scale, T)
    good = float(np.mean([v.agree for v in views])) > 0.8
    covariance = np.diag([1e-3, 1e-3, 1e-3, 2e-4, 2e-4, 2e-4, 2e-3]) ** 2
    covariance[3:6, 6] = covariance[6, 3:6] = [1e-7, -1e-7, 1.5e-7]
    fit = ScaleFit(
        scale=scale, sigma=2e-3 * scale, T_world_obj=T, covariance=covariance,
        verdict="accepted" if good else "doubtful",
        reasons=() if good else ("less than 80 % of the depth agrees with the model.",),
        checks={"agree": float(np.mean([v.agree for v in views])), "noise": float("nan")},
        limits=(
            Limit(name="hand-eye", percent=0.16, text="a hand-eye off by 0.5 mm moves it so far."),
            Limit(name="shape", percent=0.08, text="the mesh differs from the surface by 0.2 mm."),
        ),
        views=views, residual_mm=residual,
        plane=SupportPlane(T_world_table=np.eye(4), rms_m=4e-4, inliers=5000),
        extent_mm=1e3 * scale * known.scan.extent,
        candidates=tuple(
            Similarity(
                scale=scale * f, T_world_obj=T, score=0.9 - 1.5 * abs(np.log(f)), source=f"yaw {k}"
            )
            for k, f in enumerate((1.0, 1.01, 0.82, 1.3, 0.55))
        ),
        history=({"step": "fine", "rms_mm": 0.4},), cpu_s=1.25,
    )  # fmt: skip
    return replace(fit, **changes)


def residuals_mm(views: ScanViews, vertices: Any, normals: Any) -> Any:
    """Return how far outside the model the measured points lie at every vertex [mm]."""
    from scipy.spatial import cKDTree

    clouds = [
        se3.transform(f.T_world_cam, points_from_depth(f.depth_m, views.intrinsics, 2)[0])
        for f in views.frames
    ]
    points = np.concatenate(clouds)
    points = points[points[:, 2] > 0.002]
    near = cKDTree(points).query_ball_point(vertices, 0.006)
    out = np.full(len(vertices), np.nan)
    for k, found in enumerate(near):
        offsets = points[found] - vertices[k]
        beside = np.linalg.norm(np.cross(offsets, normals[k]), axis=-1) < 0.004
        if beside.sum() >= 3:
            out[k] = 1e3 * np.median(offsets[beside] @ normals[k])
    return out


def agreements(known: KnownScan, scale: float, T: Any) -> tuple[ViewAgreement, ...]:
    """Return how every view agrees with the scan at this scale and pose."""
    scaled = Mesh(vertices=scale * known.scan.vertices, faces=known.scan.faces)
    scene = RayScene([PlacedMesh(0, scaled, T)])
    rays = ray_table(known.views.intrinsics)
    out: list[ViewAgreement] = []
    for frame, T_true in zip(known.views.frames, known.views.Ts_world_cam, strict=True):
        directions = rotated(rays, frame.T_world_cam[:3, :3]).reshape(-1, 3)
        t, _ = scene.first_hits(frame.T_world_cam[:3, 3], directions)
        rendered = t.reshape(frame.depth_m.shape)
        points = frame.T_world_cam[:3, 3] + directions * frame.depth_m.reshape(-1, 1)
        measured = (frame.depth_m > 0) & (points[:, 2].reshape(frame.depth_m.shape) > 0.004)
        both = np.isfinite(rendered) & (frame.depth_m > 0)
        miss = frame.depth_m[both] - rendered[both]
        overlap = np.sum(measured & np.isfinite(rendered))
        motion = se3.invert(T_true) @ frame.T_world_cam
        out.append(
            ViewAgreement(
                index=frame.index, points=int(measured.sum()),
                agree=float(np.mean(np.abs(miss) < 0.003)),
                iou=float(overlap / np.sum(measured | np.isfinite(rendered))),
                rms_mm=float(1e3 * np.sqrt(np.mean(np.clip(miss, -0.005, 0.005) ** 2))),
                shift_mm=float(1e3 * np.linalg.norm(motion[:3, 3])),
                turn_deg=float(np.degrees(se3.angle(motion[:3, :3]))),
                used=frame.index != 4,
            )
        )  # fmt: skip
    return tuple(out)
