"""What a column is called, and which columns of a table are the pose."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim_calibration.inputs.raw_poses import (
    ANGLE_ROTATIONS,
    MATRICES,
    QUATERNIONS,
    RawPoses,
    Said,
    possible_readings,
    rounding_note,
)
from realsim_calibration.inputs.readings import PoseReading

WIDTHS = (6, 7, 12, 16)
"""Numbers a pose may have without names."""
ACCEPTED = (
    "Accepted without names: 6 numbers (position and three angles), 7 (position and quaternion), "
    "12 (3x4 matrix, or position and 3x3 matrix), 16 (4x4 matrix), each with or without an index "
    "or time in front. With names: x y z and one of qx qy qz qw, rx ry rz, roll pitch yaw, a b c, "
    "rotvec_x rotvec_y rotvec_z, r00 ... r22"
)
LABEL_NAMES = frozenset(
    "image img image_name image_file image_path img_name img_path file filename file_name "
    "file_path filepath path rgb rgb_path color colour color_path picture photo name".split()
)
"""Names of a column or key that holds the image's name."""
_INDEX = frozenset("index idx id i n no nr num number frame view pose image_id view_id".split())
_TIME = frozenset("time timestamp t stamp secs sec nsecs time_s timestamp_s timestamp_ns".split())
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
DATES_S = (9.4e8, 4.2e9)
"""Seconds since 1970 of the years 2000 and 2100."""
LONGEST_STEP_S, LONGEST_EVEN_STEP_S = 600.0, 0.5
"""Between two stops, and between two poses of a stream [s]."""
EVEN_STEPS = 0.2
"""Steps of a stream differ from their median by less than this part, in the median."""
_PREFIX = r"^(?:(?:pose|tcp|robot|ee|eef|flange|tool|gripper|transform)_)*"
_ROLES: tuple[tuple[str, str], ...] = (
    (_PREFIX + r"(?:position|pos|translation|trans|t|p)?_?([xyz])(?:_pos)?$", r"\1"),
    (_PREFIX + r"(?:orientation|quaternion|quat|q)_?([xyzw])$", r"q\1"),
    (_PREFIX + r"(?:rotation|rot)_?(w)$", r"q\1"),
    (_PREFIX + r"(?:rotvec|rvec|rv|rotation_vector|axis_angle)_?([xyz])$", r"rv\1"),
    (_PREFIX + r"(?:rotation|rot|r)_?([xyz])$", r"r\1"),
    (_PREFIX + r"(roll|pitch|yaw)$", r"\1"),
    (r"^([abc])$", r"\1"),
    (r"^quat_?([0-3])$", r"quat\1"),
    (r"^euler_?([0-2])$", r"euler\1"),
    (r"^flat_?([0-8])$", r"flat\1"),
    (r"^(?:r|m|rot|t|h)_?([0-4])_?([0-4])$", r"m\1\2"),
    (r"^(?:actual_|target_)?(?:q|j|joint|joints|theta|axis|a)_?(\d+)$", r"joint\1"),
)
_UNIT = re.compile(
    r"(?:[\s_]+|\s*[\[(]\s*)(mm|m|millimet(?:er|re)s?|met(?:er|re)s?|deg|degrees?|°|rad|radians?)"
    r"\s*[\])]?$"
)
_TCP_COLUMN = re.compile(r"^(?:actual|target)_tcp_pose_([0-5])$")
_TRIPLES: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
    (("rvx", "rvy", "rvz"), ("rotation_vector",), "a rotation vector"),
    (("rx", "ry", "rz"), ANGLE_ROTATIONS, "a rotation vector or Euler angles"),
    (("a", "b", "c"), ANGLE_ROTATIONS, "Euler angles (KUKA) or a rotation vector"),
    (("euler0", "euler1", "euler2"), ANGLE_ROTATIONS[1:], "Euler angles of unstated order"),
)


@dataclass(eq=False, kw_only=True, slots=True)
class PoseTable:
    """Rows of numbers as a file holds them, before it is known which of them are the pose."""

    path: Path
    names: tuple[str, ...]
    """(k,) the columns' names in the file; "" where it has none."""
    values: Array
    """(n, k)."""
    labels: list[str | None]
    stems: list[str]
    where: list[str]
    notes: list[str] = field(default_factory=lambda: [])


