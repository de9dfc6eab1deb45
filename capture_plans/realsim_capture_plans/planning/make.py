"""Make a capture plan: exactly n views that the arm reaches, in a short collision-free tour.

Directions, radii and rolls give camera poses; every arm branch that reaches one and is free is a
candidate; the reachable directions are thinned to n; order and branch are chosen together; every
move is checked, and goes over via points where the straight line collides.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim_capture_plans.arms.kinematics import UR5, DhChain
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.collision.shapes import Box, Mount, WorkCell
from realsim_capture_plans.planning.moves import NoFreeMoveError, connect
from realsim_capture_plans.planning.ordering import move_seconds
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig
from realsim_capture_plans.planning.viewpoints import (
    Candidates,
    choose_home,
    golden_cap,
    hemisphere_poses,
    near_home,
    reachable,
    same_elbow,
    thin_directions,
)

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
Kind = Literal["hemisphere", "calibration"]
TARGET_CAP_POINTS = 4000
"""Directions that the hole angle is measured with: 1.3 degrees apart."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Task:
    """What both kinds of plan hand from step to step."""

    kind: Kind
    center: Array
    mount: Mount
    cell: WorkCell
    config: PlanConfig
    model: CollisionModel


def hemisphere_plan(
    n: int,
    center_world: ArrayLike,
    mount: Mount | ArrayLike,
    config: PlanConfig,
    rng: np.random.Generator,
    *,
    chain: DhChain = UR5,
    obstacles: tuple[tuple[str, Box], ...] = (),
) -> CapturePlan:
    """Return n views that look at the scene from all over the reachable hemisphere.

    Args:
        n: number of views.
        center_world: (3,) what the camera looks at, in base [m].
        mount: the camera on the flange, or (4, 4) T_ee_cam [m] of a D405; a few mm off do no harm.
        config: radii, elevations, clearances, speeds.
        rng: draws the turn of the spiral and, where a move collides, the via points.
        chain: the arm, nominal or calibrated.
        obstacles: named boxes in base that the arm keeps its clearance to.

    Raises:
        InputError: n is not positive, or a given pose is not one.
        DegenerateError: fewer than n views are reachable, or one cannot be driven to.
    """
    task = _task("hemisphere", n, center_world, mount, config, chain, obstacles)
    spin = se3.exp_so3([0.0, 0.0, rng.uniform(0.0, 2 * np.pi)])
    tried = max(config.oversampling * n, config.least_directions)
    directions = golden_cap(tried, config.elevation_deg) @ spin.T
    poses, item = hemisphere_poses(task.center, directions, config)
    found = reachable(poses, item, task.mount.T_ee_cam, task.model, config.sigma_min)

    def choose(ok: Ints) -> Ints:
        return ok[thin_directions(directions[ok], n)]

    plan = _driven(task, found, n, tried, choose, rng)
    coverage = _coverage(plan.directions(), config.elevation_deg)
    return replace(plan, metrics=plan.metrics | coverage)


def calibration_plan(
    n: int,
    center_world: ArrayLike,
    mount: Mount | ArrayLike,
    config: PlanConfig,
    rng: np.random.Generator,
    *,
    normal_world: ArrayLike = (0.0, 0.0, 1.0),
    chain: DhChain = UR5,
    obstacles: tuple[tuple[str, Box], ...] = (),
) -> CapturePlan:
    """Return n views of a flat board: every roll, tilts, distances, the board all over the image.

    Rotations about all axes are what a hand-eye calibration lives on: without roll about the
    optical axis its error is two to six times as large.

    Args:
        n: number of views.
        center_world: (3,) the board's centre in base [m].
        mount: the camera on the flange, or (4, 4) T_ee_cam [m] of a D405.
        config: distances, tilt, aim jitter, clearances, speeds.
        rng: draws the poses.
        normal_world: (3,) the board's normal, to the side of the camera.
        chain: the arm, nominal or calibrated.
        obstacles: named boxes in base that the arm keeps its clearance to.

    Raises:
        InputError: n is not positive, or a given pose is not one.
        DegenerateError: fewer than n views are reachable, or one cannot be driven to.
    """
    task = _task("calibration", n, center_world, mount, config, chain, obstacles)
    normal = np.asarray(normal_world, dtype=np.float64)
    length = float(np.linalg.norm(normal))
    if normal.shape != (3,) or not length > 0:
        raise InputError(f"the board's normal is {normal.tolist()}; a direction (3,) is needed.")
    tried = max(config.board_oversampling * n, config.least_directions)
    poses, features = _board_poses(tried, task, normal / length, rng)
    found = reachable(poses, np.arange(tried), task.mount.T_ee_cam, task.model, config.sigma_min)
    roll = _board_roll(poses, _plane_axes(normal / length))

    def choose(ok: Ints) -> Ints:
        return ok[_spread_rolls(features[ok], roll[ok], n)]

    plan = _driven(task, found, n, tried, choose, rng)
    return replace(plan, metrics=plan.metrics | _board_metrics(plan, normal / length))


