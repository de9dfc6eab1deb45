"""Denavit-Hartenberg numbers of any chain of turning joints.

Every pair of neighbouring axes has a common normal, so that the transform from one joint's frame
(z is its axis) to the next one's is

    O = Tz(b) Rz(phi) Tx(a) Rx(alpha) Rz(psi) Tz(c)

The screws about z at both ends commute with the joints' own turns and join theirs. The normal may
point either way, and between parallel axes it may stand anywhere along them.
"""

import math
from typing import NamedTuple

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.dh import DhArm

PARALLEL_RAD = 1e-6
"""Axes nearer to parallel than this count as parallel [rad]: 1 micrometre at the arm's length.
Their common normal would lie a thousand kilometres away, where 64 bits do not hold micrometres."""
RIGHT_ANGLE_RAD = 1e-5
"""Angles nearer than this to a multiple of a right angle are one: files write 1.5708."""
ROUND_M = 9
"""Digits of a length [m]: nanometres."""


class Screws(NamedTuple):
    """O = Tz(b) Rz(phi) Tx(a) Rx(alpha) Rz(psi) Tz(c)."""

    b: float
    phi: float
    a: float
    alpha: float
    psi: float
    c: float


def normals(T: Array) -> tuple[Array, bool]:
    """Return the common normal (3,) of z and T's z axis, and whether they are parallel."""
    z, axis, p = np.array([0.0, 0.0, 1.0]), T[:3, 2], T[:3, 3]
    normal = np.cross(z, axis)
    sine = float(np.linalg.norm(normal))
    if sine > PARALLEL_RAD:
        return normal / sine, False
    flat = np.array([p[0], p[1], 0.0])
    length = float(np.linalg.norm(flat))
    return (flat / length if length > PARALLEL_RAD else np.array([1.0, 0.0, 0.0])), True


def screws(T: Array, normal: Array, parallel: bool, b: float) -> Screws:
    """Return the screws of a transform (4, 4) along a common normal.

    Args:
        T: from a joint's frame to the next one's.
        normal: of `normals`, or its opposite.
        parallel: whether the axes are; then the normal stands at `b`.
        b: where along the first axis the normal of parallel axes stands [m].
    """
    z, axis, p = np.array([0.0, 0.0, 1.0]), T[:3, 2], T[:3, 3]
    alpha = math.atan2(float(np.cross(z, axis) @ normal), float(axis[2]))
    if parallel:
        alpha = 0.0 if axis[2] > 0 else math.pi
        c = (float(p[2]) - b) * float(np.sign(axis[2]))
    else:
        b, _, c = np.linalg.solve(np.stack([z, normal, axis], -1), p).tolist()
    phi = math.atan2(float(normal[1]), float(normal[0]))
    R_rest = se3.exp_so3([-alpha, 0.0, 0.0]) @ se3.exp_so3([0.0, 0.0, -phi]) @ T[:3, :3]
    psi = math.atan2(float(R_rest[1, 0]), float(R_rest[0, 0]))
    return Screws(b, phi, float(p @ normal), alpha, psi, c)


def dh_of_chain(name: str, steps: Array) -> DhArm:
    """Return the arm `steps[0] Rz(q1) steps[1] Rz(q2) ... Rz(qn) steps[n]`.

    Normals point so that the joints' zeros are moved least, and between parallel axes they stand
    where the link before ends: a UR's numbers come out as its maker writes them. Angles within
    `RIGHT_ANGLE_RAD` of right ones are right, lengths are rounded to nanometres.

    Args:
        name: the arm's.
        steps: (n + 1, 4, 4) from the base to the first joint's frame, from joint to joint, and from
            the last joint to the flange, joints at zero [m].
    """
    n = len(steps) - 1
    numbers = {key: np.zeros(n) for key in ("theta", "d", "a", "alpha")}
    T_base_0, psi, c = _beginning(steps[0])
    for i in range(n):
        T = steps[i + 1]
        normal, parallel = normals(T)
        if i == n - 1 and parallel and np.hypot(*T[:2, 3]) < PARALLEL_RAD:
            # The flange on the last axis: its x is the normal, and nothing is left over.
            found = screws(T, _flat(T[:3, 0]), True, float(T[2, 3]))
        else:
            found = min(
                (screws(T, way, parallel, -c) for way in (normal, -normal)),
                key=lambda s: abs(_wrapped(psi + s.phi + 1e-9)),
            )
        numbers["theta"][i], numbers["d"][i] = _wrapped(psi + found.phi), c + found.b
        numbers["a"][i], numbers["alpha"][i] = found.a, found.alpha
        psi, c = found.psi, found.c
    T_n_ee = se3.from_rt(se3.exp_so3([0.0, 0.0, _right(psi)]), [0.0, 0.0, round(c, ROUND_M)])
    return DhArm(
        name=name,
        a=numbers["a"].round(ROUND_M) + 0.0,
        d=numbers["d"].round(ROUND_M) + 0.0,
        alpha=np.array([_right(x) for x in numbers["alpha"]]),
        theta=np.array([_right(x) for x in numbers["theta"]]),
        T_base_0=T_base_0,
        T_n_ee=T_n_ee,
    )


def _beginning(T: Array) -> tuple[Array, float, float]:
    """Return T_base_0, and what the first joint takes over of a turn and a shift about its axis."""
    tilt = max(float(np.abs(T[:3, 2] - [0, 0, 1]).max()), float(np.abs(T[:2, 3]).max()))
    if tilt > PARALLEL_RAD:
        return np.array(T), 0.0, 0.0
    return np.eye(4), math.atan2(float(T[1, 0]), float(T[0, 0])), float(T[2, 3])


def _flat(x: Array) -> Array:
    return np.array([x[0], x[1], 0.0]) / np.hypot(x[0], x[1])


def _wrapped(angle: float) -> float:
    """Return the angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


def _right(angle: float) -> float:
    """Return the angle, exactly a right one's multiple if it is nearly one."""
    quarter = round(angle / (math.pi / 2))
    near = quarter * (math.pi / 2)
    return near if abs(angle - near) < RIGHT_ANGLE_RAD else angle
