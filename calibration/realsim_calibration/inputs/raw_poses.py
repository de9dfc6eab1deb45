"""Poses as a file holds them, what the file says of them, and what its numbers admit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError, NotRigidError, UnitError
from realsim.geometry.se3 import RIGID_TOLERANCE
from realsim.records.checked_arrays import freeze
from realsim_calibration.inputs.readings import (
    EULER_ORDERS,
    MATRIX_TOLERANCE,
    AngleUnit,
    LengthUnit,
    PoseReading,
)

ANGLE_ROTATIONS: tuple[str, ...] = ("rotation_vector", *(f"euler_{o}" for o in EULER_ORDERS))
"""Every rotation that is three angles."""
QUATERNIONS = ("quaternion_xyzw", "quaternion_wxyz")
MATRICES = ("matrix", "matrix_column_major")
FULL_TURN = 2 * np.pi
METRES_BELOW = 5.0
"""A median distance below it is in metres: 5 mm would put the hand inside its own base."""
MILLIMETRES_ABOVE = 20.0
"""A median distance above it is in millimetres: 20 m is beyond every arm."""
TINY_RAD = 0.2
"""If no angle exceeds it, radians and degrees both mean a hand that hardly turns."""
MOST_DEG = 720.0
"""Beyond it a number is no angle."""
SHARE = 0.8
"""Share of the rows that must pass a test for the format to be admitted; the others are named
as bad rows when the reading is applied."""
SAME_PLACE_M = 1e-3
"""Three poses and more within this distance of the base are a unit taken wrongly."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Said:
    """What a file says of its numbers by names, nesting or units; None = nothing."""

    rotations: tuple[str, ...] | None = None
    """The rotation formats that its names leave open."""
    position_first: bool | None = None
    """True where names tell the position: the record then has it first, whatever the file's order
    is, and a reading's position_first does not matter."""
    angle_unit: AngleUnit | None = None
    length_unit: LengthUnit | None = None
    sentences: tuple[str, ...] = ()
    """The same in words, with the names that say it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RawPoses:
    """Poses as a file holds them, in the file's order."""

    path: Path
    values: Array
    """(n, k) the numbers that are the pose; NaN rows were not measured."""
    columns: tuple[str, ...]
    """(k,) names as far as the file says them ("x", "qw"); "" where it does not."""
    labels: tuple[str | None, ...]
    """(n,) name of the image that the file gives with each pose, or None."""
    stems: tuple[str, ...]
    """(n,) name or number of the pose itself (its file's stem, its key, its index); "" = none."""
    where: tuple[str, ...]
    """(n,) where each pose stands, for messages: "line 12", "entry 3", "poses/3.yaml"."""
    joints: Array | None
    """(n, j) joint angles [rad]; None where the file has none."""
    times: Array | None = None
    """(n,) time stamps [s]; None where the file has none."""
    said: Said
    possible: tuple[PoseReading, ...]
    """Every reading that the names and the numbers admit, the commonest first."""
    notes: tuple[str, ...] = ()
    """What was decided while reading, and why."""

    def __post_init__(self) -> None:
        """Check that all rows are there and freeze the arrays."""
        n = len(self.where)
        freeze(self, values=(n, None), joints=(n, None), times=(n,))

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.values)

    @property
    def measured(self) -> Mask:
        """(n,) whether all numbers of the pose are finite."""
        return np.all(np.isfinite(self.values), axis=1)

    @property
    def stated(self) -> PoseReading | None:
        """The one reading that the file leaves open, None where there are several.

        No file says whether it holds T_base_ee or its inverse: this one is not inverted, and
        `possible` has both.
        """
        plain = [r for r in self.possible if not r.inverted]
        return plain[0] if len(plain) == 1 else None

    def subset(self, rows: Sequence[int]) -> "RawPoses":
        """Return these rows in this order."""
        pick = list(rows)
        return replace(
            self,
            values=self.values[pick],
            labels=tuple(self.labels[k] for k in pick),
            stems=tuple(self.stems[k] for k in pick),
            where=tuple(self.where[k] for k in pick),
            joints=None if self.joints is None else self.joints[pick],
            times=None if self.times is None else self.times[pick],
        )

    def poses(self, reading: PoseReading, *, despite_names: bool = False) -> Array:
        """Return T_base_ee (n, 4, 4) [m] of this reading, which a person may say against the names.

        Raises:
            InputError: the file says otherwise, or a row cannot be a pose; the rows are named.
            UnitError: all poses come to lie within a millimetre of the base, or beyond all reach.
        """
        if self.said.position_first is not None:
            reading = replace(reading, position_first=self.said.position_first)
        contradiction = self.contradiction(reading)
        if contradiction and not despite_names:
            raise InputError(
                f"{contradiction} Readings that fit: {listed_readings(self.possible)}. If the "
                "names are wrong, rename the columns."
            )
        try:
            T = reading.apply(self.values, rows=self.where)
        except (InputError, NotRigidError, UnitError) as error:
            raise type(error)(f"{self.path}: {error}") from error
        flat = replace(reading, inverted=False)
        t = flat.apply(self.values, rows=self.where)[:, :3, 3]
        away = float(np.max(np.abs(t), initial=0.0))
        if len(T) >= 3 and 0 < away < SAME_PLACE_M:
            raise UnitError(
                f"{self.path}: read as '{reading}' all {len(T)} poses lie within "
                f"{1e3 * away:.3g} mm of the origin. Are the lengths already in metres?"
            )
        return T

    def contradiction(self, reading: PoseReading) -> str:
        """Return what the file says against a reading; empty where nothing does."""
        said = self.said
        pairs = (
            (said.length_unit, reading.length_unit, "length unit"),
            (said.angle_unit if reading.has_angles else None, reading.angle_unit, "angle unit"),
        )
        wrong = [f"{name} is {a}, not {b}" for a, b, name in pairs if a is not None and a != b]
        if said.rotations is not None and reading.rotation not in said.rotations:
            wrong.append(f"the rotation is not {reading.rotation}")
        if not wrong:
            return ""
        return (
            f"{self.path}: the reading '{reading}' contradicts the file: {'; '.join(wrong)} "
            f"({' '.join(said.sentences)})."
        )