def role_of(name: str) -> tuple[str, str | None]:
    """Return what a column's name means and the unit it states; "" = unknown."""
    text = name.strip().strip("\"'").lower()
    unit: str | None = None
    found = _UNIT.search(text)
    if found and found.start() > 0:
        word = found[1]
        unit = "mm" if word.startswith(("mm", "milli")) else "m" if word.startswith("m") else "rad"
        unit = "deg" if word.startswith(("deg", "°")) else unit
        text = text[: found.start()]
    text = re.sub(r"[\s.\-/:]+", "_", text).strip("_#")
    tcp = _TCP_COLUMN.match(text)
    if tcp:
        return ("x", "y", "z", "rx", "ry", "rz")[int(tcp[1])], unit
    if text in LABEL_NAMES:
        return "label", unit
    if text in _INDEX:
        return "index", unit
    if text in _TIME:
        return "time", unit
    for pattern, role in _ROLES:
        match = re.match(pattern, text)
        if match:
            return match.expand(role), unit
    return "", unit


def raw_from_table(table: PoseTable) -> RawPoses:
    """Return the poses of a table: which columns they are, and every reading they admit.

    Raises:
        InputError: no pose is among the columns, or no reading fits the numbers.
    """
    if not len(table.values):
        raise InputError(f"{table.path} holds no poses. {ACCEPTED}.")
    roles = [role_of(n) for n in table.names]
    names = [r for r, _ in roles]
    if "qw" in names and "qx" not in names:  # rotation_x beside rotation_w is a quaternion's
        names = [f"q{r[1]}" if r in ("rx", "ry", "rz") else r for r in names]
    if {"x", "y", "z"} <= set(names) and {"w", "p", "r"} <= {n.lower() for n in table.names}:
        fanuc = {"w": "roll", "p": "pitch", "r": "yaw"}
        names = [fanuc.get(n.lower(), r) for n, r in zip(table.names, names, strict=True)]
    units = [u for _, u in roles]
    joints, used = _joints(table, names, units)
    if any(r and r not in ("label", "index", "time") for k, r in enumerate(names) if k not in used):
        values, columns, said = _named(table, names, units, used)
    else:
        values, columns, said = _unnamed(table, names, used)
    possible, reasons = possible_readings(values, said, name=str(table.path), rows=table.where)
    notes = [*table.notes, *said.sentences, *reasons]
    if possible[0].rotation in MATRICES:
        notes += [n for n in (rounding_note(values, possible[0]),) if n]
    if all(r.rotation == "matrix" for r in possible) and values.shape[1] == 16:
        columns = _matrix_names()
    stems = [s or _index_stem(table, names, k) for k, s in enumerate(table.stems)]
    return RawPoses(
        path=table.path,
        values=values,
        columns=columns,
        labels=tuple(table.labels),
        stems=tuple(stems),
        where=tuple(table.where),
        joints=joints,
        times=_times(table, names),
        said=said,
        possible=possible,
        notes=tuple(dict.fromkeys(notes)),
    )


def _times(table: PoseTable, names: Sequence[str]) -> Array | None:
    """Return the time stamps [s], None where no column is named as one or two are."""
    at = [k for k, name in enumerate(names) if name == "time"]
    if len(at) != 1:
        return None
    times = table.values[:, at[0]]
    if table.names[at[0]].lower().endswith(("_ns", "nsecs")):
        return times * 1e-9
    unit = _time_unit(np.unique(times[np.isfinite(times)]))
    if unit != "s":
        table.notes.append(f"The time stamps are taken for {unit}: so they are dates or steps.")
    return times * TIME_UNITS[unit]


def _time_unit(times: Array) -> str:
    """Return the unit of ascending time stamps (n,), all different.

    Dates tell it by their size: seconds since 1970 are 1.7e9. Stamps that count from the start of a
    machine tell it by their steps, and are seconds unless these were too long: even steps are a
    stream's, uneven ones those between stops.
    """
    if len(times) < 2:
        return "s"
    steps = np.diff(times)
    step = float(np.median(steps))
    for unit, size in TIME_UNITS.items():
        dated = DATES_S[0] < times[0] * size and times[-1] * size < DATES_S[1]
        if dated and step * size <= LONGEST_STEP_S:
            return unit
    even = float(np.median(np.abs(steps - step))) < EVEN_STEPS * step
    if step <= LONGEST_STEP_S:
        return "s"
    longest = LONGEST_EVEN_STEP_S if even else LONGEST_STEP_S
    return next((u for u, size in TIME_UNITS.items() if step * size <= longest), "ns")


def _index_stem(table: PoseTable, names: Sequence[str], row: int) -> str:
    """Return the row's number from a column that is an index, or that names images by number."""
    for k, role in enumerate(names):
        if role in ("index", "label"):
            value = table.values[row, k]
            return str(int(value)) if np.isfinite(value) and value == int(value) else ""
    return ""


