"""An arm with a hand on its flange: its kinematics from the base to the grasp frame and back.

The shape of arm and hand: spheres that contain their surfaces, made of their convex bodies.

The surface of a link's bodies is cut into small triangles. A ball around a point of a body that
reaches `d` beyond the nearest of its faces stands out of the body by no more than d; of such balls
those are taken, one after the other, that hold the most of the surface that is left. A triangle is
inside the ball that holds its corners, so the whole surface is. Then each triangle goes to the ball
in which it lies deepest, and the balls shrink to what they have; d is the least of `BULGES_M` with
which few balls do.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim.robots.arm import RobotArm
from realsim.robots.compiled_chain import ChainNumbers, chain_numbers, in_dh_frame
from realsim.robots.hand import Hand
from realsim.robots.inverse import seeds_of
from realsim.robots.limits import JointLimits
from realsim.robots.shapes import Shape


@dataclass(frozen=True, eq=False, slots=True)
class GraspingArm:
    """An arm with a hand; frame `base` is the arm's, `grasp` the hand's."""

    arm: RobotArm
    hand: Hand
    numbers: ChainNumbers = field(init=False)
    """The chain with the grasp frame as its tool, for compiled code."""

    def __post_init__(self) -> None:
        """Make the numbers."""
        object.__setattr__(self, "numbers", chain_numbers(self.arm.chain, self.hand.T_ee_grasp))

    @property
    def joints(self) -> int:
        """How many joints the arm has."""
        return self.arm.joints

    @property
    def limits(self) -> JointLimits:
        """The joints' limits."""
        return self.arm.chain.limits

    @property
    def swing_joint(self) -> int:
        """Number of the joint that swings the hand, counted from 0: the first of the wrist."""
        return self.arm.wrist[0]

    def frames(self, q: ArrayLike) -> Array:
        """Return T_base_link (..., n + 2, 4, 4): base, links, and the grasp frame last.

        Args:
            q: (..., n) joint angles [rad].
        """
        links = self.arm.chain.link_frames(q)
        return np.concatenate([links, links[..., -1:, :, :] @ self.hand.T_ee_grasp], axis=-3)

    def forward(self, q: ArrayLike) -> Array:
        """Return T_base_grasp (..., 4, 4) at joint angles q (..., n) [rad]."""
        return self.arm.chain.forward(q) @ self.hand.T_ee_grasp

    def within_limits(self, q: Array, margin: float = 0.0) -> Mask:
        """Return whether all joints (..., n) keep the margin [rad] from their limits."""
        return np.all(
            (q >= self.limits.lower + margin) & (q <= self.limits.upper - margin), axis=-1
        )

    def inverse(
        self, Ts_base_grasp: Array, held_values: int, margin: float, near: Array
    ) -> tuple[NDArray[np.intp], Array]:
        """Return joint angles that reach each of the poses (N, 4, 4) exactly, within limits.

        Args:
            Ts_base_grasp: (N, 4, 4) [m].
            held_values: at how many values the free joint of a redundant arm is held.
            margin: distance kept from the joint limits [rad].
            near: (n,) of a joint's whole turns the one nearest to this is taken [rad].

        Returns:
            owner (S,), the row of each solution's pose, not decreasing, and joints (S, n) [rad].
        """
        Ts = Ts_base_grasp @ se3.invert(self.hand.T_ee_grasp)
        q, owner = seeds_of(self.arm.chain, Ts, held_values)
        low, high = self.limits.lower + margin, self.limits.upper - margin
        q = near + np.mod(q - near + np.pi, 2 * np.pi) - np.pi
        q = np.where(q < low, q + 2 * np.pi, q)
        q = np.where(q > high, q - 2 * np.pi, q)
        inside = np.all((q >= low) & (q <= high), axis=1)
        return owner[inside], q[inside]

    def swing_in_grasp(self, q: Array) -> tuple[Array, Array, Array]:
        """Return where the joint that swings the hand is, in the grasp frame, at q (N, n) [rad].

        Returns:
            its axis (N, 3), a point on it (N, 3) [m], and how far it may turn from there down and
            up (N, 2) [rad].
        """
        j, limits = self.swing_joint, self.limits
        frames = self.frames(q)
        turning = frames[..., j, :, :] @ (self.arm.chain.T_base_0 if j == 0 else np.eye(4))
        T = se3.invert(frames[..., -1, :, :]) @ turning
        left = np.stack([limits.lower[j] - q[..., j], limits.upper[j] - q[..., j]], axis=-1)
        return T[..., :3, 2], T[..., :3, 3], left

    # --- how far it reaches -----------------------------------------------------------------------
    # The shoulder is the point of the first joint's axis beside which the second's passes, the
    # wrist the point of the last but one's beside which the last's passes. Of a Panda these are
    # where axes 1 and 2 and axes 5 and 6 meet.

    @property
    def shoulder_m(self) -> float:
        """Height of the shoulder over the first joint's frame [m]."""
        return float(self.numbers.d[0])

    @property
    def wrist_reach_m(self) -> float:
        """Bound of the distance from the shoulder to the wrist [m].

        Each of the offsets between them is at right angles to the one before, whatever the angles;
        they are taken one by one or in such pairs, however they make the least.
        """
        a, d = self.numbers.a, self.numbers.d
        steps = np.abs(np.stack([a[:-2], d[1:-1]], axis=1).ravel())
        least = [0.0, float(steps[0])]
        for one, two in zip(steps[:-1].tolist(), steps[1:].tolist(), strict=True):
            least.append(min(least[-1] + two, least[-2] + float(np.hypot(one, two))))
        return least[-1]

    def wrist_distance(self, Ts_base_grasp: Array) -> Array:
        """Return the least distance (N,) [m] from the shoulder to the wrist at poses (N, 4, 4).

        The wrist lies on a circle about the last joint's axis, whatever that joint's angle. No
        inverse kinematics exists where this is more than `wrist_reach_m`.
        """
        n, chain = self.numbers, self.arm.chain
        twist = chain.alpha[-1] + chain.delta_alpha[-1]
        T_last_n = se3.from_rt(se3.exp_so3([twist, 0.0, 0.0]), [n.a[-1], 0.0, 0.0])
        Ts = Ts_base_grasp @ se3.invert(T_last_n @ n.T_n_tool)
        shoulder = se3.transform(n.T_base_0, np.array([[0.0, 0.0, n.d[0]]]))[0]
        out = Ts[:, :3, 3] - n.d[-1] * Ts[:, :3, 2] - shoulder
        along = np.sum(out * Ts[:, :3, 2], axis=1)
        across = np.sqrt(np.maximum(np.sum(out * out, axis=1) - along**2, 0.0))
        return np.hypot(along, across - abs(n.a[-2]))


