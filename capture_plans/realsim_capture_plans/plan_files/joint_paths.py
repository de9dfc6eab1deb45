"""Other people's joint paths: JSON with joints, tool poses and via flags, and CSV.

A path is read as it was written; what it is in (degrees or radians, metres or millimetres, which
robot) is proven from the tool poses, or has to be said.
"""

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.robots.arm import known_chains
from realsim.robots.kinematics import DhChain
from realsim.untrusted.files import checked_text
from realsim.untrusted.json_text import read_json
from realsim_capture_plans.plan_files import evidence
from realsim_capture_plans.plan_files.plan_json import LARGEST_BYTES

YES = ("1", "true", "yes")
NO = ("0", "false", "no", "")
CAMERA_COLUMNS = ("cam_x_m", "cam_y_m", "cam_z_m", "cam_qw", "cam_qx", "cam_qy", "cam_qz")
"""Expected camera pose in base: position [m] and quaternion, w first."""
UNIT_NAMES: dict[str, evidence.JointUnit] = {
    "rad": "rad",
    "radian": "rad",
    "radians": "rad",
    "deg": "deg",
    "degrees": "deg",
}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class JointPath:
    """Joint configurations in the order in which they are driven to."""

    source: str
    """The file, for messages."""
    joints: Array
    """(N, n) [rad]."""
    via: Mask
    """(N,) rows that are only passed; the others are views."""
    rows: tuple[str, ...]
    """What each row is called in the file, for messages."""
    reading: evidence.Reading | None
    """How the file's own tool poses prove robot and units; None where it has none."""
    Ts_base_cam: Array | None = None
    """(N, 4, 4) camera poses that the file expects [m], NaN where it has none."""


def read_path(
    path: Path | str, chain: DhChain | None, joints_unit: evidence.JointUnit | None = None
) -> JointPath:
    """Return the joint path of a .json or .csv file.

    Args:
        path: the file.
        chain: the arm that it has to be for; None leaves it to the file's tool poses.
        joints_unit: the unit of joints that say none themselves.

    Raises:
        InputError: no such file, not a path, or another robot's.
        UnitError: the unit of the joints is not said or cannot be right.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no joint path at {path}; a .json or .csv file is needed.")
    if path.suffix.lower() == ".json":
        return _json_path(path, chain, joints_unit)
    if path.suffix.lower() in (".csv", ".tsv", ".txt"):
        return _csv_path(path, chain, joints_unit)
    raise InputError(
        f"{path} is no joint path: .json (joints, cart_pose, via_points) and .csv (columns q1_rad, "
        "q2_rad ... or q1_deg ..., one for each joint) are read."
    )


def _check_count(path: Path, count: int, chain: DhChain | None) -> None:
    """Raise if the joints are not as many as the arm's."""
    if chain is not None and count != chain.joints:
        alike = ", ".join(known_chains(count)) or "none that is found by name"
        raise InputError(
            f"{path} has {count} joint angles in a row, and a {chain.name} has {chain.joints} "
            f"joints. Choose the arm that it is for with --arm ({alike})."
        )


