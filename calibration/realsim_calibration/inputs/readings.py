"""What the numbers of a robot pose mean: rotation format, order, units, direction.

Robots and tools write the same pose in dozens of ways, and most wrong ones still give rigid
transforms. A `PoseReading` says it in full, so that nothing is left to be guessed.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.errors import InputError, NotRigidError, UnitError
from realsim.geometry import se3

AngleUnit = Literal["rad", "deg"]
LengthUnit = Literal["m", "mm"]

_COMMON = ("xyz", "zyx", "zyz")
_TRIPLES = (
    *_COMMON,
    *sorted({"".join(p) for p in permutations("xyz")} - set(_COMMON)),
    *sorted({a + b + a for a in "xyz" for b in "xyz" if a != b} - set(_COMMON)),
)
EULER_ORDERS: tuple[str, ...] = tuple(o for t in _TRIPLES for o in (t, t.upper()))
"""The 12 orders about fixed axes (lower case, extrinsic) and about turned ones (upper case), the
commonest first."""
ROTATIONS: tuple[str, ...] = (
    "rotation_vector",
    "quaternion_xyzw",
    "quaternion_wxyz",
    *(f"euler_{order}" for order in EULER_ORDERS),
    "matrix",
    "matrix_column_major",
)
_SHORT = {
    "rotvec": "rotation_vector",
    "quat_xyzw": "quaternion_xyzw",
    "quat_wxyz": "quaternion_wxyz",
    "column_major": "matrix_column_major",
}
_ACCEPTED = (
    "Accepted, separated by commas: one rotation (rotvec, quat_xyzw, quat_wxyz, matrix, "
    "matrix_column_major, or euler_ with an order such as euler_XYZ: upper case about the turned "
    "axes, lower case about the fixed ones), one length unit (m, mm), for Euler angles one angle "
    "unit (rad, deg; a rotation vector is in rad unless deg is said), 'inverted' if the file holds "
    "the base seen from the tool, 'rotation_first' if the position comes last. Example: "
    "rotvec,mm,inverted"
)
QUATERNION_TOLERANCE = 5e-3
"""Largest deviation of a quaternion's length from 1: three printed decimals give 1e-3."""
MATRIX_TOLERANCE = 2e-3
"""Largest entry of |R^T R - 1|: three printed decimals (0.03 deg) give 1.7e-3."""
LAST_ROW_TOLERANCE = 1e-6
"""Largest deviation of a 4x4 matrix's last row from 0 0 0 1, which is never measured."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseReading:
    """How a row of numbers becomes a pose T_base_ee [m]."""

    rotation: str
    """One of ROTATIONS. Euler orders as in scipy: XYZ turns about the axes as turned (intrinsic),
    xyz about the fixed ones (extrinsic); the angles stand in the order of the letters."""
    angle_unit: AngleUnit = "rad"
    """Unit of rotation vectors and Euler angles; always rad for the others, which have no unit."""
    length_unit: LengthUnit = "m"
    """Unit of the position."""
    inverted: bool = False
    """Whether the file holds T_ee_base, the base seen from the tool."""
    position_first: bool = True
    """Whether the position stands before the rotation; a 4x4 matrix knows no such order."""

    def __post_init__(self) -> None:
        """Check that the reading exists."""
        if self.rotation not in ROTATIONS:
            raise InputError(f"the rotation '{self.rotation}' is not known. {_ACCEPTED}.")
        if self.angle_unit not in ("rad", "deg") or self.length_unit not in ("m", "mm"):
            raise InputError(
                f"the units '{self.angle_unit}' and '{self.length_unit}' were given; rad or deg, "
                "and m or mm are accepted."
            )
        if self.angle_unit == "deg" and not self.has_angles:
            raise InputError(f"{self.rotation} holds no angles: 'deg' says nothing of it. Omit it.")

    @property
    def has_angles(self) -> bool:
        """Whether the rotation is three angles, which have a unit."""
        return self.rotation == "rotation_vector" or self.rotation.startswith("euler_")

    @property
    def widths(self) -> tuple[int, ...]:
        """How many numbers a row may have."""
        if self.has_angles:
            return (6,)
        return (7,) if self.rotation.startswith("quaternion") else (16, 12)

    def __str__(self) -> str:
        """Return the text that `reading_from_text` reads."""
        short = {v: k for k, v in _SHORT.items() if k != "column_major"}
        words = [short.get(self.rotation, self.rotation)]
        words += [self.angle_unit] if self.has_angles else []
        words += [self.length_unit]
        words += ["inverted"] if self.inverted else []
        words += [] if self.position_first else ["rotation_first"]
        return ",".join(words)

    def apply(
        self, raw: ArrayLike, *, rows: Sequence[str] | None = None, reach_m: float = 100.0
    ) -> Array:
        """Return T_base_ee (n, 4, 4) [m] of rows of numbers (n, k), exactly rigid.

        Args:
            raw: (n, 6), (n, 7), (n, 12) or (n, 16) numbers, or one row.
            rows: what the rows are called in messages ("line 12"); else "row 0", "row 1", ...
            reach_m: distance beyond which a position is no robot's [m].

        Raises:
            InputError: the wrong count of numbers, or rows that are not finite.
            NotRigidError: rows whose numbers are not a rotation; they are named.
            UnitError: positions beyond any robot's reach.
        """
        values, names = self._checked(raw, rows)
        R, t = self._parts(values, names)
        if self.length_unit == "mm":
            t = t / 1000.0
        away: Array = np.sqrt(np.sum(t * t, axis=-1))
        far = away > reach_m
        if far.any():
            worst = float(away.max())
            mm, turned = replace(self, length_unit="mm"), replace(self, position_first=False)
            remedies = [f"--reading {mm} if the lengths are in millimetres"] * (mm != self)
            if turned != self and values.shape[1] != 16:
                remedies += [f"--reading {turned} if the rotation stands before the position"]
            raise UnitError(
                f"read as '{self}' {_listed(names, far)} would lie up to {worst:.4g} m away; at "
                f"most {reach_m:g} m is accepted. "
                + (f"Give {', or '.join(remedies)}." if remedies else "Correct the lengths.")
            )
        T = se3.from_rt(R, t)
        return se3.invert(T) if self.inverted else T

    def fits(self, raw: ArrayLike) -> NDArray[Any]:
        """Return (n,) whether each row of (n, k) numbers is a pose in this reading."""
        values = np.atleast_2d(np.asarray(raw, dtype=np.float64))
        good: Mask = np.all(np.isfinite(values), axis=1)
        safe = np.where(good[:, None], values, 0.0)
        if self.has_angles:
            return good
        if self.rotation.startswith("quaternion"):
            q = safe[:, 3:] if self.position_first else safe[:, :-3]
            return good & (np.abs(np.sqrt(np.sum(q * q, axis=1)) - 1) <= QUATERNION_TOLERANCE)
        if safe.shape[1] == 16:
            T = safe.reshape(-1, 4, 4)
            T = np.swapaxes(T, 1, 2) if self.rotation == "matrix_column_major" else T
            good = good & (np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) <= LAST_ROW_TOLERANCE)
            R = T[:, :3, :3]
        else:
            R = (safe[:, 3:] if self.position_first else safe[:, :-3]).reshape(-1, 3, 3)
        error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        return good & (error <= MATRIX_TOLERANCE) & (np.linalg.det(R) > 0)

    def _checked(self, raw: ArrayLike, rows: Sequence[str] | None) -> tuple[Array, Sequence[str]]:
        """Return finite numbers (n, k) of an accepted width, and the names of the rows."""
        values = np.asarray(raw, dtype=np.float64)
        if values.ndim == 3 and values.shape[1:] == (4, 4):
            values = values.reshape(-1, 16)
        values = np.atleast_2d(values)
        if values.ndim != 2 or values.shape[1] not in self.widths:
            wanted = " or ".join(str(w) for w in self.widths)
            raise InputError(
                f"'{self}' takes {wanted} numbers a pose; an array of shape {values.shape} was "
                "given. Is the rotation stored in another format?"
            )
        names = [f"row {k}" for k in range(len(values))] if rows is None else rows
        bad: Mask = ~np.all(np.isfinite(values), axis=1)
        if bad.any():
            raise InputError(
                f"{_listed(names, bad)}: NaN or infinite numbers were not measured. Delete such "
                "poses, with their images if there are any."
            )
        return values, names

    def _parts(self, values: Array, names: Sequence[str]) -> tuple[Array, Array]:
        """Return rotations (n, 3, 3) and positions (n, 3) in the file's unit."""
        if values.shape[1] == 16:
            T = values.reshape(-1, 4, 4)
            T = np.swapaxes(T, 1, 2) if self.rotation == "matrix_column_major" else T
            _check_last_row(T, names)
            return _orthonormal(T[:, :3, :3], names), T[:, :3, 3]
        split = 3 if self.position_first else values.shape[1] - 3
        first, second = values[:, :split], values[:, split:]
        t, r = (first, second) if self.position_first else (second, first)
        if self.has_angles:
            a = np.radians(r) if self.angle_unit == "deg" else r
            if self.rotation == "rotation_vector":
                return se3.exp_so3(a), t
            return _from_angles(a, self.rotation.removeprefix("euler_")), t
        if self.rotation.startswith("quaternion"):
            length = np.linalg.norm(r, axis=-1)
            bad = np.abs(length - 1) > QUATERNION_TOLERANCE
            if bad.any():
                k = int(np.flatnonzero(bad)[0])
                raise NotRigidError(
                    f"{_listed(names, bad)}: the quaternion does not have length 1 "
                    f"({names[k]}: {r[k].tolist()}, length {length[k]:.4g}). Are these numbers a "
                    "quaternion? If it stands before the position, add ,rotation_first to --reading"
                )
            wxyz = r if self.rotation.endswith("wxyz") else np.roll(r, 1, axis=-1)
            return se3.from_quaternion_wxyz(wxyz), t
        R = r.reshape(-1, 3, 3)
        R = np.swapaxes(R, 1, 2) if self.rotation == "matrix_column_major" else R
        return _orthonormal(R, names), t