def _task(
    kind: Kind,
    n: int,
    center: ArrayLike,
    mount: Mount | ArrayLike,
    config: PlanConfig,
    chain: DhChain,
    obstacles: tuple[tuple[str, Box], ...],
) -> _Task:
    """Check what was given and build the collision model."""
    if n < 1:
        raise InputError(f"a plan of {n} views was asked for; at least 1 is needed.")
    c = np.array(center, dtype=np.float64)
    if c.shape != (3,) or not np.all(np.isfinite(c)):
        raise InputError(f"the scene centre is {c.tolist()}; (x, y, z) in base [m] is needed.")
    carried = mount if isinstance(mount, Mount) else d405_mount(mount)
    cell = config.work_cell(c, kind, obstacles)
    model = CollisionModel(chain, carried, cell, config.clearance_m)
    return _Task(kind=kind, center=c, mount=carried, cell=cell, config=config, model=model)


def _too_few(task: _Task, n: int, reachable_count: int, tried: int) -> str:
    c = task.config
    x, y, z = task.center.tolist()
    if task.kind == "hemisphere":
        asked = f"radii {c.radius_m} m, elevations {c.elevation_deg} deg"
    else:
        asked = f"distances {c.board_distance_m} m, tilts to {c.board_tilt_deg} deg"
    return (
        f"{n} views were asked for, but of {tried} tried about ({x:.3f}, {y:.3f}, {z:.3f}) m only "
        f"{reachable_count} are reachable and free ({asked}). Bring the centre to 0.30-0.40 m in "
        "front of the base, allow smaller radii or distances, raise the least elevation, or make "
        "the keep-out box smaller."
    )


