"""Does the arm, with the camera on its flange, keep its distance from itself, table and scene?

Links are capsules (a segment with a radius) fixed in the DH frames, a little fatter than the
published housings; the camera body is two capsules that cover its box, the bracket a third. The
table and the objects' keep-out volume are axis-aligned boxes in base. Distances are exact for the
capsules: closed form between segments, and a golden-section search for segment to box, whose
distance is convex along the segment. Everything is vectorised over configurations. Unit: m.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim_capture_plans.arms.kinematics import DhChain
from realsim_capture_plans.collision.shapes import Box, Mount, WorkCell

Array = NDArray[np.float64]
GROUPS = ("self", "table", "scene")
GOLDEN_STEPS = 16
"""Shrinks a 0.4 m link to 0.2 mm, the greatest error of a capsule-box distance."""
ARM_OFFSETS_M = {"UR5": (0.13585, 0.01615), "UR5e": (0.138, 0.007)}
"""Upper arm and forearm stand this far along the shoulder's axis (ur_description kinematics)."""
CAMERA_HALF_M = (0.021, 0.021, 0.0115)
"""Half the D405's body, 42 x 42 x 23 mm (datasheet)."""
CAMERA_BODY_CENTER_M = (0.009, 0.0, -0.0078)
"""Centre of the D405's body in `cam`: the frame sits in the left imager, 3.7 mm behind the glass
(datasheet)."""
CAMERA_CAPSULE_RADIUS_M = 0.020
"""Covers a quarter of the body's face and its depth: sqrt(10.5^2 + 10.5^2 + 11.5^2) = 18.8 mm."""
BRACKET_RADIUS_M = 0.012
"""A bracket about 24 mm wide from the flange's centre to the camera."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Capsule:
    """A segment with a radius, fixed in one DH frame."""

    part: str
    frame: int
    """0 = base, i = DH frame i."""
    start: tuple[float, float, float]
    """[m] in the frame."""
    end: tuple[float, float, float]
    """[m] in the frame."""
    radius: float
    """[m]"""


def arm_capsules(chain: DhChain) -> list[Capsule]:
    """Return the arm's own capsules; radii from the housings' diameters, rounded up.

    Raises:
        InputError: the arm's link offsets are not known.
    """
    if chain.name not in ARM_OFFSETS_M:
        raise InputError(
            f"no collision model for '{chain.name}'; there is one for {', '.join(ARM_OFFSETS_M)}."
        )
    upper, fore = ARM_OFFSETS_M[chain.name]
    a2, a3 = -chain.a[1], -chain.a[2]
    d1, d4, d5, d6 = (float(chain.d[i]) for i in (0, 3, 4, 5))

    def capsule(
        part: str, frame: int, start: Sequence[float], end: Sequence[float], radius: float
    ) -> Capsule:
        (x0, y0, z0), (x1, y1, z1) = start, end
        return Capsule(part=part, frame=frame, start=(x0, y0, z0), end=(x1, y1, z1), radius=radius)

    return [
        capsule("base", 0, (0, 0, 0), (0, 0, d1 - 0.02), 0.075),
        capsule("shoulder", 1, (0, 0, 0), (0, 0, upper), 0.065),
        # The root of the upper arm stands beside the table at a height that never changes.
        capsule("root", 2, (a2, 0, upper), (a2 - 0.1, 0, upper), 0.065),
        capsule("upper arm", 2, (a2 - 0.1, 0, upper), (0, 0, upper), 0.060),
        capsule("elbow", 2, (0, 0, upper), (0, 0, fore), 0.060),
        capsule("forearm", 3, (a3, 0, fore), (0.16, 0, fore), 0.055),
        capsule("forearm end", 3, (0.16, 0, fore), (0, 0, fore), 0.047),
        capsule("wrist 1", 4, (0, -(d4 - fore), 0), (0, 0, 0), 0.048),
        capsule("wrist 2", 5, (0, d5, 0), (0, 0, 0), 0.048),
        capsule("wrist 3", 6, (0, 0, -d6), (0, 0, -0.04), 0.040),
    ]


def camera_capsules(T_ee_cam: ArrayLike) -> list[Capsule]:
    """Return the capsules of the camera body and its bracket for a mount (4, 4)."""
    T = np.asarray(T_ee_cam, dtype=np.float64)
    center = np.array(CAMERA_BODY_CENTER_M)
    hx, hy = CAMERA_HALF_M[0] / 2, CAMERA_HALF_M[1] / 2

    def ee(point: ArrayLike) -> tuple[float, float, float]:
        x, y, z = se3.transform(T, np.asarray(point, dtype=np.float64)[None])[0].tolist()
        return x, y, z

    halves = [
        Capsule(
            part="camera",
            frame=6,
            start=ee(center + np.array([-hx, y, 0])),
            end=ee(center + np.array([hx, y, 0])),
            radius=CAMERA_CAPSULE_RADIUS_M,
        )
        for y in (-hy, hy)
    ]
    bracket = Capsule(
        part="bracket", frame=6, start=(0, 0, 0), end=ee(center), radius=BRACKET_RADIUS_M
    )
    return [*halves, bracket]


SELF_PAIRS = {
    "base": ("forearm", "forearm end", "wrist 1", "wrist 2", "wrist 3", "camera", "bracket"),
    "shoulder": ("forearm end", "wrist 1", "wrist 2", "wrist 3", "camera", "bracket"),
    "root": ("wrist 1", "wrist 2", "wrist 3", "camera", "bracket"),
    "upper arm": ("wrist 1", "wrist 2", "wrist 3", "camera", "bracket"),
    "elbow": ("wrist 2", "wrist 3", "camera", "bracket"),
    "forearm": ("wrist 3", "camera", "bracket"),
    "forearm end": ("wrist 3", "camera", "bracket"),
    "wrist 1": ("camera", "bracket"),
    "wrist 2": ("camera",),
}
"""Parts that can meet. Left out: neighbours, and parts that turn about parallel axes at a distance
that the design fixes (upper arm - forearm, forearm - wrist 2, wrist 1 - wrist 3)."""
TABLE_EXEMPT = ("base", "shoulder", "root")
"""Parts whose height above the table never changes: the arm stands on it."""


class CollisionModel:
    """Clearances of one arm with one camera mount over one table and one keep-out box."""

    def __init__(self, chain: DhChain, mount: Mount, cell: WorkCell, clearance_m: float) -> None:
        """Build the model.

        Args:
            chain: the arm.
            mount: the camera on the flange.
            cell: what stands round the arm.
            clearance_m: least distance that counts as free [m].
        """
        self.chain = chain
        self.clearance_m = clearance_m
        capsules = arm_capsules(chain) + camera_capsules(mount.T_ee_cam)
        parts = [c.part for c in capsules]
        self._frame = np.array([c.frame for c in capsules])
        self._start = np.array([c.start for c in capsules], dtype=np.float64)
        self._end = np.array([c.end for c in capsules], dtype=np.float64)
        self._radius = np.array([c.radius for c in capsules])
        pairs = [
            (i, j)
            for i, first in enumerate(parts)
            for j, second in enumerate(parts)
            if second in SELF_PAIRS.get(first, ())
        ]
        self._pairs = np.array(pairs)
        self._free_parts = np.array([i for i, p in enumerate(parts) if p not in TABLE_EXEMPT])
        self._boxes = {"table": cell.table, "scene": cell.keep_out}

    def clearance(self, joints: ArrayLike) -> dict[str, Array]:
        """Return the least distance (N,) [m] per group at joints (N, 6); negative = penetration.

        Groups: `self` between parts of the arm, `table`, `scene` (the keep-out box).
        """
        start, end = self._segments(np.asarray(joints, dtype=np.float64))
        return {group: self._group(group, start, end) for group in GROUPS}

    def free(self, joints: ArrayLike) -> NDArray[np.bool_]:
        """Return (N,) whether joints (N, 6) keep the clearance in every group."""
        q = np.asarray(joints, dtype=np.float64)
        start, end = self._segments(q)
        alive = np.arange(len(q))
        for group in ("table", "scene", "self"):
            if len(alive):
                distance = self._group(group, start[alive], end[alive])
                alive = alive[distance >= self.clearance_m]
        result = np.zeros(len(q), dtype=bool)
        result[alive] = True
        return result

    def edges_free(self, q_from: ArrayLike, q_to: ArrayLike, step_rad: float) -> NDArray[np.bool_]:
        """Return (E,) whether straight joint-space moves (E, 6) -> (E, 6) stay free.

        Args:
            q_from: (E, 6) starts [rad].
            q_to: (E, 6) goals [rad].
            step_rad: greatest joint step between the configurations that are checked [rad].
        """
        samples, owner = interpolate(q_from, q_to, step_rad)
        hits = np.bincount(
            owner, weights=~self.free(samples), minlength=len(np.atleast_2d(np.asarray(q_from)))
        )
        return hits == 0

    def _segments(self, q: Array) -> tuple[Array, Array]:
        """Return the capsules' end points (N, C, 3) in base."""
        frames = self.chain.link_frames(q)[:, self._frame]
        R, t = frames[..., :3, :3], frames[..., :3, 3]
        return (
            np.einsum("ncij,cj->nci", R, self._start) + t,
            np.einsum("ncij,cj->nci", R, self._end) + t,
        )

    def _group(self, group: str, start: Array, end: Array) -> Array:
        if group == "self":
            i, j = self._pairs.T
            gap = segment_distance(start[:, i], end[:, i], start[:, j], end[:, j])
            return np.min(gap - (self._radius[i] + self._radius[j]), axis=1)
        parts = self._free_parts
        gap = segment_box_distance(start[:, parts], end[:, parts], self._boxes[group])
        return np.min(gap - self._radius[parts], axis=1)


