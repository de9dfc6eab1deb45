"""Make a capture plan: exactly n views that the arm reaches, in a short collision-free tour.

Directions, radii and rolls give camera poses; every arm branch that reaches one and is free is a
candidate; the reachable directions are thinned to n, and these are tried more densely; order and
candidates are chosen together; every move is checked, and goes over via points where the straight
line collides.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.robots.arm import UR5
from realsim.robots.inverse import CLOSED, held_joint
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box, Mount
from realsim_capture_plans.planning import viewpoints
from realsim_capture_plans.planning.advise import better_place
from realsim_capture_plans.planning.elbow import bend
from realsim_capture_plans.planning.metrics import plan_metrics
from realsim_capture_plans.planning.moves import NoFreeMoveError, connect
from realsim_capture_plans.planning.ordering import Clusters
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig
from realsim_capture_plans.planning.task import PlanTask, Progress, plan_task, seen_share
from realsim_capture_plans.planning.tour_search import held_karp_bound, two_nearest_bound
from realsim_capture_plans.planning.view_quality import nearest_deg

Ints = NDArray[np.intp]
SECOND_TRY = 6
"""Times as many poses are tried in directions that seemed out of reach."""
ELBOW_WORTH = 1.15
"""The other side of the elbow is used where the hole would be larger by this factor without it: the
way there and back takes about 8 s."""
SAMPLED_SHARE = 4
"""One in so many poses is tried of an arm whose inverse is sampled."""
MOST_MISSED = 0.25
"""Where more than this share of the directions is missed, the scene stands badly: no second try."""


def hemisphere_plan(
    n: int,
    center_world: ArrayLike,
    mount: Mount | ArrayLike,
    config: PlanConfig,
    rng: np.random.Generator,
    *,
    chain: DhChain = UR5,
    obstacles: tuple[tuple[str, Box], ...] = (),
    progress: Progress | None = None,
) -> CapturePlan:
    """Return n views that look at the scene from all over the reachable hemisphere.

    Args:
        n: number of views.
        center_world: (3,) what the camera looks at, in base [m].
        mount: the camera on the flange, or (4, 4) T_ee_cam [m] of a D405; a few mm off do no harm.
        config: radii, elevations, clearances, speeds.
        rng: draws the turn of the spiral, the search for the tour and, where a move collides, the
            via points.
        chain: the arm, nominal or calibrated.
        obstacles: named boxes in base that the arm keeps its clearance to.
        progress: told how far the work is.

    Raises:
        InputError: n is not positive, or a given pose is not one.
        DegenerateError: fewer than n views are reachable, or one cannot be driven to.
    """
    task = plan_task("hemisphere", n, center_world, mount, config, chain, obstacles, rng, progress)
    directions, found = reachable_directions(task, n)
    items = np.unique(found.item)
    tried = len(directions)
    home, one_side = _home(task, found, n, tried)
    side = float(np.sign(bend(chain, home)))
    strict = one_side.where(bend(chain, one_side.joints) * side > 0)
    if _largest_hole(directions, items, strict, n) < ELBOW_WORTH * _largest_hole(
        directions, items, one_side, n
    ):
        one_side = strict

    def more(chosen: Ints) -> viewpoints.Candidates:
        """Return the candidates of the chosen directions, tried more densely."""
        poses, item = viewpoints.hemisphere_poses(
            task.center, directions[chosen], config.radius_m, _poses(task, config.dense_poses), 0.5
        )
        dense = task.reach(poses, chosen[item], "more ways to the chosen views")
        both = viewpoints.on_one_elbow(one_side.joined(dense), chain, side)
        return viewpoints.preferred(both, seen_share(both.Ts_base_cam, task) >= config.seen_share)

    def choose(ok: Ints) -> Ints:
        return ok[viewpoints.thin_directions(directions[ok], n, directions)]

    def between(direction: Ints, joints: Array) -> tuple[Array, Ints]:
        """Return candidates (K, n) near joints (N, n), and the row that each belongs to."""
        return nearest_views(task, directions[direction], joints)

    plan = _driven(task, one_side, home, n, choose, more, between)
    found_here = {
        "hole_reachable_deg": float(nearest_deg(plan.directions(), directions[items]).max()),
        "reachable_share": len(items) / tried,
    }
    return replace(plan, metrics=plan.metrics | found_here)


def _largest_hole(directions: Array, items: Ints, found: viewpoints.Candidates, n: int) -> float:
    """Return the hole [deg] that n of the found items leave among all that are reachable."""
    ok = np.unique(found.item)
    if len(ok) < n:
        return np.inf
    chosen = directions[ok][viewpoints.thin_directions(directions[ok], n, directions)]
    return float(nearest_deg(chosen, directions[items]).max())


def reachable_directions(task: PlanTask, n: int) -> tuple[Array, viewpoints.Candidates]:
    """Return the directions (D, 3) that are tried for n views, and what reaches them."""
    config = task.config
    spin = se3.exp_so3([0.0, 0.0, task.rng.uniform(0.0, 2 * np.pi)])
    tried = max(config.oversampling * n, config.least_directions)
    directions = viewpoints.cap_with_rim(tried, config.elevation_deg) @ spin.T
    tried = len(directions)
    per_direction = _poses(task, config.poses_per_direction)
    poses, item = viewpoints.hemisphere_poses(
        task.center, directions, config.radius_m, per_direction, 0.0
    )
    found = task.reach(poses, item, "which directions are reachable")
    missed = np.setdiff1d(np.arange(tried), found.item)
    if len(missed) and len(missed) < tried * MOST_MISSED:
        # A direction may be reachable by a roll or a radius that was not tried.
        poses, item = viewpoints.hemisphere_poses(
            task.center, directions[missed], config.radius_m, SECOND_TRY * len(poses) // tried, 0.5
        )
        second = task.reach(poses, missed[item], "a second try at the rest")
        found = found.joined(second)
    return directions, found


def _poses(task: PlanTask, count: int) -> int:
    """Return how many camera poses are tried where an arm in closed form tries `count`.

    Each costs a sampled inverse twenty times as much; a redundant arm's brings as many candidates.
    """
    return count if held_joint(task.model.chain) is None else -(-count // SAMPLED_SHARE)


def calibration_plan(  # noqa: PLR0913 - a plan's own facts, one by one
    n: int,
    center_world: ArrayLike,
    mount: Mount | ArrayLike,
    config: PlanConfig,
    rng: np.random.Generator,
    *,
    normal_world: ArrayLike = (0.0, 0.0, 1.0),
    chain: DhChain = UR5,
    obstacles: tuple[tuple[str, Box], ...] = (),
    progress: Progress | None = None,
) -> CapturePlan:
    """Return n views of a flat board: every roll, tilts, distances, the board all over the image.

    Rotations about all axes are what a hand-eye calibration lives on: without roll about the
    optical axis its error is two to six times as large.

    Args:
        n: number of views.
        center_world: (3,) the board's centre in base [m].
        mount: the camera on the flange, or (4, 4) T_ee_cam [m] of a D405.
        config: distances, tilt, aim jitter, clearances, speeds.
        rng: draws the poses and the search for the tour.
        normal_world: (3,) the board's normal, to the side of the camera.
        chain: the arm, nominal or calibrated.
        obstacles: named boxes in base that the arm keeps its clearance to.
        progress: told how far the work is.

    Raises:
        InputError: n is not positive, or a given pose is not one.
        DegenerateError: fewer than n views are reachable, or one cannot be driven to.
    """
    task = plan_task("calibration", n, center_world, mount, config, chain, obstacles, rng, progress)
    normal = np.asarray(normal_world, dtype=np.float64)
    length = float(np.linalg.norm(normal))
    if normal.shape != (3,) or not length > 0:
        raise InputError(f"the board's normal is {normal.tolist()}; a direction (3,) is needed.")
    tried = max(config.board_oversampling * n, config.least_directions)
    poses, features = viewpoints.board_poses(tried, task.center, normal / length, config, rng)
    found = task.reach(poses, np.arange(tried), "which board views are reachable")
    roll = viewpoints.board_roll(poses, viewpoints.plane_axes(normal / length))
    home, one_side = _home(task, found, n, tried)

    def choose(ok: Ints) -> Ints:
        return ok[viewpoints.spread_rolls(features[ok], roll[ok], n)]

    plan = _driven(task, one_side, home, n, choose, lambda _: one_side)
    board = plan_metrics(plan, task.model, board_normal=normal)
    share = {"reachable_share": len(np.unique(found.item)) / tried}
    return replace(plan, metrics=plan.metrics | board | share)


def _too_few(task: PlanTask, n: int, reachable_count: int, tried: int) -> str:
    c, chain = task.config, task.model.chain
    x, y, z = task.center.tolist()
    elsewhere = better_place(chain, task.mount, c, max(0.0, z - c.table_height_m))
    if task.kind == "hemisphere":
        asked = f"radii {c.radius_m} m, elevations {c.elevation_deg} deg"
    else:
        asked = f"distances {c.board_distance_m} m, tilts to {c.board_tilt_deg} deg"
    return (
        f"{n} views were asked for, but of {tried} tried about ({x:.3f}, {y:.3f}, {z:.3f}) m only "
        f"{reachable_count} are reachable and free for a {chain.name} ({asked}). {elsewhere} Else "
        "allow smaller radii or distances, raise the least elevation, or make the keep-out box "
        "smaller."
    )


def _home(
    task: PlanTask, found: viewpoints.Candidates, n: int, tried: int
) -> tuple[Array, viewpoints.Candidates]:
    """Return where the tour begins, and the candidates on one side of the elbow where there are.

    Raises:
        DegenerateError: fewer than n items are reachable.
    """
    count = len(np.unique(found.item))
    if count < n:
        raise DegenerateError(_too_few(task, n, count, tried))
    chain = task.model.chain
    one_side = viewpoints.on_one_elbow(found, chain, viewpoints.better_elbow(found, chain))
    return viewpoints.choose_home(one_side, chain), one_side


def _driven(
    task: PlanTask,
    found: viewpoints.Candidates,
    home: Array,
    n: int,
    choose: Callable[[Ints], Ints],
    more: Callable[[Ints], viewpoints.Candidates],
    between: Callable[[Ints, Array], tuple[Array, Ints]] | None = None,
) -> CapturePlan:
    """Return the plan of n chosen items: an order, a candidate of each, and free moves between.

    Items that no free move leads to are left out, and the choice is made again.

    Args:
        task: arm, mount, what must stay free.
        found: what is reachable.
        home: (n,) where the tour begins [rad].
        n: number of views.
        choose: returns n of the items it is given.
        more: returns the candidates of chosen items.
        between: returns candidates of items (N,) near joints (N, n), and the row of each.

    Raises:
        DegenerateError: fewer than n items are left.
    """
    chain, config = task.model.chain, task.config
    ok = np.unique(found.item)
    while True:
        chosen = choose(ok)
        candidates = more(chosen)
        order = np.argsort(candidates.item, kind="stable")
        rows = np.split(
            candidates.joints[order],
            np.searchsorted(candidates.item[order], np.unique(candidates.item))[1:],
        )
        by_item = dict(zip(np.unique(candidates.item).tolist(), rows, strict=True))
        near = [viewpoints.with_turns(by_item[i], home, chain, config) for i in chosen.tolist()]
        task.progress("order and moves", 0, 1)
        closer = None if between is None else partial(closer_candidates, between, chosen, home)
        try:
            joints, vias, clusters = connect(near, home, task.model, config, task.rng, closer)
            break
        except NoFreeMoveError as error:
            ok = np.setdiff1d(ok, chosen[list(error.views)])
            if len(ok) < n:
                raise
    task.progress("order and moves", 1, 1)
    return _plan_of(task, home, joints, vias, clusters)


def _plan_of(
    task: PlanTask,
    home: Array,
    joints: Array,
    vias: tuple[tuple[int, Array], ...],
    clusters: Clusters,
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
    task.progress("how good it is", 0, 1)
    metrics = plan_metrics(plan, task.model)
    seconds = metrics["seconds"]
    bounds = {
        "tour_bound_s": held_karp_bound(clusters.least_s, seconds),
        "tour_bound_two_nearest_s": two_nearest_bound(clusters.least_s),
    }
    task.progress("how good it is", 1, 1)
    return replace(
        plan,
        metrics=metrics
        | bounds
        # A single view at home has no way to go.
        | ({"tour_over_bound": seconds / bounds["tour_bound_s"]} if seconds > 0 else {}),
    )


def closer_candidates(
    between: Callable[[Ints, Array], tuple[Array, Ints]],
    chosen: Ints,
    home: Array,
    views: Ints,
    joints: Array,
) -> list[Array]:
    """Return further candidates (Ki, n) of every view: near the middle of its neighbours' joints.

    Args:
        between: returns candidates of items near joints.
        chosen: (N,) item of every view.
        home: (n,) where the tour begins [rad].
        views: (N,) in tour order.
        joints: (N, n) of the views in that order [rad].
    """
    before = np.concatenate([home[None], joints[:-1]])
    after = np.concatenate([joints[1:], joints[-1:]])
    wanted = np.concatenate([(before + after) / 2, (before + joints + after) / 3, before, after])
    of = np.tile(views, 4)
    found, row = between(chosen[of], wanted)
    return [found[of[row] == view] for view in range(len(chosen))]


def nearest_views(task: PlanTask, directions: Array, joints: Array) -> tuple[Array, Ints]:
    """Return the views in directions (N, 3) that lie nearest to joints (N, n), as far as free.

    Radius and roll are those of the camera at these joints, as near as the direction allows; of the
    arm's branches and turns the one nearest to these joints is taken.

    Returns:
        joints (K, n) [rad] and the row (K,) that each belongs to.
    """
    config, chain = task.config, task.model.chain
    Ts = chain.forward(joints) @ task.mount.T_ee_cam
    radius = np.clip(np.linalg.norm(Ts[:, :3, 3] - task.center, axis=-1), *config.radius_m)
    eyes = task.center + radius[:, None] * directions
    upright = viewpoints.look_at_poses(eyes, task.center, np.zeros(len(eyes)))
    turn = np.swapaxes(upright[:, :3, :3], -1, -2) @ Ts[:, :3, :3]
    roll = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    poses = viewpoints.look_at_poses(eyes, task.center, roll)
    good = np.flatnonzero(seen_share(poses, task) >= config.seen_share)
    Ts_base_ee = poses[good] @ se3.invert(task.mount.T_ee_cam)
    if chain.joints > CLOSED:  # of all ways to hold a redundant arm the nearest
        q, arrived = chain.refine(joints[good], Ts_base_ee)
        q, of = q[arrived], np.flatnonzero(arrived)
    else:
        q, of = chain.inverse_branches(Ts_base_ee)
    row = good[of]
    q = joints[row] + np.remainder(q - joints[row] + np.pi, 2 * np.pi) - np.pi
    gap = np.abs(q - joints[row]).max(-1)
    order = np.lexsort([gap, row])
    first = np.unique(row[order], return_index=True)[1]
    q, row = q[order][first], row[order][first]
    keep = chain.limits.contains(q) & (chain.sigma_min(q) >= config.sigma_min)
    keep[keep] = task.model.free(q[keep])
    return q[keep], row[keep]
