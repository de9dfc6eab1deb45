"""Photographs in, metric cameras and points out: the steps of structure from motion in order.

What was mapped, measured and judged: errors of points and cameras, the verdict, notes.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Array32, Mask
from realsim.errors import DegenerateError, InputError
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm.bundle import point_covariances, reprojection_errors, robust_sigma
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.database import (
    Photographs,
    build_database,
    checked_photographs,
    match_pairs,
    pairs_to_match,
)
from realsim.scanning.sfm.judging import depth_scale, judge, shown
from realsim.scanning.sfm.mapping import geometry_of
from realsim.scanning.sfm.result import Geometry, Matching, Poses, Progress, SfmResult
from realsim.scanning.sfm.ways import LEAST_IN_VIEW, MODEL, Job, Mapped, map_at_poses, map_free


def reconstruct(
    images: Sequence[Path],
    intrinsics: CameraIntrinsics | None,
    config: SfmConfig,
    *,
    poses: Poses,
    Ts_world_cam: Sequence[Array | None] | None = None,
    masks: Mapping[str, Mask] | None = None,
    folder: Path,
    progress: Progress = lambda step, done, total: None,
) -> SfmResult:
    """Reconstruct cameras and sparse points; in metres where the robot's poses are known.

    Args:
        images: photographs of one camera, 3 or more.
        intrinsics: the camera; None: COLMAP finds focal length and one distortion term itself.
        config: everything that decides the result.
        poses: 'unknown': free mapping, then a similarity to the robot's poses, if there are any;
            'known': points at the robot's poses; 'refined': these poses with a bundle adjustment.
        Ts_world_cam: (4, 4) camera pose of each image by the robot [m], None where there is none.
        masks: {file name: (H, W) True where features may lie}.
        folder: keeps the database, so that a killed run goes on, and the model.
        progress: called with (step, done, total).

    Raises:
        InputError: too few images, unreadable ones, several sizes, or poses that are needed and
            missing.
        DegenerateError: no texture, no overlap, or no motion.
    """
    start = time.process_time()
    photographs = checked_photographs(images)
    robot = _robot_poses(photographs, Ts_world_cam, poses)
    job = Job(
        photographs=photographs, intrinsics=intrinsics, config=config, robot=robot,
        folder=folder, progress=progress,
    )  # fmt: skip
    _require_camera(job, poses)
    database = build_database(photographs, intrinsics, config, folder, masks, job.tick("features"))
    Ts = np.stack([robot[n] for n in photographs.names]) if poses != "unknown" else None
    pairs = pairs_to_match(len(photographs.names), Ts, config.features)
    matching = match_pairs(database, pairs, config, job.tick("matches"))
    _require_matches(matching, config)
    mapped = map_free(job, database) if Ts is None else map_at_poses(job, database, Ts, poses)
    geometry, dropped = placed(geometry_of(mapped.model, folder / MODEL))
    return outcome(job, poses, mapped, geometry, dropped, matching, time.process_time() - start)


def with_depth(
    result: SfmResult, depth_of: Callable[[str], Array32 | None], config: SfmConfig
) -> SfmResult:
    """Return the result with the depth images' scale beside the robot's, judged anew.

    Args:
        result: metric; one without a scale is returned as it is.
        depth_of: the depth image (H, W) [m] of a photograph by name, None where there is none.
        config: as of the reconstruction.
    """
    if not result.is_metric:
        return result
    checked = replace(result, depth=depth_scale(result.geometry, depth_of, config.trust))
    verdict, reasons = judge(checked, config)
    return replace(checked, verdict=verdict, reasons=reasons)


# --- what goes in -----------------------------------------------------------------------------


def _robot_poses(
    photographs: Photographs, Ts_world_cam: Sequence[Array | None] | None, poses: Poses
) -> dict[str, Array]:
    """Return the poses by name."""
    if Ts_world_cam is None:
        Ts_world_cam = [None] * len(photographs.names)
    if len(Ts_world_cam) != len(photographs.names):
        raise InputError(
            f"{len(photographs.names)} images and {len(Ts_world_cam)} camera poses were given; "
            "one pose for each image is expected, None where it is not known."
        )
    pairs = zip(photographs.names, Ts_world_cam, strict=True)
    found = {name: np.asarray(T, dtype=np.float64) for name, T in pairs if T is not None}
    missing = tuple(n for n in photographs.names if n not in found)
    if missing and poses != "unknown":
        raise InputError(
            f"{len(missing)} of {len(photographs.names)} images have no camera pose "
            f"({shown(missing)}), which poses='{poses}' needs for every one. Calibrate the "
            "session, leave these images out, or let the poses be 'unknown'."
        )
    return found


def _require_camera(job: Job, poses: Poses) -> None:
    """Raise if the camera is of another image size, or is needed and not known."""
    i, size = job.intrinsics, job.photographs.size
    if i is not None and (i.width, i.height) != size:
        raise InputError(
            f"the camera is one of {i.width}x{i.height} px, the photographs have "
            f"{size[0]}x{size[1]}. Give the intrinsics of this resolution."
        )
    if i is None and poses != "unknown":
        raise InputError(
            f"poses='{poses}' needs the camera's intrinsics; give them, or let the poses be "
            "'unknown': then COLMAP finds the focal length itself."
        )


def _require_matches(matching: Matching, config: SfmConfig) -> None:
    """Raise if no three views hang together by verified matches."""
    joined = [p for p in matching.pairs if p[3] >= config.features.min_inliers]
    if len({k for p in joined for k in p[:2]}) >= 3:
        return
    counts = sorted(zip(matching.features, matching.names, strict=True))
    least = ", ".join(f"{name} ({n})" for n, name in counts[:6])
    best = max((p[3] for p in matching.pairs), default=0)
    raise DegenerateError(
        f"the photographs share too few features: the best of {len(matching.pairs)} pairs has "
        f"{best} verified matches, {config.features.min_inliers} are the least. Fewest features: "
        f"{least}. Put newspaper or the tag board under the object, and take the views some 15 "
        "degrees apart."
    )


# --- what comes out ------------------------------------------------------------------------------


def placed(geometry: Geometry) -> tuple[Geometry, tuple[str, ...]]:
    """Return the geometry without the views that see hardly a point, and their names."""
    seen = np.bincount(geometry.cameras_of, minlength=len(geometry.names))
    keep = np.flatnonzero(seen >= LEAST_IN_VIEW)
    if len(keep) < 3:
        raise DegenerateError(
            f"{len(keep)} views see {LEAST_IN_VIEW} points or more; three are the least. The "
            "pictures share too little texture, or the given poses do not belong to them."
        )
    place = np.full(len(geometry.names), -1)
    place[keep] = np.arange(len(keep))
    use = place[geometry.cameras_of] >= 0
    dropped = tuple(n for k, n in enumerate(geometry.names) if place[k] < 0)
    return replace(
        geometry,
        names=tuple(geometry.names[k] for k in keep),
        Ts_world_cam=geometry.Ts_world_cam[keep],
        cameras_of=place[geometry.cameras_of[use]],
        points_of=geometry.points_of[use],
        uv_px=geometry.uv_px[use],
    ), dropped


def outcome(
    job: Job,
    poses: Poses,
    mapped: Mapped,
    geometry: Geometry,
    dropped: tuple[str, ...],
    matching: Matching,
    cpu_s: float,
) -> SfmResult:
    """Measure the reconstruction and judge it."""
    residuals = reprojection_errors(geometry)
    lengths = np.linalg.norm(residuals, axis=1)
    seen = np.bincount(geometry.points_of, minlength=len(geometry.points))
    covariances = point_covariances(geometry, robust_sigma(residuals))
    unit = 1e3 if mapped.is_metric else 1.0
    own = mapped.covariances
    result = SfmResult(
        poses=poses,
        geometry=geometry,
        is_metric=mapped.is_metric,
        unregistered=tuple(n for n in matching.names if n not in geometry.names),
        models=mapped.models,
        scale=mapped.scale,
        sigma_percent=mapped.sigma_percent,
        alignment=mapped.alignment,
        depth=None,
        reliability=mapped.reliability,
        camera_covariance=None if own is None else np.stack([own[n] for n in geometry.names]),
        point_sigma_mm=unit * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0)),
        track_lengths=seen.astype(np.int64),
        reprojection_px=float(np.nanmedian(lengths)),
        view_reprojection_px=np.array(
            [np.nanmedian(lengths[geometry.cameras_of == k]) for k in range(len(geometry.names))]
        ),
        matching=matching,
        verdict="unchecked",
        reasons=(),
        notes=_notes(job, mapped, matching, dropped),
        cpu_s=cpu_s,
    )
    verdict, reasons = judge(result, job.config)
    return replace(result, verdict=verdict, reasons=reasons)


def _notes(
    job: Job, mapped: Mapped, matching: Matching, dropped: tuple[str, ...]
) -> tuple[str, ...]:
    """Return what a user should know besides the verdict."""
    notes: list[str] = []
    f = job.config.features
    if job.intrinsics is None:
        notes.append(
            "the camera was not given: COLMAP found its focal length and one distortion term from "
            "the photographs, which a few views of a flat scene determine badly."
        )
    if matching.peak_threshold < f.peak_thresholds[0]:
        notes.append(
            f"little texture: SIFT's contrast threshold was lowered to {matching.peak_threshold:g} "
            f"(median {int(np.median(matching.features))} features in a view)."
        )
    if dropped:
        notes.append(f"seen by fewer than {LEAST_IN_VIEW} points: {shown(dropped)}.")
    if mapped.reliability < job.config.mapping.least_reliability:
        notes.append(
            "the cameras stay at the robot's poses: two halves of the scene would move them "
            f"differently (share of signal {mapped.reliability:.2f}, "
            f"{job.config.mapping.least_reliability:g} is needed)."
        )
    if mapped.bundle is not None and mapped.bundle.prior_factor > 1.5:
        notes.append(
            f"the robot's poses disagree {mapped.bundle.prior_factor:.1f} times as much as their "
            "noise model says; their weight was lowered."
        )
    return tuple(notes)
