"""`calibration.json`: a whole calibration in one readable file, and back."""

import json
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

import numpy as np

from realsim import __version__
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import ArmErrorMap, CameraIntrinsics, Check, RobotErrorMap, Target
from realsim.records.checked_arrays import rigid
from realsim.untrusted.own_json import OwnFile, Real, from_json, read_object, to_json
from realsim_calibration.exports.frames import FrameNames, parent_frame, quaternion_xyzw
from realsim_calibration.results import BoardShape, Clock, HandEyeReport, Mode, Stretch, ViewReport

Record = TypeVar("Record")
SCHEMA = "realsim.calibration"
VERSION = 3
ROW_LENGTH = 10
"""Numbers up to which a list of rows is written one row a line."""
SAME_ROTATION = 1e-6
"""How far matrix and quaternion of one transform may differ: more, and someone edited one."""
MAP_NOTES = {
    "pose": "T_true = T Exp(B(T) weights), see RobotErrorMap. Use X together with this map, and "
    "inside of the calibrated region only: beyond the poses of `reach` the map is a guess. X_alone "
    "needs no map.",
    "arm": "T_true = T G^-1 F(q)^-1 F'(q) G with the arm F, the arm F' whose numbers carry `errors`"
    ", and G = T_flange_tool, see ArmErrorMap; needs the joints q. Use X together with this map. "
    "X_alone needs no map.",
}
ABSOLUTE = "absolute, for another arm, a new mount, a drawing"
HERE = (
    "where this arm's camera is at the calibrated poses; covariance: for this arm as it moves here"
)
PLAIN = (
    f"without a map, by programs that know none; covariance: {ABSOLUTE}; here_covariance: for this "
    "arm as it moves here"
)
NOMINAL = (
    "do NOT use: no camera was known, and this one only gives px a meaning; --intrinsics FILE "
    "states it"
)
CONVENTIONS = {
    "transforms": "T_a_b maps points of b into a; matrices row by row; metres",
    "covariance": "of the right perturbation T Exp(xi), xi = rotation first [rad, m]; absolute "
    "(for another arm, a new mount, a drawing); X_here's, and here_covariance: for this arm as it "
    "moves here",
    "camera": "optical frame: x right, y down, z forward; integer pixels are pixel centres",
    "board": "x along the columns, y down the page, z into the paper, origin at the first point",
    "distortion": "OpenCV: k1 k2 p1 p2 k3 k4 k5 k6",
    "numbers": "written so that they read back bit for bit; null = not a number",
}

ACCURACY = (
    "seen_px", "held_out_px", "held_out_mm", "held_out_deg", "floor_px", "sigma_px", "robot_ratio",
    "mismatch_deg", "screw_ratio", "roll_range_deg",
)  # fmt: skip
CHECKED = ("checks", "clock", "nominal_lens", "T_points_board")
FITTED = (
    "map_name", "map_scores", "joint_offsets", "starts", "plain_scores", "stretch", "views",
    "information",
)  # fmt: skip


