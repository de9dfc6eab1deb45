"""Rounds of fusing and aligning until the views agree; views that cannot are left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.scanning.fusion.evidence import LEAST_FRAMES, cropped
from realsim.scanning.fusion.patches import observed_object, observed_table, view_points
from realsim.scanning.fusion.refine import PoseState, refined_twists, start_state
from realsim.scanning.fusion.region import Region
from realsim.scanning.fusion.result import FusionConfig, FusionFrame, ViewCorrection
from realsim.scanning.fusion.volume import Volume, fused_volume

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
        if len(used) < LEAST_FRAMES:
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
    crops = cropped(intrinsics, frames, (T_world_table, low - wide, high + wide), noise, config)
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
