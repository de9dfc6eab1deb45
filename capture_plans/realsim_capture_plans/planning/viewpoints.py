"""Which views of a scene can the arm take: directions, camera poses, joint candidates, choice.

Candidates are arrays, not objects: a pose list `Ts_base_cam` with an `item` number (which
direction or which view a pose belongs to), and joint candidates with the pose they reach.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.geometry import se3
from realsim_capture_plans.arms.kinematics import DhChain
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.planning.record import PlanConfig

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
BATCH = 4000
"""Poses solved at a time: keeps the arrays of the collision check below 100 MB."""
HOME_COMPARISONS = 60
"""Items, evenly picked, that a home is judged by."""
LLOYD_ROUNDS = 10
"""Moves of the chosen views to the middle of their cells; the spacing settles in about six."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidates:
    """Collision-free joint vectors and the view item and camera pose that each one reaches."""

    joints: Array
    """(M, 6) angles in (-pi, pi] [rad]."""
    item: Ints
    """(M,) direction or view number."""
    Ts_base_cam: Array
    """(M, 4, 4) camera pose reached [m]."""


def golden_cap(n: int, elevation_deg: tuple[float, float]) -> Array:
    """Return n unit vectors (n, 3), evenly spread over the elevations [deg], the topmost first.

    Golden spiral: heights in equal steps (equal areas), azimuths in golden angles.
    """
    low, high = np.sin(np.radians(elevation_deg))
    z = high - (np.arange(n) + 0.5) / n * (high - low)
    azimuth = np.arange(n) * GOLDEN_ANGLE
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], -1)


def hemisphere_poses(
    center: ArrayLike, directions: Array, config: PlanConfig
) -> tuple[Array, Ints]:
    """Return camera poses (P, 4, 4) for every direction, radius and roll, and their directions."""
    c = np.asarray(center, dtype=np.float64)
    radii = np.linspace(*config.radius_m, config.radii)
    rolls = np.arange(config.rolls) * (2 * np.pi / config.rolls)
    poses = [
        se3.look_at(c + radius * direction, c, roll)
        for direction in directions
        for radius in radii
        for roll in rolls
    ]
    return np.stack(poses), np.repeat(np.arange(len(directions)), len(radii) * len(rolls))


def reachable(
    Ts_base_cam: Array, item: Ints, T_ee_cam: ArrayLike, model: CollisionModel, sigma_min: float
) -> Candidates:
    """Return every joint vector that reaches a pose, is free and is not singular.

    Args:
        Ts_base_cam: (P, 4, 4) camera poses wanted [m].
        item: (P,) what each pose belongs to.
        T_ee_cam: (4, 4) the mount [m].
        model: what must stay free; its chain is the arm.
        sigma_min: least singular value of the Jacobian.
    """
    chain = model.chain
    T_cam_ee = se3.invert(T_ee_cam)
    joints: list[Array] = []
    pose: list[Ints] = []
    for first in range(0, len(Ts_base_cam), BATCH):
        q, of = chain.inverse_branches(Ts_base_cam[first : first + BATCH] @ T_cam_ee)
        keep = chain.limits.contains(q)
        keep[keep] = model.free(q[keep])
        keep[keep] = chain.sigma_min(q[keep]) >= sigma_min
        joints.append(q[keep])
        pose.append(of[keep] + first)
    of_pose = np.concatenate(pose)
    return Candidates(
        joints=np.concatenate(joints), item=item[of_pose], Ts_base_cam=Ts_base_cam[of_pose]
    )


def farthest_points(points: Array, n: int, first: int) -> Ints:
    """Return n row numbers of points (M, D), each the farthest from those before it."""
    chosen = [first]
    nearest = np.linalg.norm(points - points[first], axis=-1)
    for _ in range(n - 1):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=-1))
    return np.array(chosen, dtype=np.intp)


def thin_directions(directions: Array, n: int) -> Ints:
    """Return n row numbers of unit vectors (M, 3) that cover them evenly.

    Farthest points from the topmost, then Lloyd's rounds restricted to the given directions: every
    chosen one moves to the direction nearest the mean of its cell.
    """
    chosen = farthest_points(directions, n, int(np.argmax(directions[:, 2])))
    for _ in range(LLOYD_ROUNDS):
        cell = np.argmax(directions @ directions[chosen].T, axis=1)
        mean = np.zeros((n, 3))
        np.add.at(mean, cell, directions)
        # Within its own cell, so that two cells never choose the same direction.
        score = np.where(cell[:, None] == np.arange(n), directions @ mean.T, -np.inf)
        moved = np.argmax(score, axis=0)
        if np.array_equal(moved, chosen):
            break
        chosen = moved
    return chosen


def near_home(joints: Array, home: Array, chain: DhChain, config: PlanConfig) -> tuple[Array, Ints]:
    """Return whole-turn variants (K, 6) near home, the nearest first, and the row of each.

    At most `config.branch_limit` of them; every joint within `config.turn_reach_rad` of home.
    """
    rows: list[Array] = []
    origin: list[int] = []
    low = np.maximum(chain.limits.lower, home - config.turn_reach_rad)
    high = np.minimum(chain.limits.upper, home + config.turn_reach_rad)
    for i, q in enumerate(joints):
        choices = [
            [v for v in (x - 2 * np.pi, x, x + 2 * np.pi) if a <= v <= b]
            for x, a, b in zip(q, low, high, strict=True)
        ]
        for variant in product(*choices):
            rows.append(np.array(variant))
            origin.append(i)
    if not rows:
        return np.zeros((0, 6)), np.zeros(0, dtype=np.intp)
    q = np.stack(rows)
    best = np.argsort(np.abs(q - home).max(-1), kind="stable")[: config.branch_limit]
    return q[best], np.array(origin, dtype=np.intp)[best]


def choose_home(found: Candidates) -> Array:
    """Return the joints (6,) of the most top-down item from which all other items are nearest."""
    top = found.joints[found.item == found.item[np.argmin(found.Ts_base_cam[:, 2, 2])]]
    items = np.unique(found.item)
    total = np.zeros(len(top))
    for i in items[np.linspace(0, len(items) - 1, HOME_COMPARISONS).astype(int)]:
        gap = np.abs(top[:, None] - found.joints[found.item == i][None])
        total += np.minimum(gap, 2 * np.pi - gap).max(-1).min(1)
    return np.array(top[int(np.argmin(total))])


def same_elbow(found: Candidates, home: Array) -> Candidates:
    """Return the candidates whose elbow bends to the same side as at home.

    Changing sides leads through the stretched arm, and over a table there is seldom room for it.
    """
    keep = np.sin(found.joints[:, 2]) * np.sin(home[2]) > 0
    return Candidates(
        joints=found.joints[keep], item=found.item[keep], Ts_base_cam=found.Ts_base_cam[keep]
    )
