"""Free moves between views: another way round where a straight move collides, else via points."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.planning.elbow import raised
from realsim_capture_plans.planning.ordering import Clusters, move_seconds, tour, tour_seconds
from realsim_capture_plans.planning.record import PlanConfig

Ints = NDArray[np.intp]
REROUTES = 8
"""Rounds of the tour with the colliding moves made dear; the rest goes over via points."""
VAIN_REROUTES = 2
"""Rounds without a better tour after which the rest goes over via points."""
REROUTE_SHARE = 0.15
"""Steps of a reroute as a share of the first search: the tour is good already."""
LIFTS_M = (0.04, 0.08, 0.12, 0.18)
"""How far the camera is drawn back along its optical axis at a via point [m]."""
OMPL_CHECKS = 100_000
"""Configurations that OMPL may check for one move, 1 to 2 s: a limit in time would not repeat."""
MARGIN_RAD = 1.5
"""How far a joint may leave the span between start and goal in OMPL's search [rad]."""
SHORTCUTS = 60
"""Random shortcuts tried on the path that OMPL found."""


Closer = Callable[[Ints, Array], list[Array]]
"""Given the views (N,) in tour order and their joints (N, n), returns further candidates (Ki, n) of
every view, by its number."""


class NoFreeMoveError(DegenerateError):
    """No free move to some views was found; `views` are their numbers among the candidates."""

    views: tuple[int, ...] = ()


def connect(
    candidates: list[Array],
    home: Array,
    model: CollisionModel,
    config: PlanConfig,
    rng: np.random.Generator,
    closer: Closer | None = None,
) -> tuple[Array, tuple[tuple[int, Array], ...], Clusters]:
    """Return the views' joints (N, n) in tour order, the via points of moves, and the clusters.

    Args:
        candidates: per view, (Ki, n) free joints near home [rad].
        home: (n,) free joints where the tour begins [rad].
        model: what must stay free.
        config: speeds, step of the collision check.
        rng: drives the search for the tour and for ways round.
        closer: proposes further candidates that suit the neighbours in a tour.

    Raises:
        NoFreeMoveError: no free move to some views was found; its `views` says which.
    """
    clusters = Clusters.of(candidates, home, config)
    path = tour(clusters, config, rng, steps=config.tour_steps)
    for _ in range(config.closer_rounds if closer is not None else 0):
        assert closer is not None
        stops = [clusters.stop(row) for row in path.tolist()]
        views = np.array([view for view, _ in stops], dtype=np.intp)
        clusters = clusters.with_more(closer(views, clusters.joints[path]), config)
        path = np.array([clusters.row(stop) for stop in stops], dtype=np.intp)
        steps = int(REROUTE_SHARE * config.tour_steps)
        path = tour(clusters, config, rng, steps=steps, start=path)
    path, bad = _free_tour(clusters, path, model, config, rng)
    joints = clusters.joints[path]
    start = np.concatenate([home[None], joints[:-1]])
    vias: list[tuple[int, Array]] = []
    shut_in: set[int] = set()
    trouble: NoFreeMoveError | None = None
    for k in bad:
        try:
            vias.append((k, detour(start[k], joints[k], home, model, config, rng)))
        except NoFreeMoveError as error:
            shut_in.add(_harder_end(clusters, path, k, model, config))
            trouble = error
    if trouble is not None:
        # All at once: a tour of what is left is searched anew, which takes most of the time.
        trouble.views = tuple(sorted(shut_in))
        raise trouble
    return joints, tuple(vias), clusters


def _free_tour(
    clusters: Clusters,
    path: Ints,
    model: CollisionModel,
    config: PlanConfig,
    rng: np.random.Generator,
) -> tuple[Ints, list[int]]:
    """Return the rows (N,) of the best tour near a given one, and its moves that still collide."""
    colliding: set[tuple[int, int]] = set()
    known_free: set[tuple[int, int]] = set()
    best: tuple[float, Ints, list[int]] | None = None
    vain = 0
    steps = int(REROUTE_SHARE * config.tour_steps)
    for _ in range(REROUTES):
        moves: list[tuple[int, int]] = list(pairwise([0, *path.tolist()]))
        unknown = [m for m in moves if m not in colliding and m not in known_free]
        if unknown:
            ends = np.array(unknown)
            free = model.edges_free(
                clusters.joints[ends[:, 0]], clusters.joints[ends[:, 1]], config.edge_step_rad
            )
            for move, is_free in zip(unknown, free.tolist(), strict=True):
                # A straight line is as free backwards as it is forwards.
                (known_free if is_free else colliding).update((move, (move[1], move[0])))
        bad = [k for k, move in enumerate(moves) if move in colliding]
        total = tour_seconds(clusters, path, config, colliding)
        vain += 1
        if best is None or total < best[0]:
            best, vain = (total, path, bad), 0
        if not bad or vain >= VAIN_REROUTES:
            break
        path = tour(clusters, config, rng, steps=steps, start=path, colliding=colliding)
    assert best is not None  # REROUTES is positive
    return best[1], best[2]


