"""What the arm must not touch: the table, the objects and itself.

The arm is a set of spheres that contain its surface (`arm_shape`), the table a half-space, objects
are points on their surfaces. A move is checked along its whole length, not at samples: between two
checked configurations a joint motion dq moves a sphere by at most sum |dq_j| r_j, with r_j the
greatest distance that its centre can have from joint j's axis. Hence the guarantee, for a straight
move in joint space that is called free: at each checked configuration every sphere keeps
`clearance_m` from all points and from the table, and anywhere between at least half of it; links
that can meet keep `self_clearance_m` from each other in the same sense: all that are more than two
joints apart, but for those that the arm's description keeps apart. What is left out: the arm's foot
(link 0) against table and objects, because it is bolted to where it stands.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from realsim.arrays import Array, Int64
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.compiled_chain import ChainNumbers, frames_into
from realsim_sim_bridge.arm.grasping_arm import (
    GraspingArm,
    Spheres,
    arm_spheres,
    hand_spheres,
    joined,
)
from realsim_sim_bridge.arm.obstacles import Obstacles, least_distance, nearest_within

FREE, IN_TABLE, IN_ITSELF, AT_LIMITS = -1, -2, -3, -4
"""What stops a configuration; an instance number (0 or more) is the object that it touches."""
NEAR_LINKS = 2
"""Links that are so many joints apart or fewer are not asked whether they meet: between them there
is no room for a sphere's bulge, and their shapes keep them apart."""
LEAST_CLEARANCE_M = 0.002
"""Smaller clearances would need steps without end along an object."""


def in_words(code: int) -> str:
    """Return what stopped a configuration, for a sentence that starts with the move."""
    words = {
        IN_TABLE: "collides with the table",
        IN_ITSELF: "collides with the arm itself",
        AT_LIMITS: "leaves the joint limits or the arm's reach",
    }
    return words.get(code, f"collides with the object of instance {code}")


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmSpaceConfig:
    """Distances the arm keeps."""

    clearance_m: float = 0.01
    """Least distance of the arm from objects and table [m]: twice and more the objects' point
    spacing, because half of it is what holds between checked configurations."""
    self_clearance_m: float = 0.01
    """Least distance of links that can meet from each other [m]."""

    def __post_init__(self) -> None:
        """Check that moves can be checked.

        Raises:
            InputError: a clearance is too small.
        """
        if min(self.clearance_m, self.self_clearance_m) < LEAST_CLEARANCE_M:
            raise InputError(
                f"the arm's clearances are {self.clearance_m} and {self.self_clearance_m} m; moves "
                f"are checked in steps of them, so at least {LEAST_CLEARANCE_M} m is needed."
            )


class _Body(NamedTuple):
    """The arm's spheres and what they may not touch; a tuple, so that compiled code takes it."""

    chain: ChainNumbers
    T_table_base: Array
    """(4, 4) [m]."""
    links: Int64
    """(S,) link of each sphere, not decreasing."""
    centers: Array
    """(S, 3) link frame [m]."""
    radii: Array
    """(S,) [m]."""
    sides: Array
    """(S,) +1, -1 = goes with the finger at that y; 0 = does not."""
    arc: Array
    """(2,) radius of the circle on which the fingers run, 0 = none, and y of its middle [m]."""
    levers: Array
    """(S, n) greatest distance of the centre from each joint's axis [m]; 0 = not moved by it."""
    clearances: Array
    """(2,) from others, from itself [m]."""
    starts: Int64
    """(n + 3,) first sphere of each link."""
    balls: Array
    """(n + 2, 4) centre, link frame, and radius of a ball around each link's spheres [m]."""
    ball_levers: Array
    """(n + 2, n) greatest of the link's levers [m]."""
    pairs: Int64
    """(P, 2) links that can meet, the nearer to the base first."""