def interpolate(
    q_from: ArrayLike, q_to: ArrayLike, step_rad: float
) -> tuple[Array, NDArray[np.intp]]:
    """Return configurations (M, 6) along straight moves, ends included, and each one's move."""
    a, b = np.atleast_2d(np.asarray(q_from, float)), np.atleast_2d(np.asarray(q_to, float))
    counts = np.ceil(np.abs(b - a).max(-1) / step_rad).astype(np.intp) + 1
    owner = np.repeat(np.arange(len(a)), counts + 1)
    first = np.repeat(np.cumsum(counts + 1) - (counts + 1), counts + 1)
    s = (np.arange(len(owner)) - first) / counts[owner]
    return a[owner] + s[:, None] * (b - a)[owner], owner


def segment_distance(p1: Array, q1: Array, p2: Array, q2: Array) -> Array:
    """Return the least distance (...) between segments p1-q1 and p2-q2 (..., 3).

    Closed form with clamping: Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e = np.sum(d1 * d1, -1), np.sum(d2 * d2, -1)
    b, c, f = np.sum(d1 * d2, -1), np.sum(d1 * r, -1), np.sum(d2 * r, -1)
    tiny = 1e-15
    denominator = a * e - b * b
    parallel = denominator <= 1e-12 * np.maximum(a * e, tiny)
    s = np.where(
        parallel, 0.0, np.clip((b * f - c * e) / np.where(parallel, 1.0, denominator), 0.0, 1.0)
    )
    t = np.clip((b * s + f) / np.maximum(e, tiny), 0.0, 1.0)
    s = np.clip((b * t - c) / np.maximum(a, tiny), 0.0, 1.0)
    return np.linalg.norm(r + s[..., None] * d1 - t[..., None] * d2, axis=-1)


def box_distance(points: Array, box: Box) -> Array:
    """Return the signed distance (...) of points (..., 3) to a box; negative inside. Convex."""
    outside = np.maximum(np.array(box.lower) - points, points - np.array(box.upper))
    return np.linalg.norm(np.maximum(outside, 0.0), axis=-1) + np.minimum(outside.max(-1), 0.0)


def segment_box_distance(start: Array, end: Array, box: Box) -> Array:
    """Return the least signed distance (...) of segments (..., 3) to a box, to 0.2 mm."""
    ratio = (np.sqrt(5.0) - 1.0) / 2.0
    direction = end - start

    def at(t: Array) -> Array:
        return box_distance(start + t[..., None] * direction, box)

    low, high = np.zeros(start.shape[:-1]), np.ones(start.shape[:-1])
    left, right = high - ratio * (high - low), low + ratio * (high - low)
    f_left, f_right = at(left), at(right)
    best = np.minimum(np.minimum(at(low), at(high)), np.minimum(f_left, f_right))
    for _ in range(GOLDEN_STEPS):
        go_left = f_left < f_right
        low, high = np.where(go_left, low, left), np.where(go_left, right, high)
        probe = np.where(go_left, high - ratio * (high - low), low + ratio * (high - low))
        f_probe = at(probe)
        left, right = np.where(go_left, probe, right), np.where(go_left, left, probe)
        f_left, f_right = np.where(go_left, f_probe, f_right), np.where(go_left, f_left, f_probe)
        best = np.minimum(best, f_probe)
    return best
