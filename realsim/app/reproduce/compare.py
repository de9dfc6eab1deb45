"""Two folders, file by file and value by value."""

import io
import json
import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.console import shortened
from realsim.errors import InputError
from realsim.formats.export_folder import SUMS_FILE
from realsim.images import read_image
from realsim.store import provenance

MOST_FIELDS = 5
"""Differing fields of a file that are told."""
LEFT_OUT = (*provenance.MADE_AGAIN, ".export.json")
"""Ends of files that are not compared: lists and requests that follow from the others."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FileDifference:
    """A file that is not the same in both folders."""

    path: str
    words: tuple[str, ...]
    """Which fields differ and by how much."""
    greatest: float = math.nan
    """Greatest difference of two numbers; NaN = the file was not compared number by number."""


def compare_folders(first: Path, second: Path) -> tuple[int, tuple[FileDifference, ...]]:
    """Return how many files were compared, and those that differ; caches are left out."""
    names = sorted(set(_files(first)) | set(_files(second)))
    found = (_compare(first / name, second / name, name) for name in names)
    return len(names), tuple(f for f in found if f is not None)


def _files(folder: Path) -> Iterator[str]:
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        if path.is_file() and "cache" not in name.parts and not name.name.endswith(LEFT_OUT):
            yield name.as_posix()


def _compare(first: Path, second: Path, name: str) -> FileDifference | None:
    """Return in what a file differs; None = it does not."""
    for path, words in ((first, "it is missing"), (second, "it was not made again")):
        if not path.is_file():
            return FileDifference(path=name, words=(words,))
    a, b = (_told(p, p.read_bytes()) for p in (first, second))
    if a == b:
        return None
    try:
        rows = list(_fields(first, a, second, b))
    except (ValueError, KeyError, InputError):
        rows = []
    if not rows:
        return FileDifference(path=name, words=(f"{_unlike(a, b)} of {len(a)} bytes differ",))
    told = [f"{field}: {was} -> {now}" for field, was, now, _ in rows]
    words = shortened(told, MOST_FIELDS, "and {} more")
    sizes = [size for *_, size in rows if math.isfinite(size)]
    return FileDifference(path=name, words=tuple(words), greatest=max(sizes) if sizes else math.nan)


def _told(file: Path, content: bytes) -> bytes:
    """Return what a file says of a result: other versions are told apart from it."""
    if file.name == SUMS_FILE:
        lines = content.splitlines(keepends=True)
        return b"".join(x for x in lines if not x.rstrip().endswith(_RECORD))
    is_record = file.name == provenance.FOLDER_FILE or file.parent.name == "stages"
    if is_record and file.suffix == ".json" and b'"versions"' in content:
        with suppress(ValueError):
            return json.dumps(json.loads(content) | {"versions": {}}).encode()
    return content


_RECORD = f" {provenance.FOLDER_FILE}".encode()
Row = tuple[str, str, str, float]
"""Field, old value, new value, difference."""


def _fields(first: Path, a: bytes, second: Path, b: bytes) -> Iterator[Row]:
    """Yield what differs in two files of a kind that can be read; nothing of other kinds."""
    kind = first.suffix.lower()
    if kind in (".json", ".jsonl"):
        old, new = ([json.loads(line) for line in t.splitlines()] if kind == ".jsonl"
                    else json.loads(t) for t in (a, b))  # fmt: skip
        for name, was, now in provenance.differences(old, new):
            both = isinstance(was, int | float) and isinstance(now, int | float)
            size = abs(float(now) - float(was)) if both else math.nan
            yield name, provenance.in_short(was), provenance.in_short(now), size
    elif kind == ".npz":
        with (
            np.load(io.BytesIO(a), allow_pickle=False) as old,
            np.load(io.BytesIO(b), allow_pickle=False) as new,
        ):
            for name in sorted({*old.files, *new.files}):
                if name not in old.files or name not in new.files:
                    there = name in old.files
                    yield name, str(there), str(not there), math.nan
                else:
                    yield from _arrays(name, old[name], new[name])
    elif kind == ".png":
        yield from _arrays("pixels", read_image(first), read_image(second))


def _arrays(name: str, old: Any, new: Any) -> Iterator[Row]:
    """Yield the greatest difference of two arrays, if they differ."""
    if old.shape != new.shape or old.dtype != new.dtype:
        yield name, f"{old.dtype}{old.shape}", f"{new.dtype}{new.shape}", math.nan
    elif old.dtype.kind not in "iufb":
        count = int(np.count_nonzero(old != new))
        if count:
            yield name, f"{old.size} values", f"{count} others", math.nan
    elif not np.array_equal(old, new, equal_nan=old.dtype.kind == "f"):
        off = np.abs(new.astype(np.float64) - old.astype(np.float64))
        off = np.where(np.isnan(old) & np.isnan(new), 0.0, off) if old.dtype.kind == "f" else off
        at = int(np.nanargmax(off))
        told = f"{name}[{at}]"
        yield told, repr(old.flat[at].item()), repr(new.flat[at].item()), float(np.nanmax(off))


def _unlike(a: bytes, b: bytes) -> int:
    """Return how many bytes differ; what one is longer by counts."""
    n = min(len(a), len(b))
    same = np.frombuffer(a[:n], np.uint8) == np.frombuffer(b[:n], np.uint8)
    return int(n - np.count_nonzero(same)) + abs(len(a) - len(b))