BULGES_M = (0.02, 0.025, 0.03, 0.04, 0.055, 0.08)
"""How far the balls of a link may stand out of its bodies before they shrink [m]: a little more
where links are large. On average they end up with half of it."""
MOST_SPHERES = 8
"""Most spheres of a link; a link may have more only with the last of the bulges."""
EDGE_M = 0.03
"""Longest edge of a triangle [m]."""
CENTERS = 500
"""Points inside of a link from which balls are taken, about."""
ROUND, BALL = 24, 160
"""Sides of the prism around a cylinder, which is 0.9 % wider, and corners of the solid around a
ball, which is 2 % wider."""
SHRINKS, CENTER_STEPS = 3, 60
"""How often balls shrink, and steps of a centre towards its farthest corner, each shorter than the
one before (Badoiu & Clarkson 2003): the radius is within 2 % of the least."""
PALM_CELL_M, FINGER_CELL_M = 0.036, 0.018
"""Largest edge of the pieces of a hand's box that one sphere contains [m]."""


class Spheres(NamedTuple):
    """Spheres fixed in links."""

    links: Int64
    """(S,) link, not decreasing: 0 = base, 1 to n = behind that joint, n + 1 = the hand."""
    centers: Array
    """(S, 3) [m], in the DH frame of the link's number; of the hand in frame `grasp`."""
    radii: Array
    """(S,) [m]."""
    sides: Array
    """(S,) +1, -1 = goes with the finger at that y; 0 = does not."""


