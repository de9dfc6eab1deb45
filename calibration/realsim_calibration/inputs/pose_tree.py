"""Pose files that are trees: JSON, YAML, OpenCV's FileStorage, ROS poses.

JSON, YAML and OpenCV's XML as trees of dicts, lists and numbers, through the checked readers.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError
from realsim.formats.folders.listing import natural_key
from realsim.untrusted.json_text import parsed_json
from realsim.untrusted.xml_tree import parsed_xml
from realsim.untrusted.yaml_text import parsed_yaml
from realsim_calibration.inputs.columns import ACCEPTED, LABEL_NAMES, PoseTable, role_of
from realsim_calibration.inputs.pose_text import IMAGE_ENDING, number_of

_SHAPES = frozenset({(6,), (7,), (12,), (16,), (3, 4), (4, 4)})
_JOINTS = re.compile(
    r"^(?:actual_|target_)?(?:joints?|joint_?(?:positions?|angles?|values?|states?)|q|qpos|axes)"
    r"(?:_(rad|deg))?$"
)
_POSITION = frozenset("position pos translation trans t tvec xyz origin p".split())
_ROTATION = frozenset(
    "orientation rotation rot r quaternion quat q rotvec rvec rotation_vector axis_angle rpy ypr "
    "euler euler_angles rotation_matrix rot_mat quat_xyzw quat_wxyz quaternion_xyzw "
    "quaternion_wxyz xyzw wxyz".split()
)
_POSE_WORDS = re.compile(r"pose|tcp|transform|matrix|cart|^t_|base|robot|hand|flange|ee", re.I)
_ORDERS = {"rpy": ("roll", "pitch", "yaw"), "ypr": ("yaw", "pitch", "roll")}


@dataclass(kw_only=True, slots=True)
class Entry:
    """One pose of a tree: its numbers with names, the image it names."""

    names: list[str] = field(default_factory=lambda: [])
    numbers: list[float] = field(default_factory=lambda: [])
    label: str | None = None
    stem: str = ""
    where: str = ""
    source: str = ""
    """The key that the pose stood under; "" where it had none."""

    def add(self, names: Sequence[str], numbers: Sequence[float], unit: str = "") -> None:
        """Append numbers; a unit becomes part of their names."""
        self.names += [f"{n}_{unit}" if unit and n else n for n in names]
        self.numbers += numbers


def table_from_tree(path: Path, tree: Any, key: str | None = None) -> PoseTable:
    """Return the table of a tree.

    Args:
        path: the file, for messages.
        tree: lists, dicts, numbers and strings.
        key: which key holds the poses, where there are several.

    Raises:
        InputError: no poses, or several lists of poses and no key.
    """
    entries = _entries(path, tree, key)
    if not entries:
        raise InputError(f"{path} holds no poses. {ACCEPTED}.")
    names = entries[0].names
    rows: list[list[float]] = []
    for entry in entries:
        found = dict(zip(entry.names, entry.numbers, strict=True))
        if entry.names == names:
            rows.append(entry.numbers)
        elif len(found) == len(entry.names) and set(found) == set(names):
            rows.append([found[n] for n in names])
        else:
            raise InputError(
                f"{path}, {entry.where}: it holds {_shown(entry)}, but {entries[0].where} holds "
                f"{_shown(entries[0])}. All poses must be written alike."
            )
    sources = {e.source for e in entries} - {""}
    notes = [f"The poses are taken from '{s}'." for s in sorted(sources)]
    return PoseTable(
        path=path,
        names=tuple(names),
        values=np.array(rows, dtype=np.float64),
        labels=[e.label for e in entries],
        stems=[e.stem for e in entries],
        where=[e.where for e in entries],
        notes=notes,
    )


def _shown(entry: Entry) -> str:
    """Return what an entry holds, for a message."""
    named = [n for n in entry.names if n]
    return f"{len(entry.numbers)} numbers" + (f" ({', '.join(named[:10])})" if named else "")


def _shape(node: Any) -> tuple[int, ...] | None:
    """Return the shape of nested lists of numbers, None where they are not."""
    if not isinstance(node, list) or not node:
        return None
    if all(_scalar(v) is not None for v in node):
        return (len(node),)
    inner = {_shape(v) for v in node}
    shape = inner.pop()
    return None if inner or shape is None else (len(node), *shape)


def _scalar(node: Any) -> float | None:
    """Return a number, None for anything else (true and false are no numbers)."""
    if isinstance(node, bool) or node is None or isinstance(node, (list, dict)):
        return None
    return number_of(str(node))


def _flat(node: Any) -> list[float]:
    """Return the numbers of nested lists."""
    if isinstance(node, list):
        return [x for v in node for x in _flat(v)]
    value = _scalar(node)
    return [] if value is None else [value]


def _entries(path: Path, tree: Any, key: str | None) -> list[Entry]:
    """Return the poses of a whole file."""
    if isinstance(tree, dict) and key is not None and key in tree:
        extra = {k: v for k, v in tree.items() if k != key and _is_companion(k, v, tree[key])}
        return _from_dict(path, {key: tree[key], **extra}, None)
    if isinstance(tree, dict):
        return _from_dict(path, tree, key)
    if isinstance(tree, list):
        return _from_list(path, tree, key)
    raise InputError(f"{path} holds '{str(tree)[:60]}', no poses. {ACCEPTED}.")


def _from_list(path: Path, node: list[Any], key: str | None) -> list[Entry]:
    """Return the poses of a list, or the one pose that it is."""
    if _shape(node) in _SHAPES:
        return [_entry(path, node, key, "its pose")]
    columns = _shape(node)
    if columns in ((6, 1), (7, 1)):
        return [_entry(path, _flat(node), key, "its pose")]
    return [_entry(path, v, key, f"entry {k}") for k, v in enumerate(node)]


def _from_dict(path: Path, node: dict[str, Any], key: str | None) -> list[Entry]:
    """Return the poses of a dict: one pose, image to pose, or a list with companions."""
    if key is None and len(node) >= 2 and all(_is_pose(v) for v in node.values()):
        if not any(_JOINTS.match(k.lower()) for k in node) and not _POSITION & {
            _stem(k)[0] for k in node
        }:
            return _by_name(path, node)
    if _is_pose(node) or (key is not None and key in node and _is_pose(node[key])):
        return [_entry(path, node, key, "its pose")]
    lists = {k: v for k, v in node.items() if _is_pose_list(v) and not _JOINTS.match(k.lower())}
    if len(lists) > 1:
        raise InputError(
            f"{path} holds {len(lists)} lists of poses ({', '.join(lists)}). Say which one is "
            "meant by its key."
        )
    if len(lists) == 1:
        name, poses = next(iter(lists.items()))
        if isinstance(poses, dict):
            entries = _from_dict(path, poses, key)
        else:
            entries = _from_list(path, poses, key)
        for entry in entries:
            entry.source = f"{name}.{entry.source}" if entry.source else name
        _add_companions(path, node, name, entries)
        return entries
    if len(node) == 1 and _is_pose(next(iter(node.values()))):
        return _by_name(path, node)
    keys = ", ".join(list(node)[:12])
    wanted = f"the key '{key}' was asked for; " if key is not None else ""
    raise InputError(f"{path}: {wanted}no poses were found under the keys {keys}. {ACCEPTED}.")


def _by_name(path: Path, node: dict[str, Any]) -> list[Entry]:
    """Return the poses of a dict from image (or pose) name to pose."""
    entries: list[Entry] = []
    for name in sorted(node, key=natural_key):
        entry = _entry(path, node[name], None, f"'{name}'")
        if IMAGE_ENDING.search(name):
            entry.label = name
        entry.stem = Path(name).stem if entry.label else name
        entries.append(entry)
    return entries


def _is_companion(key: str, value: Any, poses: Any) -> bool:
    """Return whether a list goes along with the poses: the images' names or the joints."""
    known = key.lower().rstrip("s") in LABEL_NAMES or _JOINTS.match(key.lower()) is not None
    return known and isinstance(value, list) and len(value) == len(poses)