class ArmSpace:
    """The obstacles around an arm whose base stands at T_table_base."""

    def __init__(
        self, T_table_base: Array, obstacles: Obstacles, config: ArmSpaceConfig, arm: GraspingArm
    ):
        """Prepare the checks.

        Args:
            T_table_base: (4, 4) the arm's base [m].
            obstacles: points on all objects, the grasped one too, in the table's frame.
            config: distances to keep.
            arm: the arm with its hand.
        """
        self.obstacles = obstacles
        bare = arm_spheres(arm.arm)
        whole = joined([bare, hand_spheres(arm.hand, arm.joints + 1)])
        self.bodies = {
            False: _body(T_table_base, bare, config, arm),
            True: _body(T_table_base, whole, config, arm),
        }
        """The arm without and with the hand's spheres: near an object they are too coarse and the
        hand's boxes are checked instead."""

    def blame(self, q: Array, openings_m: Array, *, with_hand: bool) -> Int64:
        """Return what stops each configuration (N, n), or FREE.

        Args:
            q: joint angles [rad].
            openings_m: (N,) distance of the finger faces [m].
            with_hand: whether the hand's spheres are checked too.
        """
        return self.blame_moves(q[:, None], openings_m, with_hand=with_hand)

    def blame_moves(self, paths: Array, openings_m: Array, *, with_hand: bool) -> Int64:
        """Return what stops each path (N, W, n) of straight joint moves, or FREE."""
        return _blame_paths(
            np.ascontiguousarray(paths), openings_m, self.bodies[with_hand], self.obstacles
        )


def _body(T_table_base: Array, spheres: Spheres, config: ArmSpaceConfig, arm: GraspingArm) -> _Body:
    """Return spheres with their levers, and which links can meet."""
    links, hand = spheres.links, arm.hand
    openings = np.linspace(0.0, hand.max_opening_m, 9)
    slide = float(np.hypot(openings / 2, hand.z_pad(openings)).max())
    levers = _levers(arm, spheres, np.abs(spheres.sides) * slide)
    count = arm.joints + 2
    starts = np.searchsorted(links, np.arange(count + 1))
    balls, ball_levers = np.zeros((count, 4)), np.zeros((count, arm.joints))
    for link in np.unique(links).tolist():
        mine = links == link
        low, high = spheres.centers[mine].min(axis=0), spheres.centers[mine].max(axis=0)
        balls[link, :3] = (low + high) / 2
        apart = np.linalg.norm(spheres.centers[mine] - balls[link, :3], axis=1)
        moved = np.abs(spheres.sides[mine]) * slide
        balls[link, 3] = (apart + spheres.radii[mine] + moved).max()
        ball_levers[link] = levers[mine].max(axis=0)
    kept_apart = arm.arm.kept_apart
    pairs = [
        (a, b)
        for a in range(count)
        for b in range(a + NEAR_LINKS + 1, count)
        # The hand turns with the last link.
        if min(b, arm.joints) - a > NEAR_LINKS
        and (a, b) not in kept_apart
        and starts[a] < starts[a + 1]
        and starts[b] < starts[b + 1]
    ]
    return _Body(
        chain=arm.numbers,
        T_table_base=np.ascontiguousarray(T_table_base, dtype=np.float64),
        links=links,
        centers=np.ascontiguousarray(spheres.centers),
        radii=np.ascontiguousarray(spheres.radii),
        sides=spheres.sides,
        arc=np.array([hand.arc_radius_m, hand.arc_axis_y_m]),
        levers=levers,
        clearances=np.array([config.clearance_m, config.self_clearance_m]),
        starts=starts.astype(np.int64),
        balls=balls,
        ball_levers=ball_levers,
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
    )


