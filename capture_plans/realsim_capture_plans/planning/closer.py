"""Candidates between neighbours: the roll and the distance that suit a view's place in the tour."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim_capture_plans.planning.task import PlanTask, seen_share
from realsim_capture_plans.planning.viewpoints import look_at_poses

Array = NDArray[np.float64]
Ints = NDArray[np.intp]


def closer_candidates(
    between: Callable[[Ints, Array], tuple[Array, Ints]],
    chosen: Ints,
    home: Array,
    views: Ints,
    joints: Array,
) -> list[Array]:
    """Return further candidates (Ki, 6) of every view: near the middle of its neighbours' joints.

    Args:
        between: returns candidates of items near joints.
        chosen: (N,) item of every view.
        home: (6,) where the tour begins [rad].
        views: (N,) in tour order.
        joints: (N, 6) of the views in that order [rad].
    """
    before = np.concatenate([home[None], joints[:-1]])
    after = np.concatenate([joints[1:], joints[-1:]])
    wanted = np.concatenate([(before + after) / 2, (before + joints + after) / 3, before, after])
    of = np.tile(views, 4)
    found, row = between(chosen[of], wanted)
    return [found[of[row] == view] for view in range(len(chosen))]


def nearest_views(task: PlanTask, directions: Array, joints: Array) -> tuple[Array, Ints]:
    """Return the views in directions (N, 3) that lie nearest to joints (N, 6), as far as free.

    Radius and roll are those of the camera at these joints, as near as the direction allows; of the
    arm's branches and turns the one nearest to these joints is taken.

    Returns:
        joints (K, 6) [rad] and the row (K,) that each belongs to.
    """
    config, chain = task.config, task.model.chain
    Ts = chain.forward(joints) @ task.mount.T_ee_cam
    radius = np.clip(np.linalg.norm(Ts[:, :3, 3] - task.center, axis=-1), *config.radius_m)
    eyes = task.center + radius[:, None] * directions
    upright = look_at_poses(eyes, task.center, np.zeros(len(eyes)))
    turn = np.swapaxes(upright[:, :3, :3], -1, -2) @ Ts[:, :3, :3]
    roll = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    poses = look_at_poses(eyes, task.center, roll)
    good = np.flatnonzero(seen_share(poses, task) >= config.seen_share)
    q, of = chain.inverse_branches(poses[good] @ se3.invert(task.mount.T_ee_cam))
    row = good[of]
    q = joints[row] + np.remainder(q - joints[row] + np.pi, 2 * np.pi) - np.pi
    gap = np.abs(q - joints[row]).max(-1)
    order = np.lexsort([gap, row])
    first = np.unique(row[order], return_index=True)[1]
    q, row = q[order][first], row[order][first]
    keep = chain.limits.contains(q) & (chain.sigma_min(q) >= config.sigma_min)
    keep[keep] = task.model.free(q[keep])
    return q[keep], row[keep]
