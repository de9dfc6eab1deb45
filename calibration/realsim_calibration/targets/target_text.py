"""Targets as one line of text: for a command line, and printed on the sheet itself.

    charuco:5x7,square=33mm,marker=20mm,dict=6X6_100[,legacy]
    chessboard:8x6,square=21.9mm
    circles:10x10,pitch=25.4mm[,asymmetric][,large-origin]
    aprilgrid:6x4,tag=40mm,gap=10mm[,family=tag36h11][,first=0][,from-bottom][,corner-squares]
    tag:7,size=80mm[,gap=10mm][,family=tag36h11]

Counts are columns x rows: of squares for a ChArUco board, of INNER CORNERS for a chessboard, of
dots, of tags. Lengths carry their unit. `format_target` writes what `parse_target` reads, and the
same target comes back bit for bit.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, cast

from realsim.errors import InputError, UnitError
from realsim.records import TAG_CELLS, CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.targets.marker_sets import check_markers, dictionary_name

UNITS_M: dict[str, Decimal] = {
    "mm": Decimal("0.001"),
    "cm": Decimal("0.01"),
    "m": Decimal(1),
    "in": Decimal("0.0254"),
}
"""Units of length and their size [m]."""
LONGEST_TEXT = 400
"""Longest line [characters]; the longest target takes a third of it."""
FILE_ENDINGS = (".json", ".yaml", ".yml")
"""A line that ends so was meant as the name of a target file."""
_LENGTH = re.compile(r"([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*([a-zA-Zµ\"]*)")
_COUNTS = re.compile(r"([0-9]{1,4})\s*[xX×]\s*([0-9]{1,4})")
_NUMBER = re.compile(r"[0-9]{1,6}")


def parse_length(text: str, what: str) -> float:
    """Return a length with its unit, such as '21.9mm', in metres.

    The decimal number is scaled exactly before it becomes a float, so that '21.9mm' is 0.0219.

    Raises:
        UnitError: it has no unit, or one that is not known.
        InputError: it is not a number.
    """
    found = _LENGTH.fullmatch(text.strip())
    if found is None:
        raise InputError(
            f"'{what}={text}' is not a length; write a number and its unit, for example "
            f"{what}=33mm."
        )
    number, unit = found.groups()
    if unit not in UNITS_M:
        fault = f"has the unit '{unit}'" if unit else "has no unit"
        raise UnitError(
            f"'{what}={text}' {fault}; accepted units: {', '.join(UNITS_M)}. Write for example "
            f"{what}={number}mm."
        )
    return float(Decimal(number) * UNITS_M[unit])


def format_length(value_m: float) -> str:
    """Return a length in millimetres with its unit; `parse_length` gives the same float back."""
    value = Decimal(repr(float(value_m))) / UNITS_M["mm"]
    text = format(value.normalize(), "f")
    return f"{text}mm"


def _number(text: str, key: str) -> int:
    """Return a whole number."""
    if not _NUMBER.fullmatch(text):
        raise InputError(f"'{key}={text}' is not a whole number; write for example {key}=0.")
    return int(text)


def _family(text: str, key: str) -> str:
    """Return the AprilTag family."""
    family = text.lower() if text.lower().startswith("tag") else f"tag{text.lower()}"
    if family not in TAG_CELLS:
        raise InputError(f"'{key}={text}' is not known; accepted: {', '.join(TAG_CELLS)}.")
    return family


def single_tag_gap(tag_size_m: float, family: str) -> float:
    """Return the white border that every tag needs, one module wide [m]."""
    return tag_size_m / TAG_CELLS[family]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Form:
    """One kind of target: which words its line may have."""

    usage: str
    """A line that is accepted, for messages."""
    record: type[Any]
    counted: str
    """What the counts count, for messages; empty where a single id stands in their place."""
    needed: tuple[str, ...]
    """Keys that must be given."""
    optional: tuple[str, ...] = ()
    """Keys that may be given."""
    flags: tuple[str, ...] = ()
    """Words without a value."""


KEYS: dict[str, tuple[str, Callable[[str, str], Any]]] = {
    "square": ("square_m", parse_length),
    "marker": ("marker_m", parse_length),
    "pitch": ("pitch_m", parse_length),
    "tag": ("tag_size_m", parse_length),
    "size": ("tag_size_m", parse_length),
    "gap": ("gap_m", parse_length),
    "dict": ("dictionary", lambda text, _: dictionary_name(text)),
    "family": ("family", _family),
    "first": ("first_id", _number),
}
"""The record's field that each key is, and how its text is read."""
FLAGS: dict[str, tuple[str, Any]] = {
    "legacy": ("legacy", True),
    "asymmetric": ("asymmetric", True),
    "large-origin": ("large_origin", True),
    "from-bottom": ("ids_from", "bottom"),
    "corner-squares": ("corner_squares", True),
}
"""The record's field that each word without a value sets."""
FORMS: dict[str, _Form] = {
    "charuco": _Form(
        record=CharucoBoard,
        usage="charuco:5x7,square=33mm,marker=20mm,dict=6X6_100[,legacy]",
        counted="COLUMNSxROWS of squares",
        needed=("square", "marker", "dict"),
        flags=("legacy",),
    ),
    "chessboard": _Form(
        record=Chessboard,
        usage="chessboard:8x6,square=21.9mm",
        counted="COLUMNSxROWS of INNER CORNERS",
        needed=("square",),
    ),
    "circles": _Form(
        record=CircleGrid,
        usage="circles:10x10,pitch=25.4mm[,asymmetric][,large-origin]",
        counted="COLUMNSxROWS of dots",
        needed=("pitch",),
        flags=("asymmetric", "large-origin"),
    ),
    "aprilgrid": _Form(
        record=TagBoard,
        usage="aprilgrid:6x4,tag=40mm,gap=10mm[,family=tag36h11][,first=0][,from-bottom]"
        "[,corner-squares]",
        counted="COLUMNSxROWS of tags",
        needed=("tag", "gap"),
        optional=("family", "first"),
        flags=("from-bottom", "corner-squares"),
    ),
    "tag": _Form(
        record=TagBoard,
        usage="tag:7,size=80mm[,gap=10mm][,family=tag36h11]",
        counted="",
        needed=("size",),
        optional=("gap", "family"),
    ),
}
"""The kinds of target that a line may name."""