def _levers(arm: GraspingArm, spheres: Spheres, slides: Array) -> Array:
    """Return the greatest distance (S, n) [m] of each centre from each joint's axis.

    The steps from axis to axis, each from the point of the one beside which the next passes, have
    fixed lengths; what of the first lies along the joint's own axis does not count.

    Args:
        arm: the arm with its hand.
        spheres: its spheres.
        slides: (S,) how far a finger may have moved it [m].
    """
    chain, n = arm.numbers, arm.joints
    levers = np.zeros((len(spheres.links), n))
    in_hand = (spheres.links == n + 1)[:, None]
    centers = np.where(in_hand, se3.transform(chain.T_n_tool, spheres.centers), spheres.centers)
    for s, (link, center) in enumerate(zip(spheres.links.tolist(), centers, strict=True)):
        last = min(link, n) - 1
        if last < 0:
            continue
        ca, sa = chain.cos_alpha[last], chain.sin_alpha[last]
        x, y, z = center
        at = np.array([x + chain.a[last], ca * y - sa * z, sa * y + ca * z])
        levers[s, last] = np.hypot(at[0], at[1]) + slides[s]
        beyond = float(np.linalg.norm(at)) + slides[s]
        for j in range(last - 1, -1, -1):
            levers[s, j] = np.hypot(chain.a[j], chain.d[j + 1] * chain.sin_alpha[j]) + beyond
            beyond += np.hypot(chain.a[j], chain.d[j + 1])
    return levers


# --- compiled -----------------------------------------------------------------------------------


@njit
def _centers_into(q: Any, opening: float, body: Any, frames: Any, centers: Any) -> None:
    """Write the spheres' centres (S, 3) in the table's frame [m]."""
    frames_into(body.chain, q, body.T_table_base, frames)
    rise, radius, middle = 0.0, body.arc[0], body.arc[1]
    if radius > 0.0:
        rise = np.sqrt(radius**2 - (0.5 * opening - middle) ** 2) - np.sqrt(radius**2 - middle**2)
    for s in range(len(body.links)):
        T = frames[body.links[s]]
        x = body.centers[s, 0]
        y = body.centers[s, 1] + 0.5 * opening * body.sides[s]
        z = body.centers[s, 2] + rise * abs(body.sides[s])
        for r in range(3):
            centers[s, r] = T[r, 0] * x + T[r, 1] * y + T[r, 2] * z + T[r, 3]


@njit
def _outer_gap(
    x: float, y: float, z: float, radius: float, clearance: float, obstacles: Any
) -> Any:
    """Return how far a sphere is at least from table and objects [m], and what is too near."""
    table = z - radius
    if table < clearance:
        return table, IN_TABLE
    gap = least_distance(obstacles, x, y, z) - radius
    if gap < clearance:
        reach = radius + 2 * clearance
        near, row = nearest_within(obstacles, x, y, z, reach)
        if row >= 0 and near - radius < clearance:
            return near - radius, obstacles.instances[row]
        gap = min(near - radius, 2 * clearance)
    return min(gap, table), FREE


@njit
def _self_step(frames: Any, centers: Any, body: Any, turns: Any, step: float) -> float:
    """Return how far along a move links that can meet are safe of each other; -1 = too near.

    `step` is the safe share known so far; the rest is as in `_stop_or_step`.
    """
    clearance, n = body.clearances[1], len(turns)
    middles = np.empty((len(body.balls), 3))
    for link in range(len(body.balls)):
        T, ball = frames[link], body.balls[link]
        for r in range(3):
            middles[link, r] = T[r, 0] * ball[0] + T[r, 1] * ball[1] + T[r, 2] * ball[2] + T[r, 3]
    for p in range(len(body.pairs)):
        first, second = body.pairs[p, 0], body.pairs[p, 1]
        # Only the joints between the two links change their distance.
        rate = 0.0
        for j in range(first, min(second, n)):
            rate += turns[j] * body.ball_levers[second, j]
        near = max(clearance, step * rate)
        dx = middles[first, 0] - middles[second, 0]
        dy = middles[first, 1] - middles[second, 1]
        dz = middles[first, 2] - middles[second, 2]
        around = near + body.balls[first, 3]
        if dx * dx + dy * dy + dz * dz > (around + body.balls[second, 3]) ** 2:
            continue
        for b in range(body.starts[second], body.starts[second + 1]):
            x, y, z, radius = centers[b, 0], centers[b, 1], centers[b, 2], body.radii[b]
            dx, dy, dz = x - middles[first, 0], y - middles[first, 1], z - middles[first, 2]
            if dx * dx + dy * dy + dz * dz > (around + radius) ** 2:
                continue
            for a in range(body.starts[first], body.starts[first + 1]):
                dx, dy, dz = x - centers[a, 0], y - centers[a, 1], z - centers[a, 2]
                squared = dx * dx + dy * dy + dz * dz
                if squared > (near + radius + body.radii[a]) ** 2:
                    continue
                gap = np.sqrt(squared) - radius - body.radii[a]
                if gap < clearance:
                    return -1.0
                rate = 0.0
                for j in range(first, min(second, n)):
                    rate += turns[j] * body.levers[b, j]
                step = min(step, gap / max(rate, 1e-300))
    return step