def calibration_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return the text of `calibration.json`."""
    return _pretty(to_json(_document(report, frames))) + "\n"


def read_calibration(path: Path | str) -> HandEyeReport:
    """Return the calibration of a `calibration.json`: every number as it was written.

    Raises:
        InputError: no such file, another schema or version, a missing or damaged entry.
    """
    path = Path(path)
    document = read_object(path)
    schema = document.get("schema")
    if schema != SCHEMA:
        raise InputError(
            f"{path} has the schema {schema!r}; a calibration has {SCHEMA!r}. Is it another file?"
        )
    if document.get("version") != VERSION:
        raise InputError(
            f"{path} has version {document.get('version')!r} of the schema; this program reads "
            f"version {VERSION}. Write it again with a program of the same version."
        )
    try:
        return _report(from_json(document, _File, str(path)), str(path))
    except (InputError, TypeError, ValueError) as error:
        where = "" if str(path) in str(error) else f"{path}: "
        raise InputError(f"{where}{error}") from error


# --- writing ------------------------------------------------------------------------------------


def _document(report: HandEyeReport, frames: FrameNames) -> dict[str, Any]:
    """Return a calibration as plain values."""
    in_hand = report.mode == "eye_in_hand"
    parent, other = parent_frame(report, frames), frames.robot_base if in_hand else frames.hand
    cam = frames.camera_optical
    with_map = "only together with robot_map" if report.robot_map is not None else "as it is"
    with_map += f"; covariance: {ABSOLUTE}"
    return {
        "schema": SCHEMA,
        "version": VERSION,
        "written_by": f"realsim {__version__}",
        "conventions": CONVENTIONS,
        "mode": report.mode,
        "warnings": list(report.warnings),
        "frames": frames.frames,
        "X": _transform(report.X, parent, cam, with_map, report.X_covariance),
        "X_here": None
        if report.X_here is None
        else _transform(report.X_here, parent, cam, HERE, report.X_here_covariance),
        "X_alone": {
            **_transform(report.X_alone, parent, cam, PLAIN, report.X_alone_covariance),
            "origin": report.plain_name,
            "here_covariance": report.X_alone_here_covariance,
        },
        "Z": _transform(report.Z, other, frames.target, "together with X", None),
        "Z_alone": _transform(report.Z_alone, other, frames.target, "together with X_alone", None),
        "accuracy": _entries(report, ACCURACY),
        **_entries(report, CHECKED),
        "intrinsics": {
            "use": NOMINAL if report.nominal_lens else "together with X",
            **to_json(report.intrinsics),
            "covariance": report.intrinsics_covariance,
        },
        "intrinsics_alone": {
            "use": NOMINAL if report.nominal_lens else "together with X_alone",
            **to_json(report.intrinsics_alone),
        },
        "target": {"type": type(report.target).__name__, **to_json(report.target)},
        "board": {**to_json(report.board), "warp_mm": report.board.warp_mm},
        "robot_map": _map_entries(report.robot_map),
        **_entries(report, FITTED),
    }


def _entries(record: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Return some fields of a record, which the file and the report have alike."""
    return {name: getattr(record, name) for name in names}


def _map_entries(robot_map: RobotErrorMap | ArmErrorMap | None) -> dict[str, Any] | None:
    """Return a map as plain values, its kind and how to use it before them."""
    if robot_map is None:
        return None
    kind = "arm" if isinstance(robot_map, ArmErrorMap) else "pose"
    return {**to_json(robot_map), "kind": kind, "note": MAP_NOTES[kind]}


def _transform(
    T: Array, parent: str, child: str, use: str, covariance: Array | None
) -> dict[str, Any]:
    """Return a transform as plain values, its covariance with it where there is one."""
    plain: dict[str, Any] = {
        "parent": parent,
        "child": child,
        "use": use,
        "matrix": T,
        "translation_m": T[:3, 3],
        "quaternion_xyzw": quaternion_xyzw(T),
    }
    if covariance is not None:
        plain["covariance"] = covariance
    return plain


def _pretty(value: Any, indent: str = "") -> str:
    """Return JSON in which a row of numbers is a line."""
    inner = indent + "  "
    if isinstance(value, dict) and value:
        entries = cast("dict[str, Any]", value)
        lines = [f"{inner}{json.dumps(k)}: {_pretty(v, inner)}" for k, v in entries.items()]
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(v, dict | list) for v in value):
        rows = cast("list[Any]", value)
        if not isinstance(rows[0], list) or (len(rows[0]) > 2 or len(rows) <= ROW_LENGTH):
            return "[\n" + ",\n".join(inner + _pretty(v, inner) for v in rows) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


# --- reading ------------------------------------------------------------------------------------


class _Transform(OwnFile, frozen=True, kw_only=True):
    """A transform and its frames."""

    parent: str
    child: str
    use: str
    matrix: Array
    translation_m: Array
    quaternion_xyzw: Array


class _Calibrated(_Transform, frozen=True, kw_only=True):
    """A transform that was estimated: its covariance is there."""

    covariance: Array


class _Alone(_Calibrated, frozen=True, kw_only=True):
    """X_alone: also where it comes from, and its covariance for this arm."""

    origin: str
    here_covariance: Array | None


