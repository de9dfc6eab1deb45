"""The objects of one image: its annotation and its meta file, which say the same thing twice."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.graspnet.annotations import ANNOTATIONS, AnnotatedObject, read_objects
from realsim.formats.graspnet.meta import META, Meta, read_meta
from realsim.geometry import se3

SAME_POSITION_M = 1.01e-4
"""Greatest difference along one axis: half of the fourth decimal for each of the two files, and
single precision."""
SAME_ROTATION_RAD = 4e-4
"""Half of the fourth decimal on four components is 2e-4 rad at most, for each of the two files."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ImageObject:
    """One object of an image."""

    number: int
    """GraspNet's, from 0."""
    T_cam_obj: Array
    """(4, 4) [m]: of the meta file where there is one, which has seven digits, else of the XML."""
    xyzw_R_cam_obj: Array | None
    """(3, 3) the XML's rotation if its numbers were x y z w; None without XML."""
    entry: dict[str, Any]
    """What the files have, for a writer of the same format."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ImageObjects:
    """What the two files of an image say."""

    objects: tuple[ImageObject, ...]
    """In the files' order."""
    meta: Meta | None
    has_annotation: bool


def read_image_objects(folder: Path, index: int) -> ImageObjects:
    """Return the objects of an image.

    Args:
        folder: of the camera.
        index: of the image.

    Raises:
        InputError: neither file is there, one is damaged, or the two contradict each other.
        UnitError: millimetres.
    """
    annotation = folder / ANNOTATIONS / f"{index:04d}.xml"
    meta = folder / META / f"{index:04d}.mat"
    seen = read_objects(annotation) if annotation.is_file() else None
    said = read_meta(meta) if meta.is_file() else None
    if seen is None and said is None:
        raise InputError(f"there is neither {annotation} nor {meta}: the poses are in there.")
    return ImageObjects(
        objects=joined_objects(seen, said, f"{annotation} and {meta}"),
        meta=said,
        has_annotation=seen is not None,
    )


def joined_objects(
    seen: tuple[AnnotatedObject, ...] | None, said: Meta | None, where: str
) -> tuple[ImageObject, ...]:
    """Return the objects of the annotation, with the poses of the meta file.

    Raises:
        InputError: the two do not have the same objects, or not the same poses.
    """
    if seen is None:
        numbers = () if said is None else said.numbers
        return tuple(_joined(n, None, said, k) for k, n in enumerate(numbers))
    if said is None:
        return tuple(_joined(o.number, o, None, 0) for o in seen)
    rows = _rows_in_meta([o.number for o in seen], list(said.numbers), where)
    for o, row in zip(seen, rows, strict=True):
        _require_same_pose(o, said.Ts_cam_obj[row], where)
    return tuple(_joined(o.number, o, said, row) for o, row in zip(seen, rows, strict=True))


def _joined(number: int, seen: AnnotatedObject | None, said: Meta | None, row: int) -> ImageObject:
    if said is not None:
        T = said.Ts_cam_obj[row]
    else:
        assert seen is not None
        T = seen.T_cam_obj
    entry = {
        "fields": None if seen is None else dict(seen.fields),
        "pose": None if said is None else said.poses[row].tolist(),
        "T_cam_obj": T.tolist(),
    }
    xyzw = None if seen is None else seen.xyzw_R_cam_obj
    return ImageObject(number=number, T_cam_obj=T, xyzw_R_cam_obj=xyzw, entry=entry)


def _rows_in_meta(seen: list[int], said: list[int], where: str) -> list[int]:
    """Return for each object of the annotation its row in the meta file."""
    if seen == said:
        return list(range(len(seen)))
    counts = Counter(seen)
    if counts != Counter(said) or max(counts.values(), default=1) > 1:
        raise InputError(
            f"{where} do not have the same objects: {seen} and {said} (cls_indexes - 1). Restore "
            "the file that is wrong, or take one of the two away."
        )
    return [said.index(n) for n in seen]


def _require_same_pose(seen: AnnotatedObject, T: Array, where: str) -> None:
    off = float(np.max(np.abs(seen.T_cam_obj[:3, 3] - T[:3, 3])))
    turn = float(se3.angle(seen.T_cam_obj[:3, :3].T @ T[:3, :3]))
    if off <= SAME_POSITION_M and turn <= SAME_ROTATION_RAD:
        return
    hint = ""
    if turn > SAME_ROTATION_RAD and (
        float(se3.angle(seen.xyzw_R_cam_obj.T @ T[:3, :3])) <= SAME_ROTATION_RAD
    ):
        hint = " Read as x y z w the quaternion agrees; the format's order is w x y z."
    raise InputError(
        f"{where} disagree about object {seen.number:03d} by {1e3 * off:.2f} mm and "
        f"{np.degrees(turn):.3f} deg; the four decimals of the XML explain "
        f"{1e3 * SAME_POSITION_M:.1f} mm and {np.degrees(SAME_ROTATION_RAD):.3f} deg. Restore the "
        f"file that is wrong, or take one of the two away.{hint}"
    )
