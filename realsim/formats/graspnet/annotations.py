"""annotations/%04d.xml of GraspNet-1Billion: the objects of one image, read and written.

    <scene><obj><obj_id>0</obj_id> ... <pos_in_world>x y z</pos_in_world>
    <ori_in_world>w x y z</ori_in_world></obj></scene>

In spite of their names the two are the pose of the object in THIS image's camera: metres and a
quaternion. graspnetAPI's own writer gives both four decimals, 0.09 mm; its reader takes any number
of them, and nine are written here: nothing is lost.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.records.checked_arrays import rigid
from realsim.untrusted.xml_tree import read_xml

ANNOTATIONS = "annotations"
DECIMALS = 9
LARGEST_XML = 1_000_000
"""[bytes]: a scene of ten objects has 4 kB."""
LARGEST_NUMBER = 99_999
"""Largest number of an object; GraspNet-1Billion has 0 to 87."""
LENGTH_TOLERANCE = 0.01
"""A quaternion with four decimals has the length 1 to 1e-4; another one is something else."""
FARTHEST_M = 10.0
"""From a camera to what a robot grasps; a greater number is millimetres."""
FIELDS = ("obj_id", "obj_name", "obj_path", "pos_in_world", "ori_in_world")
"""graspnetAPI reads them by their places, so they come first, in this order."""
TAG = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AnnotatedObject:
    """One <obj>."""

    number: int
    """GraspNet's, from 0."""
    T_cam_obj: Array
    """(4, 4) object in the image's camera [m]."""
    xyzw_R_cam_obj: Array
    """(3, 3) its rotation if the four numbers were x y z w; evidence against that order."""
    fields: Mapping[str, str]
    """The texts of its elements."""

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze it."""
        object.__setattr__(self, "T_cam_obj", rigid(self.T_cam_obj, f"object {self.number}"))


def read_objects(path: Path) -> tuple[AnnotatedObject, ...]:
    """Return the objects of an annotation, in its order.

    Raises:
        InputError: missing, too large, with entities, or not GraspNet's XML.
        UnitError: the positions are in millimetres.
    """
    root = read_xml(path, most_bytes=LARGEST_XML)
    if root.tag != "scene":
        raise InputError(f"{path} is a <{root.tag:.40}>; GraspNet's <scene> is expected.")
    return tuple(_object(node, f"object {k} of {path}") for k, node in enumerate(root.iter("obj")))


def _object(node: Any, where: str) -> AnnotatedObject:
    fields: dict[str, str] = {}
    for child in node:
        tag, text = str(child.tag), str(child.text or "").strip()
        if tag in fields:
            raise InputError(f"{where} has <{tag:.40}> twice; which one holds?")
        fields[tag] = text
    number = _numbers(fields.get("obj_id", ""), 1, f"obj_id of {where}")[0]
    if number != int(number) or not 0 <= number <= LARGEST_NUMBER:
        raise InputError(
            f"{where} has the obj_id {number:g}; whole numbers from 0 to {LARGEST_NUMBER} are read."
        )
    position = _numbers(fields.get("pos_in_world", ""), 3, f"pos_in_world of {where}")
    far = float(np.linalg.norm(position))
    if far > FARTHEST_M:
        raise UnitError(
            f"pos_in_world of {where} is {far:g} from the camera; it is in metres there, and no "
            f"grasped object is farther than {FARTHEST_M:g} m. If the file is in millimetres, "
            "divide by 1000."
        )
    q = np.array(_numbers(fields.get("ori_in_world", ""), 4, f"ori_in_world of {where}"))
    length = float(np.linalg.norm(q))
    if abs(length - 1.0) > LENGTH_TOLERANCE:
        raise InputError(
            f"ori_in_world of {where} has the length {length:.3g}; a quaternion w x y z of "
            "length 1 is needed."
        )
    return AnnotatedObject(
        number=int(number),
        T_cam_obj=se3.from_rt(se3.from_quaternion_wxyz(q), position),
        xyzw_R_cam_obj=se3.from_quaternion_wxyz(np.roll(q, 1)),
        fields=fields,
    )


def _numbers(text: str, count: int, name: str) -> list[float]:
    words = text.split() if len(text) < 1000 else []
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.all(np.isfinite(numbers)):
        raise InputError(f"{name} is {text.strip()[:60]!r}; {count} finite number(s) are needed.")
    return numbers


def _text(numbers: Array) -> str:
    return " ".join(f"{x:.{DECIMALS}f}" for x in numbers)


def object_fields(number: int, T_cam_obj: Array) -> dict[str, str]:
    """Return the texts of an <obj>."""
    return {
        "obj_id": str(number),
        "obj_name": f"{number:03d}.ply",
        "obj_path": f"models/{number:03d}/nontextured.ply",
        "pos_in_world": _text(T_cam_obj[:3, 3]),
        "ori_in_world": _text(se3.quaternion_wxyz(T_cam_obj[:3, :3])),
    }


def pose_of(fields: Mapping[str, str]) -> Array:
    """Return T_cam_obj (4, 4) [m] that a reader gets from the texts of an <obj>."""
    q = [float(x) for x in fields["ori_in_world"].split()]
    return se3.from_rt(
        se3.from_quaternion_wxyz(q), [float(x) for x in fields["pos_in_world"].split()]
    )


def annotation_bytes(objects: Sequence[Mapping[str, str]]) -> bytes:
    """Return an annotation of the texts of its objects, laid out as graspnetAPI's writer does."""
    lines = ['<?xml version="1.0" ?>', "<scene>" if objects else "<scene/>"]
    for fields in objects:
        more = [tag for tag in fields if tag not in FIELDS and TAG.fullmatch(tag)]
        lines.append("    <obj>")
        for tag in (*FIELDS, *more):
            lines.append(f"        <{tag}>{escape(fields.get(tag, ''))}</{tag}>")
        lines.append("    </obj>")
    lines += ["</scene>"] if objects else []
    return ("\n".join(lines) + "\n").encode("utf-8")
