"""`calibration.json`: a whole calibration in one readable file, and back."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from realsim import __version__
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.records import ArmErrorMap, CameraIntrinsics, Check, RobotErrorMap, Target
from realsim.records.checked_arrays import frozen, rigid
from realsim.store import atomic
from realsim_calibration.exports.frames import FrameNames, parent_frame, quaternion_xyzw
from realsim_calibration.results import BoardShape, HandEyeReport, ViewReport

Array = NDArray[np.float64]
SCHEMA = "realsim.calibration"
VERSION = 2
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
ARM_ROWS = ("a", "d", "alpha", "theta", "delta_a", "delta_d", "delta_alpha", "delta_theta")
CONVENTIONS = {
    "transforms": "T_a_b maps points of b into a; matrices row by row; metres",
    "covariance": "of the right perturbation T Exp(xi), xi = rotation first [rad, m]",
    "camera": "optical frame: x right, y down, z forward; integer pixels are pixel centres",
    "board": "x along the columns, y down the page, z into the paper, origin at the first point",
    "distortion": "OpenCV: k1 k2 p1 p2 k3 k4 k5 k6",
    "numbers": "written so that they read back bit for bit; null = not a number",
}


def write_calibration(report: HandEyeReport, path: Path | str, *, frames: FrameNames) -> Path:
    """Write a calibration as `calibration.json`, whole or not at all."""
    path = Path(path)
    atomic.write_text(path, calibration_text(report, frames))
    return path


def calibration_text(report: HandEyeReport, frames: FrameNames) -> str:
    """Return the text of `calibration.json`."""
    return _pretty(_document(report, frames)) + "\n"


def read_calibration(path: Path | str) -> HandEyeReport:
    """Return the calibration of a `calibration.json`: every number as it was written.

    Raises:
        InputError: no such file, another schema or version, a missing or damaged entry.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"the calibration {path} does not exist.") from None
    except (json.JSONDecodeError, UnicodeDecodeError, OSError) as error:
        raise InputError(f"the calibration {path} cannot be read as JSON: {error}.") from None
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema != SCHEMA:
        raise InputError(
            f"{path} has the schema {schema!r}; a calibration has {SCHEMA!r}. Is it another file?"
        )
    if document.get("version") != VERSION:
        raise InputError(
            f"{path} has version {document.get('version')!r} of the schema; this program reads "
            f"version {VERSION}. Write it again with a program of the same version."
        )
    return _report(_Entry(cast("Mapping[str, Any]", document), str(path)))


# --- writing ------------------------------------------------------------------------------------


def _document(report: HandEyeReport, frames: FrameNames) -> dict[str, Any]:
    """Return a calibration as plain values."""
    in_hand = report.mode == "eye_in_hand"
    parent, other = parent_frame(report, frames), frames.robot_base if in_hand else frames.hand
    cam = frames.camera_optical
    with_map = "only together with robot_map" if report.robot_map is not None else "as it is"
    return {
        "schema": SCHEMA,
        "version": VERSION,
        "written_by": f"realsim {__version__}",
        "conventions": CONVENTIONS,
        "mode": report.mode,
        "warnings": list(report.warnings),
        "frames": {
            "robot_base": frames.robot_base,
            "hand": frames.hand,
            "camera_optical": cam,
            "target": frames.target,
        },
        "X": _transform(report.X, parent, cam, with_map, report.X_covariance),
        "X_alone": _transform(
            report.X_alone, parent, cam, "without a map", report.X_alone_covariance
        ),
        "Z": _transform(report.Z, other, frames.target, "together with X", None),
        "Z_alone": _transform(report.Z_alone, other, frames.target, "together with X_alone", None),
        "accuracy": {
            "seen_px": report.seen_px,
            "held_out_px": report.held_out_px,
            "held_out_mm": report.held_out_mm,
            "held_out_deg": report.held_out_deg,
            "floor_px": report.floor_px,
            "sigma_px": report.sigma_px,
            "robot_ratio": report.robot_ratio,
            "mismatch_deg": report.mismatch_deg,
            "screw_ratio": report.screw_ratio,
            "roll_range_deg": report.roll_range_deg,
        },
        "checks": [dataclasses.asdict(c) for c in report.checks],
        "intrinsics": {
            "use": "together with X",
            **dataclasses.asdict(report.intrinsics),
            "covariance": report.intrinsics_covariance,
        },
        "intrinsics_alone": {
            "use": "together with X_alone",
            **dataclasses.asdict(report.intrinsics_alone),
        },
        "target": {"type": type(report.target).__name__, **dataclasses.asdict(report.target)},
        "board": {**dataclasses.asdict(report.board), "warp_mm": report.board.warp_mm},
        "robot_map": _map_entries(report.robot_map),
        "map_name": report.map_name,
        "map_scores": [list(pair) for pair in report.map_scores],
        "joint_offsets": report.joint_offsets,
        "starts": [list(pair) for pair in report.starts],
        "views": [dataclasses.asdict(v) for v in report.views],
        "information": report.information,
    }


