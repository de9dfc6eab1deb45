"""Joints beside poses: which robot, which units and which tool offset make them agree.

Joint angles and tool poses of the same moments leave no doubt: read as they were meant, they differ
by one constant transform, the tool offset; read in any other way they differ by centimetres.
"""

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.arm import known_chains
from realsim.robots.kinematics import DhChain

JointUnit = Literal["rad", "deg"]
FULL_TURN_RAD = 2 * np.pi
"""No joint of the usual arms turns farther than this from zero."""
ROUNDING_RAD = 0.02
"""A controller reports a joint at its limit up to a degree beyond it."""
MILLIMETRES_FROM_M = 3.0
"""Coordinates beyond this are not metres: no arm that is known here reaches half as far."""
LEAST_TURN_DEG = 6.5
"""A path in which no joint ever exceeds this many degrees hardly moves; angles that are all smaller
are radians."""
FITS_M = 0.010
"""Tool poses that fit to this are this robot's [m]: nominal kinematics of a real arm are 1 to 5 mm
off, another model's 28 mm or more after the best tool offset."""
FITS_DEG = 3.0
"""Orientations beyond this [deg] were written in another form; the positions prove the joints."""
CLEARLY = 3.0
"""Another robot's reading is this many times worse, otherwise the poses decide nothing."""
NOMINAL_OFF_M = 0.005
"""Error of another robot's reading below which the poses decide nothing either [m]: a real arm may
be this far from its own nominal numbers."""
EXACT_M = 1e-4
"""Poses computed from the same joints agree to this [m], however they were rounded."""
NOMINAL = 1e-6
"""A robot of a known name has that model's nominal numbers to this [m or rad]."""
TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
"""ROS base_link in the controller's base."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Reading:
    """One way to read joints and poses, and how well it makes them agree."""

    chain: DhChain
    """The arm that is assumed."""
    joint_unit: JointUnit
    """The unit that the joints are assumed to be in."""
    length_unit: Literal["m", "mm"]
    """The unit that the positions are assumed to be in."""
    base: Literal["base", "base_link"]
    """The frame that the poses are assumed to be in: the controller's base or ROS base_link."""
    T_ee_tcp: Array
    """(4, 4) tool offset that fits best [m]; the identity where none was fitted."""
    gap_m: float
    """Median distance that is left between the positions [m]."""
    gap_deg: float
    """Median angle that is left between the orientations [deg]."""
    worst: int
    """The row that fits worst."""
    worst_m: float
    """Its distance [m]."""

    def text(self) -> str:
        """Return the reading and its fit in words."""
        where = "" if self.base == "base" else ", poses in ROS's base_link"
        if self.gap_deg > FITS_DEG:
            where += ", orientations that are no rotation vectors"
        return (
            f"a {self.chain.name}, joints in {self.joint_unit}, positions in {self.length_unit}"
            f"{where}: {1e3 * self.gap_m:.1f} mm, {self.gap_deg:.2f} deg"
        )


def same_arm(first: DhChain, second: DhChain) -> bool:
    """Return whether two chains are one in all nominal numbers, as a Panda's and an FR3's are."""
    parts = ("a", "d", "alpha", "theta", "T_base_0", "T_n_ee")
    return first.joints == second.joints and all(
        np.abs(getattr(first, p) - getattr(second, p)).max() <= NOMINAL for p in parts
    )


def readings(joints: Array, Ts: Array, chains: tuple[DhChain, ...], *, tool: bool) -> list[Reading]:
    """Return every way to read joints (N, n) and poses (N, 4, 4), the best first.

    Args:
        joints: as they were written.
        Ts: poses as they were written, in the base.
        chains: the arms that it may have been.
        tool: fit a constant tool offset, otherwise the poses are the flange's.
    """
    found: list[Reading] = []
    units: tuple[JointUnit, ...] = ("rad", "deg")
    for chain, unit in product(chains, units):
        q = joints if unit == "rad" else np.radians(joints)
        if np.any(np.abs(q) > FULL_TURN_RAD + ROUNDING_RAD):
            continue
        T_flange_base = se3.invert(chain.forward(q))
        for length, base in product(("m", "mm"), ("base", "base_link")):
            Ts_base = np.array(Ts)
            Ts_base[:, :3, 3] *= 1.0 if length == "m" else 1e-3
            offsets = T_flange_base @ (Ts_base if base == "base" else TURNED @ Ts_base)
            T = np.eye(4)
            if tool:
                R = se3.mean_rotation(offsets[:, :3, :3])
                T = se3.from_rt(R, np.median(offsets[:, :3, 3], axis=0))
            gaps = np.linalg.norm(offsets[:, :3, 3] - T[:3, 3], axis=-1)
            angles = np.degrees(np.asarray(se3.angle(T[:3, :3].T @ offsets[:, :3, :3])))
            reading = Reading(
                chain=chain,
                joint_unit=unit,
                length_unit=length,
                base=base,
                T_ee_tcp=T,
                gap_m=float(np.median(gaps)),
                gap_deg=float(np.median(angles)),
                worst=int(np.argmax(gaps)),
                worst_m=float(gaps.max()),
            )
            found.append(reading)
    # What makes metres of millimetres and radians of degrees lets all positions fall together, and
    # small gaps are then no proof: orientations that fit go first.
    return sorted(found, key=lambda r: (r.gap_m > FITS_M, r.gap_deg > FITS_DEG, r.gap_m))


