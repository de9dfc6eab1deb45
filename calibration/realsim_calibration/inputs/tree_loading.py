"""Loading JSON and YAML as trees of dicts, lists and numbers; nothing of a file is executed."""

import json
import re
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim_calibration.inputs.pose_text import number_of

MAX_NUMBERS = 2_000_000
"""Values in one file; a YAML file of a few lines can otherwise unfold to billions."""
MAX_DEPTH = 40
"""Levels of nesting in one file."""


def loaded_json(path: Path, text: str) -> Any:
    """Return the tree of a JSON file.

    Raises:
        InputError: malformed, nested too deeply, or a key twice; the line is named.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        node = dict(pairs)
        if len(node) != len(pairs):
            keys = [k for k, _ in pairs]
            twice = next(k for k in keys if keys.count(k) > 1)
            raise InputError(
                f"{path}: the key '{twice}' stands twice in one object; one of its two values "
                "would be lost. Give every pose a name of its own."
            )
        return node

    try:
        tree = json.loads(text, object_pairs_hook=once)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}, line {error.lineno}, column {error.colno}: not JSON ({error.msg}). Is the "
            "file cut off?"
        ) from error
    except RecursionError as error:
        raise InputError(f"{path} is nested too deeply to be a list of poses.") from error
    _check_size(path, tree)
    return _plain(path, tree)


def loaded_yaml(path: Path, text: str) -> Any:
    """Return the tree of a YAML file (several documents become a list), OpenCV's matrices too.

    Raises:
        InputError: malformed, an unknown tag, nested too deeply; the line is named.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    loader: Any = YAML(typ="safe", pure=True)

    def opencv(constructor: Any, node: Any) -> Any:
        return dict(constructor.construct_mapping(node, deep=True), type_id="opencv-matrix")

    constructor: Any = type("FileStorageConstructor", (loader.Constructor,), {})
    constructor.add_constructor("tag:yaml.org,2002:opencv-matrix", opencv)
    loader.Constructor = constructor
    # OpenCV writes "%YAML:1.0", which is no directive of YAML
    text = re.sub(r"\A%YAML[^\n]*", "", text)
    try:
        documents = [d for d in loader.load_all(text) if d is not None]
    except YAMLError as error:
        mark: Any = getattr(error, "problem_mark", None)
        at = f", line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError(f"{path}{at}: not YAML that can be read ({problem}).") from error
    except (RecursionError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not YAML that can be read ({error}).") from error
    tree = documents[0] if len(documents) == 1 else documents
    _check_size(path, tree)
    return _plain(path, tree)


def _check_size(path: Path, tree: Any) -> None:
    """Raise if a tree is too large or too deep; nodes that are shared count every time."""
    count = 0
    stack: list[tuple[Any, int]] = [(tree, 0)]
    while stack:
        node, depth = stack.pop()
        count += 1
        if depth > MAX_DEPTH or count > MAX_NUMBERS:
            raise InputError(
                f"{path} holds more than {MAX_NUMBERS} values or {MAX_DEPTH} levels: this is no "
                "list of poses."
            )
        if isinstance(node, dict):
            stack += [(v, depth + 1) for v in node.values()]
        elif isinstance(node, list):
            stack += [(v, depth + 1) for v in node]


def _plain(path: Path, node: Any) -> Any:
    """Return the tree with OpenCV's matrices as nested lists."""
    if isinstance(node, list):
        return [_plain(path, n) for n in node]
    if not isinstance(node, dict):
        return node
    if node.get("type_id") != "opencv-matrix" and not {"rows", "cols", "dt", "data"} <= set(node):
        return {str(k): _plain(path, v) for k, v in node.items()}
    try:
        channels = int(re.sub(r"\D", "", str(node["dt"])) or 1)
        shape = (int(node["rows"]), int(node["cols"]) * channels)
        data = [number_of(str(v)) for v in node["data"]]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: an OpenCV matrix lacks rows, cols, dt or data.") from error
    if len(data) != shape[0] * shape[1] or None in data:
        raise InputError(
            f"{path}: an OpenCV matrix of {shape[0]} rows and {shape[1]} columns holds "
            f"{len(data)} values{', not all of them numbers' if None in data else ''}. Is the "
            "file cut off?"
        )
    return [data[r * shape[1] : (r + 1) * shape[1]] for r in range(shape[0])]
