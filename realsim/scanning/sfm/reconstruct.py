"""Photographs in, metric cameras and points out: the steps of structure from motion in order."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError, InputError
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm.alignment import align_to_robot
from realsim.scanning.sfm.bundle import (
    Bundle,
    adjust,
    point_covariances,
    reprojection_errors,
    robust_sigma,
)
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.database import MatchDatabase, build_database, match_pairs
from realsim.scanning.sfm.depth_scale import depth_scale
from realsim.scanning.sfm.judging import judge, shown
from realsim.scanning.sfm.mapping import (
    geometry_of,
    map_freely,
    model_at_poses,
    scaled,
    set_geometry,
    triangulated,
)
from realsim.scanning.sfm.pairs import pairs_to_match
from realsim.scanning.sfm.photographs import Photographs, checked_photographs
from realsim.scanning.sfm.result import (
    Alignment,
    Geometry,
    Matching,
    Poses,
    Progress,
    SfmResult,
)

Array = NDArray[np.float64]
MODEL = "model"
"""Folder of the COLMAP model, in metres where the scale is known."""
WORK = ".work"
"""Folder that COLMAP writes into while it runs."""
LEAST_IN_VIEW = 10
"""Points that a view must see to count as placed."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Mapped:
    """A reconstruction in the robot's world, or in its own."""

    model: Any
    models: tuple[int, ...]
    scale: float
    sigma_percent: float
    alignment: Alignment | None
    bundle: Bundle | None
    is_metric: bool


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Job:
    """What every step needs."""

    photographs: Photographs
    intrinsics: CameraIntrinsics | None
    config: SfmConfig
    robot: dict[str, Array]
    """Camera poses by the robot, of the images that have one."""
    folder: Path
    progress: Progress

    def tick(self, step: str) -> Callable[[int, int], None]:
        """Return the progress of one step."""
        return lambda done, total: self.progress(step, done, total)