def why_poses_disagree(joints: ArrayLike, Ts_base_ee: ArrayLike, chain: DhChain) -> str:
    """Return in words why flange poses (N, 4, 4) do not follow from joints (N, n) by this chain."""
    q, Ts = np.asarray(joints, dtype=np.float64), np.asarray(Ts_base_ee, dtype=np.float64)
    others = tuple(c for c in known_chains(chain.joints).values() if c.name != chain.name)
    found = readings(q, Ts, (chain, *others), tool=False)
    best = found[0] if found else None
    if best is None or best.gap_m > EXACT_M:
        nominal = readings(q, Ts, tuple(known_chains(chain.joints).values()), tool=False)
        if nominal and nominal[0].gap_m <= FITS_M:
            best = nominal[0]
    if best is None or best.gap_m > FITS_M:
        return (
            "no known robot model and no wrong unit explains it: joints, poses or their order "
            "were changed"
        )
    causes: list[str] = []
    if best.chain.name != chain.name:
        causes.append(f"these joints and poses fit a {best.chain.name}")
    elif best.gap_m > EXACT_M or best.chain is not chain:
        causes.append("the poses are those of another calibration of this model")
    if best.joint_unit == "deg":
        causes.append("the joints are in degrees; radians are needed")
    if best.length_unit == "mm":
        causes.append("the poses are in millimetres; metres are needed")
    if best.base == "base_link":
        causes.append("the poses are in ROS's base_link, turned by 180 deg about z")
    odd = f"view {best.worst} differs most, by {1e3 * best.worst_m:.2f} mm"
    return "; ".join(causes or [odd])


def proven_reading(
    joints: ArrayLike, Ts_base_tcp: ArrayLike, chain: DhChain | None, source: str
) -> Reading:
    """Return how joints (N, n) and tool poses (N, 4, 4) must be read.

    Args:
        joints: as they were written.
        Ts_base_tcp: tool poses as they were written, rotations as matrices.
        chain: the arm that it has to be; None finds out.
        source: what the data is called in errors.

    Raises:
        InputError: nothing fits, the poses decide nothing, or they are another robot's.
    """
    q, Ts = np.asarray(joints, dtype=np.float64), np.asarray(Ts_base_tcp, dtype=np.float64)
    alike = known_chains(q.shape[-1])
    known = tuple(c for c in alike.values() if chain is None or c.name != chain.name)
    found = readings(q, Ts, known if chain is None else (chain, *known), tool=True)
    if not found or found[0].gap_m > FITS_M:
        best = f" The best is {found[0].text()}." if found else ""
        raise InputError(
            f"{source}: its joints and its tool poses do not belong together, whatever the robot "
            f"({', '.join(alike)}), the units and the tool offset.{best} Check that no "
            "column is missing and that poses and joints are of the same moments."
        )
    best = found[0]
    if chain is not None and best.chain is not chain:
        own = next((r for r in found if r.chain is chain), None)
        if own is not None and own.gap_m <= min(FITS_M, max(CLEARLY * best.gap_m, NOMINAL_OFF_M)):
            return own
        ours = "" if own is None else f", for a {chain.name} {1e3 * own.gap_m:.0f} mm are left"
        raise InputError(
            f"{source} is a path of another robot: its joints and tool poses fit {best.text()}"
            f"{ours}. Driven by a {chain.name} the camera would be elsewhere. Choose --arm "
            f"{best.chain.name}, or take a path of this robot."
        )
    turned = [r for r in found if best.gap_deg > FITS_DEG or r.gap_deg <= FITS_DEG]
    second = next((r for r in turned if not same_arm(r.chain, best.chain)), None)
    undecided = max(CLEARLY * best.gap_m, NOMINAL_OFF_M)
    if chain is None and second is not None and second.gap_m < undecided:
        raise InputError(
            f"{source}: its poses do not tell which robot it is: {best.text()}, and "
            f"{second.text()}. Name it with --arm."
        )
    return best


def check_joint_unit(rows: Array, unit: JointUnit, names: list[str], source: str) -> None:
    """Raise if joints (N, n) can hardly be in the unit that they claim.

    Args:
        rows: joints as they were written.
        unit: what they claim to be in.
        names: what each row is called in errors.
        source: what the file is called in errors.

    Raises:
        UnitError: radians beyond a full turn, or degrees that hardly move.
    """
    from realsim.errors import UnitError

    size = np.abs(rows)
    i, j = np.unravel_index(int(np.argmax(size)), size.shape)
    largest = f"{names[i]}, joint {j + 1} of {rows.shape[1]} is {rows[i, j]:.6g}"
    if unit == "rad" and size[i, j] > FULL_TURN_RAD + ROUNDING_RAD:
        raise UnitError(
            f"{source}: joints that should be in radians look like degrees: {largest}, and no "
            "joint turns farther than 2 pi = 6.283 rad. Convert them, or name the unit deg."
        )
    if unit == "deg" and len(rows) > 1 and size[i, j] < LEAST_TURN_DEG:
        raise UnitError(
            f"{source}: joints that should be in degrees look like radians: the largest is "
            f"{largest}; an arm within {LEAST_TURN_DEG:.0f} degrees of zero lies stretched on the "
            "table. Name the unit rad."
        )