def _joints(
    table: PoseTable, names: Sequence[str], units: Sequence[str | None]
) -> tuple[Array | None, set[int]]:
    """Return the joint angles [rad] and the columns they are."""
    columns = [k for k, r in enumerate(names) if re.fullmatch(r"joint\d+", r)]
    if not columns:
        return None, set()
    numbers = [int(names[k][5:]) for k in columns]
    if len(set(numbers)) != len(numbers):
        raise InputError(
            f"{table.path}: several columns mean the same joint "
            f"({', '.join(table.names[k] for k in columns)}). Keep one of each."
        )
    columns = [k for _, k in sorted(zip(numbers, columns, strict=True))]
    values = table.values[:, columns]
    stated = {units[k] for k in columns} - {None}
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if len(stated) == 1:
        unit = cast(str, stated.pop())
        table.notes.append(f"The joints are in {unit}, as their names say.")
    else:
        unit = "deg" if largest > 2 * np.pi * (1 + 1e-3) else "rad"
        table.notes.append(
            f"The joints are taken for {'degrees' if unit == 'deg' else 'radians'}: the largest "
            f"is {largest:.4g}, {'more than' if unit == 'deg' else 'at most'} a turn in rad."
        )
    return (np.radians(values) if unit == "deg" else values.copy()), set(columns)


def _named(
    table: PoseTable, names: Sequence[str], units: Sequence[str | None], used: set[int]
) -> tuple[Array, tuple[str, ...], Said]:
    """Return the pose's numbers, their names and what these say, of a table with names."""
    at: dict[str, int] = {}
    for k, role in enumerate(names):
        if not role or role in ("label", "index", "time") or k in used:
            continue
        if role in at:
            raise InputError(
                f"{table.path}: two columns mean {role}: '{table.names[at[role]]}' and "
                f"'{table.names[k]}'. Keep one of them."
            )
        at[role] = k
    matrix = _matrix_columns(at)
    if len(matrix) == 16 or (len(matrix) == 12 and "x" not in at):
        return _whole_matrix(table, matrix)
    missing = [c for c in "xyz" if c not in at]
    order, kinds, what = _rotation_columns(table.path, at, matrix)
    if missing or not order:
        present = ", ".join(n for n in table.names if n) or "none"
        lacking = f"the position's {', '.join(missing)}" if missing else "a complete rotation"
        raise InputError(
            f"{table.path}: {lacking} is missing among the columns {present}. {ACCEPTED}."
        )
    position = [at[c] for c in "xyz"]
    rotation = [at[c] for c in order]
    columns = position + rotation
    ignored = [
        table.names[k]
        for k in range(len(names))
        if k not in columns and k not in used and names[k] not in ("label", "index", "time")
    ]
    if ignored:
        table.notes.append(f"Columns that were not used: {', '.join(ignored)}.")
    shown = " ".join(table.names[k] for k in rotation)
    length = _unit(table, units, position, ("m", "mm"))
    angle = _unit(table, units, rotation, ("rad", "deg"))
    stated = " and ".join(u for u in (length, angle) if u)
    said = Said(
        rotations=kinds,
        position_first=True,
        length_unit=length,
        angle_unit=angle,
        sentences=(
            f"The columns {shown} are {what}.",
            *((f"The names state {stated}.",) if stated else ()),
        ),
    )
    return table.values[:, columns], tuple(names[k] for k in columns), said


def _unit(
    table: PoseTable, units: Sequence[str | None], columns: Sequence[int], accepted: tuple[str, ...]
) -> Any:
    """Return the unit that the names of some columns state, None where they do not.

    Raises:
        InputError: they state several, or one of another kind.
    """
    stated = {units[k] for k in columns} - {None}
    if not stated:
        return None
    if len(stated) > 1 or not stated <= set(accepted):
        shown = ", ".join(table.names[k] for k in columns)
        raise InputError(
            f"{table.path}: the columns {shown} state the units {', '.join(map(str, stated))}; one "
            f"of {' or '.join(accepted)} is accepted for all three."
        )
    return stated.pop()


def _matrix_columns(at: dict[str, int]) -> list[str]:
    """Return the names m00 ... in row order if a whole matrix is named, counted from 0 or 1."""
    for start in (0, 1):
        for rows, columns in ((4, 4), (3, 4), (3, 3)):
            wanted = [f"m{r + start}{c + start}" for r in range(rows) for c in range(columns)]
            if all(w in at for w in wanted):
                return wanted
    return []


def _whole_matrix(table: PoseTable, matrix: Sequence[str]) -> tuple[Array, tuple[str, ...], Said]:
    """Return a matrix whose every entry has a name, its last row filled in."""
    at = {role_of(n)[0]: k for k, n in enumerate(table.names)}
    values = table.values[:, [at[m] for m in matrix]]
    sentence = "The columns are a matrix by rows and columns."
    said = Said(rotations=("matrix",), position_first=True, sentences=(sentence,))
    return completed(values), _matrix_names(), said


