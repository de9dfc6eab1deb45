"""Targets as files: our own JSON or YAML layout, and Kalibr's YAML.

Our layout is a flat object. `kind` is tag_board, charuco, chessboard or circle_grid, the other keys
are the record's fields; a length is given as `square_m` or as `square_mm`, never as both. An object
without `kind` that has a tag board's fields is read as one. Unknown keys are refused: a mistyped
optional key would silently mean its default. Files are data only, nothing in them is executed.
"""

import dataclasses
import math
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any, cast

from realsim.errors import InputError, UnitError
from realsim.records import TAG_CELLS, CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim.untrusted.json_text import read_json
from realsim.untrusted.yaml_text import read_yaml
from realsim_calibration.targets.marker_sets import check_markers, dictionary_name

LARGEST_BYTES = 65536
"""Largest target file: a target is a dozen numbers, anything longer is another file."""
LEAST_SPACING = 0.05
"""Least `tagSpacing` of Kalibr: tags need a white border of one module in eight or ten, so that a
smaller ratio is a gap given in metres."""
KINDS: dict[str, type[Any]] = {
    "tag_board": TagBoard,
    "charuco": CharucoBoard,
    "chessboard": Chessboard,
    "circle_grid": CircleGrid,
}
"""The values of `kind`."""
_COUNTS = ("rows", "columns", "first_id")
_SWITCHES = ("corner_squares", "legacy", "asymmetric", "large_origin")
_CHOICES: dict[str, tuple[str, ...]] = {"family": tuple(TAG_CELLS), "ids_from": ("top", "bottom")}

Json = dict[str, Any]


def target_to_json(target: Target) -> Json:
    """Return a target as plain JSON values [m]; `target_from_json` gives the same one back."""
    kind = next(name for name, record in KINDS.items() if isinstance(target, record))
    values: Json = {"kind": kind}
    for field in dataclasses.fields(target):
        value = getattr(target, field.name)
        plain = float if field.name.endswith("_m") else int if field.name in _COUNTS else (
            bool if field.name in _SWITCHES else str)  # fmt: skip
        values[field.name] = plain(value)
    return values


def target_from_json(data: Any) -> Target:
    """Return the target that an object describes, in our layout or in Kalibr's.

    Raises:
        InputError: a key is wrong, missing or doubtful; the message names it and what is accepted.
        UnitError: a length cannot be metres.
    """
    values = _object(data)
    if "target_type" in values:
        target = _from_kalibr(values)
    else:
        target = _from_ours(values)
    check_markers(target)
    return target


def _object(data: Any) -> Json:
    """Return data as an object with text keys and plain values."""
    if not isinstance(data, Mapping):
        raise InputError(
            f"a target is an object with the key 'kind' ({', '.join(KINDS)}) or Kalibr's "
            f"'target_type'; found {_type_name(data)}."
        )
    values = {str(key)[:80]: value for key, value in cast("Mapping[Any, Any]", data).items()}
    for key, value in values.items():
        # The value itself is not shown: nested aliases of YAML can be of any length.
        if not isinstance(value, (str, bool, int, float)):
            raise InputError(f"target: '{key}' must be one value, found {_type_name(value)}.")
    return values


def _type_name(value: Any) -> str:
    """Return what a value is, in words."""
    if value is None:
        return "nothing"
    return {"dict": "an object", "list": "a list", "str": "text"}.get(
        type(value).__name__, f"a value of type {type(value).__name__}"
    )


# --- our own layout ---------------------------------------------------------------------------


def _from_ours(values: Json) -> Target:
    """Return the target of our own layout."""
    kind = values.get("kind")
    if kind is None and {"rows", "columns"} <= set(values) and any(
        key in values for key in ("tag_size_m", "tag_size_mm")
    ):  # fmt: skip
        kind = "tag_board"
    if kind is None:
        raise InputError(
            f"the target lacks 'kind' (accepted: {', '.join(KINDS)}) or Kalibr's 'target_type'; it "
            f"has: {', '.join(values) or 'nothing'}."
        )
    record = KINDS.get(str(kind))
    if record is None:
        raise InputError(f"the target's kind '{kind}' is not known; accepted: {', '.join(KINDS)}.")
    fields = {field.name: field for field in dataclasses.fields(record)}
    _refuse_unknown(values, fields, str(kind))
    given: Json = {}
    for name, field in fields.items():
        value = _field(values, name, str(kind))
        if value is not None:
            given[name] = value
        elif field.default is dataclasses.MISSING:
            needed = f"'{name}' or '{name}m'" if name.endswith("_m") else f"'{name}'"
            raise InputError(f"the {kind} target lacks {needed}; it has: {', '.join(values)}.")
    return cast(Target, record(**given))


def _refuse_unknown(values: Json, fields: Mapping[str, Any], kind: str) -> None:
    """Raise if a key is none of the record's."""
    known = ["kind"]
    for name in fields:
        known += [name, f"{name}m"] if name.endswith("_m") else [name]
    unknown = [key for key in values if key not in known]
    if unknown:
        raise InputError(
            f"the {kind} target has the unknown key{'s' * (len(unknown) > 1)} "
            f"{', '.join(unknown)}; accepted: {', '.join(known)}."
        )


def _field(values: Json, name: str, kind: str) -> Any:
    """Return the checked value of a record's field, None where it is not given."""
    if name.endswith("_m"):
        return _either_length(values, name, kind)
    if name not in values:
        return None
    if name in _COUNTS:
        return _count(values, name)
    if name in _SWITCHES:
        return _switch(values, name)
    value = values[name]
    if not isinstance(value, str):
        raise InputError(f"target: '{name}' must be text, found {value}.")
    if name == "dictionary":
        return dictionary_name(value)
    if value not in _CHOICES[name]:
        raise InputError(
            f"target: '{name}' is '{value[:80]}'; accepted: {', '.join(_CHOICES[name])}."
        )
    return value


