"""Files of two releases that differ, beside images and poses: tables, models, maps, grasps."""

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from realsim.formats.bop.labelled import read_models_info
from realsim.formats.bop.models import INFO_FILE

LEFT_OUT = re.compile(
    r"(^|cameras/[^/]+/)(rgb|gray|depth|mask|mask_visib|label|reports|stages|models\w*)/"
    r"|(^|/)(cache|pictures|thumbnails)/|(^|/)\.|\.(html|jpg|md)$"
    r"|(^|/)(SHA256SUMS|croissant\.json|provenance.*\.json|session.*\.json|manifest\.jsonl)$"
)
"""Paths of files that are compared otherwise, that are made of others, or say how and when."""


def names_in(models: Path) -> dict[int, str]:
    """Return the names of a folder's models by id; {} where they do not tell models apart."""
    names = {i: str(row.get("name", i)) for i, row in read_models_info(models).items()}
    return names if len(set(names.values())) == len(names) else {}


def other_files(old: Path, new: Path) -> list[str]:
    """Return the files of two folders that hold something else, or are in one of them only.

    Left out are images, which are compared pixel by pixel, and what says how a folder was made.
    """
    names = {
        p.relative_to(root).as_posix()
        for root in (old, new)
        for p in root.rglob("*")
        if p.is_file() and not LEFT_OUT.search(p.relative_to(root).as_posix())
    }
    return [n for n in sorted(names) if not is_same_file(old / n, new / n)]


def other_models(roots: Sequence[Path], names: Sequence[dict[int, str]]) -> Iterator[str]:
    """Return the files of models that differ: of equal names, or of equal ids without names."""
    for folder in sorted({p.name for r in roots for p in r.glob("models*") if p.is_dir()}):
        files = [
            {_called(p, r / folder, ids): p for p in (r / folder).rglob("*")
             if p.is_file() and p.name != INFO_FILE and not LEFT_OUT.search(p.name)}
            for r, ids in zip(roots, names, strict=True)
        ]  # fmt: skip
        yield from [
            f"{folder}/{n}" for n in sorted(files[0].keys() | files[1].keys())
            if n not in files[0] or n not in files[1] or not is_same_file(files[0][n], files[1][n])
        ]  # fmt: skip
        rows = [
            {ids.get(i, str(i)): row for i, row in read_models_info(r / folder).items()}
            for r, ids in zip(roots, names, strict=True)
        ]
        if rows[0] != rows[1]:
            yield f"{folder}/{INFO_FILE}"


def other_in_roots(old: Path, new: Path) -> list[str]:
    """Return the files of models and tables in the roots of two data sets that differ."""
    names = [names_in(r / "models") for r in (old, new)]
    tables = {p.name for r in (old, new) for p in r.glob("*.json") if not LEFT_OUT.search(p.name)}
    other = [n for n in sorted(tables) if not is_same_file(old / n, new / n)]
    return [*other, *other_models((old, new), names)]


def is_same_file(old: Path, new: Path) -> bool:
    """Return whether two files are there and hold the same bytes, or the same JSON values."""
    if not (old.is_file() and new.is_file()):
        return False
    a, b = old.read_bytes(), new.read_bytes()
    if a == b or old.suffix != ".json":
        return a == b
    try:
        tables: list[Any] = [json.loads(text) for text in (a, b)]
    except ValueError:
        return False
    for table in tables:
        if isinstance(table, dict):
            cast("dict[str, Any]", table).pop("info", None)  # COCO's says when it was made
    return tables[0] == tables[1]


def _called(file: Path, folder: Path, names: dict[int, str]) -> str:
    """Return a model's file by the name of the model, where it has one."""
    path = file.relative_to(folder).as_posix()
    number = re.fullmatch(r"obj_(\d{6})(.*)", path)
    return path if number is None else names.get(int(number[1]), f"obj_{number[1]}") + number[2]