@njit
def _stop_or_step(
    frames: Any, centers: Any, body: Any, obstacles: Any, rates: Any, turns: Any
) -> Any:
    """Return what stops a configuration (or FREE), and how far along a move it is safe.

    Args:
        frames: of the links.
        centers: (S, 3) of the spheres [m].
        body: the arm.
        obstacles: what it may not touch.
        rates: (S,) how fast each sphere moves at most [m per whole move].
        turns: (n,) |dq| of the move [rad].
    """
    step = np.inf
    for s in range(len(body.links)):
        if body.links[s] == 0:
            continue
        x, y, z = centers[s, 0], centers[s, 1], centers[s, 2]
        gap, code = _outer_gap(x, y, z, body.radii[s], body.clearances[0], obstacles)
        if code != FREE:
            return code, 0.0
        step = min(step, gap / max(rates[s], 1e-300))
    step = _self_step(frames, centers, body, turns, step)
    if step < 0.0:
        return IN_ITSELF, 0.0
    return FREE, step


@njit
def blame_move(start: Any, end: Any, opening: float, body: Any, obstacles: Any, room: Any) -> Any:
    """Return what stops the straight move from `start` to `end` (n,), or FREE.

    `room` are the arrays (frames, centers, rates, turns, q) of `room_for` to work in.
    """
    frames, centers, rates, turns, q = room
    for j in range(len(q)):
        turns[j] = abs(end[j] - start[j])
    for s in range(len(rates)):
        rates[s] = 0.0
        for j in range(len(q)):
            rates[s] += turns[j] * body.levers[s, j]
    t = 0.0
    while True:
        for j in range(len(q)):
            q[j] = start[j] + t * (end[j] - start[j])
        _centers_into(q, opening, body, frames, centers)
        code, step = _stop_or_step(frames, centers, body, obstacles, rates, turns)
        if code != FREE or t >= 1.0:
            return code
        # The gap at the next stop is at least the clearance too, so that the least gap between the
        # stops, (gap + clearance - rate step) / 2, is half the clearance.
        t = min(t + step, 1.0)


@njit
def room_for(body: Any) -> Any:
    """Return arrays for `blame_move` to work in."""
    count, n = len(body.links), len(body.chain.a)
    room = np.empty((n + 2, 3, 4)), np.empty((count, 3)), np.empty(count), np.empty(n), np.empty(n)
    return room


@njit
def _blame_paths(paths: Any, openings: Any, body: Any, obstacles: Any) -> Any:
    """Return what stops each path (N, W, n) of straight moves first, or FREE."""
    codes = np.full(len(paths), FREE, dtype=np.int64)
    room = room_for(body)
    count = paths.shape[1]
    for n in range(len(paths)):
        for w in range(max(count - 1, 1)):
            end = paths[n, min(w + 1, count - 1)]
            codes[n] = blame_move(paths[n, w], end, openings[n], body, obstacles, room)
            if codes[n] != FREE:
                break
    return codes
