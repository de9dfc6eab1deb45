"""Two ways from matches to metric cameras and points: free mapping, and mapping at given poses."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm import mapping
from realsim.scanning.sfm.alignment import align_to_robot, tested_freely, tested_refined
from realsim.scanning.sfm.bundle import Bundle, adjust, halves, prior_sigmas, reliability
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.database import MatchDatabase, Photographs
from realsim.scanning.sfm.result import Alignment, Poses, Progress

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
    covariances: dict[str, Array] | None = None
    """(6, 6) of each camera's right perturbation [rad, m], by name."""
    reliability: float = float("nan")
    """Share of signal in what two halves of the scene do to the cameras; NaN: not refined."""


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
    models = mapping.map_freely(
        database, job.config, refine_camera=job.intrinsics is None, folder=job.folder / WORK,
        tick=job.tick("mapping"),
    )  # fmt: skip
    model, sizes = models[0], tuple(int(m.num_reg_images()) for m in models)
    found = mapping.geometry_of(model, job.folder / MODEL)
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
    mapping.scaled(model, alignment.scale, alignment.R, alignment.t)
    metric = mapping.geometry_of(model, job.folder / MODEL)
    alignment, own = tested_freely(
        alignment, metric, job.robot, job.config.alignment, job.config.mapping
    )
    return Mapped(
        model=model, models=sizes, scale=alignment.scale, sigma_percent=alignment.sigma_percent,
        alignment=alignment, bundle=None, is_metric=True,
        covariances=dict(zip(metric.names, own, strict=True)),
    )  # fmt: skip


def map_at_poses(job: Job, database: MatchDatabase, Ts: Array, poses: Poses) -> Mapped:
    """Triangulate at the robot's poses; where asked for, refine both."""
    m, limit = job.config.mapping, job.config.mapping.known_error_px
    model = _with_points(job, database, mapping.model_at_poses(database, Ts), limit)
    if poses == "known":
        job.progress("mapping", 1, 1)
        _drop_far(model, limit, m.min_angle_deg)
        return _known(job, model, Ts)
    model, bundle, robot = _refined(job, database, model)
    found = bundle.geometry
    alignment, share = _compared(job, bundle, robot)
    if share < m.least_reliability:
        model = _with_points(job, database, mapping.model_at_poses(database, Ts), m.reprojection_px)
        known = _known(job, model, Ts)
        return replace(known, alignment=alignment, reliability=share)
    _drop_far(model, m.reprojection_px, m.min_angle_deg)
    arm = job.config.alignment.noise.arm_scale_percent
    places = range(0, 6 * len(found.names), 6)
    return Mapped(
        model=model, models=(len(Ts),), scale=1.0,
        sigma_percent=float(np.hypot(100 * scale_sigma(bundle), arm)), alignment=alignment,
        bundle=bundle, is_metric=True, reliability=share,
        covariances={
            n: bundle.covariance[k : k + 6, k : k + 6]
            for n, k in zip(found.names, places, strict=True)
        },
    )  # fmt: skip


def _refined(job: Job, database: MatchDatabase, model: Any) -> tuple[Any, Bundle, Array]:
    """Adjust and triangulate in turn; return the model, the adjustment and the robot's poses."""
    m, tick = job.config.mapping, job.tick("mapping")
    done = 0
    while True:
        tick(2 * done + 1, 2 * m.refine_rounds)
        found = mapping.geometry_of(model, job.folder / MODEL)
        robot = np.stack([job.robot[n] for n in found.names])
        bundle = adjust(found, robot, job.config.alignment.noise, m)
        mapping.set_geometry(model, bundle.geometry)
        done += 1
        tick(2 * done, 2 * m.refine_rounds)
        if done >= m.refine_rounds:
            return model, bundle, robot
        model = _with_points(job, database, model, m.reprojection_px)


def _with_points(job: Job, database: MatchDatabase, model: Any, limit_px: float) -> Any:
    """Return the model with points triangulated at its cameras."""
    model = mapping.triangulated(model, database, job.config, limit_px, job.folder / WORK)
    if len(model.points3D) < LEAST_IN_VIEW:
        raise DegenerateError(
            f"only {len(model.points3D)} points fit the robot's camera poses within {limit_px:g} "
            "px: the poses do not belong to these pictures (other order, other frame, wrong "
            "hand-eye, millimetres), or the views share nothing. Run it with the poses "
            "unknown: the residuals then say which views disagree."
        )
    return model


def _known(job: Job, model: Any, Ts: Array) -> Mapped:
    """Return the model at the robot's poses, with the sigma of their scale."""
    found = mapping.geometry_of(model, job.folder / MODEL)
    robot = np.stack([job.robot[n] for n in found.names])
    alignment = align_to_robot(
        found.names, found.Ts_world_cam, robot, job.config.alignment,
        np.random.default_rng(job.config.seed),
    )  # fmt: skip
    return Mapped(
        model=model, models=(len(Ts),), scale=1.0, sigma_percent=alignment.sigma_percent,
        alignment=None, bundle=None, is_metric=True,
    )  # fmt: skip


def _compared(job: Job, bundle: Bundle, robot: Array) -> tuple[Alignment, float]:
    """Return the refined cameras against the robot's, and how repeatable their difference is."""
    config, found = job.config.alignment, bundle.geometry
    alignment = align_to_robot(
        found.names, found.Ts_world_cam, robot, config, np.random.default_rng(job.config.seed)
    )
    alignment = tested_refined(alignment, bundle, robot, config)
    seen = np.bincount(found.cameras_of, minlength=len(found.names)) >= LEAST_IN_VIEW
    use = seen & ~np.array([v.outlier for v in alignment.views])
    parts: list[Array] = []
    for half in halves(found):
        moved = adjust(half, robot, config.noise, job.config.mapping).geometry.Ts_world_cam[use]
        shift = se3.log(se3.invert(robot[use]) @ moved) / prior_sigmas(config.noise)
        # What all views share is the hand-eye's; its prior is wide, and it is one number of many.
        parts.append(shift - shift.mean(0))
    return alignment, reliability(*parts) if int(use.sum()) >= config.min_views else 0.0


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
