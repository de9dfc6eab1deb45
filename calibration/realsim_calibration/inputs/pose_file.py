"""Reading poses from any file, from a folder with one file a pose, or from a list of those."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError
from realsim.formats.folders.listing import natural_key
from realsim_calibration.inputs.columns import LABEL_NAMES, PoseTable, raw_from_table
from realsim_calibration.inputs.pose_arrays import table_from_npy, table_from_npz
from realsim_calibration.inputs.pose_text import decoded, table_from_text
from realsim_calibration.inputs.pose_tree import loaded_json, loaded_yaml, table_from_tree
from realsim_calibration.inputs.raw_poses import RawPoses

ENDINGS = (".txt", ".csv", ".tsv", ".dat", ".log", ".json", ".yaml", ".yml", ".npy", ".npz")
"""Endings of pose files."""
MAX_TEXT_BYTES = 64 * 2**20
"""Size of a text file; 10000 poses take 3 MB."""
MAX_YAML_BYTES = 2 * 2**20
"""Size of a YAML file, which takes about a second for 150 kB to read."""
MAX_LISTING_BYTES = 2**20
"""Size of a list of poses and images."""
MAX_FOLDER_FILES = 20_000
"""Files of one pose each in a folder."""
_TREES = (".json", ".yaml", ".yml")
_BOARD_SERIES = re.compile(r"c[PM]o|board|target|marker|object")
"""In the name of a file: it holds the board's pose in the camera (ViSP: cPo, cMo)."""
_CAMERA = re.compile(
    rb"\b(fx|camera_?matrix|intrinsics?|dist(ortion)?_?coeff\w*|distortion_model)\b", re.IGNORECASE
)
"""Keys of a file of intrinsics."""


def read_pose_file(path: Path | str, *, key: str | None = None, board: bool = False) -> RawPoses:
    """Return the poses of a file, of a folder with a file for each, or of a list of such files.

    Accepted: lines of numbers (txt, csv, tsv; header optional), JSON and YAML (lists, dicts from
    image to pose, ROS poses, OpenCV's FileStorage), npy and npz. A list names a pose file and an
    image for each view. Robot poses and poses of the board in the camera are read alike.

    Args:
        path: the file or folder.
        key: which key or array holds the poses, where there are several.
        board: whether a folder's poses of the board are wanted, where it has the robot's, too
            (ViSP's pose_cPo_1.yaml beside pose_fPe_1.yaml).

    Raises:
        InputError: missing, damaged, too large, or no poses; names the line, entry or file.
    """
    path = Path(path)
    if path.is_dir():
        return _from_folder(path, key, board=board)
    if not path.is_file():
        raise InputError(f"{path} does not exist; a file or a folder of poses was expected there.")
    tree = file_tree(path) if path.suffix.lower() in _TREES else None
    if tree is not None:
        listed = _listing(tree)
        if listed:
            return _from_listing(path, listed, key)
    return raw_from_table(_table(path, key, tree))


def file_text(path: Path) -> str:
    """Return a text file's content."""
    limit = MAX_YAML_BYTES if path.suffix.lower() in (".yaml", ".yml") else MAX_TEXT_BYTES
    size = path.stat().st_size
    if size > limit:
        raise InputError(
            f"{path} has {size / 2**20:.1f} MB; at most {limit / 2**20:.0f} MB of poses are read "
            "from such a file. Is it the right one?"
        )
    if size == 0:
        raise InputError(f"{path} is empty. Was it copied or written completely?")
    try:
        return decoded(path, path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error}).") from error


def file_tree(path: Path) -> Any:
    """Return the tree of a JSON or YAML file."""
    text = file_text(path)
    return (loaded_json if path.suffix.lower() == ".json" else loaded_yaml)(text, str(path))


def _table(path: Path, key: str | None, tree: Any = None) -> PoseTable:
    """Return the table of one file."""
    ending = path.suffix.lower()
    if ending not in ENDINGS and ending:
        raise InputError(f"{path}: poses are read from {', '.join(ENDINGS)} files, not {ending}.")
    if ending == ".npy":
        return table_from_npy(path)
    if ending == ".npz":
        return table_from_npz(path, key)
    if ending in _TREES:
        return table_from_tree(path, file_tree(path) if tree is None else tree, key)
    text = file_text(path)
    if re.match(r"\s*(\{|\[\s*[\[{])", text):
        try:
            return table_from_tree(path, loaded_json(text, str(path)), key)
        except InputError:
            if text.lstrip().startswith("{"):
                raise
    return table_from_text(path, text)