def reading_from_text(text: str) -> PoseReading:
    """Return the reading that a text such as "rotvec,mm,inverted" names.

    Raises:
        InputError: an unknown word, one missing, or two that exclude each other.
    """
    given: dict[str, Any] = {}

    def take(field: str, value: Any, word: str) -> None:
        if field in given and given[field] != value:
            raise InputError(
                f"the reading '{text}' says two things of the {field.replace('_', ' ')}: "
                f"{given[field]} and {word}. Give one. {_ACCEPTED}."
            )
        given[field] = value

    for word in (w for w in re.split(r"[,\s]+", text.strip()) if w):
        name = _SHORT.get(word.lower(), word if word.startswith("euler_") else word.lower())
        if name in ROTATIONS:
            take("rotation", name, word)
        elif name in ("m", "mm"):
            take("length_unit", name, word)
        elif name in ("rad", "deg"):
            take("angle_unit", name, word)
        elif name == "inverted":
            take("inverted", True, word)
        elif name in ("rotation_first", "position_first"):
            take("position_first", name == "position_first", word)
        else:
            raise InputError(f"'{word}' in the reading '{text}' is not known. {_ACCEPTED}.")
    for field, what in (("rotation", "the rotation's format"), ("length_unit", "the length unit")):
        if field not in given:
            raise InputError(f"the reading '{text}' does not say {what}. {_ACCEPTED}.")
    if str(given["rotation"]).startswith("euler_") and "angle_unit" not in given:
        raise InputError(f"the reading '{text}' does not say the angle unit. {_ACCEPTED}.")
    return PoseReading(**given)