def _rotation_columns(
    path: Path, at: dict[str, int], matrix: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...], str]:
    """Return the rotation's columns in order, the formats they leave open, and what they are."""
    found: list[tuple[tuple[str, ...], tuple[str, ...], str]] = []
    if all(c in at for c in ("qx", "qy", "qz", "qw")):
        given = tuple(sorted(("qx", "qy", "qz", "qw"), key=lambda c: at[c]))
        w_first = given == ("qw", "qx", "qy", "qz")
        order = given if w_first else ("qx", "qy", "qz", "qw")
        kind = "quaternion_wxyz" if w_first else "quaternion_xyzw"
        found.append((order, (kind,), f"a quaternion, read as {kind[-4:]}"))
    if all(c in at for c in ("roll", "pitch", "yaw")):
        order = tuple(sorted(("roll", "pitch", "yaw"), key=lambda c: at[c]))
        axes = "".join({"roll": "x", "pitch": "y", "yaw": "z"}[c] for c in order)
        kinds = (f"euler_{axes}", f"euler_{axes.upper()}")
        found.append((order, kinds, "Euler angles about x (roll), y (pitch) and z (yaw)"))
    for triple, kinds, what in _TRIPLES:
        if all(c in at for c in triple):
            found.append((triple, kinds, what))
    for count, stem, kinds, what in (
        (4, "quat", QUATERNIONS, "a quaternion of unstated order"),
        (9, "flat", MATRICES, "a rotation matrix of unstated order"),
    ):
        given = tuple(f"{stem}{k}" for k in range(count))
        if all(c in at for c in given):
            found.append((given, kinds, what))
    if len(matrix) == 9:
        found.append((tuple(matrix), ("matrix",), "a rotation matrix by rows"))
    if len(found) > 1:
        names = " and ".join(" ".join(order) for order, _, _ in found)
        raise InputError(
            f"{path}: the poses have two rotations each ({names}). Delete the columns or keys of "
            "one of them."
        )
    return found[0] if found else ((), (), "")


def _unnamed(
    table: PoseTable, names: Sequence[str], used: set[int]
) -> tuple[Array, tuple[str, ...], Said]:
    """Return the pose's numbers and what their nesting says, of a table without names."""
    columns = [k for k in range(table.values.shape[1]) if not names[k] and k not in used]
    unknown = [table.names[k] for k in columns if table.names[k]]
    if unknown:
        table.notes.append(f"The column names {', '.join(unknown)} are not known and are ignored.")
    values = table.values[:, columns]
    width = values.shape[1]
    ascending = len(values) > 1 and bool(np.all(np.diff(values[:, 0]) > 0)) if width else False
    if width - 1 in WIDTHS and ascending and not _is_pose(values):
        whole = bool(np.all(values[:, 0] == np.round(values[:, 0])))
        table.notes.append(
            f"The first of {width} numbers rises from pose to pose: it is taken for "
            f"{'an index' if whole else 'a time'}, the other {width - 1} for the pose."
        )
        if whole:
            table.stems = [str(int(v)) for v in values[:, 0]]
        values = values[:, 1:]
        width -= 1
    if width not in WIDTHS:
        raise InputError(
            f"{table.path}: {width} numbers a pose were found ({table.where[0]}). {ACCEPTED}."
        )
    if width == 12:
        whole_matrix = completed(values)
        if np.mean(PoseReading(rotation="matrix").fits(whole_matrix)) > 0.5:
            sentence = "The 12 numbers are a 3x4 matrix row by row."
            said = Said(rotations=("matrix",), position_first=True, sentences=(sentence,))
            return whole_matrix, _matrix_names(), said
    return values, ("",) * width, Said()


def _is_pose(values: Array) -> bool:
    """Return whether rows of 7 numbers already are poses, so that none of them is an index."""
    if values.shape[1] != 7:
        return values.shape[1] in WIDTHS
    return any(
        bool(np.mean(PoseReading(rotation=q, position_first=p).fits(values)) > 0.5)
        for q in QUATERNIONS
        for p in (True, False)
    )


def completed(values: Array) -> Array:
    """Return 4x4 matrices (n, 16) of 3x4 ones (n, 12); others unchanged."""
    if values.shape[1] != 12:
        return values
    return np.concatenate([values, np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1))], axis=1)


def _matrix_names() -> tuple[str, ...]:
    return tuple(f"m{r}{c}" for r in range(4) for c in range(4))
