"""Depth images at known poses become the mesh of the object on the table.

plane and object found -> poses made to agree -> distances fused -> surface closed -> judged

Rounds of fusing and aligning until the views agree; views that cannot are left out.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.mesh import vertex_normals
from realsim.records import CameraIntrinsics, Mesh, SupportPlane, Verdict
from realsim.registration.evidence import DepthNoise
from realsim.scanning.fusion import evidence
from realsim.scanning.fusion.patches import observed_object, observed_table, view_points
from realsim.scanning.fusion.refine import PoseState, refined_twists, start_state
from realsim.scanning.fusion.region import Region, find_region
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
from realsim.scanning.fusion.volume import Volume, fused_volume, least_views

COARSE_CELLS = 2.0
"""The surface that views are aligned to has voxels so much larger: an eighth of the time."""
TABLE_MARGIN_M = 0.06
"""The table is looked at this far around the object [m]."""
BELOW_CELLS = 3
"""Layers of the volume below the plane."""
LEAST_SUPPORT = 0.5
"""A view with less than this share of the usual support is not reconciled."""
LEAST_SHARED = 10
"""A view that shares fewer patches of the object with others is not judged by them."""
LEFT_OUT_PER_ROUND = 0.25
"""At most this share of the views is judged at once: one wrong view makes others look wrong."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Alignment:
    """The views that agree and where their cameras are."""

    frames: tuple[FusionFrame, ...]
    """The views that are used, in the order of their numbers."""
    Ts_world_cam: Array
    """(F, 4, 4) their refined poses."""
    plane: SupportPlane
    """The refined table."""
    corrections: tuple[ViewCorrection, ...]
    """Corrections of all views, left-out ones included."""
    left_out: tuple[tuple[int, str], ...]
    """Views that were left out, and why."""
    coarse: Volume
    """The last coarse surface, in the refined table's frame but for its last small step."""
    surface_sigma_m: float
    """1-sigma by which pose errors that are left move the surface [m]."""
    figures: dict[str, Any]
    """For the report."""


def volume_box(region: Region, config: FusionConfig) -> tuple[Array, Array]:
    """Return the least and greatest corner (3,) of the volume in the table's frame [m]."""
    low, high = region.low - config.margin_m, region.high + config.margin_m
    low[2] = -BELOW_CELLS * COARSE_CELLS * config.voxel_m
    return low, high


def cut_height(region: Region, config: FusionConfig) -> float:
    """Return the height below which nothing is measured as the object [m]."""
    return float(min(config.cut_m, 0.25 * region.high[2]))


def aligned(
    intrinsics: CameraIntrinsics,
    frames: Sequence[FusionFrame],
    region: Region,
    noise: DepthNoise,
    config: FusionConfig,
) -> Alignment:
    """Return the views' poses, refined in rounds if the configuration says so.

    Raises:
        DegenerateError: fewer than three views agree.
    """
    left_out: list[tuple[int, str]] = []
    lost: list[ViewCorrection] = []
    used = list(frames)
    while True:
        result, wrong = _rounds(intrinsics, used, region, noise, config)
        if not wrong:
            break
        for number, why, correction in wrong:
            left_out.append((used[number].index, why))
            lost.append(correction)
        numbers = {w[0] for w in wrong}
        used = [f for i, f in enumerate(used) if i not in numbers]
        if len(used) < evidence.LEAST_FRAMES:
            raise DegenerateError(
                f"only {len(used)} of {len(frames)} views agree with each other (left out: "
                f"{', '.join(str(i) for i, _ in left_out)}). Did the object move between the "
                "views, or do the poses belong to other images?"
            )
    corrections = sorted([*result.corrections, *lost], key=lambda c: c.index)
    return replace(result, corrections=tuple(corrections), left_out=tuple(sorted(left_out)))


