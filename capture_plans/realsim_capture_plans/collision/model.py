"""Does the arm, with the camera on its flange, keep its distance from itself, table and scene?

The bodies of arm, camera and bracket and the boxes of the work cell go into coal, the chain into
pinocchio, both once; every question is then answered in C++. Distances are exact for the shapes
(GJK and EPA, to 1e-6 m); negative means penetration. Unit: m.

Which bodies can meet: pairs that the design keeps apart or together are never asked.

Left out are neighbouring links (their housings touch); links that the arm's description says are
kept apart by its design; camera, bracket and the last link (one rigid piece, checked once); the
foot and everything that stands still; and every pair of which a sweep shows that its distance does
not depend on the joints, such as shoulder and table.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.robots.arm import RobotArm, arm_of
from realsim.robots.coal_geometry import Body, Collider, Geometry, Pair
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Mount, WorkCell, finite_box, link_placements
from realsim_capture_plans.collision.mount import camera_shape

SWEEP_STEPS = 18
"""Angles of each of two joints over which a pair is swept."""
TURN_STEPS = 72
"""Angles of the last joint, swept alone."""
CONSTANT_M = 0.001
"""A distance that varies less over the sweep is a constant."""
ARM_FAR_M = 0.20
"""Swept pairs that stay farther than this beyond the clearance never meet: half a step of both
joints moves the elbow, 0.65 m out, by 0.2 m."""
WRIST_FAR_M = 0.07
"""The same for the wrists: half a step of both joints moves a mount 0.2 m out by it."""
OVERLAP_M = 0.002
"""A bracket is drawn onto the flange; so much overlap is drawing, not collision."""


class ChosenPairs(NamedTuple):
    """Pairs by group, and how far the camera's body is from the last link."""

    pairs: list[Pair]
    groups: list[str]
    mount_gap_m: float


def choose_pairs(
    arm: RobotArm, bodies: tuple[Body, ...], geometry: Geometry, clearance_m: float
) -> ChosenPairs:
    """Return the pairs that can meet.

    Raises:
        InputError: the mount runs into the wrist, or a box into a part of the arm that never
            leaves it.
    """
    gap = _checked_mount(arm, bodies, geometry)
    pairs: list[Pair] = []
    groups: list[str] = []
    for i, first in enumerate(bodies):
        for j, second in enumerate(bodies[i + 1 :], i + 1):
            if group := _group(arm, first, second):
                pairs.append((i, j))
                groups.append(group)
    left_out = _unchanging(arm, bodies, geometry, pairs, clearance_m)
    kept = [k for k, pair in enumerate(pairs) if pair not in left_out]
    return ChosenPairs([pairs[k] for k in kept], [groups[k] for k in kept], gap)


def _group(arm: RobotArm, first: Body, second: Body) -> str | None:
    """Return the group of a pair, None if the design keeps it apart or together."""
    roles = {first.role, second.role}
    if {"table", "scene"} >= roles:
        return None
    fixed = next((b for b in (first, second) if b.role in ("table", "scene")), None)
    if fixed is not None:
        moving = second if fixed is first else first
        return None if moving.frame == 0 else fixed.role
    low, high = sorted((first.frame, second.frame))
    if roles == {"mount"} or (roles == {"mount", "link"} and low == high):
        return None
    if roles == {"mount", "link"}:
        return "tool"
    return None if high - low <= 1 or (low, high) in arm.kept_apart else "self"


def _checked_mount(arm: RobotArm, bodies: tuple[Body, ...], geometry: Geometry) -> float:
    """Return the camera's distance from the last link [m].

    Raises:
        InputError: the mount is inside the last link or its flange.
    """
    wrist = [k for k, b in enumerate(bodies) if b.role == "link" and b.frame == arm.joints]
    mount = [k for k, b in enumerate(bodies) if b.role == "mount"]
    pairs = [(w, m) for m in mount for w in wrist]
    cover = np.array([bodies[m].cover_m for _, m in pairs])
    gaps = geometry.with_pairs(pairs)(np.zeros((1, arm.joints)))[0]
    is_camera = np.array([bodies[m].part == "camera" for _, m in pairs])
    deep = gaps + cover + np.where(is_camera, 0.0, OVERLAP_M)
    if np.min(deep) < 0:
        # A camera in the wrist takes its bracket along: name the cause.
        camera = is_camera & (deep < 0)
        worst = int(np.argmin(np.where(camera, deep, np.inf) if camera.any() else deep))
        w, m = pairs[worst]
        raise InputError(
            f"the mount's {_named(bodies, m)} is {-(gaps + cover)[worst] * 1e3:.1f} mm inside the "
            f"{bodies[w].part} (the round end of the arm behind the flange, z < 0 in the flange's "
            f"frame). {_mount_advice(bodies[m])}"
        )
    return float(np.min(gaps[is_camera], initial=np.inf))