def _json_path(path: Path, chain: DhChain | None, unit: evidence.JointUnit | None) -> JointPath:
    """Return a path of lists `joints`, `cart_pose` (x y z, rotation vector a b c), `via_points`."""
    data = read_json(path, most_bytes=LARGEST_BYTES)
    if not isinstance(data, dict) or "joints" not in data:
        keys = sorted(data)[:6] if isinstance(data, dict) else type(data).__name__
        raise InputError(
            f"{path} holds {keys}; a joint path has the list 'joints' (a row a view), and beside "
            "it 'cart_pose' and 'via_points'. A realsim plan needs no import."
        )
    rows = _matrix(data["joints"], None, f"{path}: 'joints'")
    _check_count(path, rows.shape[1], chain)
    names = tuple(f"row {k}" for k in range(len(rows)))
    flags = data.get("via_points", ["0"] * len(rows))
    if not isinstance(flags, list) or len(flags) != len(rows):
        count = len(flags) if isinstance(flags, list) else flags
        raise InputError(f"{path} has {len(rows)} joint rows and {count} 'via_points'.")
    via = np.array([_flag(v, f"{path}: via_points[{k}]") for k, v in enumerate(flags)])
    if "cart_pose" not in data:
        if unit is None:
            raise UnitError(
                f"{path} does not say whether its joints are degrees or radians: it has no "
                "'cart_pose' that would prove it. Give it with --joints-unit."
            )
        evidence.check_joint_unit(rows, unit, list(names), str(path))
        q = rows if unit == "rad" else np.radians(rows)
        return JointPath(source=str(path), joints=q, via=via, rows=names, reading=None)
    try:
        poses = [[pose[key] for key in "xyzabc"] for pose in data["cart_pose"]]
    except (TypeError, KeyError) as error:
        raise InputError(
            f"{path}: 'cart_pose' needs x, y, z and the rotation vector a, b, c in every row "
            f"({error})."
        ) from error
    pose = _matrix(poses, 6, f"{path}: 'cart_pose'")
    if len(pose) != len(rows):
        raise InputError(f"{path} has {len(rows)} joint rows and {len(pose)} in 'cart_pose'.")
    Ts = np.tile(np.eye(4), (len(pose), 1, 1))
    Ts[:, :3, :3], Ts[:, :3, 3] = se3.exp_so3(pose[:, 3:]), pose[:, :3]
    reading = evidence.proven_reading(rows, Ts, chain, str(path))
    if unit is not None and unit != reading.joint_unit:
        raise UnitError(
            f"{path}: its joints were said to be in {unit}, but with its tool poses they fit "
            f"{reading.text()}. Leave out --joints-unit."
        )
    q = rows if reading.joint_unit == "rad" else np.radians(rows)
    return JointPath(source=str(path), joints=q, via=via, rows=names, reading=reading)


def _csv_path(path: Path, chain: DhChain | None, unit: evidence.JointUnit | None) -> JointPath:
    """Return a path of columns q1_rad ... qn_rad (or _deg) and, if there is one, `via`."""
    table, lines = _csv_table(path)
    header = list(table)
    columns, unit = _joint_columns(path, header, unit)
    _check_count(path, len(columns), chain)
    names = tuple(f"line {n}" for n in lines)
    rows = np.stack([_numbers(path, table[c], c, lines) for c in columns], axis=-1)
    evidence.check_joint_unit(rows, unit, list(names), str(path))
    q = rows if unit == "rad" else np.radians(rows)
    via = np.zeros(len(q), dtype=bool)
    if "via" in header:
        flags = zip(table["via"], lines, strict=True)
        via = np.array([_flag(v, f"{path}, line {n}") for v, n in flags])
    Ts = None
    if all(c in header for c in CAMERA_COLUMNS):
        seen = np.array([bool(v) for v in table[CAMERA_COLUMNS[0]]])
        kept = [n for n, s in zip(lines, seen, strict=True) if s]
        Ts = np.full((len(q), 4, 4), np.nan)
        columns = (np.array(table[c])[seen].tolist() for c in CAMERA_COLUMNS)
        read = (_numbers(path, c, n, kept) for c, n in zip(columns, CAMERA_COLUMNS, strict=True))
        numbers = np.stack(list(read), axis=-1)
        if len(numbers):
            R = se3.from_quaternion_wxyz(numbers[:, 3:])
            Ts[seen] = se3.from_rt(R, numbers[:, :3])
    return JointPath(
        source=str(path), joints=q, via=via, rows=names, reading=None, Ts_base_cam=Ts
    )  # fmt: skip