def _listing(tree: Any) -> list[tuple[str, str]]:
    """Return the (pose file, image file) pairs of a list, none where the tree is no such list."""
    if isinstance(tree, dict):
        for value in tree.values():
            if isinstance(value, list) and _listing(value):
                return _listing(value)
        return []
    pairs: list[tuple[str, str]] = []
    for entry in tree if isinstance(tree, list) else []:
        if not isinstance(entry, dict):
            return []
        pose = next((v for k, v in entry.items() if "pose" in k.lower()), None)
        image = next((v for k, v in entry.items() if k.lower() in LABEL_NAMES), None)
        if not isinstance(pose, str) or not isinstance(image, str):
            return []
        pairs.append((pose, image))
    return pairs


def _from_listing(path: Path, pairs: Sequence[tuple[str, str]], key: str | None) -> RawPoses:
    """Return the poses of a list of pose and image files, in its order."""
    root = path.parent.resolve()
    files: list[Path] = []
    for k, (pose, image) in enumerate(pairs):
        file = (root / pose).resolve()
        if not file.is_relative_to(root):
            raise InputError(
                f"{path}, entry {k}: the pose file '{pose}' lies outside of the list's folder."
            )
        if not file.is_file():
            raise InputError(f"{path}, entry {k}: the pose file '{pose}' of '{image}' is missing.")
        files.append(file)
    twice = sorted({p for p, _ in pairs if [q for q, _ in pairs].count(p) > 1}, key=natural_key)
    if twice:
        raise InputError(f"{path} names pose files more than once: {', '.join(twice[:8])}.")
    raw = read_single_files(path, files, [p for p, _ in pairs], key)
    note = f"{path.name} says which pose belongs to which image."
    return replace(raw, labels=tuple(i for _, i in pairs), notes=(note, *raw.notes))


def _from_folder(folder: Path, key: str | None, *, board: bool) -> RawPoses:
    """Return the poses of a folder: by a list in or beside it, else one file a pose."""
    for place in (folder, folder.parent):
        lists = _listings_in(place, folder)
        if len(lists) > 1:
            names = ", ".join(p.name for p, _ in lists)
            raise InputError(f"{place} holds several lists of poses and images: {names}. Give one.")
        if lists:
            path, pairs = lists[0]
            raw = _from_listing(path, pairs, key)
            listed = {(path.parent / p).resolve() for p, _ in pairs}
            others = [f for f in _pose_files(folder)[0] if f.resolve() not in listed | {path}]
            if others and place != folder:
                note = f"Not on the list and not read: {', '.join(f.name for f in others[:8])}."
                raw = replace(raw, notes=(*raw.notes, note))
            return raw
    files, note = _pose_files(folder, board=board)
    if not files:
        raise InputError(
            f"{folder} holds no pose files ({', '.join(ENDINGS)}). Give the file or the folder "
            "that holds the robot's poses."
        )
    if len(files) == 1:
        raw = read_pose_file(files[0], key=key)
        note = f"{files[0].name} is the only pose file of the folder. {note}".strip()
    else:
        raw = read_single_files(folder, files, [f.name for f in files], key)
    return replace(raw, notes=((note,) if note else ()) + raw.notes)


def _listings_in(place: Path, folder: Path) -> list[tuple[Path, list[tuple[str, str]]]]:
    """Return the lists in a place that name pose files of the folder."""
    found: list[tuple[Path, list[tuple[str, str]]]] = []
    for path in sorted(p for p in place.iterdir() if p.suffix.lower() in _TREES and p.is_file()):
        if path.stat().st_size > MAX_LISTING_BYTES:
            continue
        data = path.read_bytes()
        if b"pose" not in data or not any(w.encode() in data for w in LABEL_NAMES):
            continue
        try:
            pairs = _listing(file_tree(path))
        except InputError:
            continue  # in the folder it is read as a pose file, which says what is wrong
        if any((place / p).resolve().is_relative_to(folder.resolve()) for p, _ in pairs):
            found.append((path, pairs))
    return found