def listed_readings(readings: Sequence[PoseReading], most: int = 10) -> str:
    """Return readings for a message, at most so many."""
    more = f" and {len(readings) - most} more" if len(readings) > most else ""
    return "; ".join(str(r) for r in readings[:most]) + more


def possible_readings(
    values: Array, said: Said, *, name: str, rows: Sequence[str]
) -> tuple[tuple[PoseReading, ...], tuple[str, ...]]:
    """Return every reading that the names and the numbers admit, and the reasons in words.

    Args:
        values: (n, k) numbers, k = 6, 7, 12 or 16.
        said: what the file says of them.
        name: the file, for messages.
        rows: what the rows are called.

    Raises:
        InputError: no reading fits; the message says what was tried and what it met.
    """
    finite = np.isfinite(values).all(axis=1)
    if not finite.any():
        raise InputError(f"{name}: all {len(values)} poses hold NaN or infinite numbers.")
    usable = values[finite]
    names = [rows[int(k)] for k in np.flatnonzero(finite)]
    found: list[PoseReading] = []
    reasons: list[str] = []
    refused: list[str] = []
    by_width = {6: ANGLE_ROTATIONS, 7: QUATERNIONS, 12: MATRICES, 16: MATRICES}
    kinds = by_width[values.shape[1]] if said.rotations is None else said.rotations
    for first, kind in product((True, False), kinds):
        if (said.position_first is not None and first != said.position_first) or (
            not first and values.shape[1] == 16
        ):
            continue
        reading = PoseReading(rotation=kind, position_first=first)
        problem = _rotation_problem(reading, usable, names)
        if problem:
            refused.append(problem)
            continue
        angles, why_angle = _angle_units(reading, usable, said)
        lengths, why_length = _length_units(reading, usable, said)
        if not angles:
            refused.append(why_angle)
            continue
        if not found:  # of the commonest reading: the others only repeat it
            reasons = [w for w in (why_angle, why_length) if w]
        found += [
            replace(reading, angle_unit=a, length_unit=b) for b, a in product(lengths, angles)
        ]
    if not found:
        tried = " ".join(dict.fromkeys(refused))
        raise InputError(
            f"{name}: no pose format fits its {values.shape[1]} numbers a pose. {tried} Are other "
            "numbers among them? Name the columns in a first line, or delete the others."
        )
    return (*found, *(replace(r, inverted=True) for r in found)), tuple(reasons)