def _map_entries(robot_map: RobotErrorMap | ArmErrorMap | None) -> dict[str, Any] | None:
    """Return a map as plain values, its kind and how to use it before them."""
    if robot_map is None:
        return None
    kind = "arm" if isinstance(robot_map, ArmErrorMap) else "pose"
    return {"kind": kind, "note": MAP_NOTES[kind], **dataclasses.asdict(robot_map)}


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


def _plain(value: Any) -> Any:
    """Return arrays, tuples and floats as JSON takes them: NaN = null, infinity = a word."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in cast("dict[str, Any]", value).items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in cast("list[Any]", value)]
    if isinstance(value, float) and not np.isfinite(value):
        return None if np.isnan(value) else str(value)
    return value


def _pretty(value: Any, indent: str = "") -> str:
    """Return JSON in which a row of numbers is a line."""
    value = _plain(value)
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


class _Entry:
    """A part of the file, and where it is, for messages."""

    def __init__(self, value: Mapping[str, Any], where: str) -> None:
        self.value = value
        self.where = where

    def wrong(self, key: str, what: str) -> InputError:
        """Return the error of one entry."""
        return InputError(
            f"{self.where}: '{key}' {what}. The file was cut short or changed by hand; write it "
            "again from the calibration."
        )

    def raw(self, key: str) -> Any:
        """Return an entry as it is."""
        if key not in self.value:
            raise self.wrong(key, "is missing")
        return self.value[key]

    def part(self, key: str) -> "_Entry":
        """Return an entry that holds entries."""
        value = self.raw(key)
        if not isinstance(value, dict):
            raise self.wrong(key, "does not hold named entries")
        return _Entry(cast("Mapping[str, Any]", value), f"{self.where}: '{key}'")

    def parts(self, key: str) -> "list[_Entry]":
        """Return a list of entries that hold entries."""
        value = self.raw(key)
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            raise self.wrong(key, "is not a list of named entries")
        items = cast("list[Mapping[str, Any]]", value)
        return [_Entry(v, f"{self.where}: '{key}' [{k}]") for k, v in enumerate(items)]

    def text(self, key: str) -> str:
        """Return a text."""
        value = self.raw(key)
        if not isinstance(value, str):
            raise self.wrong(key, f"is {value!r}, not a text")
        return value

    def number(self, key: str) -> float:
        """Return a number, NaN for null."""
        return float(self.array(key, ()))

    def integer(self, key: str) -> int:
        """Return a whole number."""
        value = self.number(key)
        if not value.is_integer():
            raise self.wrong(key, f"is {self.raw(key)!r}, not a whole number")
        return int(value)

    def integers(self, key: str) -> tuple[int, ...]:
        """Return whole numbers."""
        values = self.array(key, (None,))
        if not np.array_equal(values, np.rint(values)) or not np.all(np.isfinite(values)):
            raise self.wrong(key, f"is {self.raw(key)!r}, not a list of whole numbers")
        return tuple(int(v) for v in values)

    def array(self, key: str, shape: tuple[int | None, ...]) -> Array:
        """Return an array of numbers of a shape (None = any length), null = NaN."""
        value = self.raw(key)
        try:
            if value == [] and shape and shape[0] is None:
                value = np.zeros([n or 0 for n in shape])
            array = np.array(value, dtype=np.float64)
            return frozen(array, np.float64, shape, f"'{key}'")
        except (TypeError, ValueError, InputError) as error:
            raise self.wrong(key, f"cannot be used ({error})") from None

    def scores(self, key: str) -> tuple[tuple[str, float], ...]:
        """Return (name, number) pairs."""
        value = self.raw(key)
        try:
            pairs = [(name, float("nan" if px is None else px)) for name, px in value]
        except (TypeError, ValueError) as error:
            raise self.wrong(key, f"is not a list of names and numbers ({error})") from None
        return tuple((str(name), px) for name, px in pairs)


def _read_transform(entry: _Entry) -> Array:
    """Return a transform (4, 4), matrix and quaternion compared."""
    T = rigid(entry.array("matrix", (4, 4)), f"{entry.where}: 'matrix'")
    q, t = entry.array("quaternion_xyzw", (4,)), entry.array("translation_m", (3,))
    turned = se3.angle(T[:3, :3].T @ se3.from_quaternion_wxyz(q[[3, 0, 1, 2]]))
    if turned > SAME_ROTATION or np.abs(t - T[:3, 3]).max() > SAME_ROTATION:
        raise entry.wrong("matrix", "and its quaternion and translation are different transforms")
    return T


def _report(d: _Entry) -> HandEyeReport:
    """Return the record of a file's entries."""
    mode = d.text("mode")
    if mode not in ("eye_in_hand", "eye_to_hand"):
        raise d.wrong("mode", f"is {mode!r}; eye_in_hand and eye_to_hand are known")
    accuracy, offsets = d.part("accuracy"), d.raw("joint_offsets")
    names = (
        "seen_px", "held_out_px", "held_out_mm", "held_out_deg", "sigma_px", "robot_ratio",
        "mismatch_deg", "screw_ratio", "roll_range_deg",
    )  # fmt: skip
    figures = {name: accuracy.number(name) for name in names}
    return HandEyeReport(
        mode=mode,
        target=_target(d.part("target")),
        X=_read_transform(d.part("X")),
        X_covariance=d.part("X").array("covariance", (6, 6)),
        Z=_read_transform(d.part("Z")),
        X_alone=_read_transform(d.part("X_alone")),
        X_alone_covariance=d.part("X_alone").array("covariance", (6, 6)),
        Z_alone=_read_transform(d.part("Z_alone")),
        intrinsics_alone=_intrinsics(d.part("intrinsics_alone")),
        intrinsics=_intrinsics(d.part("intrinsics")),
        intrinsics_covariance=d.part("intrinsics").array("covariance", (12, 12)),
        board=_board(d.part("board")),
        robot_map=None if d.raw("robot_map") is None else _map(d.part("robot_map")),
        map_name=d.text("map_name"),
        map_scores=d.scores("map_scores"),
        joint_offsets=None if offsets is None else d.array("joint_offsets", (6, 2)),
        views=tuple(_view(v) for v in d.parts("views")),
        starts=d.scores("starts"),
        checks=tuple(_check(c) for c in d.parts("checks")),
        information=d.array("information", (None, None)),
        **figures,
    )


