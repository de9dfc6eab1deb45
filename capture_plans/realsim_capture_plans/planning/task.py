"""What is to be planned: arm, mount, work cell, what counts as seen; checked once."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box, Mount, WorkCell
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.planning.record import PlanConfig
from realsim_capture_plans.planning.view_quality import SENSORS
from realsim_capture_plans.planning.viewpoints import Candidates, reachable

Ints = NDArray[np.intp]
Kind = Literal["hemisphere", "calibration"]
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""
SCENE_GRID = 4
"""Points per side that stand for the keep-out volume when views are judged by what they see."""
GREATEST_CENTER_M = 3.0
"""Farther than this from the base the centre must have been given in another unit [m]."""
TOO_NEAR = 0.5
"""Worth of what a view sees that has part of the scene nearer than the sensor can measure."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlanTask:
    """What both kinds of plan hand from step to step."""

    kind: Kind
    center: Array
    mount: Mount
    cell: WorkCell
    config: PlanConfig
    model: CollisionModel
    rng: np.random.Generator
    progress: Progress

    def reach(self, poses: Array, item: Ints, what: str) -> Candidates:
        """Return the candidates of camera poses (P, 4, 4) for items (P,)."""
        return reachable(
            poses, item, self.mount.T_ee_cam, self.model, self.config.sigma_min,
            lambda done, total: self.progress(what, done, total),
        )  # fmt: skip


def checked_center(center: ArrayLike) -> Array:
    """Return a scene centre (3,) [m].

    Raises:
        InputError: it is no point.
        UnitError: it cannot be in metres.
    """
    c = np.array(center, dtype=np.float64)
    if c.shape != (3,) or not np.all(np.isfinite(c)):
        raise InputError(f"the scene centre is {c.tolist()}; (x, y, z) in base [m] is needed.")
    if np.abs(c).max() > GREATEST_CENTER_M:
        raise UnitError(
            f"the scene centre is {c.tolist()} m, farther than any arm reaches. Were millimetres "
            f"given? Metres are needed: {(c * 1e-3).tolist()} m?"
        )
    return c


def plan_task(  # noqa: PLR0913, PLR0917 - hands on what both kinds of plan are given
    kind: Kind,
    n: int,
    center: ArrayLike,
    mount: Mount | ArrayLike,
    config: PlanConfig,
    chain: DhChain,
    obstacles: tuple[tuple[str, Box], ...],
    rng: np.random.Generator,
    progress: Progress | None,
) -> PlanTask:
    """Check what was given and build the collision model."""
    if n < 1:
        raise InputError(f"a plan of {n} views was asked for; at least 1 is needed.")
    c = checked_center(center)
    carried = mount if isinstance(mount, Mount) else d405_mount(mount)
    cell = config.work_cell(c, kind, obstacles)
    # One speed for all joints: that of the slowest at the most.
    config = replace(
        config,
        speed=min(config.speed, float(chain.limits.speed.min())),
        acceleration=min(config.acceleration, float(chain.limits.acceleration.min())),
    )
    return PlanTask(
        kind=kind,
        center=c,
        mount=carried,
        cell=cell,
        config=config,
        model=CollisionModel(chain, carried, cell, config.clearance_m),
        rng=rng,
        progress=progress or (lambda what, done, total: None),
    )


def seen_share(Ts_base_cam: Array, task: PlanTask) -> Array:
    """Return (M,) which share of the keep-out volume each pose has in its image, not too near."""
    if task.mount.camera not in SENSORS:
        return np.ones(len(Ts_base_cam))
    sensor = SENSORS[task.mount.camera]
    camera = sensor.intrinsics
    low = np.array(task.cell.keep_out.lower)
    low[2] = task.cell.table.upper[2]
    steps = np.linspace(0.0, 1.0, SCENE_GRID)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    points = low + grid * (np.array(task.cell.keep_out.upper) - low)
    points_cam = se3.transform(se3.invert(Ts_base_cam), points)
    uv = project(camera, points_cam)
    inside = np.all((uv >= 0) & (uv <= [camera.width - 1, camera.height - 1]), axis=-1)
    depth = points_cam[..., 2]
    inside &= depth > 0
    # A view that has something too near in its image counts as one that sees little.
    near = np.any(inside & (depth < sensor.nearest_m), axis=-1)
    return np.where(near, TOO_NEAR, 1.0) * np.mean(inside, axis=-1)