def _rotation_problem(reading: PoseReading, values: Array, names: Sequence[str]) -> str:
    """Return why too few rows are rotations in this reading; empty where they are."""
    good = reading.fits(values)
    if np.mean(good) >= SHARE:
        return ""
    k = int(np.flatnonzero(~good)[0])
    kind = reading.rotation + ("" if reading.position_first else " before the position")
    try:
        reading.apply(values[k], rows=names[k : k + 1], reach_m=np.inf)
    except InputError as error:
        reason = str(error).partition(": ")[2].partition(". ")[0]
        return f"Not {kind}, {np.sum(~good)} of {len(good)} rows: {reason}."
    return ""


def _split(reading: PoseReading, values: Array) -> tuple[Array, Array]:
    """Return the positions (n, 3) and the rotation's numbers (n, k - 3)."""
    if values.shape[1] == 16:
        T = values.reshape(-1, 4, 4)
        T = np.swapaxes(T, 1, 2) if reading.rotation == "matrix_column_major" else T
        return T[:, :3, 3], T[:, :3, :3].reshape(-1, 9)
    if reading.position_first:
        return values[:, :3], values[:, 3:]
    return values[:, -3:], values[:, :-3]


def _angle_units(
    reading: PoseReading, values: Array, said: Said
) -> tuple[tuple[AngleUnit, ...], str]:
    """Return the units that the angles admit, and why."""
    if not reading.has_angles:
        return ("rad",), ""
    angles = _split(reading, values)[1]
    if reading.rotation == "rotation_vector":
        size = np.sqrt(np.sum(angles * angles, axis=1))
    else:
        size = np.abs(angles).max(axis=1)
    largest = float(size.max())
    degrees = np.mean(size > 2 * FULL_TURN) >= 0.5
    if np.mean(size > MOST_DEG) > 1 - SHARE:
        return (), f"Not angles: most rows hold numbers beyond {MOST_DEG:g}."
    if said.angle_unit is not None:
        why = (
            f"The names state rad, and the largest angle is {largest:.4g}, beyond two turns. If "
            f"these are degrees, give --reading, such as {replace(reading, angle_unit='deg')}."
        )
        return (said.angle_unit,), why if said.angle_unit == "rad" and degrees else ""
    if TINY_RAD <= largest <= FULL_TURN * (1 + 1e-3):
        return ("rad",), f"The largest angle is {largest:.4g}, at most a turn: radians."
    if degrees:
        return ("deg",), f"The largest angle is {largest:.4g}, beyond two turns in rad: degrees."
    return ("rad", "deg"), f"The largest angle is {largest:.4g}: rad or deg is left open."


def _length_units(
    reading: PoseReading, values: Array, said: Said
) -> tuple[tuple[LengthUnit, ...], str]:
    """Return the units that the positions admit, and why."""
    if said.length_unit is not None:
        return (said.length_unit,), ""
    t = _split(reading, values)[0]
    median = float(np.median(np.sqrt(np.sum(t * t, axis=1))))
    if median < METRES_BELOW:
        return ("m",), f"The median distance is {median:.4g}: metres."
    if median > MILLIMETRES_ABOVE:
        return ("mm",), f"The median distance is {median:.4g}: millimetres."
    return ("m", "mm"), f"The median distance is {median:.4g}: m or mm is left open."


def rounding_note(values: Array, reading: PoseReading) -> str:
    """Return what to say of matrices that were printed with few decimals; empty where exact."""
    finite = values[np.isfinite(values).all(axis=1)]
    R = _split(reading, finite)[1].reshape(-1, 3, 3)
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    error = float(off[off <= MATRIX_TOLERANCE].max(initial=0.0))
    if error <= RIGID_TOLERANCE:
        return ""
    return (
        f"The matrices are rotations to {error:.1g} only (printed with few decimals?); the "
        f"nearest rotations are taken, about {np.degrees(error) / 2:.2g} deg away."
    )