def _target(d: _Entry) -> Target:
    """Return the printed target."""
    kinds = {kind.__name__: kind for kind in get_args(Target)}
    name = d.text("type")
    if name not in kinds:
        raise d.wrong("type", f"is {name!r}; {', '.join(kinds)} are known")
    fields = {k: v for k, v in d.value.items() if k != "type"}
    try:
        return kinds[name](**fields)
    except TypeError as error:
        raise d.wrong("type", f"does not fit its entries ({error})") from None


def _intrinsics(d: _Entry) -> CameraIntrinsics:
    """Return the camera."""
    return CameraIntrinsics(
        width=d.integer("width"),
        height=d.integer("height"),
        fx=d.number("fx"),
        fy=d.number("fy"),
        cx=d.number("cx"),
        cy=d.number("cy"),
        distortion=d.array("distortion", (8,)),
    )


def _board(d: _Entry) -> BoardShape:
    """Return the target's shape."""
    sides = None if d.raw("half_sides_m") is None else d.array("half_sides_m", (2,))
    return BoardShape(
        scale=d.number("scale"),
        aspect=d.number("aspect"),
        warp=d.array("warp", (3,)),
        sd=d.array("sd", (5,)),
        half_extent_m=d.number("half_extent_m"),
        half_sides_m=None if sides is None else (float(sides[0]), float(sides[1])),
    )


def _map(d: _Entry) -> RobotErrorMap | ArmErrorMap:
    """Return the robot's error map."""
    kind = d.text("kind")
    if kind == "arm":
        arm = d.part("arm")
        return ArmErrorMap(
            arm=DhArm(name=arm.text("name"), **{row: arm.array(row, (6,)) for row in ARM_ROWS}),
            errors=d.array("errors", (24,)),
            T_flange_tool=rigid(d.array("T_flange_tool", (4, 4)), f"{d.where}: 'T_flange_tool'"),
        )
    frame = d.text("frame") if kind == "pose" else ""
    if frame not in ("ee", "base"):
        raise d.wrong("kind", f"is {kind!r} in the axes of {frame!r}; arm, and pose in ee or base")
    return RobotErrorMap(
        frame=frame,
        mean=d.array("mean", (12,)),
        sd_m=d.number("sd_m"),
        weights=d.array("weights", (6, 12)),
        reach=d.array("reach", (None, 12)),
    )


def _check(d: _Entry) -> Check:
    """Return one check."""
    verdict = d.text("verdict")
    if verdict not in ("good", "warn", "bad", "unknown"):
        raise d.wrong("verdict", f"is {verdict!r}; good, warn, bad and unknown are known")
    return Check(
        name=d.text("name"),
        verdict=verdict,
        sentence=d.text("sentence"),
        advice=d.text("advice"),
        value=d.number("value"),
        unit=d.text("unit"),
        views=d.integers("views"),
    )


def _view(d: _Entry) -> ViewReport:
    """Return one view."""
    T = rigid(d.array("T_base_ee", (4, 4)), f"{d.where}: 'T_base_ee'")
    ids, uv = d.integers("point_ids"), d.array("uv", (None, 2))
    if len(ids) != len(uv):
        raise d.wrong("point_ids", f"has {len(ids)} numbers for {len(uv)} points")
    return ViewReport(
        index=d.integer("index"),
        label=d.text("label"),
        used=bool(d.raw("used")),
        reason=d.text("reason"),
        T_base_ee=T,
        joints=None if d.raw("joints") is None else d.array("joints", (6,)),
        point_ids=np.array(ids, dtype=np.int64),
        uv=uv,
        residuals=d.array("residuals", (None, 2)),
        seen_px=d.number("seen_px"),
        unseen_px=d.number("unseen_px"),
        unseen_mm=d.number("unseen_mm"),
        unseen_deg=d.number("unseen_deg"),
        robot_error=d.array("robot_error", (6,)),
    )