def _add_companions(path: Path, node: dict[str, Any], source: str, entries: list[Entry]) -> None:
    """Give the poses the images' names and the joints that stand in lists beside them."""
    for key, value in node.items():
        joints = _JOINTS.match(key.lower())
        labels = key.lower().rstrip("s") in LABEL_NAMES
        if key == source or not (joints or labels) or not isinstance(value, list):
            continue
        if len(value) != len(entries):
            raise InputError(
                f"{path}: '{key}' holds {len(value)} entries, '{source}' {len(entries)}. They "
                "must belong together one by one."
            )
        for entry, one in zip(entries, value, strict=True):
            if labels and isinstance(one, str):
                entry.label = one
            elif joints and _shape(one) is not None:
                flat = _flat(one)
                entry.add([f"joint{i + 1}" for i in range(len(flat))], flat, joints[1] or "")


def _is_pose_list(node: Any) -> bool:
    """Return whether a node holds several poses (or one, in a list)."""
    if isinstance(node, list):
        return bool(node) and (all(_is_pose(v) for v in node) or _shape(node) in _SHAPES)
    return isinstance(node, dict) and len(node) >= 1 and all(_is_pose(v) for v in node.values())


def _is_pose(node: Any) -> bool:
    """Return whether a node is one pose."""
    if isinstance(node, list):
        return _shape(node) in _SHAPES
    if not isinstance(node, dict):
        return False
    return _complete(_direct(node)) or bool(_candidates(node))


