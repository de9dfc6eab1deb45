"""Depth images at known poses become the mesh of the object on the table.

plane and object found -> poses made to agree -> distances fused -> surface closed -> judged
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.geometry.mesh import vertex_normals
from realsim.records import CameraIntrinsics, Mesh, Verdict
from realsim.scanning.fusion.align import Alignment, aligned, cut_height, volume_box
from realsim.scanning.fusion.evidence import (
    Crops,
    checked_frames,
    cropped,
    fitted_to_noise,
    measured_noise,
)
from realsim.scanning.fusion.region import find_region
from realsim.scanning.fusion.result import (
    Coverage,
    FusedObject,
    FusionConfig,
    FusionFrame,
    ViewCorrection,
)
from realsim.scanning.fusion.surface import (
    Surface,
    VertexEvidence,
    closed_surface,
    patch_widths,
    vertex_evidence,
)
from realsim.scanning.fusion.volume import fused_volume, least_views

__all__ = [
    "Coverage",
    "FusedObject",
    "FusionConfig",
    "FusionFrame",
    "ViewCorrection",
    "fuse_object",
]

HOPELESS_SHARE = 0.4
"""With less than this of the surface above the cut measured the mesh is rejected."""
FACING_DOWN = -0.2
"""z of a normal below which a surface faces down: cameras above a table see it edge-on at best."""
LEFT_OUT_SHARE = 0.25
"""With more views than this left out something else is wrong than a view."""


def fuse_object(
    intrinsics: CameraIntrinsics, frames: Sequence[FusionFrame], config: FusionConfig
) -> FusedObject:
    """Return the mesh of the one object on the table, in world, with what it is worth.

    Args:
        intrinsics: of the depth camera.
        frames: at least three; their order does not matter.
        config: settings.

    Raises:
        InputError: frames that cannot be used, nothing or several things on the table.
        UnitError: depth that cannot be in metres.
        DegenerateError: no table, or views that do not agree.
    """
    started = time.process_time()
    usable, notes = checked_frames(frames, intrinsics)
    noise = measured_noise(usable, config)
    config = fitted_to_noise(usable, noise, config)
    region = find_region(intrinsics, usable, noise, config)
    alignment = aligned(intrinsics, usable, region, noise, config)
    low, high = volume_box(region, config)
    cell = _voxel(low, high, config)
    if cell > config.voxel_m:
        notes.append(
            f"the object is large: voxels of {1e3 * cell:.2f} mm instead of "
            f"{1e3 * config.voxel_m:.2f} mm keep the memory in bounds."
        )
    T_world_table = alignment.plane.T_world_table
    moved = [
        replace(f, T_world_cam=T)
        for f, T in zip(alignment.frames, alignment.Ts_world_cam, strict=True)
    ]
    crops = cropped(intrinsics, moved, (T_world_table, low, high), noise, config)
    Ts_cam_table = se3.invert(alignment.Ts_world_cam) @ T_world_table
    volume = fused_volume(crops, Ts_cam_table, (low, high, cell), alignment.coarse, config)
    surface = closed_surface(volume, cut_height(region, config), config)
    return _judged(surface, crops, Ts_cam_table, alignment, (region.notes, notes, started), config)


def _voxel(low: Array, high: Array, config: FusionConfig) -> float:
    """Return the edge of a voxel [m]: as configured, or what the memory allows."""
    volume = float(np.prod(high - low))
    return max(config.voxel_m, float(np.cbrt(volume / config.memory_voxels)))


def _judged(
    surface: Surface,
    crops: Crops,
    Ts_cam_table: Array,
    alignment: Alignment,
    so_far: tuple[tuple[str, ...], list[str], float],
    config: FusionConfig,
) -> FusedObject:
    """Return the result: support and sigma per vertex, coverage, verdict."""
    local = Mesh(vertices=surface.vertices, faces=surface.faces)
    normals = vertex_normals(local)
    seen = vertex_evidence(surface.vertices, normals, crops, Ts_cam_table, alignment.frames, config)
    needed = least_views(config, len(alignment.frames))
    measured = surface.known & (seen.views >= needed)
    sigma = _sigma(seen, alignment.surface_sigma_m, measured)
    coverage = _coverage(surface, normals[:, 2] < FACING_DOWN, measured)
    verdict, reasons = _verdict(coverage, alignment, config)
    mesh = Mesh(
        vertices=se3.transform(alignment.plane.T_world_table, surface.vertices),
        faces=surface.faces,
        colors=seen.colors,
    )
    notes = [*so_far[1], *so_far[0]]
    notes += [f"view {i} was left out: {why}." for i, why in alignment.left_out]
    if coverage.closed > 0.005:
        notes.append(
            f"{100 * coverage.closed:.1f} % of the surface was seen by no camera and closed; the "
            f"largest such patch is {coverage.largest_hole_mm:.0f} mm."
        )
    if coverage.overhang > 0.02:
        notes.append(
            f"{100 * coverage.overhang:.0f} % of the surface hangs over and is seen by no camera "
            "above the table; it is filled as far down as the views allow. A second scan with the "
            "object turned over would show it."
        )
    notes.append(
        f"the underside ({100 * coverage.underside:.0f} % of the surface) was on the table: it is "
        "invented, flat on the plane."
    )
    return FusedObject(
        mesh=mesh, plane=alignment.plane, measured=measured,
        support=np.where(measured, seen.views, 0).astype(np.int32), sigma_m=sigma,
        coverage=coverage, corrections=alignment.corrections, verdict=verdict, reasons=reasons,
        report=_report(surface, crops, alignment, sigma), notes=tuple(notes),
        cpu_s=time.process_time() - so_far[2],
    )  # fmt: skip


def _sigma(seen: VertexEvidence, pose_sigma_m: float, measured: Mask) -> Array:
    """Return the 1-sigma (V,) of the measured vertices along their normals [m].

    The noise of the mean, as the depth model says or as the views' spread says, whichever is
    larger, and what the pose errors that are left move the surface by, which is common to
    neighbouring vertices.
    """
    by_spread = seen.spread_m / np.sqrt(np.maximum(seen.views - 1, 1))
    noise = np.maximum(seen.noise_sigma_m, by_spread)
    pose = pose_sigma_m if np.isfinite(pose_sigma_m) else 0.0
    return np.where(measured, np.hypot(noise, pose), np.nan)


def _coverage(surface: Surface, down: Mask, measured: Mask) -> Coverage:
    """Return the shares of the area that were measured and invented."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total = float(area.sum())

    def share(vertices: Mask) -> float:
        return float(area @ vertices[surface.faces].mean(axis=1) / total)

    invented = ~measured & ~surface.below_cut
    closed, overhang = share(invented & ~down), share(invented & down)
    holes = patch_widths(surface, invented & ~down)
    known = share(measured)
    return Coverage(
        measured=known,
        measured_above_cut=known / (known + closed) if known > 0 else 0.0,
        underside=share(surface.below_cut),
        closed=closed,
        overhang=overhang,
        largest_hole_mm=float(1e3 * np.max(holes, initial=0.0)),
    )