def reconstruct(
    images: Sequence[Path],
    intrinsics: CameraIntrinsics | None,
    config: SfmConfig,
    *,
    poses: Poses,
    Ts_world_cam: Sequence[Array | None] | None = None,
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
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
    job = _Job(
        photographs=photographs, intrinsics=intrinsics, config=config, robot=robot,
        folder=folder, progress=progress,
    )  # fmt: skip
    _require_camera(job, poses)
    database = build_database(photographs, intrinsics, config, folder, masks, job.tick("features"))
    Ts = np.stack([robot[n] for n in photographs.names]) if poses != "unknown" else None
    pairs = pairs_to_match(len(photographs.names), Ts, config.features)
    matching = match_pairs(database, pairs, config, job.tick("matches"))
    _require_matches(matching, config)
    mapped = _freely(job, database) if Ts is None else _at_poses(job, database, Ts, poses)
    geometry, dropped = _placed(geometry_of(mapped.model, folder / MODEL))
    return _result(job, poses, mapped, geometry, dropped, matching, time.process_time() - start)


def with_depth(
    result: SfmResult,
    depth_of: Callable[[str], NDArray[np.float32] | None],
    config: SfmConfig,
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


def _require_camera(job: _Job, poses: Poses) -> None:
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


# --- three ways to cameras and points ---------------------------------------------------------


def _freely(job: _Job, database: MatchDatabase) -> _Mapped:
    """Map without poses, then bring the model to the robot's world."""
    models = map_freely(
        database, job.config, refine_camera=job.intrinsics is None, folder=job.folder / WORK,
        tick=job.tick("mapping"),
    )  # fmt: skip
    model, sizes = models[0], tuple(int(m.num_reg_images()) for m in models)
    found = geometry_of(model, job.folder / MODEL)
    posed = [k for k, n in enumerate(found.names) if n in job.robot]
    if not job.robot:
        return _Mapped(
            model=model, models=sizes, scale=float("nan"), sigma_percent=float("nan"),
            alignment=None, bundle=None, is_metric=False,
        )  # fmt: skip
    names = tuple(found.names[k] for k in posed)
    alignment = align_to_robot(
        names, found.Ts_world_cam[posed], np.array([job.robot[n] for n in names]).reshape(-1, 4, 4),
        job.config.alignment, np.random.default_rng(job.config.seed),
    )  # fmt: skip
    scaled(model, alignment.scale, alignment.R, alignment.t)
    return _Mapped(
        model=model, models=sizes, scale=alignment.scale, sigma_percent=alignment.sigma_percent,
        alignment=alignment, bundle=None, is_metric=True,
    )  # fmt: skip


def _at_poses(job: _Job, database: MatchDatabase, Ts: Array, poses: Poses) -> _Mapped:
    """Triangulate at the robot's poses; where asked for, refine both."""
    m, work, tick = job.config.mapping, job.folder / WORK, job.tick("mapping")
    rounds = m.refine_rounds if poses == "refined" else 1
    model, bundle = model_at_poses(database, Ts), None
    names = np.array(database.photographs.names)
    for k in range(rounds):
        limit = m.known_error_px if k == 0 else m.reprojection_px
        model = triangulated(model, database, job.config, limit, work)
        if len(model.points3D) < LEAST_IN_VIEW:
            raise DegenerateError(
                f"only {len(model.points3D)} points fit the robot's camera poses within {limit:g} "
                "px: the poses do not belong to these pictures (other order, other frame, wrong "
                "hand-eye, millimetres), or the views share nothing. Run it with the poses "
                "unknown: the residuals then say which views disagree."
            )
        tick(2 * k + 1, 2 * rounds)
        if poses == "refined":
            found = geometry_of(model, job.folder / MODEL)
            order = [int(np.flatnonzero(names == n)[0]) for n in found.names]
            bundle = adjust(found, Ts[order], job.config.alignment.noise, m)
            set_geometry(model, bundle.geometry)
        tick(2 * k + 2, 2 * rounds)
    _drop_far(model, m.reprojection_px if bundle else m.known_error_px, m.min_angle_deg)
    return _judged_against_robot(job, model, Ts, bundle)


def _judged_against_robot(job: _Job, model: Any, Ts: Array, bundle: Bundle | None) -> _Mapped:
    """Return the model with the scale's sigma, and each camera's distance from the robot's pose."""
    found = geometry_of(model, job.folder / MODEL)
    robot = np.stack([job.robot[n] for n in found.names])
    alignment = align_to_robot(
        found.names, found.Ts_world_cam, robot, job.config.alignment,
        np.random.default_rng(job.config.seed),
    )  # fmt: skip
    sigma = alignment.sigma_percent
    if bundle is not None:
        arm = job.config.alignment.noise.arm_scale_percent
        sigma = float(np.hypot(100 * scale_sigma(bundle), arm))
    return _Mapped(
        model=model, models=(len(Ts),), scale=1.0, sigma_percent=sigma,
        alignment=None if bundle is None else alignment, bundle=bundle, is_metric=True,
    )  # fmt: skip


def scale_sigma(bundle: Bundle) -> float:
    """Return the 1-sigma of the scale (a ratio) that the cameras' covariance amounts to.

    A small growth is d log s = sum_i (c_i - m) . dc_i / sum_i |c_i - m|^2 of the centres c_i about
    their mean m, with dc_i = R_i v_i of the right perturbation.
    """
    T = bundle.geometry.Ts_world_cam
    away = T[:, :3, 3] - T[:, :3, 3].mean(0)
    row = np.zeros(len(bundle.covariance))
    along = np.einsum("vij,vi->vj", T[:, :3, :3], away) / np.square(away).sum()
    for i, v in enumerate(along):
        row[6 * i + 3 : 6 * i + 6] = v
    return float(np.sqrt(row @ bundle.covariance @ row))


def _drop_far(model: Any, error_px: float, angle_deg: float) -> None:
    """Delete observations far from their point's projection and points without depth."""
    import pycolmap

    manager: Any = pycolmap.ObservationManager(model)
    manager.filter_all_points3D(error_px, angle_deg)


# --- what comes out ---------------------------------------------------------------------------


def _placed(geometry: Geometry) -> tuple[Geometry, tuple[str, ...]]:
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


def _result(
    job: _Job,
    poses: Poses,
    mapped: _Mapped,
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
        camera_covariance=_camera_covariance(mapped.bundle, geometry),
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


def _camera_covariance(bundle: Bundle | None, geometry: Geometry) -> Array | None:
    """Return the cameras' own blocks (V, 6, 6) of the refinement's covariance."""
    if bundle is None:
        return None
    place = {n: k for k, n in enumerate(bundle.geometry.names)}
    rows = [6 * place[n] for n in geometry.names]
    return np.stack([bundle.covariance[r : r + 6, r : r + 6] for r in rows])


def _notes(
    job: _Job, mapped: _Mapped, matching: Matching, dropped: tuple[str, ...]
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
    if mapped.bundle is not None and mapped.bundle.prior_factor > 1.5:
        notes.append(
            f"the robot's poses disagree {mapped.bundle.prior_factor:.1f} times as much as their "
            "noise model says; their weight was lowered."
        )
    return tuple(notes)