class _File(OwnFile, frozen=True, kw_only=True):
    """The file; records with notes beside their fields are still plain."""

    schema: str
    version: int
    written_by: str
    conventions: dict[str, str]
    mode: Mode
    warnings: list[str]
    frames: dict[str, str]
    X: _Calibrated
    X_here: _Calibrated | None
    X_alone: _Alone
    Z: _Transform
    Z_alone: _Transform
    accuracy: dict[str, Real]
    checks: tuple[Check, ...]
    clock: Clock | None = None
    nominal_lens: bool = False
    T_points_board: Array | None = None
    intrinsics: dict[str, Any]
    intrinsics_alone: dict[str, Any]
    target: dict[str, Any]
    board: dict[str, Any]
    robot_map: dict[str, Any] | None
    map_name: str
    map_scores: tuple[tuple[str, Real], ...]
    joint_offsets: Array | None
    starts: tuple[tuple[str, Real], ...]
    plain_scores: tuple[tuple[str, Real], ...]
    stretch: Stretch | None
    views: tuple[ViewReport, ...]
    information: Array


def _matrix(entry: _Transform, where: str) -> Array:
    """Return a transform (4, 4), matrix and quaternion compared."""
    T = rigid(entry.matrix, where)
    q, t = (np.ravel(v) for v in (entry.quaternion_xyzw, entry.translation_m))
    same = len(q) == 4 and len(t) == 3 and np.abs(t - T[:3, 3]).max() <= SAME_ROTATION
    if (
        not same
        or se3.angle(T[:3, :3].T @ se3.from_quaternion_wxyz(q[[3, 0, 1, 2]])) > SAME_ROTATION
    ):
        raise InputError(
            f"{where}: matrix, quaternion and translation are different transforms. The file was "
            "changed by hand; write it again from the calibration."
        )
    return T


def _record(values: dict[str, Any], kind: type[Record], where: str, *beside: str) -> Record:
    """Return the record among values that stand beside other ones."""
    return from_json({k: v for k, v in values.items() if k not in beside}, kind, where)


def _report(d: _File, path: str) -> HandEyeReport:
    """Return the record of a file's entries."""
    targets = {kind.__name__: kind for kind in get_args(Target)}
    maps = {"arm": ArmErrorMap, "pose": RobotErrorMap}
    for name, known, entry in (
        ("target", targets, d.target.get("type")),
        ("robot_map", maps, (d.robot_map or {"kind": "arm"}).get("kind")),
    ):
        if entry not in known:
            raise InputError(f"{path}: {name} is {entry!r}; {', '.join(known)} are known.")
    figures: dict[str, Any] = {k: v for k, v in d.accuracy.items() if k != "floor_px"}
    robot_map = None
    if d.robot_map is not None:
        robot_map = _record(
            d.robot_map, maps[d.robot_map["kind"]], f"{path}: robot_map", "kind", "note"
        )
    if not d.intrinsics.get("covariance"):
        raise InputError(f"{path}: intrinsics have no covariance. Write the file again.")
    camera, alone = (
        _record(v, CameraIntrinsics, f"{path}: intrinsics", "use", "covariance")
        for v in (d.intrinsics, d.intrinsics_alone)
    )
    return HandEyeReport(
        mode=d.mode,
        target=_record(d.target, targets[d.target["type"]], f"{path}: target", "type"),
        X=_matrix(d.X, f"{path}: X"),
        X_covariance=d.X.covariance,
        Z=_matrix(d.Z, f"{path}: Z"),
        X_here=None if d.X_here is None else _matrix(d.X_here, f"{path}: X_here"),
        X_here_covariance=None if d.X_here is None else d.X_here.covariance,
        X_alone=_matrix(d.X_alone, f"{path}: X_alone"),
        X_alone_covariance=d.X_alone.covariance,
        X_alone_here_covariance=d.X_alone.here_covariance,
        plain_name=d.X_alone.origin,
        Z_alone=_matrix(d.Z_alone, f"{path}: Z_alone"),
        intrinsics_alone=alone,
        intrinsics=camera,
        intrinsics_covariance=np.array(d.intrinsics["covariance"], dtype=np.float64),
        board=_record(d.board, BoardShape, f"{path}: board", "warp_mm"),
        robot_map=robot_map,
        **_entries(d, CHECKED + FITTED),
        **figures,
    )