def _listed(names: Sequence[str], bad: Mask, most: int = 8) -> str:
    """Return the names of the bad rows for a message, at most so many."""
    chosen = [names[int(k)] for k in np.flatnonzero(bad)]
    more = f" and {len(chosen) - most} more" if len(chosen) > most else ""
    return ", ".join(chosen[:most]) + more + f" ({len(chosen)} of {len(bad)})"


def _check_last_row(T: Array, names: Sequence[str]) -> None:
    """Raise unless every matrix ends in 0 0 0 1."""
    off = np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1)
    bad = off > LAST_ROW_TOLERANCE
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        raise NotRigidError(
            f"{_listed(names, bad)}: the last row of the matrix is not 0 0 0 1 ({names[k]}: "
            f"{T[k, 3].tolist()}). Is it stored column by column (matrix_column_major)?"
        )


def _orthonormal(R: Array, names: Sequence[str]) -> Array:
    """Return the nearest rotations, those that are exact untouched; rows that are none raise."""
    det = np.linalg.det(R)
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    mirrored = (det < 0) & (error <= MATRIX_TOLERANCE)
    if mirrored.any():
        raise NotRigidError(
            f"{_listed(names, mirrored)}: the matrix is mirrored (determinant -1); a rotation has "
            "+1. One axis has the wrong sign, or a left-handed tool wrote it."
        )
    bad = error > MATRIX_TOLERANCE
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        raise NotRigidError(
            f"{_listed(names, bad)}: the 3x3 part is not a rotation ({names[k]}: R^T R is off the "
            f"identity by {error[k]:.2g}, at most {MATRIX_TOLERANCE:g} is accepted; determinant "
            f"{det[k]:.4g}). Delete these poses with their images, or correct the numbers."
        )
    U, _, Vt = np.linalg.svd(R)
    return np.where((error > se3.EXACT_TOLERANCE)[:, None, None], U @ Vt, R)


def _about(axis: int, angle: Array) -> Array:
    """Return rotations (n, 3, 3) by angles (n,) [rad] about one coordinate axis."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((len(angle), 3, 3))
    R[:, axis, axis] = 1.0
    R[:, j, j] = R[:, k, k] = np.cos(angle)
    R[:, k, j] = np.sin(angle)
    R[:, j, k] = -R[:, k, j]
    return R


def _from_angles(angles: Array, order: str) -> Array:
    """Return rotations (n, 3, 3) of Euler angles (n, 3) [rad] in an order of EULER_ORDERS."""
    a, b, c = (_about("xyz".index(s), angles[:, k]) for k, s in enumerate(order.lower()))
    return a @ b @ c if order.isupper() else c @ b @ a