def target_usage() -> str:
    """Return the accepted forms, one a line, for help texts."""
    lines = [form.usage + (f"   ({form.counted})" if form.counted else "") for form in
             FORMS.values()]  # fmt: skip
    return "\n".join(lines)


def parse_target(text: str) -> Target:
    """Return the target that a line such as 'chessboard:8x6,square=21.9mm' describes.

    Raises:
        InputError: a word is wrong or missing; the message names it and what is accepted.
        UnitError: a length has no unit.
    """
    text = text.strip()
    if len(text) > LONGEST_TEXT:
        raise InputError(
            f"a target's line has at most {LONGEST_TEXT} characters, this one has {len(text)}."
        )
    kind, colon, rest = text.partition(":")
    form = FORMS.get(kind.strip().lower())
    if text.lower().endswith(FILE_ENDINGS):
        raise InputError(
            f"no such file: '{text}'. Give the target file that `realsim board` wrote, or one line:"
            f"\n{target_usage()}"
        )
    if form is None or not colon:
        raise InputError(
            f"`{text}` is no kind of target. Accepted are lines like:\n" + target_usage()
        )
    target = cast(Target, form.record(**_fields(text, rest, form)))
    check_markers(target)
    return target


def _fields(text: str, rest: str, form: _Form) -> dict[str, Any]:
    """Return the record's fields by the words behind the kind, each one that the kind has."""
    first, *others = [word.strip() for word in rest.split(",")]
    values: dict[str, str] = {}
    flags: set[str] = set()
    for word in others:
        key, equals, value = (part.strip() for part in word.partition("="))
        key = key.lower()
        allowed = (*form.needed, *form.optional) if equals else form.flags
        if key not in allowed:
            raise InputError(_not_accepted(text, word, form))
        if key in values or key in flags:
            raise InputError(f"'{key}' occurs twice in '{text}'; give it once.")
        if equals:
            values[key] = value
        else:
            flags.add(key)
    missing = [key for key in form.needed if key not in values]
    if missing:
        raise InputError(
            f"'{text}' lacks {', '.join(f'{key}=' for key in missing)}. Accepted: {form.usage}"
        )
    count = _leading(text, first, form)
    columns, rows = count if form.counted else (1, 1)
    fields: dict[str, Any] = {"columns": columns, "rows": rows}
    for key in (*form.needed, *form.optional):
        if key in values:
            name, read = KEYS[key]
            fields[name] = read(values[key], key)
    if not form.counted:
        fields["first_id"] = count[0]
        usual = single_tag_gap(fields["tag_size_m"], fields.get("family", "tag36h11"))
        fields.setdefault("gap_m", usual)
    return fields | dict(FLAGS[flag] for flag in flags)


