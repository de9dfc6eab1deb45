"""Two ways from matches to metric cameras and points: free mapping, and mapping at given poses."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm.alignment import align_to_robot
from realsim.scanning.sfm.bundle import Bundle, adjust
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.database import MatchDatabase
from realsim.scanning.sfm.mapping import (
    geometry_of,
    map_freely,
    model_at_poses,
    scaled,
    set_geometry,
    triangulated,
)
from realsim.scanning.sfm.photographs import Photographs
from realsim.scanning.sfm.result import Alignment, Poses, Progress

Array = NDArray[np.float64]
MODEL = "model"
"""Folder of the COLMAP model, in metres where the scale is known."""
WORK = ".work"
"""Folder that COLMAP writes into while it runs."""
LEAST_IN_VIEW = 10
"""Points that a view must see to count as placed."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mapped:
    """A reconstruction in the robot's world, or in its own."""

    model: Any
    models: tuple[int, ...]
    scale: float
    sigma_percent: float
    alignment: Alignment | None
    bundle: Bundle | None
    is_metric: bool


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Job:
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


def map_free(job: Job, database: MatchDatabase) -> Mapped:
    """Map without poses, then bring the model to the robot's world."""
    models = map_freely(
        database, job.config, refine_camera=job.intrinsics is None, folder=job.folder / WORK,
        tick=job.tick("mapping"),
    )  # fmt: skip
    model, sizes = models[0], tuple(int(m.num_reg_images()) for m in models)
    found = geometry_of(model, job.folder / MODEL)
    posed = [k for k, n in enumerate(found.names) if n in job.robot]
    if not job.robot:
        return Mapped(
            model=model, models=sizes, scale=float("nan"), sigma_percent=float("nan"),
            alignment=None, bundle=None, is_metric=False,
        )  # fmt: skip
    names = tuple(found.names[k] for k in posed)
    alignment = align_to_robot(
        names, found.Ts_world_cam[posed], np.array([job.robot[n] for n in names]).reshape(-1, 4, 4),
        job.config.alignment, np.random.default_rng(job.config.seed),
    )  # fmt: skip
    scaled(model, alignment.scale, alignment.R, alignment.t)
    return Mapped(
        model=model, models=sizes, scale=alignment.scale, sigma_percent=alignment.sigma_percent,
        alignment=alignment, bundle=None, is_metric=True,
    )  # fmt: skip


def map_at_poses(job: Job, database: MatchDatabase, Ts: Array, poses: Poses) -> Mapped:
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


def _judged_against_robot(job: Job, model: Any, Ts: Array, bundle: Bundle | None) -> Mapped:
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
    return Mapped(
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
