"""The named values of a camera file, whatever text it is."""

from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.untrusted.files import checked_bytes
from realsim_calibration.inputs.tree_loading import loaded_json, loaded_xml, loaded_yaml

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
    data = checked_bytes(path, LARGEST_BYTES)
    known = next((what for magic, what in BINARY_KINDS if data.startswith(magic)), "")
    if what := known or ("a binary file" if b"\0" in data[:HEAD_BYTES] else ""):
        raise InputError(f"{path} is {what}, no camera file. {ACCEPTED}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"the camera file {path} cannot be read as text: {error}.") from error
    if not text.strip():
        raise InputError(f"the camera file {path} is empty.")
    return text


def named_values(text: str, path: Path, camera_keys: tuple[str, ...]) -> Fields:
    """Return the fields of a JSON, XML or YAML file, or of the one camera one level down.

    Args:
        text: the file's contents.
        path: its name, for messages.
        camera_keys: keys that only a camera has.

    Raises:
        InputError: it is damaged, or is no mapping.
    """
    read = {"{": loaded_json, "[": loaded_json, "<": loaded_xml}.get(text.lstrip()[:1], loaded_yaml)
    fields = read(text, f"the camera file {path}")
    if not isinstance(fields, dict):
        raise InputError(f"{path} holds no named values, so no camera.")
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