def _not_accepted(text: str, word: str, form: _Form) -> str:
    """Return the message on a word that a kind does not have."""
    known = [f"{key}=" for key in (*form.needed, *form.optional)] + list(form.flags)
    name = word.partition("=")[0].strip().lower()
    if name in form.flags:
        hint = f" '{name}' takes no value."
    elif name in (*form.needed, *form.optional):
        hint = f" '{name}' needs a value."
    else:
        hint = ""
    return (
        f"'{word}' in '{text}' is not accepted.{hint} Accepted words: {', '.join(known)}; for "
        f"example {form.usage}"
    )


def _leading(text: str, first: str, form: _Form) -> tuple[int, int]:
    """Return the counts, or the id twice."""
    if not form.counted:
        if not _NUMBER.fullmatch(first):
            raise InputError(f"'{first}' in '{text}' is not a tag's id. Accepted: {form.usage}")
        return int(first), int(first)
    found = _COUNTS.fullmatch(first)
    if found is None:
        raise InputError(
            f"'{first}' in '{text}' is not {form.counted}, such as 8x6. Accepted: {form.usage}"
        )
    return int(found[1]), int(found[2])


def format_target(target: Target) -> str:
    """Return the line that `parse_target` reads as this very target."""
    counts = f"{target.columns}x{target.rows}"
    if isinstance(target, CharucoBoard):
        name = dictionary_name(target.dictionary).removeprefix("DICT_")
        square, marker = format_length(target.square_m), format_length(target.marker_m)
        legacy = ",legacy" if target.legacy else ""
        return f"charuco:{counts},square={square},marker={marker},dict={name}{legacy}"
    if isinstance(target, Chessboard):
        return f"chessboard:{counts},square={format_length(target.square_m)}"
    if isinstance(target, CircleGrid):
        flags = ",asymmetric" * target.asymmetric + ",large-origin" * target.large_origin
        return f"circles:{counts},pitch={format_length(target.pitch_m)}{flags}"
    return _format_tags(target, counts)


def _format_tags(board: TagBoard, counts: str) -> str:
    """Return the line of a tag board, the short form for a single plain tag."""
    size, gap = format_length(board.tag_size_m), format_length(board.gap_m)
    family = "" if board.family == "tag36h11" else f",family={board.family}"
    single = board.rows == board.columns == 1
    if single and board.ids_from == "top" and not board.corner_squares:
        usual = board.gap_m == single_tag_gap(board.tag_size_m, board.family)
        return f"tag:{board.first_id},size={size}{'' if usual else f',gap={gap}'}{family}"
    first = f",first={board.first_id}" if board.first_id else ""
    flags = ",from-bottom" * (board.ids_from == "bottom") + ",corner-squares" * board.corner_squares
    return f"aprilgrid:{counts},tag={size},gap={gap}{family}{first}{flags}"


def _mm(value_m: float) -> str:
    """Return a length for the reader."""
    return f"{value_m * 1000:.6g} mm"


def describe(target: Target) -> str:
    """Return one line that tells a reader what the target is."""
    counts = f"{target.columns} x {target.rows}"
    turn = "; looks the same turned by 180 deg" if target.half_turn else ""
    if isinstance(target, CharucoBoard):
        legacy = ", legacy pattern" if target.legacy else ""
        return (
            f"ChArUco board, {counts} squares of {_mm(target.square_m)}, markers of "
            f"{_mm(target.marker_m)} from {dictionary_name(target.dictionary)}{legacy}"
        )
    if isinstance(target, Chessboard):
        return f"Chessboard, {counts} inner corners, squares of {_mm(target.square_m)}{turn}"
    if isinstance(target, CircleGrid):
        kind = "Asymmetric circle grid" if target.asymmetric else "Circle grid"
        pitch = f"rows {_mm(target.pitch_m)} apart" if target.asymmetric else (
            f"{_mm(target.pitch_m)} apart")  # fmt: skip
        large = ", first dot larger" if target.large_origin else ""
        return f"{kind}, {counts} dots, {pitch}{large}{turn}"
    if target.rows == target.columns == 1:
        return f"AprilTag {target.first_id} of {target.family}, edge {_mm(target.tag_size_m)}"
    last = target.first_id + target.rows * target.columns - 1
    squares = ", with corner squares" if target.corner_squares else ""
    return (
        f"AprilGrid, {counts} tags of {_mm(target.tag_size_m)}, gaps of {_mm(target.gap_m)}, "
        f"{target.family}, ids {target.first_id} to {last} from the {target.ids_from}{squares}"
    )
