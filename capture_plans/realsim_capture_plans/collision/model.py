"""Does the arm, with the camera on its flange, keep its distance from itself, table and scene?

The bodies of arm, camera and bracket and the boxes of the work cell go into coal, the chain into
pinocchio, both once; every question is then answered in C++. Distances are exact for the shapes
(GJK and EPA, to 1e-6 m); negative means penetration. Unit: m.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.robots.arm import RobotArm, arm_of
from realsim.robots.coal_geometry import Body, Collider, Geometry
from realsim.robots.kinematics import DhChain
from realsim.robots.link_shapes import finite_box, link_placements
from realsim.robots.shapes import Mount, WorkCell
from realsim_capture_plans.collision.mount import camera_shape
from realsim_capture_plans.collision.pairs import choose_pairs

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
