"""Pose files of lines: whitespace, comma, semicolon or tab between the numbers."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim_calibration.inputs.columns import ACCEPTED, LABEL_NAMES, PoseTable, role_of

LAST = np.array([0.0, 0.0, 0.0, 1.0])
"""The last row of a 4x4 matrix."""
COMMENT = ("#", "//", "%")
IMAGE_ENDING = re.compile(r"\.(png|jpe?g|bmp|tiff?|webp|pgm|ppm)$", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_NOT_FINITE = {"nan": np.nan, ".nan": np.nan, "inf": np.inf, ".inf": np.inf, "infinity": np.inf}


@dataclass(frozen=True, kw_only=True, slots=True)
class TextLine:
    """One line of a file that is not a comment."""

    number: int
    """Counted from 1."""
    fields: list[str]


def number_of(token: str) -> float | None:
    """Return the number that a token is, NaN and infinities included; None if it is none."""
    text = token.strip().removeprefix("p[").strip("[](){} \"'")
    if _NUMBER.fullmatch(text):
        return float(text.replace("d", "e").replace("D", "e"))
    sign = -1.0 if text.startswith("-") else 1.0
    value = _NOT_FINITE.get(text.lstrip("+-").lower())
    return None if value is None else sign * value


def decoded(path: Path, data: bytes) -> str:
    """Return the text of a file: UTF-8 or, with its mark, UTF-16; old 8-bit files as Latin-1.

    Raises:
        InputError: it is not text.
    """
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            return data.decode("utf-16")
        except UnicodeDecodeError as error:
            raise InputError(f"{path} starts like UTF-16 text but is not ({error}).") from error
    if b"\x00" in data:
        raise InputError(
            f"{path} is not text (a zero byte at {data.index(0)}). Poses are read from txt, csv, "
            "json, yaml, npy and npz files."
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def table_from_text(path: Path, text: str) -> PoseTable:
    """Return the table of a text file.

    Raises:
        InputError: no numbers, lines of unequal length, or words where numbers should be; the
            line is named.
    """
    notes: list[str] = []
    lines, remarks = _lines(path, text, notes)
    if not lines:
        raise InputError(f"{path} holds no poses: no line of numbers was found. {ACCEPTED}.")
    header: list[str] | None = None
    if len(lines) > 1 and _is_header(lines[0], lines[1]):
        header, lines = lines[0].fields, lines[1:]
    lines = _equal(path, lines, header)
    width = len(lines[0].fields)
    if header is None:
        header = next((r for r in remarks if len(r) == width and _known(r)), None)
    words = _word_columns(path, lines)
    names = [""] * width if header is None else header
    labels: list[str | None] = [None] * len(lines)
    stems = [""] * len(lines)
    if words:
        column = _label_column(path, words, names, lines)
        found = [line.fields[column].strip().strip("\"':") for line in lines]
        if names[column].strip().lower() in LABEL_NAMES or any(map(IMAGE_ENDING.search, found)):
            labels = list(found)
        elif len(set(found)) > 1 or len(found) == 1:  # "pose:" before every line names nothing
            stems = found
    keep = [k for k in range(width) if k not in words]
    if not keep:
        raise InputError(
            f"{path}, line {lines[0].number}: '{' '.join(lines[0].fields)[:60]}' is no row of "
            f"numbers. {ACCEPTED}."
        )
    values = np.array([[_number(path, line, k) for k in keep] for line in lines], dtype=np.float64)
    where = [f"line {line.number}" for line in lines]
    names = [names[k] for k in keep]
    if not any(names):
        blocks = _blocks(values)
        if blocks is not None:
            step = len(values) // len(blocks)
            notes.append(f"Each {step} lines are one matrix or pose.")
            values, where = blocks, where[::step]
            labels, stems = labels[::step], stems[::step]
            names = [""] * values.shape[1]
    return PoseTable(
        path=path,
        names=tuple(names),
        values=values,
        labels=labels,
        stems=stems,
        where=where,
        notes=notes,
    )


def _lines(path: Path, text: str, notes: list[str]) -> tuple[list[TextLine], list[list[str]]]:
    """Return the lines in fields, and the comments in words (one may be the header)."""
    kept: list[tuple[int, str]] = []
    remarks: list[list[str]] = []
    for k, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith(COMMENT):
            remarks.append(re.split(r"[,;\s]+", stripped.lstrip("#/% ").strip()))
            continue
        stripped = re.split(r"\s#|\s//", stripped)[0].rstrip()
        if stripped and not set(stripped) <= set("-=[](){},"):
            kept.append((k, stripped))
    split = _splitter([s for _, s in kept], notes)
    return [TextLine(number=k, fields=_fields(path, k, s, split)) for k, s in kept], remarks


def _splitter(lines: list[str], notes: list[str]) -> str:
    """Return what stands between the fields: one of ';', ',', tab, ' ', ', ' and 'decimal;'."""
    numeric = [s for s in lines if re.search(r"\d", s)]
    for mark in (";", "\t", " "):
        tokens = [t.strip() for s in numeric for t in re.split(r"\s+" if mark == " " else mark, s)]
        commas = [t for t in tokens if "," in t]
        if (
            len(commas) > len(numeric)
            and all(_DECIMAL_COMMA.fullmatch(t) for t in commas)
            and not any(_NUMBER.fullmatch(t) and "." in t for t in tokens)
        ):
            notes.append(f"Decimal commas ('{commas[0]}') are read as decimal points.")
            return f"decimal{mark}"
    for mark in (";", ",", "\t"):
        with_mark = sum(mark in s for s in lines)
        if with_mark and with_mark >= len(lines) / 2:
            # "img.png, 0.1 0.2 0.3": the mark and spaces mixed
            inner = any(
                len(f.split()) > 1 and all(number_of(t) is not None for t in f.split())
                for s in lines
                for f in s.split(mark)
            )
            return f"{mark} " if inner else mark
    return " "


def _fields(path: Path, number: int, line: str, split: str) -> list[str]:
    """Return the fields of a line."""
    if split.startswith("decimal"):
        mark = split.removeprefix("decimal")
        return [
            f.replace(",", ".") if _DECIMAL_COMMA.fullmatch(f.strip()) else f
            for f in (line.split() if mark == " " else line.strip(mark + " ").split(mark))
        ]
    if split == " ":
        return [f for f in re.sub(r"(?<=p)\[|[\[\](){}]", " ", line).split() if f != "p"]
    if len(split) == 2:
        return [f for f in re.split(rf"[{split[0]}\s]+", line.strip("[](){} p")) if f]
    try:
        fields = next(csv.reader([line.rstrip(split + " ")], delimiter=split, strict=True))
    except (csv.Error, StopIteration) as error:
        raise InputError(f"{path}, line {number}: {error} in '{line[:60]}'.") from error
    fields = [f.strip() for f in fields]
    for k, f in enumerate(fields):
        if not f:
            raise InputError(
                f"{path}, line {number}: field {k + 1} is empty ('{line[:60]}'). Write nan for a "
                "pose that was not measured, or delete the line."
            )
    return fields


def _is_header(first: TextLine, second: TextLine) -> bool:
    """Return whether the first line holds names only and the second one numbers."""
    return all(number_of(f) is None for f in first.fields) and any(
        number_of(f) is not None for f in second.fields
    )


def _known(words: list[str]) -> bool:
    """Return whether all words are names of columns."""
    return all(role_of(w)[0] for w in words)


def _equal(path: Path, lines: list[TextLine], header: list[str] | None) -> list[TextLine]:
    """Return the lines, all of which must have as many fields as the header or the first."""
    width = len(header) if header is not None else len(lines[0].fields)
    for line in lines:
        if len(line.fields) != width:
            other = "the header has" if header is not None else f"line {lines[0].number} has"
            raise InputError(
                f"{path}, line {line.number}: {len(line.fields)} fields "
                f"('{' '.join(line.fields)[:60]}'), but {other} {width}. Is the line cut off, or "
                "is a name with spaces not in quotes?"
            )
    return lines


def _word_columns(path: Path, lines: list[TextLine]) -> list[int]:
    """Return the columns that hold words; a column that holds both raises."""
    found: list[int] = []
    for k in range(len(lines[0].fields)):
        words = [line for line in lines if number_of(line.fields[k]) is None]
        if not words:
            continue
        if len(words) < len(lines) and not any(IMAGE_ENDING.search(w.fields[k]) for w in words):
            raise InputError(
                f"{path}, line {words[0].number}: field {k + 1} is '{words[0].fields[k][:40]}', "
                "a number is expected there as in the other lines."
            )
        found.append(k)
    return found


def _label_column(path: Path, words: list[int], names: list[str], lines: list[TextLine]) -> int:
    """Return the column that names the images."""
    named = [k for k in words if names[k].strip().lower() in LABEL_NAMES]
    ending = [k for k in words if all(IMAGE_ENDING.search(line.fields[k]) for line in lines)]
    for choice in (named, ending, words):
        if len(choice) == 1:
            return choice[0]
    shown = ", ".join(f"'{lines[0].fields[k][:30]}'" for k in words)
    raise InputError(
        f"{path}, line {lines[0].number}: several columns hold words ({shown}). Name the one with "
        "the images 'image' in a header line, or delete the others."
    )


def _number(path: Path, line: TextLine, column: int) -> float:
    """Return the number of a field."""
    value = number_of(line.fields[column])
    if value is None:
        raise InputError(
            f"{path}, line {line.number}: field {column + 1} is '{line.fields[column][:40]}', not "
            "a number."
        )
    return value


def _blocks(values: Array) -> Array | None:
    """Return poses (n, k) where each takes several lines, None where each has one."""
    n, width = values.shape
    if width == 4:
        if n % 4 == 0:
            stacked = values.reshape(-1, 4, 4)
            ends = [stacked[:, 3], stacked[:, :, 3]]
            if any(np.mean(np.all(np.abs(e - LAST) < 1e-6, axis=1)) > 0.5 for e in ends):
                return values.reshape(-1, 16)
        if n % 3 == 0:
            return values.reshape(-1, 12)
    if width == 1 and n in (6, 7, 12, 16):
        return values.reshape(1, n)
    return None