def _board_poses(
    tried: int, task: _Task, normal: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return camera poses (tried, 4, 4) over a board and what they should differ in (tried, 5).

    Additive recurrence in six dimensions (Roberts' R-sequence: steps 1/g^k with g^7 = g + 1)
    spreads direction, roll, distance and aim point evenly for any number of poses.
    """
    c = task.config
    g = 1.5
    for _ in range(50):
        g = (1.0 + g) ** (1.0 / 7.0)
    steps = g ** -np.arange(1.0, 7.0)
    u = np.mod(rng.uniform(size=6) + np.arange(1, tried + 1)[:, None] * steps, 1.0)
    cos_tilt = 1.0 - u[:, 0] * (1.0 - np.cos(np.radians(c.board_tilt_deg)))
    sin_tilt = np.sqrt(1.0 - cos_tilt**2)
    azimuth, roll = 2 * np.pi * u[:, 1], 2 * np.pi * u[:, 2]
    distance = c.board_distance_m[0] + u[:, 3] * (c.board_distance_m[1] - c.board_distance_m[0])
    axes = _plane_axes(normal)
    aim = task.center + (2 * u[:, 4:6] - 1.0) * c.aim_jitter_m @ axes[:2]
    direction = np.stack([np.cos(azimuth) * sin_tilt, np.sin(azimuth) * sin_tilt, cos_tilt], -1)
    eye = aim + distance[:, None] * (direction @ axes)
    poses = np.stack([se3.look_at(e, a, r) for e, a, r in zip(eye, aim, roll, strict=True)])
    # About one unit per feature: direction over the cap, distance and aim point over their ranges.
    sideways = direction[:, :2] / np.sin(np.radians(c.board_tilt_deg))
    return poses, np.concatenate([sideways, 2 * u[:, 3:6] - 1.0], axis=1)


def _spread_rolls(features: Array, roll: Array, n: int) -> Ints:
    """Return n row numbers: one of every n-th of the full turn, otherwise far from each other.

    A sector in which nothing is reachable gives its view to the rows farthest from the others.
    """
    sector = np.floor(np.mod(roll, 2 * np.pi) / (2 * np.pi) * n).astype(np.intp) % n
    nearest = np.full(len(features), np.inf)
    chosen: list[int] = []
    # The first round takes the sectors one by one, the second fills up from all rows.
    for rows in [*(sector == s for s in range(n)), *([np.ones(len(roll), dtype=bool)] * n)]:
        score = np.where(rows, nearest, -1.0)
        score[chosen] = -1.0
        best = int(np.argmax(score))
        if len(chosen) < n and score[best] >= 0:
            chosen.append(best)
            distance = np.linalg.norm(features - features[best], axis=1)
            nearest = np.minimum(nearest, distance)
    return np.array(chosen, dtype=np.intp)


def _plane_axes(normal: Array) -> Array:
    """Return rows x, y, z = normal of a right-handed frame on the board."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(helper, normal)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def _board_roll(Ts_base_cam: Array, axes: Array) -> Array:
    """Return the roll (N,) [rad] that the board is seen at: its own x axis in the image."""
    x_cam = np.swapaxes(Ts_base_cam[:, :3, :3], -1, -2) @ axes[0]
    return np.arctan2(x_cam[:, 1], x_cam[:, 0])


def _driven(
    task: _Task,
    found: Candidates,
    n: int,
    tried: int,
    choose: Callable[[Ints], Ints],
    rng: np.random.Generator,
) -> CapturePlan:
    """Return the plan of n chosen items: an order, a branch of each, and free moves between them.

    An item that no free move leads to is left out, and the choice is made again.

    Args:
        task: arm, mount, what must stay free.
        found: what is reachable.
        n: number of views.
        tried: number of items that were tried.
        choose: returns n of the items it is given.
        rng: drives the search for via points.

    Raises:
        DegenerateError: fewer than n items are left.
    """
    chain, config = task.model.chain, task.config
    count = len(np.unique(found.item))
    if count < n:
        raise DegenerateError(_too_few(task, n, count, tried))
    home = choose_home(found)
    one_side = same_elbow(found, home)
    if len(np.unique(one_side.item)) >= n:
        found = one_side
    ok = np.unique(found.item)
    while True:
        chosen = choose(ok)
        near = [near_home(found.joints[found.item == i], home, chain, config)[0] for i in chosen]
        try:
            joints, vias = connect(near, home, task.model, config, rng)
            break
        except NoFreeMoveError as error:
            ok = ok[ok != chosen[error.view]]
            if len(ok) < n:
                raise
    share = {"reachable_share": len(ok) / tried}
    return _plan_of(task, home, joints, vias, share)


def _plan_of(
    task: _Task,
    home: Array,
    joints: Array,
    vias: tuple[tuple[int, Array], ...],
    metrics: dict[str, float],
) -> CapturePlan:
    """Return the record of a tour, with its metrics."""
    chain = task.model.chain
    Ts_base_cam = chain.forward(joints) @ task.mount.T_ee_cam
    plan = CapturePlan(
        kind=task.kind,
        chain=chain,
        mount=task.mount,
        cell=task.cell,
        home=home,
        joints=joints,
        center_world=task.center,
        vias=vias,
        reference_view=int(np.argmin(Ts_base_cam[:, 2, 2])),
        config=task.config,
    )
    return replace(plan, metrics=_motion_metrics(plan, task.model) | metrics)


def _motion_metrics(plan: CapturePlan, model: CollisionModel) -> dict[str, float]:
    """Return how far, how long and how near to trouble the arm goes."""
    corners = [plan.move(k) for k in range(len(plan))]
    legs = np.concatenate([np.abs(np.diff(c, axis=0)) for c in corners])
    start = np.concatenate([c[:-1] for c in corners])
    goal = np.concatenate([c[1:] for c in corners])
    free = model.edges_free(start, goal, plan.config.edge_step_rad)
    clearance = model.clearance(plan.joints)
    sigma = model.chain.sigma_min(plan.joints)
    return {
        "views": float(len(plan)),
        "moves_with_vias": float(len(plan.vias)),
        "colliding_legs": float(np.sum(~free)),
        "travel_leading_rad": float(legs.max(-1).sum()),
        "travel_total_rad": float(legs.sum()),
        "largest_step_rad": float(legs.max()),
        "seconds": float(move_seconds(legs.max(-1), plan.config).sum()),
        "sigma_min": float(sigma.min()),
        "sigma_median": float(np.median(sigma)),
        **{f"clearance_{group}_m": float(d.min()) for group, d in clearance.items()},
    }


def _coverage(directions: Array, elevation_deg: tuple[float, float]) -> dict[str, float]:
    """Return the greatest hole and the spacing of unit vectors (N, 3) over a cap [deg]."""
    target = golden_cap(TARGET_CAP_POINTS, elevation_deg)
    nearest = np.max(target @ directions.T, axis=1)
    hole = float(np.degrees(np.arccos(np.clip(nearest.min(), -1.0, 1.0))))
    if len(directions) == 1:
        return {"hole_deg": hole}
    gram = directions @ directions.T - 3.0 * np.eye(len(directions))
    spacing = np.degrees(np.arccos(np.clip(gram.max(axis=1), -1.0, 1.0)))
    return {
        "hole_deg": hole,
        "spacing_min_deg": float(spacing.min()),
        "spacing_median_deg": float(np.median(spacing)),
    }


def _board_metrics(plan: CapturePlan, normal: Array) -> dict[str, float]:
    """Return how the board is seen: the widest gap between rolls, tilt and distance ranges."""
    axes = _plane_axes(normal)
    roll = np.sort(_board_roll(plan.Ts_base_cam, axes))
    gaps = np.diff(np.concatenate([roll, roll[:1] + 2 * np.pi]))
    tilt = np.degrees(np.arccos(np.clip(-plan.Ts_base_cam[:, :3, 2] @ normal, -1.0, 1.0)))
    height = (plan.Ts_base_cam[:, :3, 3] - plan.center_world) @ normal
    distance = height / np.cos(np.radians(tilt))
    return {
        "roll_gap_deg": float(np.degrees(gaps.max())),
        "tilt_min_deg": float(tilt.min()),
        "tilt_max_deg": float(tilt.max()),
        "distance_min_m": float(distance.min()),
        "distance_max_m": float(distance.max()),
    }