def _named(bodies: tuple[Body, ...], k: int) -> str:
    """Return a body's part, numbered where the bracket has several."""
    same = [i for i, b in enumerate(bodies) if b.part == bodies[k].part]
    kind = bodies[k].shape.kind
    if len(same) == 1:
        return f"{bodies[k].part} ({kind})"
    return f"{bodies[k].part} piece {same.index(k) + 1} of {len(same)} ({kind})"


def _mount_advice(body: Body) -> str:
    if body.part == "camera":
        return (
            "Check translation_m and the direction of the transform: T_ee_cam places the camera "
            "in the flange, z out of it; an inverted transform looks like this."
        )
    if body.shape.kind == "convex":
        return (
            "A convex piece fills its holes and hooks: split a ring or a clamp into pieces that "
            "are convex themselves, and check the mesh's unit and origin (the flange's centre)."
        )
    return "Draw the bracket from the flange's face (z = 0) outwards."


def _unchanging(
    arm: RobotArm,
    bodies: tuple[Body, ...],
    geometry: Geometry,
    pairs: list[Pair],
    clearance_m: float,
) -> set[Pair]:
    """Return pairs, two joints apart at the most, that never meet or whose distance never changes.

    Raises:
        InputError: such a pair is in contact whatever the joints.
    """
    left_out: set[Pair] = set()
    for first in range(arm.joints):
        swept = [(i, j) for i, j in pairs if _starts_at(bodies[i], bodies[j], first)]
        if not swept:
            continue
        distance = geometry.with_pairs(swept)(_sweep(first, arm.joints))
        _check_sweep(arm, bodies, swept, distance)
        low, high = distance.min(axis=0), distance.max(axis=0)
        far_m = ARM_FAR_M if first < arm.wrist[0] else WRIST_FAR_M
        never = (high - low < CONSTANT_M) | (low > clearance_m + far_m)
        left_out |= {pair for pair, is_never in zip(swept, never, strict=True) if is_never}
    return left_out


def _starts_at(first: Body, second: Body, frame: int) -> bool:
    low, high = sorted((first.frame, second.frame))
    return low == frame and high - low <= 2


def _sweep(first: int, count: int) -> Array:
    """Return joints (M, n) that turn the two joints behind DH frame `first`, or the last one."""
    if first == count - 1:
        q = np.zeros((TURN_STEPS, count))
        q[:, first] = np.linspace(0, 2 * np.pi, TURN_STEPS, endpoint=False)
        return q
    turns = np.linspace(0, 2 * np.pi, SWEEP_STEPS, endpoint=False)
    q = np.zeros((SWEEP_STEPS**2, count))
    q[:, first : first + 2] = np.stack(np.meshgrid(turns, turns), axis=-1).reshape(-1, 2)
    return q


def _check_sweep(
    arm: RobotArm, bodies: tuple[Body, ...], swept: list[Pair], distance: Array
) -> None:
    """Check that what is swept has somewhere to go.

    Raises:
        InputError: a box in a part of the arm, or the mount in the link before the last one, at
            every angle.
    """
    for k, (i, j) in enumerate(swept):
        if bodies[j].role in ("table", "scene") and np.max(distance[:, k]) < 0:
            raise InputError(
                f"'{bodies[j].part}' is inside the arm's {bodies[i].part} at every joint angle, by "
                f"{-np.max(distance[:, k]) * 1e3:.0f} mm at the best. Heights and boxes are in the "
                "controller's base, z = 0 at the arm's foot: correct the height, or let the box "
                "begin beside the arm."
            )
    beside = [k for k, (i, j) in enumerate(swept) if _is_mount_beside(arm, bodies[i], bodies[j])]
    if not beside:
        return
    best = int(np.argmax(distance[:, beside].min(axis=1)))
    k = beside[int(np.argmin(distance[best, beside]))]
    if distance[best, k] < 0:
        i, j = swept[k]
        raise InputError(
            f"the mount's {_named(bodies, j)} is in the {bodies[i].part} at every angle of the "
            f"last joint, by {-distance[best, k] * 1e3:.1f} mm at the best. "
            f"{_mount_advice(bodies[j])}"
        )