def _verdict(
    coverage: Coverage, alignment: Alignment, config: FusionConfig
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict and why it is not 'accepted'."""
    reasons: list[str] = []
    share = coverage.measured_above_cut
    if share < config.least_measured_share:
        reasons.append(
            f"only {100 * share:.0f} % of the surface above the table was measured (at least "
            f"{100 * config.least_measured_share:.0f} % is wanted): transparent, glossy, or not "
            "seen from all sides."
        )
    if coverage.largest_hole_mm > 1e3 * config.largest_hole_m:
        reasons.append(
            f"a patch {coverage.largest_hole_mm:.0f} mm wide was seen by no camera and is "
            f"invented; up to {1e3 * config.largest_hole_m:.0f} mm is accepted."
        )
    views = len(alignment.frames) + len(alignment.left_out)
    if len(alignment.left_out) > LEFT_OUT_SHARE * views:
        reasons.append(
            f"{len(alignment.left_out)} of {views} views do not agree with the others: do the "
            "poses belong to the images, and did the object stand still?"
        )
    if share < HOPELESS_SHARE:
        return "rejected", tuple(reasons)
    return ("doubtful" if reasons else "accepted"), tuple(reasons)


def _report(surface: Surface, crops: Crops, alignment: Alignment, sigma: Array) -> dict[str, Any]:
    """Return the figures of all steps as plain JSON values."""
    shifts = [c.shift_mm for c in alignment.corrections if c.used]
    turns = [c.turn_deg for c in alignment.corrections if c.used]
    known = sigma[np.isfinite(sigma)]
    return {
        "views": len(alignment.frames),
        "left_out": [{"view": i, "why": why} for i, why in alignment.left_out],
        "noise_per_m": float(crops.noise[0]),
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "specks_removed": surface.specks,
        "cavities_filled": surface.cavities,
        "shift_median_mm": float(np.median(shifts)),
        "turn_median_deg": float(np.median(turns)),
        "pose_sigma_mm": 1e3 * alignment.surface_sigma_m
        if np.isfinite(alignment.surface_sigma_m)
        else None,
        "sigma_median_mm": float(1e3 * np.median(known)) if len(known) else None,
        "refinement": alignment.figures,
    }
