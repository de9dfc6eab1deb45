"""Text, JSON, YAML and OpenCV's XML as plain named values: safe loaders and size limits only."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError

Fields = dict[str, Any]
LARGEST_BYTES = 4_000_000
"""A camera file is a few kilobytes; one with hundreds of poses in it may have a megabyte."""

BINARY_KINDS = (
    (b"MATLAB ", "a MATLAB file"),
    (b"\x89HDF", "an HDF5 file (MATLAB 7.3 writes them, too)"),
    (b"\x93NUMPY", "a NumPy array"),
    (b"PK\x03\x04", "a ZIP archive (.npz is one)"),
    (b"\x89PNG", "a picture"),
    (b"\xff\xd8", "a picture"),
)
"""First bytes of what people give for a camera file."""
HEAD_BYTES = 1024
"""Read of a file to see whether it is text: binary formats have a zero byte early on."""
ACCEPTED = (
    "Accepted are text files: JSON, YAML or OpenCV's XML with fx, fy, cx, cy or a camera matrix "
    "and the image size; ROS's camera_info; COLMAP's cameras.txt. Write its numbers into one, "
    'such as {"fx": 600, "fy": 600, "cx": 320, "cy": 240, "width": 640, "height": 480}.'
)


def read_text(path: Path) -> str:
    """Return a text file's contents.

    Raises:
        InputError: it is missing, too large, or no text.
    """
    if not path.is_file():
        raise InputError(f"the camera file {path} does not exist.")
    size = path.stat().st_size
    if size > LARGEST_BYTES:
        raise InputError(
            f"the camera file {path} has {size / 1e6:.1f} MB; {LARGEST_BYTES / 1e6:.0f} MB are "
            "accepted. Is it a picture or a bag?"
        )
    if what := _binary_kind(path):
        raise InputError(f"{path} is {what}, no camera file. {ACCEPTED}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(f"the camera file {path} cannot be read as text: {error}.") from error
    if not text.strip():
        raise InputError(f"the camera file {path} is empty.")
    return text


def _binary_kind(path: Path) -> str:
    """Return what a file is that is no text, an empty text where it may be one."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    known = next((what for magic, what in BINARY_KINDS if head.startswith(magic)), "")
    return known or ("a binary file" if b"\0" in head else "")


def named_values(text: str, path: Path, camera_keys: tuple[str, ...]) -> Fields:
    """Return the fields of a JSON, XML or YAML file, or of the one camera one level down.

    Args:
        text: the file's contents.
        path: its name, for messages.
        camera_keys: keys that only a camera has.

    Raises:
        InputError: it is damaged, or is no mapping.
    """
    start = text.lstrip()[:1]
    try:
        if start == "{":
            data: Any = json.loads(text)
        elif start == "<":
            data = _xml(text, path)
        elif start == "[":
            raise InputError(f"{path} holds a list; a camera file holds named values.")
        else:
            data = _yaml(text, path)
        if not isinstance(data, Mapping):
            raise InputError(f"{path} holds no named values, so no camera.")
        fields = _plain({str(key): value for key, value in data.items()})
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"the camera file {path} is damaged: {first_line(error)}") from error
    inner = [k for k, v in fields.items() if _has(v, camera_keys)]
    if _has(fields, camera_keys) or not inner:
        return fields
    if len(inner) > 1:
        raise InputError(
            f"{path} holds several cameras ({', '.join(inner[:6])}); give a file with one."
        )
    return fields[inner[0]]


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, its type where there is none."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _has(value: Any, keys: tuple[str, ...]) -> bool:
    return isinstance(value, dict) and any(key in value for key in keys)


def _plain(fields: Fields) -> Fields:
    """Return fields with matrices written as {rows, cols, data} made arrays."""
    plain: Fields = {}
    for key, value in fields.items():
        if isinstance(value, Mapping) and "data" in value:
            data = np.array(value["data"], dtype=np.float64).ravel()
            rows, cols = int(value.get("rows", 1)), int(value.get("cols", data.size))
            if rows * cols != data.size:
                raise ValueError(f"{key} claims {rows}x{cols} numbers and holds {data.size}")
            plain[key] = data.reshape(rows, cols)
        elif isinstance(value, Mapping):
            plain[key] = {str(k): v for k, v in value.items()}
            plain[key] = _plain(plain[key])
        else:
            plain[key] = value
    return plain


def _yaml(text: str, path: Path) -> Any:
    """Return a YAML file's value; OpenCV's dialect starts with %YAML:1.0 and tags its matrices."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    lines = text.splitlines()
    if lines[0].startswith("%YAML"):
        lines = lines[1:]
    lines = [line for line in lines if not line.lstrip().startswith("#")]
    cleaned = "\n".join(lines).replace("!!opencv-matrix", "")
    if "&" in cleaned and "*" in cleaned:
        raise InputError(f"{path} uses YAML references, which no camera file needs.")
    try:
        # The safe loader makes plain values only: no tag in the file can run anything.
        return YAML(typ="safe", pure=True).load(cleaned)
    except YAMLError as error:
        raise ValueError(first_line(error)) from error


def _xml(text: str, path: Path) -> Fields:
    """Return the matrices and numbers of OpenCV's XML."""
    from xml.etree import ElementTree

    if "<!" in text.replace("<!--", ""):
        raise InputError(f"{path} declares XML entities, which no camera file needs.")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(str(error)) from error
    if root.tag != "opencv_storage":
        raise InputError(f"{path} is XML of the kind <{root.tag}>; OpenCV's is read.")
    return {node.tag: _xml_value(node) for node in root}


def _xml_value(node: Any) -> Any:
    data = node.find("data")
    if data is not None:
        return {
            "rows": int(node.findtext("rows", "1")),
            "cols": int(node.findtext("cols", "1")),
            "data": [float(x) for x in (data.text or "").split()],
        }
    if len(node):
        return {child.tag: _xml_value(child) for child in node}
    words = (node.text or "").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return (node.text or "").strip()
    return numbers[0] if len(numbers) == 1 else numbers
