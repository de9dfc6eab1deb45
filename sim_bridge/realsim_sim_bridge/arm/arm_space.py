"""What the arm must not touch: the table, the objects and itself.

The arm is a set of spheres that contain its surface (`arm_shape`), the table a half-space, objects
are points on their surfaces. A move is checked along its whole length, not at samples: between two
checked configurations a joint motion dq moves a sphere by at most sum |dq_j| r_j, with r_j the
greatest distance that its centre can have from joint j's axis. Hence the guarantee, for a straight
move in joint space that is called free: at each checked configuration every sphere keeps
`clearance_m` from all points and from the table, and anywhere between at least half of it; wrist
and hand keep `self_clearance_m` from base and shoulder in the same sense. What is left out: the
arm's foot (link 0) against table and objects, because it is bolted to where it stands.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import Hand
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.arm.chain import frames_into
from realsim_sim_bridge.arm.obstacles import (
    FINGER_SIDE,
    Obstacles,
    arm_spheres,
    hand_spheres,
    least_distance,
    nearest_within,
)

Array = NDArray[np.float64]
Codes = NDArray[np.int64]

FREE, IN_TABLE, IN_ITSELF, AT_LIMITS = -1, -2, -3, -4
"""What stops a configuration; an instance number (0 or more) is the object that it touches."""
NEAR_LINKS, FAR_LINKS = (0, 1, 2), (5, 6, 7, 8)
"""Links that can meet although they are not neighbours: all pairs that Franka's own list of
collisions (franka_description, SRDF) leaves in."""
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
    """Least distance of wrist and hand from base and shoulder [m]."""

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

    T_table_base: Array
    """(4, 4) [m]."""
    links: NDArray[np.int64]
    """(S,) link of each sphere, not decreasing."""
    centers: Array
    """(S, 3) link frame [m]."""
    radii: Array
    """(S,) [m]."""
    sides: Array
    """(S,) +1, -1 = moves along y with half the opening, as a finger does; 0 = does not."""
    levers: Array
    """(S, 7) greatest distance of the centre from each joint's axis [m]; 0 = not moved by it."""
    clearances: Array
    """(2,) from others, from itself [m]."""
    trunk: Array
    """(4,) the shoulder in the table's frame and the radius around it that base and shoulder never
    leave [m]."""


class ArmSpace:
    """The obstacles around an arm whose base stands at T_table_base."""

    def __init__(
        self,
        T_table_base: Array,
        obstacles: Obstacles,
        config: ArmSpaceConfig,
        geometry: Hand,
    ):
        """Prepare the checks.

        Args:
            T_table_base: (4, 4) the arm's base [m].
            obstacles: points on all objects, the grasped one too, in the table's frame.
            config: distances to keep.
            geometry: the hand.
        """
        self.obstacles = obstacles
        arm, hand = arm_spheres(), hand_spheres(geometry)
        self.bodies = {
            False: _body(T_table_base, arm, config, geometry),
            True: _body(T_table_base, np.concatenate([arm, hand]), config, geometry),
        }
        """The arm without and with the hand's spheres: near an object they are too coarse and the
        hand's boxes are checked instead."""

    def blame(self, q: Array, openings_m: Array, *, with_hand: bool) -> Codes:
        """Return what stops each configuration (N, 7), or FREE.

        Args:
            q: joint angles [rad].
            openings_m: (N,) distance of the finger faces [m].
            with_hand: whether the hand's spheres are checked too.
        """
        return self.blame_moves(q[:, None], openings_m, with_hand=with_hand)

    def blame_moves(self, paths: Array, openings_m: Array, *, with_hand: bool) -> Codes:
        """Return what stops each path (N, W, 7) of straight joint moves, or FREE."""
        return _blame_paths(
            np.ascontiguousarray(paths), openings_m, self.bodies[with_hand], self.obstacles
        )


def _body(T_table_base: Array, spheres: Array, config: ArmSpaceConfig, geometry: Hand) -> _Body:
    """Return spheres (S, 5) of link, centre and radius with their levers."""
    links = spheres[:, 0].astype(np.int64)
    sides = np.where(links == FINGER_SIDE[0], 1.0, np.where(links == FINGER_SIDE[1], -1.0, 0.0))
    links = np.minimum(links, panda.JOINTS + 1)
    levers = _levers(links, spheres[:, 1:4], np.abs(sides) * geometry.max_opening_m / 2)
    return _Body(
        T_table_base=np.ascontiguousarray(T_table_base, dtype=np.float64),
        links=links,
        centers=np.ascontiguousarray(spheres[:, 1:4]),
        radii=np.ascontiguousarray(spheres[:, 4]),
        sides=sides,
        levers=levers,
        clearances=np.array([config.clearance_m, config.self_clearance_m]),
        trunk=_trunk(T_table_base, links, spheres),
    )


def _trunk(T_table_base: Array, links: NDArray[np.int64], spheres: Array) -> Array:
    """Return the shoulder (3,) and the radius of a ball around it that contains links 0 to 2."""
    shoulder = np.array([0.0, 0.0, panda.SHOULDER_M])
    centers = spheres[:, 1:4] - np.where((links == 0)[:, None], shoulder, 0.0)
    # The frames of links 1 and 2 have their origin there, however they turn.
    reach = np.linalg.norm(centers, axis=1) + spheres[:, 4]
    radius = reach[np.isin(links, NEAR_LINKS)].max()
    return np.append(se3.transform(T_table_base, shoulder[None])[0], radius)


