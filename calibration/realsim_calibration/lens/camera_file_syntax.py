"""The named values of a camera file, whatever text it is."""

from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.untrusted.files import checked_bytes
from realsim.untrusted.xml_tree import parsed_xml
from realsim_calibration.inputs.pose_text import number_of
from realsim_calibration.inputs.pose_tree import loaded_json, loaded_xml, loaded_yaml

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
VISP_SIZE = {"image_width": "image_width", "image_height": "image_height"}
_VISP_PINHOLE = {"px": "fx", "py": "fy", "u0": "cx", "v0": "cy"}
VISP_MODELS = {
    "perspectiveProjWithDistortion": {**_VISP_PINHOLE, "kud": "k1"},
    "perspectiveProjWithoutDistortion": _VISP_PINHOLE,
}
"""Lens models of ViSP's camera.xml that the record has a place for, and what their values are."""
ACCEPTED = (
    "Accepted are text files: JSON, YAML or OpenCV's XML with fx, fy, cx, cy or a camera matrix "
    "and the image size; ROS's camera_info; COLMAP's cameras.txt; ViSP's camera.xml. Write its "
    'numbers into one: {"fx": 600, "fy": 600, "cx": 320, "cy": 240, "width": 640, "height": 480}.'
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
    read = {"{": loaded_json, "[": loaded_json, "<": _loaded_xml}.get(
        text.lstrip()[:1], loaded_yaml
    )
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


def _loaded_xml(text: str, where: str) -> Any:
    """Return the fields of OpenCV's XML, or of ViSP's.

    Raises:
        InputError: malformed, of another kind, or ViSP's with several cameras or another lens.
    """
    root = parsed_xml(text.encode(), where)
    return loaded_xml(text, where) if root.tag != "root" else _visp(root, where)


def _visp(root: Any, where: str) -> Fields:
    """Return fx fy cx cy, image size and distortion of vpXmlParserCamera's file.

    kud is Brown's k1: distorted = undistorted (1 + kud r^2) in the image plane at distance 1 (ViSP,
    vpCameraParameters); kdu is the approximate inverse and is not needed.
    """
    cameras = [node for node in root if node.tag == "camera"]
    if len(cameras) != 1:
        names = ", ".join((node.findtext("name") or "?").strip() for node in cameras[:6])
        raise InputError(
            f"{where} holds {len(cameras)} cameras of ViSP{f' ({names})' if names else ''}; give a "
            "file with one <camera>."
        )
    models = {(m.findtext("type") or "").strip(): m for m in cameras[0] if m.tag == "model"}
    kind = next((k for k in VISP_MODELS if k in models), None)
    if kind is None:
        raise InputError(
            f"{where}: the lens models of ViSP's camera are {', '.join(models) or 'missing'}; "
            f"{' or '.join(VISP_MODELS)} is read."
        )
    fields: Fields = {}
    for node, names in ((cameras[0], VISP_SIZE), (models[kind], VISP_MODELS[kind])):
        for name, key in names.items():
            value = number_of((node.findtext(name) or "").strip())
            if value is None:
                raise InputError(f"{where}: ViSP's camera has no number <{name}>.")
            fields[key] = value
    fields["distortion"] = [fields.pop("k1", 0.0)]
    return fields


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, its type where there is none."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _has(value: Any, keys: tuple[str, ...]) -> bool:
    return isinstance(value, dict) and any(key in value for key in keys)
