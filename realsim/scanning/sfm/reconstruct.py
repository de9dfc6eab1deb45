"""Photographs in, metric cameras and points out: the steps of structure from motion in order."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError, InputError
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.database import build_database, match_pairs
from realsim.scanning.sfm.depth_scale import depth_scale
from realsim.scanning.sfm.judging import judge, shown
from realsim.scanning.sfm.mapping import geometry_of
from realsim.scanning.sfm.outcome import outcome, placed
from realsim.scanning.sfm.pairs import pairs_to_match
from realsim.scanning.sfm.photographs import Photographs, checked_photographs
from realsim.scanning.sfm.result import Matching, Poses, Progress, SfmResult
from realsim.scanning.sfm.ways import MODEL, Job, map_at_poses, map_free

Array = NDArray[np.float64]


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
