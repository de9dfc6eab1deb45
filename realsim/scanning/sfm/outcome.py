"""What was mapped, measured and judged: errors of points and cameras, the verdict, notes."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.scanning.sfm.bundle import (
    point_covariances,
    reprojection_errors,
    robust_sigma,
)
from realsim.scanning.sfm.judging import judge, shown
from realsim.scanning.sfm.result import Geometry, Matching, Poses, SfmResult
from realsim.scanning.sfm.ways import LEAST_IN_VIEW, Job, Mapped

Array = NDArray[np.float64]


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
    count = len(geometry.points)
    seen = np.bincount(geometry.points_of, minlength=count)
    squares = np.bincount(geometry.points_of, np.nan_to_num(lengths) ** 2, minlength=count)
    covariances = point_covariances(geometry, robust_sigma(residuals))
    unit = 1e3 if mapped.is_metric else 1.0
    missing = set(matching.names) - set(geometry.names)
    result = SfmResult(
        poses=poses,
        geometry=geometry,
        is_metric=mapped.is_metric,
        unregistered=tuple(n for n in matching.names if n in missing),
        models=mapped.models,
        scale=mapped.scale,
        sigma_percent=mapped.sigma_percent,
        alignment=mapped.alignment,
        depth=None,
        reliability=mapped.reliability,
        camera_covariance=_camera_covariance(mapped, geometry),
        point_error_px=np.sqrt(squares / np.maximum(seen, 1)),
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


def _camera_covariance(mapped: Mapped, geometry: Geometry) -> Array | None:
    """Return the cameras' own blocks (V, 6, 6) of the covariance."""
    own = mapped.covariances
    return None if own is None else np.stack([own[n] for n in geometry.names])


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