def joined(parts: list[Spheres]) -> Spheres:
    """Return all spheres of several sets, sorted by link."""
    links, centers, radii, sides = (np.concatenate(x) for x in zip(*parts, strict=True))
    order = np.argsort(links, kind="stable")
    return Spheres(links[order], centers[order], radii[order], sides[order])


# --- the arm ------------------------------------------------------------------------------------

_made: dict[str, Spheres] = {}


def arm_spheres(arm: RobotArm) -> Spheres:
    """Return the spheres of an arm's links."""
    key = f"{arm.name} {arm.folder.digest}"
    if key not in _made:
        parts: list[Spheres] = []
        for link in range(arm.joints + 1):
            bodies = [s for s in arm.shapes if s.frame == link]
            if not bodies:
                continue
            centers, radii = _fitted([ConvexHull(solid_points(body)) for body in bodies])
            in_frame = se3.transform(in_dh_frame(arm.chain, link), centers)
            parts.append(_of_link(link, in_frame, radii))
        _made[key] = joined(parts)
    return _made[key]


def _of_link(link: int, centers: Array, radii: Array, side: float = 0.0) -> Spheres:
    n = len(radii)
    return Spheres(np.full(n, link, dtype=np.int64), centers, radii, np.full(n, side))


def _fitted(hulls: list[ConvexHull]) -> tuple[Array, Array]:
    """Return centres (S, 3) and radii (S,) of balls that hold the surface of solids [m]."""
    triangles = _surface(hulls)
    corners, of = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    of = of.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    counts = np.maximum((high - low) * (CENTERS / np.prod(high - low)) ** (1 / 3), 1).astype(int)
    grid = np.stack(np.meshgrid(*((np.arange(n) + 0.5) / n for n in counts), indexing="ij"), -1)
    inside = low + grid.reshape(-1, 3) * (high - low)
    depth = -np.min([_outside(h, inside) for h in hulls], axis=0)
    inside, depth = inside[depth > 0], depth[depth > 0]
    far = np.sqrt(np.maximum(_squares(inside, corners), 0.0))
    far = np.max([far[:, of[:, k]] for k in range(3)], axis=0)
    area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    chosen: list[int] = []
    bulge = 0.0
    for bulge in BULGES_M:
        last = bulge == BULGES_M[-1]
        chosen = _cover_of(far <= (depth + bulge)[:, None], area, None if last else MOST_SPHERES)
        if chosen:
            break
    centers, radii = inside[chosen], depth[chosen] + bulge
    for _ in range(SHRINKS):
        out = _squares(centers, corners)[:, of].max(axis=2)
        group = np.argmin(out - radii[:, None] ** 2, axis=0)
        around = [_around(corners[np.unique(of[group == k])]) for k in np.unique(group)]
        centers, radii = np.array([c for c, _ in around]), np.array([r for _, r in around])
    return centers, radii


def _squares(points: Array, others: Array) -> Array:
    """Return the squared distances (P, Q) between points (P, 3) and others (Q, 3) [m^2]."""
    apart = -2.0 * points @ others.T
    return apart + np.sum(points**2, axis=1)[:, None] + np.sum(others**2, axis=1)


def _cover_of(held: Mask, area: Array, most: int | None) -> list[int]:
    """Return balls that together hold all triangles; none where that cannot be.

    Args:
        held: (C, T) whether a ball holds a triangle.
        area: (T,) of the triangles.
        most: how many balls at most.
    """
    weights = held.astype(np.float32)
    size = area.astype(np.float32)
    left, chosen = np.ones(len(area), dtype=np.bool_), list[int]()
    while left.any():
        gain = weights @ (size * left)
        best = int(np.argmax(gain))
        if gain[best] <= 0.0 or len(chosen) == most:
            return []
        chosen.append(best)
        left &= ~held[best]
    return chosen


def _outside(hull: ConvexHull, points: Array) -> Array:
    """Return how far points (P, 3) are outside of the planes of a solid's faces [m]."""
    return np.asarray((points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1))