def _harder_end(
    clusters: Clusters, path: Ints, k: int, model: CollisionModel, config: PlanConfig
) -> int:
    """Return which view of move k is the shut-in one: the one whose way from home is not free."""
    q = clusters.joints
    if k > 0:
        ends = q[path[k - 1 : k + 1]]
        free = model.edges_free(np.stack([q[0], q[0]]), ends, config.edge_step_rad)
        if free[1] and not free[0]:
            return clusters.stop(int(path[k - 1]))[0]
    return clusters.stop(int(path[k]))[0]


def detour(
    q_from: Array,
    q_to: Array,
    home: Array,
    model: CollisionModel,
    config: PlanConfig,
    rng: np.random.Generator,
) -> Array:
    """Return via points (K, n) that make a move free: the quickest of those that were found.

    Raises:
        NoFreeMoveError: neither simple via points nor OMPL make the move free.
    """
    best: tuple[float, Array] | None = None

    def consider(via: Array) -> None:
        nonlocal best
        corners = np.concatenate([q_from[None], via, q_to[None]])
        legs = np.abs(np.diff(corners, axis=0)).max(-1)
        seconds = float(move_seconds(legs, config.speed, config.acceleration).sum())
        if best is not None and seconds >= best[0]:
            return
        if np.all(model.edges_free(corners[:-1], corners[1:], config.edge_step_rad)):
            best = (seconds, via)

    for via in _proposals(q_from, q_to, home, model):
        consider(via)
    path = ompl_path(q_from, q_to, model, config, rng)
    if path is not None:
        consider(_shortened(path, model, config, rng)[1:-1])
    if best is None:
        raise NoFreeMoveError(
            f"no free move was found from joints {np.round(q_from, 3).tolist()} to "
            f"{np.round(q_to, 3).tolist()} rad. Make the keep-out box smaller, the clearance less, "
            "or move the scene centre."
        )
    return best[1]


def _proposals(q_from: Array, q_to: Array, home: Array, model: CollisionModel) -> Iterator[Array]:
    """Yield via points: the camera drawn back at one or both ends, or by way of home."""
    chain = model.chain
    ends = np.stack([q_from, q_to])
    for lift in LIFTS_M:
        drawn_back = chain.forward(ends) @ se3.from_translation([0.0, 0.0, -lift])
        q, arrived = chain.refine(ends, drawn_back)
        if np.all(arrived) and np.all(chain.limits.contains(q)):
            yield from (q, q[:1], q[1:], np.stack([q[0], home, q[1]]))
            yield np.concatenate([q[:1], raised(chain, ends), q[1:]])
    yield home[None]
    yield raised(chain, ends)


def ompl_path(
    q_from: Array, q_to: Array, model: CollisionModel, config: PlanConfig, rng: np.random.Generator
) -> Array | None:
    """Return a free path (K, n) found by OMPL's RRT-Connect, or None.

    A new planner after `setSeed` draws the same numbers again, so plans repeat; the search ends
    after a number of checks, not after a time.
    """
    import ompl.base as ob
    import ompl.geometric as og
    import ompl.util as ou

    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    ou.RNG.setSeed(int(rng.integers(1, 2**31)))
    limits = model.chain.limits
    low = np.maximum(np.minimum(q_from, q_to) - MARGIN_RAD, limits.lower)
    high = np.minimum(np.maximum(q_from, q_to) + MARGIN_RAD, limits.upper)
    n = len(q_from)
    space: Any = ob.RealVectorStateSpace(n)
    bounds: Any = ob.RealVectorBounds(n)
    for k in range(n):
        bounds.setLow(k, float(low[k]))
        bounds.setHigh(k, float(high[k]))
    space.setBounds(bounds)
    # OMPL's steps are Euclidean; a step of this length turns no joint by more than edge_step_rad.
    space.setLongestValidSegmentFraction(config.edge_step_rad / float(space.getMaximumExtent()))
    checks = 0

    def free(state: Any) -> bool:
        nonlocal checks
        checks += 1
        return bool(model.free(np.array([[state[k] for k in range(n)]]))[0])

    setup: Any = og.SimpleSetup(space)
    setup.setStateValidityChecker(free)
    start, goal = space.allocState(), space.allocState()
    for k in range(n):
        start[k], goal[k] = float(q_from[k]), float(q_to[k])
    setup.setStartAndGoalStates(start, goal)
    setup.setPlanner(og.RRTConnect(setup.getSpaceInformation()))
    solved = setup.solve(ob.PlannerTerminationCondition(lambda: checks > OMPL_CHECKS))
    if not solved or not setup.haveExactSolutionPath():
        return None
    states = setup.getSolutionPath().getStates()
    path = np.array([[s[k] for k in range(n)] for s in states])
    path[0], path[-1] = q_from, q_to
    # OMPL's own check is asked again by ours, at our step.
    free_legs = model.edges_free(path[:-1], path[1:], config.edge_step_rad)
    return path if np.all(free_legs) else None


def _shortened(
    path: Array, model: CollisionModel, config: PlanConfig, rng: np.random.Generator
) -> Array:
    """Return the path (K, n) with corners left out wherever the straight move is free."""
    for _ in range(SHORTCUTS):
        if len(path) <= 2:
            break
        i, j = np.sort(rng.choice(len(path), 2, replace=False))
        if (
            j - i > 1
            and model.edges_free(path[i : i + 1], path[j : j + 1], config.edge_step_rad)[0]
        ):
            path = np.concatenate([path[: i + 1], path[j:]])
    return path