def _candidates(node: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a dict that hold a pose each."""
    return {
        k: v
        for k, v in node.items()
        if not _JOINTS.match(k.lower()) and _stem(k)[0] not in _ROTATION and _is_pose(v)
    }


def _complete(entry: Entry) -> bool:
    """Return whether an entry has a position and a rotation, or a matrix, by its names."""
    roles = {role_of(n)[0] for n in entry.names}
    entries = sum(bool(re.fullmatch(r"m\d\d", r)) for r in roles)
    others = {r for r in roles if r not in ("", "index", "time", "label")}
    return entries >= 12 or ({"x", "y", "z"} <= roles and len(others) >= 6)


def _stem(key: str) -> tuple[str, str]:
    """Return a key in lower case without its unit, and the unit."""
    match = re.fullmatch(r"(.+?)_(mm|m|deg|rad)", key.lower())
    return (match[1], match[2]) if match else (key.lower(), "")


def _direct(node: dict[str, Any]) -> Entry:
    """Return what a dict says by named numbers, position and orientation."""
    entry = Entry()
    for key, value in node.items():
        name, unit = _stem(key)
        number = _scalar(value)
        if number is not None and not (isinstance(value, str) and name in LABEL_NAMES):
            entry.add([key], [number])
        elif name in _POSITION or name in _ROTATION:
            for names, numbers in _part(name, value):
                entry.add(names, numbers, unit)
    return entry


def _part(name: str, node: Any) -> Iterator[tuple[list[str], list[float]]]:
    """Yield names and numbers of a position or of a rotation."""
    if isinstance(node, dict):
        flat = {k.lower(): _scalar(v) for k, v in node.items()}
        prefix = "" if name in _POSITION else "rv" if "vec" in name or "axis" in name else "r"
        prefix = "q" if "w" in flat else prefix
        if all(v is not None for v in flat.values()):
            names = [f"{prefix}{k}" if k in ("x", "y", "z", "w") else k for k in flat]
            yield names, [v for v in flat.values() if v is not None]
        return
    shape, numbers = _shape(node), _flat(node)
    if shape in ((3, 1), (1, 3), (4, 1), (1, 4)):
        shape = (len(numbers),)
    if name in _POSITION:
        if shape == (3,):
            yield ["x", "y", "z"], numbers
    elif shape == (3, 3):
        yield [f"r{r}{c}" for r in range(3) for c in range(3)], numbers
    elif shape == (9,):
        yield [f"flat_{k}" for k in range(9)], numbers
    elif shape == (4,):
        order = name[-4:] if name.endswith(("xyzw", "wxyz")) else ""
        yield ([f"q{c}" for c in order] or [f"quat_{k}" for k in range(4)]), numbers
    elif shape == (3,) and name in _ORDERS:
        yield list(_ORDERS[name]), numbers
    elif shape == (3,) and name.startswith("euler"):
        yield [f"euler_{k}" for k in range(3)], numbers
    elif shape == (3,):
        vector = "vec" in name or "axis" in name or name == "rotation_vector"
        yield [f"{'rv' if vector else 'r'}{c}" for c in "xyz"], numbers


def _entry(path: Path, node: Any, key: str | None, where: str) -> Entry:
    """Return one pose.

    Raises:
        InputError: it is none, or several; its place in the file is named.
    """
    if isinstance(node, list):
        shape = _shape(node)
        if key is not None:
            raise InputError(f"{path}, {where}: the key '{key}' was asked for; it has no keys.")
        if shape not in _SHAPES:
            what = f"an array of shape {shape}" if shape else f"'{str(node)[:60]}'"
            raise InputError(f"{path}, {where}: {what} is no pose. {ACCEPTED}.")
        entry = Entry(where=where)
        numbers = _flat(node)
        # 4x4 may still be transposed, which its 0 0 0 1 tells: only 3x4 says what it is
        nested = [f"m{r}{c}" for r in range(3) for c in range(4)]
        entry.add(nested if shape == (3, 4) else [""] * len(numbers), numbers)
        return entry
    if not isinstance(node, dict):
        raise InputError(f"{path}, {where}: '{str(node)[:60]}' is no pose. {ACCEPTED}.")
    entry = _direct(node)
    if key is not None:
        if key not in node:
            raise InputError(
                f"{path}, {where}: the key '{key}' was asked for; it has {', '.join(node)}."
            )
        entry = _nested(path, key, node[key], where)
    elif not _complete(entry):
        entry = _chosen(path, node, where)
    entry.where = where
    for name, value in node.items():
        joints = _JOINTS.match(name.lower())
        flat = _flat(value) if joints and _shape(value) is not None else []
        if joints and flat and not (name == "q" and len(flat) == 4):
            entry.add([f"joint{i + 1}" for i in range(len(flat))], flat, joints[1] or "")
        elif name.lower() in LABEL_NAMES and isinstance(value, str) and entry.label is None:
            entry.label = value
    return entry


def _chosen(path: Path, node: dict[str, Any], where: str) -> Entry:
    """Return the pose under the one key of a dict that holds one."""
    found = _candidates(node)
    if len(found) > 1:
        likely = {k: v for k, v in found.items() if _POSE_WORDS.search(k)}
        if len(likely) != 1:
            raise InputError(
                f"{path}, {where}: several keys hold a pose ({', '.join(found)}). Say which one "
                "is meant by its key."
            )
        found = likely
    if not found:
        keys = ", ".join(list(node)[:12])
        raise InputError(f"{path}, {where}: no pose under the keys {keys}. {ACCEPTED}.")
    return _nested(path, *next(iter(found.items())), where)


def _nested(path: Path, key: str, node: Any, where: str) -> Entry:
    """Return the pose that stands under a key, with the key in its source."""
    entry = _entry(path, node, None, where)
    entry.source = f"{key}.{entry.source}" if entry.source else key
    return entry


_NOT_FINITE = re.compile(
    r"(?<=[\[,:\s])([-+]?)\.?(nan|inf(?:inity)?)(?=[\s,\]}]|\Z)", re.IGNORECASE
)
"""Numbers that were not measured: they become texts, which say the same and are no surprise."""


def loaded_json(text: str, where: str) -> Any:
    """Return the tree of a JSON text; `where` names it in messages.

    Raises:
        InputError: malformed, nested too deeply, or a key twice.
    """
    return _plain(parsed_json(_NOT_FINITE.sub(r'"\1\2"', text), where), where)


def loaded_yaml(text: str, where: str) -> Any:
    """Return the tree of a YAML text (several documents become a list), OpenCV's dialect too.

    Raises:
        InputError: malformed, an unknown tag, nested too deeply.
    """
    # OpenCV writes "%YAML:1.0", which is no directive of YAML, and tags its matrices.
    text = re.sub(r"\A%YAML[^\n]*", "", text).replace("!!opencv-matrix", "")
    parts = re.split(r"(?m)^---(?=\s|$)", _NOT_FINITE.sub(r'"\1\2"', text))
    found = (parsed_yaml(part, where) for part in parts if part.strip())
    documents = [d for d in found if d is not None]
    return _plain(documents[0] if len(documents) == 1 else documents, where)


def loaded_xml(text: str, where: str) -> Any:
    """Return the tree of OpenCV's XML.

    Raises:
        InputError: malformed, or XML of another kind.
    """
    root = parsed_xml(text.encode(), where)
    if root.tag != "opencv_storage":
        raise InputError(f"{where} is XML of the kind <{root.tag}>; OpenCV's is read.")
    return _plain({node.tag: _of_xml(node) for node in root}, where)


def _of_xml(node: Any) -> Any:
    if len(node):
        return {child.tag: _of_xml(child) for child in node}
    words = (node.text or "").split()
    numbers = [number_of(word) for word in words]
    if None in numbers:
        return (node.text or "").strip()
    return numbers[0] if len(numbers) == 1 and node.tag != "data" else numbers


def _plain(node: Any, where: str) -> Any:
    """Return the tree with matrices, written as rows, cols and data, as nested lists."""
    if isinstance(node, list):
        return [_plain(n, where) for n in node]
    if not isinstance(node, dict):
        return node
    if not {"rows", "cols", "data"} <= set(node):
        return {str(k): _plain(v, where) for k, v in node.items()}
    try:
        channels = int(re.sub(r"\D", "", str(node.get("dt", ""))) or 1)
        shape = (int(node["rows"]), int(node["cols"]) * channels)
        rows = [v if isinstance(v, list) else [v] for v in node["data"]]
        data = [number_of(str(v)) for row in rows for v in row]
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: rows, cols, dt or data of a matrix are no numbers.") from error
    if len(data) != shape[0] * shape[1] or None in data:
        raise InputError(
            f"{where}: a matrix of {shape[0]} rows and {shape[1]} columns holds {len(data)} "
            f"values{', not all of them numbers' if None in data else ''}. Is the file cut off?"
        )
    if shape == (6, 1) and "dt" not in node:  # ViSP's vpPoseVector: tx ty tz [m], theta u [rad]
        return {"translation_m": data[:3], "rotation_vector_rad": data[3:]}
    return [data[r * shape[1] : (r + 1) * shape[1]] for r in range(shape[0])]