def _pose_files(folder: Path, *, board: bool = False) -> tuple[list[Path], str]:
    """Return a folder's pose files in natural order, and what was left out."""
    files = _candidates(folder)
    if len(files) > MAX_FOLDER_FILES:
        raise InputError(f"{folder} holds {len(files)} files; at most {MAX_FOLDER_FILES} are read.")
    cameras = [p for p in files if _is_camera(p)]
    files = [p for p in files if p not in cameras] or files
    kinds: dict[tuple[str, str], list[Path]] = {}
    for p in files:
        kinds.setdefault((re.sub(r"\d+", "#", p.stem), p.suffix.lower()), []).append(p)
    series = sorted((v for v in kinds.values() if len(v) > 1), key=len, reverse=True)
    if len(series) > 1:
        of_board = [bool(_BOARD_SERIES.search(s[0].stem)) for s in series]
        wanted = [s for s, b in zip(series, of_board, strict=True) if b == board]
        series = wanted if len(wanted) == 1 and any(of_board) else series
    if len(series) > 1:
        shown = "; ".join(f"{len(s)} like {min(s).name}" for s in series)
        raise InputError(
            f"{folder} holds several series of files ({shown}). Give the poses a folder of their "
            "own."
        )
    chosen = series[0] if series else files
    left = sorted(p.name for p in files if p not in chosen)
    note = f"Not read, as their names are unlike the others: {', '.join(left[:8])}." if left else ""
    if cameras and cameras != files:
        note += f" Not read, as a camera: {', '.join(p.name for p in cameras[:8])}."
    return sorted(chosen, key=lambda p: natural_key(p.name)), note.strip()


def pose_files_in(folder: Path) -> list[Path]:
    """Return the files of a folder that may hold poses, in natural order; cameras do not."""
    files = [p for p in _candidates(folder) if not _is_camera(p)]
    return sorted(files, key=lambda p: natural_key(p.name))


def _candidates(folder: Path) -> list[Path]:
    """Return the files of a folder that have the ending of pose files."""
    files = (p for p in folder.glob("[!.]*") if p.suffix.lower() in ENDINGS)
    return [p for p in files if p.is_file()]


def _is_camera(path: Path) -> bool:
    """Return whether a file holds a camera's intrinsics, by its keys."""
    if path.suffix.lower() not in _TREES or path.stat().st_size > MAX_LISTING_BYTES:
        return False
    data = path.read_bytes()
    return b"pose" not in data.lower() and _CAMERA.search(data) is not None


def read_single_files(
    path: Path, files: Sequence[Path], names: Sequence[str], key: str | None
) -> RawPoses:
    """Return the poses of files that hold one each."""
    tables: list[PoseTable] = []
    for file, name in zip(files, names, strict=True):
        table = _table(file, key)
        if len(table.values) != 1:
            raise InputError(
                f"{file} holds {len(table.values)} poses; beside {len(files) - 1} other pose files "
                "each must hold one."
            )
        first = tables[0] if tables else table
        if table.names != first.names and not _reordered(table, first.names):
            raise InputError(
                f"{file} holds {_columns(table)}, {files[0].name} {_columns(first)}: all files "
                "must be written alike."
            )
        table.where = [name]
        table.stems = [file.stem]
        tables.append(table)
    return raw_from_table(
        replace(
            tables[0],
            path=path,
            values=np.concatenate([t.values for t in tables]),
            labels=[t.labels[0] for t in tables],
            stems=[t.stems[0] for t in tables],
            where=[t.where[0] for t in tables],
        )
    )


def _reordered(table: PoseTable, names: tuple[str, ...]) -> bool:
    """Put a table's columns in the order of these names; return whether they are the same ones.

    Programs write keys in the order of a hash, another in every file.
    """
    if "" in names or len(set(names)) != len(names) or sorted(names) != sorted(table.names):
        return False
    table.values = table.values[:, [table.names.index(n) for n in names]]
    table.names = names
    return True


def _columns(table: PoseTable) -> str:
    """Return what a table holds, for a message."""
    named = [n for n in table.names if n]
    return f"{len(table.names)} numbers" + (f" ({', '.join(named[:10])})" if named else "")