def _is_mount_beside(arm: RobotArm, first: Body, second: Body) -> bool:
    return first.frame == arm.joints - 1 and second.role == "mount"


GROUPS = ("self", "tool", "table", "scene")
"""`self`: the arm's links among themselves; `tool`: camera and bracket against the links; `table`;
`scene`: the keep-out box and the obstacles."""
LEAST_FIRST = ("table", "tool", "scene", "self")
"""Order in which `free` asks: what is hit most often first."""


class CollisionModel:
    """Clearances of one arm with one camera mount in one work cell.

    Answers do not depend on what was asked before. One model serves one thread.
    """

    def __init__(self, chain: DhChain, mount: Mount, cell: WorkCell, clearance_m: float) -> None:
        """Build the model.

        Args:
            chain: the arm.
            mount: the camera on the flange.
            cell: what stands round the arm.
            clearance_m: least distance that counts as free [m].

        Raises:
            InputError: no shapes for this arm or camera; a calibration that is another arm's; a
                mount that runs into the wrist; a box round a part of the arm that cannot leave it.
        """
        if not (np.isfinite(clearance_m) and clearance_m >= 0):
            raise InputError(f"clearance_m is {clearance_m}; a length of 0 m or more is needed.")
        arm = arm_of(chain)
        self.chain, self.mount, self.cell = chain, mount, cell
        self.clearance_m = float(clearance_m)
        self._bodies = bodies_of(arm, mount, cell)
        placements = link_placements(arm)
        geometry = Geometry(chain, placements, self._bodies)
        # Which pairs the design keeps apart is seen on the nominal arm: the calibration's
        # millimetres would make constant distances look as if they changed.
        drawn = Geometry(chain.nominal(), np.tile(np.eye(4), (arm.joints + 1, 1, 1)), self._bodies)
        chosen = choose_pairs(arm, self._bodies, drawn, self.clearance_m)
        order = sorted(
            range(len(chosen.pairs)), key=lambda k: (LEAST_FIRST.index(chosen.groups[k]), k)
        )
        self._pairs = [chosen.pairs[k] for k in order]
        self._groups = np.array([chosen.groups[k] for k in order])
        self.mount_gap_m = chosen.mount_gap_m
        """Distance of the camera's body from wrist 3, which never changes [m]."""
        self._distances = geometry.with_pairs(self._pairs)
        self._hits = Collider(self._distances, self.clearance_m)

    @property
    def pairs(self) -> tuple[tuple[str, str, str], ...]:
        """The pairs that are checked: group and the two parts."""
        return tuple(
            (str(group), self._bodies[i].part, self._bodies[j].part)
            for group, (i, j) in zip(self._groups, self._pairs, strict=True)
        )

    def clearance(self, joints: ArrayLike) -> dict[str, Array]:
        """Return the least distance (N,) [m] per group at joints (N, n); negative = penetration.

        The keys are `GROUPS`; a group without pairs that can meet is infinitely far.
        """
        distance = self._distances(_checked_joints(joints, self.chain.joints))
        return {
            group: np.min(distance[:, self._groups == group], axis=1, initial=np.inf)
            for group in GROUPS
        }

    def free(self, joints: ArrayLike) -> Mask:
        """Return (N,) whether joints (N, n) keep the clearance in every group."""
        hits = self._hits
        return np.array(
            [not hits(q) for q in _checked_joints(joints, self.chain.joints)], dtype=bool
        )

    def nearest(self, q: ArrayLike) -> tuple[str, str, str, float]:
        """Return group, the two parts and the distance [m] of the nearest pair at joints (n,)."""
        distance = self._distances(
            _checked_joints(np.asarray(q, dtype=np.float64)[None], self.chain.joints)
        )[0]
        k = int(np.argmin(distance))
        i, j = self._pairs[k]
        return str(self._groups[k]), self._bodies[i].part, self._bodies[j].part, float(distance[k])

    def edges_free(self, q_from: ArrayLike, q_to: ArrayLike, step_rad: float) -> Mask:
        """Return (E,) whether straight joint-space moves (E, n) -> (E, n) stay free.

        The ends are checked first, then the middle, then the quarters, until the first hit: what
        a move runs into is wide, so that a coarse look finds it.

        Args:
            q_from: (E, n) starts [rad].
            q_to: (E, n) goals [rad].
            step_rad: greatest joint step between the configurations that are checked [rad].
        """
        starts, ends = (
            _checked_joints(np.atleast_2d(np.asarray(q)), self.chain.joints) for q in (q_from, q_to)
        )
        if len(starts) != len(ends):
            raise InputError(f"{len(starts)} starts and {len(ends)} goals do not make moves.")
        counts = _counts(starts, ends, step_rad)
        hits = self._hits
        free = np.ones(len(starts), dtype=bool)
        for e, (start, end, n) in enumerate(zip(starts, ends, counts.tolist(), strict=True)):
            samples = start + _coarse_to_fine(n)[:, None] * (end - start)
            free[e] = not any(hits(q) for q in samples)
        return free