def _either_length(values: Json, name: str, kind: str) -> float | None:
    """Return a length given in metres or in millimetres [m]."""
    in_mm = f"{name}m"
    if name in values and in_mm in values:
        raise InputError(
            f"the {kind} target has both '{name}' and '{in_mm}'; give the length once."
        )
    if name in values:
        return _length(values, name, "m")
    return _length(values, in_mm, "mm") if in_mm in values else None


def _length(values: Json, key: str, unit: str) -> float:
    """Return a length [m]."""
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(
            f"target: '{key}' must be a number [{unit}] without a unit behind it, found "
            f"{_shown(value)}."
        )
    if not abs(value) < 1e6 or math.isnan(value) or value <= 0:
        raise UnitError(
            f"target: '{key}' is {_shown(value)} {unit}; a positive length is expected."
        )
    # Scaled as a decimal number, so that 21.9 mm is 0.0219 m to the last bit.
    return float(Decimal(repr(value)) / 1000) if unit == "mm" else float(value)


def _shown(value: Any) -> str:
    """Return a value for a message, cut short."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**12:
        return "a huge number"
    text = f"'{value}'" if isinstance(value, str) else str(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _count(values: Json, key: str) -> int:
    """Return a whole number that is not negative."""
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 10**6:
        raise InputError(f"target: '{key}' must be a whole number, found {_shown(value)}.")
    return value


def _switch(values: Json, key: str) -> bool:
    """Return a truth value."""
    value = values[key]
    if not isinstance(value, bool):
        raise InputError(f"target: '{key}' must be true or false, found {_shown(value)}.")
    return value


# --- Kalibr -----------------------------------------------------------------------------------

_KALIBR: dict[str, tuple[str, ...]] = {
    "aprilgrid": ("tagCols", "tagRows", "tagSize", "tagSpacing"),
    "checkerboard": ("targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters"),
    "circlegrid": ("targetCols", "targetRows", "spacingMeters", "asymmetricGrid"),
}
"""Kalibr's `target_type` and the keys that each has, all of them needed."""


def _from_kalibr(values: Json) -> Target:
    """Return the target of Kalibr's layout.

    Source: github.com/ethz-asl/kalibr, wiki page "Calibration targets". `tagSpacing` is the gap as
    a share of the tag; rows and columns of a checkerboard are inner corners; ids of an aprilgrid
    start at the bottom row, and black squares sit between the tags' corners.
    """
    kind = _shown(values["target_type"]).strip("'").lower()
    keys = _KALIBR.get(kind)
    if keys is None:
        raise InputError(
            f"Kalibr's target_type '{kind}' is not known; accepted: {', '.join(_KALIBR)}."
        )
    unknown = [key for key in values if key not in (*keys, "target_type")]
    missing = [key for key in keys if key not in values]
    if unknown or missing:
        faults = [f"lacks {', '.join(missing)}"] * bool(missing)
        faults += [f"has the unknown {', '.join(unknown)}"] * bool(unknown)
        raise InputError(
            f"Kalibr's {kind} {' and '.join(faults)}; accepted: target_type, {', '.join(keys)}."
        )
    if kind == "aprilgrid":
        return _kalibr_aprilgrid(values)
    columns, rows = _count(values, "targetCols"), _count(values, "targetRows")
    if kind == "circlegrid":
        return CircleGrid(
            rows=rows,
            columns=columns,
            pitch_m=_length(values, "spacingMeters", "m"),
            asymmetric=_switch(values, "asymmetricGrid"),
        )
    along_y = _length(values, "rowSpacingMeters", "m")
    along_x = _length(values, "colSpacingMeters", "m")
    if along_y != along_x:
        raise InputError(
            f"Kalibr's checkerboard has rowSpacingMeters {along_y} and colSpacingMeters {along_x}; "
            "only square fields are accepted: both must be the same."
        )
    return Chessboard(rows=rows, columns=columns, square_m=along_x)


def _kalibr_aprilgrid(values: Json) -> TagBoard:
    """Return Kalibr's aprilgrid."""
    size = _length(values, "tagSize", "m")
    ratio = values["tagSpacing"]
    number = isinstance(ratio, (int, float)) and not isinstance(ratio, bool)
    if not number or not LEAST_SPACING <= ratio <= 1 / LEAST_SPACING:
        raise InputError(
            f"Kalibr's tagSpacing is {_shown(ratio)}; the gap as a share of tagSize is expected, "
            f"at least {LEAST_SPACING:g}, for example 0.3. Was the gap given in metres? Then write "
            "gap / tagSize."
        )
    return TagBoard(
        rows=_count(values, "tagRows"),
        columns=_count(values, "tagCols"),
        tag_size_m=size,
        gap_m=float(Decimal(repr(size)) * Decimal(repr(ratio))),
        ids_from="bottom",
        corner_squares=True,
    )


# --- files ------------------------------------------------------------------------------------


def read_target(path: Path | str) -> Target:
    """Return the target of a .json, .yaml or .yml file.

    Raises:
        InputError: the file is not there, too large, not JSON or YAML, or not a target.
    """
    path = Path(path)
    readers = {".json": read_json, ".yaml": read_yaml, ".yml": read_yaml}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"{path}: a target file ends in {', '.join(readers)}; this one ends in '{path.suffix}'."
        )
    values = reader(path, most_bytes=LARGEST_BYTES)
    try:
        return target_from_json(values)
    except InputError as error:
        raise type(error)(f"{path}: {error}") from None
