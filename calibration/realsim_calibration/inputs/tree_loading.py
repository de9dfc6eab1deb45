"""JSON, YAML and OpenCV's XML as trees of dicts, lists and numbers, through the checked readers."""

import re
from typing import Any

from realsim.errors import InputError
from realsim.untrusted.json_text import parsed_json
from realsim.untrusted.xml_tree import parsed_xml
from realsim.untrusted.yaml_text import parsed_yaml
from realsim_calibration.inputs.pose_text import number_of

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