def _levers(links: NDArray[np.int64], centers: Array, slides: Array) -> Array:
    """Return the greatest distance (S, 7) [m] of each centre from each joint's axis.

    Args:
        links: (S,) link of each sphere.
        centers: (S, 3) link frame [m].
        slides: (S,) how far a finger may have moved it [m].
    """
    in_seven = se3.transform(se3.invert(panda.JOINT7_GRASP), centers)
    centers = np.where((links > panda.JOINTS)[:, None], in_seven, centers)
    links = np.minimum(links, panda.JOINTS)
    origins = panda.link_frames(np.zeros(panda.JOINTS))[:, :3, 3]
    lengths = np.linalg.norm(np.diff(origins, axis=0), axis=1)
    levers = np.zeros((len(links), panda.JOINTS))
    for joint in range(1, panda.JOINTS + 1):
        here = links == joint
        levers[here, joint - 1] = np.hypot(centers[here, 0], centers[here, 1]) + slides[here]
        if joint == panda.JOINTS:
            break
        # The next joint's origin turns with this one, at a fixed distance from its axis.
        swing = float(np.hypot(panda.A_M[joint], panda.D_M[joint] * np.sin(panda.ALPHA[joint])))
        for s in np.nonzero(links > joint)[0].tolist():
            chain = float(lengths[joint + 1 : links[s]].sum())
            reach = float(np.linalg.norm(centers[s])) + float(slides[s])
            levers[s, joint - 1] = swing + chain + reach
    return levers


# --- compiled -----------------------------------------------------------------------------------

_NEAR_END, _FAR_START = max(NEAR_LINKS) + 1, min(FAR_LINKS)


@njit
def _centers_into(q: Any, opening: float, body: Any, frames: Any, centers: Any) -> None:
    """Write the spheres' centres (S, 3) in the table's frame [m]."""
    frames_into(q, body.T_table_base, frames)
    for s in range(len(body.links)):
        T = frames[body.links[s]]
        x, z = body.centers[s, 0], body.centers[s, 2]
        y = body.centers[s, 1] + 0.5 * opening * body.sides[s]
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
def _self_step(centers: Any, body: Any, rates: Any, turns: Any, step: float) -> float:
    """Return how far along a move wrist and hand are safe of base and shoulder; -1 = too near.

    `step` is the safe share known so far; the rest is as in `_stop_or_step`.
    """
    count, clearance = len(body.links), body.clearances[1]
    for b in range(count - 1, -1, -1):
        if body.links[b] < _FAR_START:
            break
        x, y, z, radius = centers[b, 0], centers[b, 1], centers[b, 2], body.radii[b]
        near = max(clearance, step * rates[b]) + radius
        dx, dy, dz = x - body.trunk[0], y - body.trunk[1], z - body.trunk[2]
        if dx * dx + dy * dy + dz * dz > (body.trunk[3] + near) ** 2:
            continue
        for a in range(count):
            if body.links[a] >= _NEAR_END:
                break
            dx, dy, dz = x - centers[a, 0], y - centers[a, 1], z - centers[a, 2]
            squared = dx * dx + dy * dy + dz * dz
            if squared > (near + body.radii[a]) ** 2:
                continue
            gap = np.sqrt(squared) - radius - body.radii[a]
            if gap < clearance:
                return -1.0
            # Only the joints between the two links change their distance.
            rate = 0.0
            for j in range(body.links[a], 7):
                rate += turns[j] * body.levers[b, j]
            step = min(step, gap / max(rate, 1e-300))
    return step


@njit
def _stop_or_step(centers: Any, body: Any, obstacles: Any, rates: Any, turns: Any) -> Any:
    """Return what stops a configuration (or FREE), and how far along a move it is safe.

    Args:
        centers: (S, 3) of the spheres [m].
        body: the arm.
        obstacles: what it may not touch.
        rates: (S,) how fast each sphere moves at most [m per whole move].
        turns: (7,) |dq| of the move [rad].
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
    step = _self_step(centers, body, rates, turns, step)
    if step < 0.0:
        return IN_ITSELF, 0.0
    return FREE, step


@njit
def blame_move(start: Any, end: Any, opening: float, body: Any, obstacles: Any, room: Any) -> Any:
    """Return what stops the straight move from `start` to `end` (7,), or FREE.

    `room` are the arrays (frames, centers, rates, turns, q) of `room_for` to work in.
    """
    frames, centers, rates, turns, q = room
    for j in range(7):
        turns[j] = abs(end[j] - start[j])
    for s in range(len(rates)):
        rates[s] = 0.0
        for j in range(7):
            rates[s] += turns[j] * body.levers[s, j]
    t = 0.0
    while True:
        for j in range(7):
            q[j] = start[j] + t * (end[j] - start[j])
        _centers_into(q, opening, body, frames, centers)
        code, step = _stop_or_step(centers, body, obstacles, rates, turns)
        if code != FREE or t >= 1.0:
            return code
        # The gap at the next stop is at least the clearance too, so that the least gap between the
        # stops, (gap + clearance - rate step) / 2, is half the clearance.
        t = min(t + step, 1.0)


@njit
def room_for(body: Any) -> Any:
    """Return arrays for `blame_move` to work in."""
    count = len(body.links)
    return np.empty((9, 3, 4)), np.empty((count, 3)), np.empty(count), np.empty(7), np.empty(7)


@njit
def _blame_paths(paths: Any, openings: Any, body: Any, obstacles: Any) -> Any:
    """Return what stops each path (N, W, 7) of straight moves first, or FREE."""
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
