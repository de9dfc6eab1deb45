"""Which views of a scene can the arm take: directions, camera poses, joint candidates, choice.

Candidates are arrays, not objects: a pose list `Ts_base_cam` with an `item` number (which
direction or which view a pose belongs to), and joint candidates with the pose they reach.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.robots.kinematics import DhChain
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.planning.elbow import bend
from realsim_capture_plans.planning.record import PlanConfig

Ints = NDArray[np.intp]
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
GOLDEN_RATIO = (np.sqrt(5.0) - 1.0) / 2.0
BATCH = 4000
"""Poses solved at a time: keeps the arrays of the inverse below 100 MB."""
HOME_COMPARISONS = 60
"""Items, evenly picked, that a home is judged by."""
LLOYD_ROUNDS = 30
"""Moves of the chosen views to the middle of their cells; most settle within fifteen."""
PATCHES = 200
"""Views moved to the largest hole, at most; it stops shrinking after some ten."""
Tick = Callable[[int, int], None]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidates:
    """Collision-free joint vectors and the view item and camera pose that each one reaches."""

    joints: Array
    """(M, n) angles inside the limits, of several whole turns one [rad]."""
    item: Ints
    """(M,) direction or view number."""
    Ts_base_cam: Array
    """(M, 4, 4) camera pose reached [m]."""

    def where(self, keep: Mask) -> "Candidates":
        """Return the candidates (M,) that are kept."""
        return Candidates(
            joints=self.joints[keep], item=self.item[keep], Ts_base_cam=self.Ts_base_cam[keep]
        )

    def joined(self, other: "Candidates") -> "Candidates":
        """Return these candidates and the other ones."""
        return Candidates(
            joints=np.concatenate([self.joints, other.joints]),
            item=np.concatenate([self.item, other.item]),
            Ts_base_cam=np.concatenate([self.Ts_base_cam, other.Ts_base_cam]),
        )


def golden_cap(n: int, elevation_deg: tuple[float, float]) -> Array:
    """Return n unit vectors (n, 3), evenly spread over the elevations [deg], the topmost first.

    Golden spiral: heights in equal steps (equal areas), azimuths in golden angles.
    """
    low, high = np.sin(np.radians(elevation_deg))
    z = high - (np.arange(n) + 0.5) / n * (high - low)
    azimuth = np.arange(n) * GOLDEN_ANGLE
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], -1)


def cap_with_rim(n: int, elevation_deg: tuple[float, float]) -> Array:
    """Return n unit vectors over a cap (`golden_cap`) and, as far apart, some on its lower rim.

    The spiral ends half a turn short of the rim, where the cells of its last vectors reach out.
    """
    low, high = np.sin(np.radians(elevation_deg))
    spacing = np.sqrt(2 * np.pi * (high - low) / n)
    r = np.cos(np.radians(elevation_deg[0]))
    azimuth = np.arange(0.0, 2 * np.pi, spacing / r)
    rim = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), np.full(len(azimuth), low)], -1)
    return np.concatenate([golden_cap(n, elevation_deg), rim])


def look_at_poses(eyes: Array, targets: ArrayLike, rolls: Array) -> Array:
    """Return camera poses (P, 4, 4) at eyes (P, 3) that look at targets (P, 3) or (3,).

    The same as `se3.look_at` one by one; rolls (P,) [rad] turn about the optical axis.
    """
    z = np.asarray(targets, dtype=np.float64) - eyes
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    x = np.stack([z[:, 1], -z[:, 0], np.zeros(len(z))], -1)
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    x = np.where(length < 1e-9, [1.0, 0.0, 0.0], x / np.maximum(length, 1e-300))
    y = np.cross(z, x)
    c, s = np.cos(rolls)[:, None], np.sin(rolls)[:, None]
    poses = np.zeros((len(eyes), 4, 4))
    poses[:, :3, 0], poses[:, :3, 1] = c * x + s * y, c * y - s * x
    poses[:, :3, 2], poses[:, :3, 3], poses[:, 3, 3] = z, eyes, 1.0
    return poses


def hemisphere_poses(
    center: ArrayLike,
    directions: Array,
    radius_m: tuple[float, float],
    per_direction: int,
    phase: float,
) -> tuple[Array, Ints]:
    """Return camera poses (P, 4, 4) that look at the centre, and the direction (P,) of each.

    Rolls go round in equal steps, with another beginning in every direction; radii follow the
    golden ratio, evenly in between.

    Args:
        center: (3,) what is looked at [m].
        directions: (D, 3) unit vectors from the centre to the cameras.
        radius_m: least and greatest distance.
        per_direction: poses per direction.
        phase: shifts rolls and radii, so that another call gives other poses (0 to 1).
    """
    d = np.repeat(np.arange(len(directions)), per_direction)
    k = np.tile(np.arange(per_direction), len(directions))
    roll = (k + np.mod(d * GOLDEN_RATIO + phase, 1.0)) * (2 * np.pi / per_direction)
    share = np.mod((k + 0.5) * GOLDEN_RATIO + d * (np.sqrt(2.0) - 1.0) + phase, 1.0)
    radius = radius_m[0] + share * (radius_m[1] - radius_m[0])
    eyes = np.asarray(center, dtype=np.float64) + radius[:, None] * directions[d]
    return look_at_poses(eyes, center, roll), d


def reachable(
    Ts_base_cam: Array,
    item: Ints,
    T_ee_cam: ArrayLike,
    model: CollisionModel,
    sigma_min: float,
    tick: Tick | None = None,
) -> Candidates:
    """Return every joint vector that reaches a pose, is free and is not singular.

    Of an arm whose inverse is sampled, those that `DhChain.inverse_branches` finds.

    Args:
        Ts_base_cam: (P, 4, 4) camera poses wanted [m].
        item: (P,) what each pose belongs to.
        T_ee_cam: (4, 4) the mount [m].
        model: what must stay free; its chain is the arm.
        sigma_min: least singular value of the Jacobian.
        tick: called with (poses tried, poses).
    """
    chain = model.chain
    T_cam_ee = se3.invert(T_ee_cam)
    joints: list[Array] = [np.zeros((0, chain.joints))]
    pose: list[Ints] = [np.zeros(0, dtype=np.intp)]
    for first in range(0, len(Ts_base_cam), BATCH):
        q, of = chain.inverse_branches(Ts_base_cam[first : first + BATCH] @ T_cam_ee)
        keep = chain.limits.contains(q)
        keep[keep] = chain.sigma_min(q[keep]) >= sigma_min
        keep[keep] = model.free(q[keep])
        joints.append(q[keep])
        pose.append(of[keep] + first)
        if tick is not None:
            tick(min(first + BATCH, len(Ts_base_cam)), len(Ts_base_cam))
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


def thin_directions(directions: Array, n: int, wanted: Array | None = None) -> Ints:
    """Return n row numbers of unit vectors (M, 3) that cover a cap evenly.

    Farthest points from the topmost, then Lloyd's rounds: every chosen one moves to that of its
    cell's directions which is nearest the mean of the cell. Then the chosen one that is missed
    least moves to where the hole is, as long as the hole shrinks.

    Args:
        directions: (M, 3) to choose from.
        n: how many.
        wanted: (W, 3) what is to be covered, reachable or not; by default the directions.
    """
    target = directions if wanted is None else wanted
    chosen = farthest_points(directions, n, int(np.argmax(directions[:, 2])))
    best, least_hole = chosen, np.inf
    for _ in range(LLOYD_ROUNDS):
        likeness = target @ directions[chosen].T
        cell = np.argmax(likeness, axis=1)
        hole = float(np.arccos(np.clip(likeness.max(axis=1).min(), -1.0, 1.0)))
        if hole < least_hole:
            best, least_hole = chosen, hole
        mean = np.zeros((n, 3))
        np.add.at(mean, cell, target)
        # Within its own cell, so that two cells never choose the same direction.
        own = np.argmax(directions @ directions[chosen].T, axis=1)
        score = np.where(own[:, None] == np.arange(n), directions @ mean.T, -np.inf)
        moved = np.argmax(score, axis=0)
        if np.array_equal(moved, chosen):
            break
        chosen = moved
    return best if n == 1 else _patched(directions, best, target)


def _patched(directions: Array, chosen: Ints, target: Array) -> Ints:
    """Return the choice (n,) after moving views to the largest hole while that makes it smaller.

    Args:
        directions: (M, 3) to choose from.
        chosen: (n,) rows of the choice.
        target: (W, 3) what is to be covered.
    """
    chosen = chosen.copy()
    likeness = target @ directions[chosen].T
    for _ in range(PATCHES):
        order = np.argsort(likeness, axis=1)
        row = np.arange(len(target))
        first, second = likeness[row, order[:, -1]], likeness[row, order[:, -2]]
        hole = int(np.argmin(first))
        filling = int(np.argmax(directions @ target[hole]))
        if filling in chosen:
            break
        filled = target @ directions[filling]
        # What would be worst covered if each view went: its own cell, seen from its second nearest.
        without = np.full(len(chosen), 1.0)
        np.minimum.at(without, order[:, -1], np.maximum(second, filled))
        goes = int(np.argmax(without))
        if min(without[goes], np.sort(np.maximum(first, filled))[0]) <= first[hole] + 1e-12:
            break
        chosen[goes] = filling
        likeness[:, goes] = filled
    return chosen


def with_turns(joints: Array, home: Array, chain: DhChain, config: PlanConfig) -> Array:
    """Return joints (M, n) with all their whole turns (K, n) inside the limits and near home.

    At most `config.branch_limit` of them; every joint within `config.turn_reach_rad` of home.
    """
    low = np.maximum(chain.limits.lower, home - config.turn_reach_rad)
    high = np.minimum(chain.limits.upper, home + config.turn_reach_rad)
    # A joint that has not even one whole turn winds up no cables: all of its range counts.
    short = chain.limits.upper - chain.limits.lower <= 2 * np.pi + 1e-9
    low, high = np.where(short, chain.limits.lower, low), np.where(short, chain.limits.upper, high)
    q = np.asarray(joints, dtype=np.float64)
    for k in range(q.shape[1]):
        turned = np.repeat(q[None], 3, axis=0)
        turned[:, :, k] += np.array([-2 * np.pi, 0.0, 2 * np.pi])[:, None]
        inside = (turned[:, :, k] >= low[k]) & (turned[:, :, k] <= high[k])
        q = turned[inside]
    q = q[np.argsort(np.abs(q - home).max(-1), kind="stable")]
    if len(q) <= config.branch_limit:
        return q
    return q[np.linspace(0, len(q) - 1, config.branch_limit).astype(np.intp)]


def choose_home(found: Candidates, chain: DhChain) -> Array:
    """Return the joints (n,) of the most top-down item from which all other items are nearest."""
    top = found.joints[found.item == found.item[np.argmin(found.Ts_base_cam[:, 2, 2])]]
    items = np.unique(found.item)
    total = np.zeros(len(top))
    turns = chain.limits.upper - chain.limits.lower >= 2 * np.pi - 1e-9
    for i in items[np.linspace(0, len(items) - 1, HOME_COMPARISONS).astype(int)]:
        gap = np.abs(top[:, None] - found.joints[found.item == i][None])
        total += np.where(turns, np.minimum(gap, 2 * np.pi - gap), gap).max(-1).min(1)
    return np.array(top[int(np.argmin(total))])


def on_one_elbow(found: Candidates, chain: DhChain, side: float) -> Candidates:
    """Return the candidates whose elbow bends to one side, and all of items that have no such.

    Changing sides leads through the stretched arm and takes several seconds: it is for views that
    cannot be had otherwise.

    Args:
        found: the candidates.
        chain: the arm.
        side: +1 or -1, the sign of `bend`.
    """
    return preferred(found, bend(chain, found.joints) * side > 0)


def better_elbow(found: Candidates, chain: DhChain) -> float:
    """Return the side, +1 or -1, to which the elbow bends in candidates of more items."""
    bent = bend(chain, found.joints)
    counts = [len(np.unique(found.item[bent * side > 0])) for side in (1.0, -1.0)]
    return 1.0 if counts[0] >= counts[1] else -1.0


def preferred(found: Candidates, good: Mask) -> Candidates:
    """Return the good candidates (M,), and all of items that have no good one."""
    served = np.zeros(int(found.item.max(initial=0)) + 1, dtype=np.bool_)
    served[found.item[good]] = True
    return found.where(good | ~served[found.item])


def board_poses(
    tried: int, center: Array, normal: Array, config: PlanConfig, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return camera poses (tried, 4, 4) over a board and what they should differ in (tried, 5).

    Additive recurrence in six dimensions (Roberts' R-sequence: steps 1/g^k with g^7 = g + 1)
    spreads direction, roll, distance and aim point evenly for any number of poses.
    """
    c = config
    g = 1.5
    for _ in range(50):
        g = (1.0 + g) ** (1.0 / 7.0)
    steps = g ** -np.arange(1.0, 7.0)
    u = np.mod(rng.uniform(size=6) + np.arange(1, tried + 1)[:, None] * steps, 1.0)
    cos_tilt = 1.0 - u[:, 0] * (1.0 - np.cos(np.radians(c.board_tilt_deg)))
    sin_tilt = np.sqrt(1.0 - cos_tilt**2)
    azimuth, roll = 2 * np.pi * u[:, 1], 2 * np.pi * u[:, 2]
    distance = c.board_distance_m[0] + u[:, 3] * (c.board_distance_m[1] - c.board_distance_m[0])
    axes = plane_axes(normal)
    aim = center + (2 * u[:, 4:6] - 1.0) * c.aim_jitter_m @ axes[:2]
    direction = np.stack([np.cos(azimuth) * sin_tilt, np.sin(azimuth) * sin_tilt, cos_tilt], -1)
    eye = aim + distance[:, None] * (direction @ axes)
    poses = look_at_poses(eye, aim, roll)
    # About one unit per feature: direction over the cap, distance and aim point over their ranges.
    sideways = direction[:, :2] / np.sin(np.radians(c.board_tilt_deg))
    return poses, np.concatenate([sideways, 2 * u[:, 3:6] - 1.0], axis=1)


def spread_rolls(features: Array, roll: Array, n: int) -> Ints:
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


def plane_axes(normal: Array) -> Array:
    """Return rows x, y, z = normal of a right-handed frame on the board."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(helper, normal)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def board_roll(Ts_base_cam: Array, axes: Array) -> Array:
    """Return the roll (N,) [rad] that the board is seen at: its own x axis in the image."""
    x_cam = np.swapaxes(Ts_base_cam[:, :3, :3], -1, -2) @ axes[0]
    return np.arctan2(x_cam[:, 1], x_cam[:, 0])
