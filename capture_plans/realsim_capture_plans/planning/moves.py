"""Free moves between views: another branch where a straight move collides, else via points."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.planning.ordering import Edge, move_seconds, tour
from realsim_capture_plans.planning.record import PlanConfig

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
COLLISION_SECONDS = 5.0
"""Added to a colliding move in the search: more than a detour over via points takes."""
REROUTES = 6
"""Rounds of the tour with the colliding moves made dear; the rest goes over via points."""
LIFTS_M = (0.04, 0.08, 0.12, 0.18)
"""How far the camera is drawn back along its optical axis at a via point [m]."""
TREE_STEPS = 1000
"""Draws of the tree search, the last resort; a change of the elbow's side takes some hundreds."""
TREE_REACH_RAD = 0.5
"""Longest branch of the trees [rad]."""
TREE_MARGIN_RAD = 1.5
"""How far a joint may leave the span between start and goal in the tree search [rad]."""
SHORTCUTS = 60
"""Random shortcuts tried on the path that the trees found."""


class NoFreeMoveError(DegenerateError):
    """No free move to a view was found; `view` is its number among the candidates given."""

    view: int = -1


def connect(
    candidates: list[Array],
    home: Array,
    model: CollisionModel,
    config: PlanConfig,
    rng: np.random.Generator,
) -> tuple[Array, tuple[tuple[int, Array], ...]]:
    """Return the views' joints (N, 6) in tour order and the via points of moves not straight.

    Args:
        candidates: per view, (Ki, 6) free joints near home [rad].
        home: (6,) free joints where the tour begins [rad].
        model: what must stay free.
        config: speeds, step of the collision check.
        rng: drives the tree search where drawing the camera back is not enough.

    Raises:
        NoFreeMoveError: no free move to a view was found; its `view` says which.
    """
    forbidden: dict[Edge, float] = {}
    best: tuple[float, Array, list[int], Ints] | None = None
    order = None
    for _ in range(REROUTES):
        order, choice = tour(candidates, home, config, order, forbidden)
        joints = np.stack([candidates[i][c] for i, c in zip(order, choice, strict=True)])
        start = np.concatenate([home[None], joints[:-1]])
        free = model.edges_free(start, joints, config.edge_step_rad)
        bad: list[int] = np.flatnonzero(~free).tolist()
        legs = np.abs(joints - start).max(-1)
        total = float(move_seconds(legs, config).sum()) + COLLISION_SECONDS * len(bad)
        if best is None or total < best[0]:
            best = (total, joints, bad, order)
        if not bad:
            break
        for k in bad:
            view, branch = (-1, 0) if k == 0 else (int(order[k - 1]), int(choice[k - 1]))
            forbidden[(view, branch, int(order[k]), int(choice[k]))] = COLLISION_SECONDS
    assert best is not None  # REROUTES is positive
    _, joints, bad, order = best
    start = np.concatenate([home[None], joints[:-1]])
    vias: list[tuple[int, Array]] = []
    for k in bad:
        try:
            vias.append((k, detour(start[k], joints[k], home, model, config, rng)))
        except NoFreeMoveError as error:
            error.view = _harder_end(order, k, start[k], joints[k], home, model, config)
            raise
    return joints, tuple(vias)


def _harder_end(
    order: Ints,
    k: int,
    q_from: Array,
    q_to: Array,
    home: Array,
    model: CollisionModel,
    config: PlanConfig,
) -> int:
    """Return which view of move k is the shut-in one: the one whose way from home is not free."""
    if k > 0:
        free = model.edges_free(
            np.stack([home, home]), np.stack([q_from, q_to]), config.edge_step_rad
        )
        if free[1] and not free[0]:
            return int(order[k - 1])
    return int(order[k])


def detour(
    q_from: Array,
    q_to: Array,
    home: Array,
    model: CollisionModel,
    config: PlanConfig,
    rng: np.random.Generator,
) -> Array:
    """Return via points (K, 6) that make a move free: the quickest of those that were found.

    Raises:
        NoFreeMoveError: neither simple via points nor the tree search make the move free.
    """
    best: tuple[float, Array] | None = None
    for via in _proposals(q_from, q_to, home, model):
        corners = np.concatenate([q_from[None], via, q_to[None]])
        seconds = float(move_seconds(np.abs(np.diff(corners, axis=0)).max(-1), config).sum())
        if best is not None and seconds >= best[0]:
            continue
        if np.all(model.edges_free(corners[:-1], corners[1:], config.edge_step_rad)):
            best = (seconds, via)
    if best is None:
        path = _grown_path(q_from, q_to, model, config, rng)
        if path is not None:
            return _shortened(path, model, config, rng)[1:-1]
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
            yield np.concatenate([q[:1], _upright(ends), q[1:]])
    yield home[None]
    yield _upright(ends)


def _upright(ends: Array) -> Array:
    """Return both ends with the arm stretched up: where an elbow may change its side."""
    tall = ends.copy()
    tall[:, 1:3] = -np.pi / 2, 0.0
    return tall


def _grown_path(
    q_from: Array, q_to: Array, model: CollisionModel, config: PlanConfig, rng: np.random.Generator
) -> Array | None:
    """Return a free path (K, 6) by growing one tree from each end, or None.

    RRT-Connect: Kuffner and LaValle, ICRA 2000.
    """
    limits = model.chain.limits
    low = np.maximum(np.minimum(q_from, q_to) - TREE_MARGIN_RAD, limits.lower)
    high = np.minimum(np.maximum(q_from, q_to) + TREE_MARGIN_RAD, limits.upper)
    trees = ([q_from], [q_to])
    parents: tuple[list[int], list[int]] = ([-1], [-1])

    def grow(which: int, target: Array) -> bool:
        """Add one branch towards the target; return whether the branch is free."""
        nodes = np.stack(trees[which])
        near = int(np.argmin(np.abs(nodes - target).max(-1)))
        step = target - nodes[near]
        length = float(np.abs(step).max())
        tip = target if length <= TREE_REACH_RAD else nodes[near] + step * TREE_REACH_RAD / length
        if not model.edges_free(nodes[near], tip, config.edge_step_rad)[0]:
            return False
        trees[which].append(tip)
        parents[which].append(near)
        return True

    def trunk(which: int) -> list[Array]:
        path, node = list[Array](), len(trees[which]) - 1
        while node >= 0:
            path.append(trees[which][node])
            node = parents[which][node]
        return path

    for step in range(TREE_STEPS):
        a, b = step % 2, 1 - step % 2
        if not grow(a, rng.uniform(low, high)):
            continue
        goal = trees[a][-1]
        while grow(b, goal):
            if trees[b][-1] is goal:
                path = np.stack([*trunk(a)[::-1], *trunk(b)[1:]])
                return path if a == 0 else path[::-1]
    return None


def _shortened(
    path: Array, model: CollisionModel, config: PlanConfig, rng: np.random.Generator
) -> Array:
    """Return the path (K, 6) with corners left out wherever the straight move is free."""
    for _ in range(SHORTCUTS):
        if len(path) <= 2:
            break
        i, j = np.sort(rng.choice(len(path), 2, replace=False))
        if j - i > 1 and model.edges_free(path[i], path[j], config.edge_step_rad)[0]:
            path = np.concatenate([path[: i + 1], path[j:]])
    return path
