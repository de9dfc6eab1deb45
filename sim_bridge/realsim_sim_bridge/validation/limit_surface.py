"""Coulomb's limit for a rigid object held at points: the load at which it slips.

Each point carries a normal load n_i, given and fixed, and at most the friction mu n_i, against the
direction in which it slides. A load that acts in the pad's plane, wrench w = (torque about the
pad's normal, force in the plane), is carried up to the factor (the upper bound theorem of
plasticity; Goyal, Ruina & Papadopoulos 1991, "Planar sliding with dry friction")

    lambda = min over planar twists t with w . t = 1 of  sum_i mu n_i |v + omega J p_i|

that is the friction's power against the load's, at the easiest motion. For a pure force through the
centre it is mu sum n_i / |force|, for a pure torque mu sum n_i |p_i| / |torque|; loads beside the
centre turn the object about an instantaneous centre between the two, and that is what is searched.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SWEEPS = 400
"""Steps of the reweighted least squares; 60 reach 1e-6 away from a corner of the limit surface."""
STILL = 1e-13
"""Relative change of the twist at which the search ends."""
SMALLEST_M_S = 1e-9
"""Slower points weigh no more than at this speed, in units of the fastest: no division by 0."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrictionPatch:
    """Points that hold an object by friction, in the plane of the pads."""

    points_m: Array
    """(P, 2) [m]."""
    friction_n: Array
    """(P,) largest friction of each, mu n_i [N]."""

    def slip_load(self, load: ArrayLike) -> float:
        """Return the factor by which a load can grow until the object slips; inf for no load.

        Args:
            load: (3,) torque about the plane's normal, at the origin [N m], and force (2,) [N]. The
                torque is positive from the first axis to the second.
        """
        w = np.asarray(load, dtype=np.float64)
        if not np.any(w):
            return float("inf")
        # In units of the pad, so that turning and sliding weigh alike.
        length = float(np.linalg.norm(self.points_m, axis=1).max()) or 1.0
        w = w / [length, 1.0, 1.0]
        rows = self._sliding(length)
        twists = [self._easiest(rows, w), *_turns_about(rows, w)]
        return min(self._power(rows, t) / float(w @ t) for t in twists)

    def _sliding(self, length: float) -> Array:
        """Return S (P, 2, 3): the velocity of each point is S_i (omega length, v)."""
        x, z = self.points_m.T / length
        one, zero = np.ones_like(x), np.zeros_like(x)
        return np.stack(
            [np.stack([-z, one, zero], axis=-1), np.stack([x, zero, one], axis=-1)], axis=1
        )

    def _power(self, rows: Array, twist: Array) -> float:
        """Return the power of friction [W] at a twist (3,)."""
        return float(self.friction_n @ np.linalg.norm(rows @ twist, axis=1))

    def _easiest(self, rows: Array, w: Array) -> Array:
        """Return the twist (3,) of least power among those with w . t = 1.

        Reweighted least squares (Weiszfeld 1937): with weights mu n_i / |v_i| of the last twist the
        sum is a quadratic form t^T Q t, whose least value has t parallel to Q^-1 w.
        """
        twist = w / (w @ w)
        for _ in range(SWEEPS):
            speeds = np.linalg.norm(rows @ twist, axis=1)
            if not np.any(speeds):
                return twist
            weights = self.friction_n / np.maximum(speeds, SMALLEST_M_S * speeds.max())
            Q = np.einsum("p,pij,pik->jk", weights, rows, rows)
            # A patch on a line or in a point does not resist every twist.
            before, twist = twist, np.linalg.pinv(Q) @ w
            twist /= w @ twist
            if np.abs(twist - before).max() <= STILL * np.abs(twist).max():
                break
        return twist


def _turns_about(rows: Array, w: Array) -> list[Array]:
    """Return the twists (3,) with w . t = 1 about each point: corners, which descent is slow at."""
    twists: list[Array] = []
    for S in rows:
        turn = np.cross(S[0], S[1])
        power = float(w @ turn)
        if abs(power) > 1e-12 * np.linalg.norm(w):
            twists.append(turn / power)
    return twists


def hand_patch(points_m: Array, force_n: float, friction: float) -> FrictionPatch:
    """Return the patch of two facing fingers whose points (P, 2) [m] share the force evenly."""
    count = len(points_m)
    return FrictionPatch(
        points_m=points_m, friction_n=np.full(count, 2.0 * friction * force_n / count)
    )