def _rounds(
    intrinsics: CameraIntrinsics,
    frames: Sequence[FusionFrame],
    region: Region,
    noise: DepthNoise,
    config: FusionConfig,
) -> tuple[Alignment, list[tuple[int, str, ViewCorrection]]]:
    """Run the rounds with these views; also return the views that do not agree."""
    low, high = volume_box(region, config)
    wide = np.array([TABLE_MARGIN_M, TABLE_MARGIN_M, 0.0])
    T_world_table = region.plane.T_world_table
    given = np.stack([f.T_world_cam for f in frames])
    crops = evidence.cropped(
        intrinsics, frames, (T_world_table, low - wide, high + wide), noise, config
    )
    cell = COARSE_CELLS * config.voxel_m
    heights = (cut_height(region, config) + cell, config.plane_tolerance_m)
    Ts_table_cam = se3.invert(T_world_table) @ given
    points = view_points(intrinsics, crops, Ts_table_cam, (low, high), heights)
    state = start_state(len(frames))
    volume: Volume | None = None
    history: list[dict[str, Any]] = []
    matched = np.ones(len(frames))
    for _ in range(config.rounds if config.refine else 1):
        current = given @ se3.exp(state.twists)
        Ts_table_cam = se3.invert(T_world_table) @ current
        volume = fused_volume(crops, se3.invert(Ts_table_cam), (low, high, cell), volume, config)
        seen, matched = observed_object(points, Ts_table_cam, volume, config)
        if config.refine:
            table = observed_table(points, Ts_table_cam)
            state = refined_twists(seen, table, state, config)
            T_world_table = T_world_table @ _tilted(state.plane)
            history.append(state.figures)
    assert volume is not None
    current = given @ se3.exp(state.twists)
    corrections = _corrections(frames, current, state)
    result = Alignment(
        frames=tuple(frames), Ts_world_cam=current,
        plane=replace(region.plane, T_world_table=T_world_table),
        corrections=corrections, left_out=(), coarse=volume,
        surface_sigma_m=state.surface_sigma_m,
        figures={
            "rounds": history,
            "common_shift_mm": float(1e3 * np.linalg.norm(state.common[3:])),
            "common_turn_deg": float(np.degrees(np.linalg.norm(state.common[:3]))),
        },
    )  # fmt: skip
    wrong = _wrong(state, matched, corrections, config) if config.refine else []
    return result, wrong


def _tilted(plane: Array) -> Array:
    """Return the transform (4, 4) from the new table to the old one: z = a + b x + c y."""
    a, b, c = plane
    return se3.from_rt(se3.exp_so3([c, -b, 0.0]), [0.0, 0.0, a])


def _corrections(
    frames: Sequence[FusionFrame], current: Array, state: PoseState
) -> tuple[ViewCorrection, ...]:
    """Return what was done to every view."""
    own = state.twists - state.common
    return tuple(
        ViewCorrection(
            index=f.index,
            T_world_cam=current[i],
            shift_mm=float(1e3 * np.linalg.norm(state.twists[i, 3:])),
            turn_deg=float(np.degrees(np.linalg.norm(state.twists[i, :3]))),
            own_shift_mm=float(1e3 * np.linalg.norm(own[i, 3:])),
            own_turn_deg=float(np.degrees(np.linalg.norm(own[i, :3]))),
            rms_mm=float(1e3 * state.rms_m[i]),
        )
        for i, f in enumerate(frames)
    )


def _wrong(
    state: PoseState, matched: Array, corrections: tuple[ViewCorrection, ...], config: FusionConfig
) -> list[tuple[int, str, ViewCorrection]]:
    """Return the views that the others speak against, the worst first, not too many at once."""
    sigma = np.repeat([config.arm_sigma[1], config.arm_sigma[0]], 3)
    own = np.abs(state.twists - state.common) / sigma
    size = np.sqrt(np.mean(np.square(own), axis=1)) / config.outlier_factor
    known = state.shared >= LEAST_SHARED
    # Views whose patches are as near as their noise allows are not judged against each other.
    usual_misfit = max(1.0, float(np.median(state.misfit[known]))) if known.any() else 1.0
    misfit = np.where(known, state.misfit / (config.outlier_factor * usual_misfit), 0.0)
    agreeing = np.where(known, matched * state.support, matched)
    usual = float(np.nanmedian(agreeing)) if np.isfinite(agreeing).any() else 0.0
    support = LEAST_SUPPORT * usual / np.maximum(agreeing, 1e-3)
    scores = np.nan_to_num(np.stack([size, misfit, support]), nan=0.0)
    worst = np.max(scores, axis=0)
    many = max(1, int(LEFT_OUT_PER_ROUND * len(worst)))
    wrong: list[tuple[int, str, ViewCorrection]] = []
    for i in np.argsort(-worst, kind="stable")[:many]:
        # Where one view is far worse than the next, only that one is judged in this pass.
        if worst[i] <= 1.0 or worst[i] < 0.5 * worst.max():
            break
        c = corrections[i]
        why = (
            f"it would have to move by {c.own_shift_mm:.1f} mm and {c.own_turn_deg:.2f} deg",
            f"its points are {c.rms_mm:.2f} mm from the others' surface",
            f"only {100 * agreeing[i]:.0f} % of its points lie on the others' surface "
            f"(usual: {100 * usual:.0f} %)",
        )[int(np.argmax(scores[:, i]))]
        wrong.append((int(i), why, replace(c, used=False)))
    return wrong


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
    usable, notes = evidence.checked_frames(frames, intrinsics)
    noise = evidence.measured_noise(usable, config)
    config = evidence.fitted_to_noise(usable, noise, config)
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
    crops = evidence.cropped(intrinsics, moved, (T_world_table, low, high), noise, config)
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
    crops: evidence.Crops,
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


def _report(
    surface: Surface, crops: evidence.Crops, alignment: Alignment, sigma: Array
) -> dict[str, Any]:
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