def _surface(hulls: list[ConvexHull]) -> Array:
    """Return triangles (T, 3, 3) of all solids but for those inside of another of them."""
    parts: list[Array] = []
    for k, hull in enumerate(hulls):
        part = _cut(hull.points[hull.simplices])
        for other in [*hulls[:k], *hulls[k + 1 :]]:
            hidden = _outside(other, part.reshape(-1, 3)).reshape(-1, 3).max(axis=1) < -1e-6
            part = part[~hidden]
        parts.append(part)
    return np.round(np.concatenate(parts), 9)


def solid_points(shape: Shape) -> Array:
    """Return corners (P, 3) of a convex solid around a shape, in the shape's link [m]."""
    size = shape.size_m
    if shape.points is not None:
        points = shape.points
    elif shape.kind == "box":
        points = np.array(np.meshgrid(*[(-x / 2, x / 2) for x in size])).reshape(3, -1).T
    else:
        radius, length = size[0], size[1] if len(size) > 1 else 0.0
        if shape.kind == "cylinder":
            turn = 2 * np.pi * np.arange(ROUND) / ROUND
            ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
            around = ring * radius / np.cos(np.pi / ROUND)
        else:
            around = radius * _ball()
        end = np.array([0.0, 0.0, length / 2])
        points = np.concatenate([around - end, around + end])
    return se3.transform(shape.T_frame_shape, points)


@lru_cache(maxsize=1)
def _ball() -> Array:
    """Return corners (P, 3) of a solid around the unit ball."""
    points = _directions(BALL)
    return points / -ConvexHull(points).equations[:, 3].max()


def _directions(count: int) -> Array:
    """Return unit vectors (P, 3) spread evenly."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _cut(triangles: Array) -> Array:
    """Return triangles (T, 3, 3) whose edges are short, each cut across its longest edge."""
    while True:
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        first = np.argmax(edges, axis=1)
        long = edges.max(axis=1) > EDGE_M
        if not long.any():
            return triangles
        whole, at = triangles[long], first[long]
        a, b, c = (whole[np.arange(len(at)), (at + k) % 3] for k in range(3))
        middle = (a + b) / 2
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        triangles = np.concatenate([triangles[~long], *halves])


def _around(points: Array) -> tuple[Array, float]:
    """Return centre and radius of a small sphere around points (P, 3)."""
    center = points.mean(axis=0)
    for k in range(CENTER_STEPS):
        farthest = points[np.argmax(_squares(center[None], points)[0])]
        center = center + (farthest - center) / (k + 2)
    return center, float(np.linalg.norm(points - center, axis=1).max()) * (1.0 + 1e-9)


# --- the hand -----------------------------------------------------------------------------------


def hand_spheres(hand: Hand, link: int) -> Spheres:
    """Return the spheres that contain a hand's boxes, frame `grasp`.

    The fingers are those of the closed hand, which go with its opening; bars that turn are held by
    spheres around all that they sweep.

    Args:
        hand: the hand.
        link: its number.
    """
    closed = hand.boxes(0.0)[0]
    swept = hand.swept_boxes(np.zeros(1), np.array([hand.max_opening_m]))[0]
    palms, fingers = len(hand.palm_boxes), len(hand.finger_boxes)
    parts = [_cover(link, box, PALM_CELL_M, 0.0) for box in closed[:palms]]
    for first, side in ((palms, -1.0), (palms + hand.side_boxes, 1.0)):
        bars = first + fingers
        parts += [_cover(link, box, FINGER_CELL_M, side) for box in closed[first:bars]]
        parts += [
            _cover(link, box, PALM_CELL_M, 0.0) for box in swept[bars : first + hand.side_boxes]
        ]
    return joined(parts)


def _cover(link: int, box: Array, cell_m: float, side: float) -> Spheres:
    """Return spheres that contain the box (2, 3): one around each of its equal pieces."""
    size = box[1] - box[0]
    counts = np.maximum(np.ceil(size / cell_m - 1e-9), 1).astype(np.int64)
    pieces = size / counts
    grid = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in counts), indexing="ij"), axis=-1)
    centers = box[0] + grid.reshape(-1, 3) * pieces
    radius = float(np.linalg.norm(pieces)) / 2
    return _of_link(link, centers, np.full(len(centers), radius), side)
