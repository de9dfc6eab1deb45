"""Which bodies can meet: pairs that the design keeps apart or together are never asked.

Left out are neighbouring links (their housings touch); links that the arm's description says are
kept apart by its design; camera, bracket and the last link (one rigid piece, checked once); the
foot and everything that stands still; and every pair of which a sweep shows that its distance does
not depend on the joints, such as shoulder and table.
"""

from typing import NamedTuple

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.robots.arm import RobotArm
from realsim.robots.coal_geometry import Body, Geometry, Pair

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