def _csv_table(path: Path) -> tuple[dict[str, list[str]], list[int]]:
    """Return the columns of a CSV file by their names, and the line number of every row."""
    filled = [
        (n, line)
        for n, line in enumerate(checked_text(path, LARGEST_BYTES).splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not filled:
        raise InputError(f"{path} is empty; a header and one row per configuration are needed.")
    mark = max(";\t,", key=filled[0][1].count)
    body = list(csv.reader(io.StringIO("\n".join(line for _, line in filled)), delimiter=mark))
    header = [name.strip().lower() for name in body[0]]
    if len(set(header)) != len(header):
        raise InputError(f"{path}: the header names a column twice: {', '.join(header)}.")
    lines = [n for n, _ in filled[1:]]
    if not lines:
        raise InputError(f"{path} has a header and no rows.")
    for n, row in zip(lines, body[1:], strict=True):
        if len(row) != len(header):
            raise InputError(
                f"{path}, line {n} has {len(row)} values and the header {len(header)} names."
            )
    columns = zip(header, zip(*body[1:], strict=True), strict=True)
    return {name: [v.strip() for v in values] for name, values in columns}, lines


def _joint_columns(
    path: Path, header: list[str], unit: evidence.JointUnit | None
) -> tuple[list[str], evidence.JointUnit]:
    """Return the names of the joints' columns and their unit."""
    found: dict[int, tuple[str, str]] = {}
    for name in header:
        if match := re.fullmatch(r"q_?([1-9][0-9]?)(?:[ _]*[\[(]?([a-z]+)[\])]?)?", name):
            found[int(match[1])] = (name, match[2] or "")
    numbers = range(1, max(found, default=0) + 1)
    if not found or sorted(found) != list(numbers):
        raise InputError(
            f"{path}: the first line is '{', '.join(header)[:120]}'; a header with the columns "
            "q1_rad, q2_rad ... or q1_deg, q2_deg ..., one for each joint, is needed (and 'via', "
            "if some rows are only passed)."
        )
    said = {u for _, u in found.values()}
    if said == {""}:
        if unit is None:
            raise UnitError(
                f"{path}: the columns q1, q2 ... do not say their unit. Name them q1_rad or "
                "q1_deg, or say it with --joints-unit."
            )
        return [found[j][0] for j in numbers], unit
    units: set[evidence.JointUnit | None] = {UNIT_NAMES.get(u) for u in said}
    named = units.pop()
    if units or named is None:
        raise UnitError(
            f"{path}: the joints' columns have the units {sorted(said)}; all in rad or all in deg "
            "are needed."
        )
    if unit is not None and unit != named:
        raise UnitError(f"{path}: its columns say {named}, --joints-unit says {unit}.")
    return [found[j][0] for j in numbers], named


def _numbers(path: Path, values: list[str], name: str, lines: list[int]) -> Array:
    """Return the numbers of a column."""
    out = np.zeros(len(values))
    for k, text in enumerate(values):
        try:
            out[k] = float(text)
        except ValueError:
            out[k] = np.nan
        if not np.isfinite(out[k]):
            hint = " Decimal commas are not read; write points." if "," in text else ""
            raise InputError(f"{path}, line {lines[k]}: {name} is {text!r}, not a number.{hint}")
    return out


def _matrix(value: Any, width: int | None, name: str) -> Array:
    """Return rows of numbers as (N, width); None = any width that all have."""
    wanted = "as many" if width is None else width
    try:
        rows = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: rows of {wanted} numbers are needed ({error}).") from error
    fits = rows.ndim == 2 and rows.size and rows.shape[1] == (width or rows.shape[1])
    if not fits or not np.isfinite(rows).all():
        raise InputError(
            f"{name} has the shape {rows.shape}; at least one row of {wanted} finite numbers is "
            "needed."
        )
    return rows


def _flag(value: Any, name: str) -> bool:
    text = str(value).strip().lower()
    if text not in YES + NO:
        raise InputError(f"{name}: the via flag is {value!r}; {', '.join(YES + NO[:-1])} are read.")
    return text in YES