def bodies_of(arm: RobotArm, mount: Mount, cell: WorkCell) -> tuple[Body, ...]:
    """Return everything that the model knows: links, camera and bracket, the cell's boxes.

    Raises:
        InputError: no shapes for this arm or camera, or a box that is nowhere near.
    """
    if not arm.shapes:
        raise InputError(
            f"the arm '{arm.name}' has no bodies to be kept apart: neither rods nor blocks in its "
            f"robot.toml, nor shapes in its URDF. Without them nothing can be planned."
        )
    links = [Body(shape, "link") for shape in arm.shapes]
    carried = [
        Body(replace(s, frame=arm.joints), "mount", mount.cover_m)
        for s in (camera_shape(mount), *mount.bracket)
    ]
    table = [Body(finite_box("table", cell.table), "table")]
    scene = [
        Body(finite_box(name, box), "scene")
        for name, box in (("keep-out box", cell.keep_out), *cell.obstacles)
    ]
    return (*links, *carried, *table, *scene)


def interpolate(
    q_from: ArrayLike, q_to: ArrayLike, step_rad: float
) -> tuple[Array, NDArray[np.intp]]:
    """Return configurations (M, n) along straight moves, ends included, and each one's move."""
    a, b = np.atleast_2d(np.asarray(q_from, float)), np.atleast_2d(np.asarray(q_to, float))
    counts = _counts(a, b, step_rad)
    owner = np.repeat(np.arange(len(a)), counts + 1)
    first = np.repeat(np.cumsum(counts + 1) - (counts + 1), counts + 1)
    s = (np.arange(len(owner)) - first) / counts[owner]
    return a[owner] + s[:, None] * (b - a)[owner], owner


def _counts(a: Array, b: Array, step_rad: float) -> NDArray[np.intp]:
    """Return (E,) how many equal steps each move has; one at least."""
    return np.ceil(np.abs(b - a).max(-1) / step_rad).astype(np.intp) + 1


@lru_cache(maxsize=1024)
def _coarse_to_fine(steps: int) -> Array:
    """Return the fractions k / steps, k = 0..steps, ends first and then by bisection."""
    order: list[int] = [0, steps]
    spans: Sequence[tuple[int, int]] = [(0, steps)]
    while spans:
        halves: list[tuple[int, int]] = []
        for low, high in spans:
            middle = (low + high) // 2
            if low < middle < high:
                order.append(middle)
                halves += [(low, middle), (middle, high)]
        spans = halves
    fractions = np.array(order, dtype=np.float64) / steps
    fractions.setflags(write=False)
    return fractions


def _checked_joints(joints: ArrayLike, count: int) -> Array:
    """Return joints (N, n), contiguous.

    Raises:
        InputError: another shape, or numbers that are not finite (which would count as free).
    """
    q = np.ascontiguousarray(joints, dtype=np.float64)
    if q.ndim != 2 or q.shape[1] != count:
        raise InputError(f"joints have the shape {q.shape}; (N, {count}) is needed.")
    if not np.all(np.isfinite(q)):
        raise InputError("joints hold NaN or infinite numbers; finite angles [rad] are needed.")
    return q
