"""The rows of scene_camera.json, scene_gt.json and scene_gt_info.json, checked all at once.

A scene has thousands of rows: numbers are stacked and checked together, and only where something
is wrong are the rows gone through one by one, for a message that names the row.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError, NotRigidError
from realsim.geometry import se3
from realsim.records import bop_units as units
from realsim.untrusted.json_text import read_json
from realsim.untrusted.values import whole

Json = dict[str, Any]
GT_KEYS = ("obj_id", "cam_R_m2c", "cam_t_m2c")
LARGEST_OBJECT_ID = 999_999
"""Greatest number of an object, by the six digits of obj_000001.ply."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GroundTruth:
    """The annotations of a scene: every row as it is, and all poses together."""

    file: Path
    rows: Mapping[int, list[Json]]
    """Image -> its rows."""
    start: Mapping[int, int]
    """Image -> place of its first row in the arrays."""
    obj_ids: Int64
    """(N,)."""
    Ts_cam_obj: Array
    """(N, 4, 4) [m]."""

    def places(self, index: int) -> slice:
        """Return where the rows of an image are in the arrays; an empty slice = it has none."""
        first = self.start.get(index, 0)
        return slice(first, first + len(self.rows.get(index, ())))


def by_image(path: Path) -> dict[int, Any]:
    """Return the entries of a document by image, in the order of the images.

    Raises:
        InputError: it is not an object with one entry per image number.
    """
    data = read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"{path} is not an object with one entry per image number.")
    found: dict[int, Any] = {}
    entries: Json = data
    for key, value in entries.items():
        if not (key.isascii() and key.isdecimal() and len(key) <= 12):
            raise InputError(
                f"{path} is not an object with one entry per image number: it has the key {key!r}."
            )
        if int(key) in found:
            raise InputError(f"{path} has image {int(key)} twice.")
        found[int(key)] = value
    return {i: found[i] for i in sorted(found)}


def read_cameras(path: Path) -> dict[int, Json]:
    """Return the camera rows of a scene by image.

    Raises:
        InputError: not such a file.
    """
    rows = by_image(path)
    for i, row in rows.items():
        if not isinstance(row, dict):
            raise InputError(
                f"image {i} of {path} must be an object with cam_K; found {row!r:.60}."
            )
    return rows


def read_object_lists(path: Path) -> dict[int, list[Json]]:
    """Return the lists of objects of scene_gt.json or scene_gt_info.json by image.

    Raises:
        InputError: not such a file.
    """
    rows = by_image(path)
    for i, listed in rows.items():
        items: Sequence[Any] = listed if isinstance(listed, list) else ()
        if not isinstance(listed, list) or not all(isinstance(row, dict) for row in items):
            raise InputError(
                f"image {i} of {path} must have a list of objects; found {listed!r:.60}."
            )
    return rows


def read_ground_truth(path: Path, *, least_id: int = 1) -> GroundTruth:
    """Return the annotations of a scene, poses in metres.

    Args:
        path: scene_gt.json.
        least_id: least object id; 0 lets IPD's first object pass, which no `ObjectModel` can have.

    Raises:
        InputError: a row lacks something.
        NotRigidError: a rotation that is none.
        UnitError: a translation that is not in millimetres.
    """
    rows = read_object_lists(path)
    named = [(i, k, row) for i, listed in rows.items() for k, row in enumerate(listed)]
    for i, k, row in named:
        if any(key not in row for key in GT_KEYS):
            raise InputError(
                f"{_name(path, i, k)} must be an object with {', '.join(GT_KEYS)}; it has "
                f"{', '.join(row) or 'nothing'}."
            )
    obj_ids = [
        whole(row["obj_id"], f"obj_id of {_name(path, i, k)}", least_id, LARGEST_OBJECT_ID)
        for i, k, row in named
    ]
    start: dict[int, int] = {}
    count = 0
    for i, listed in rows.items():
        start[i] = count
        count += len(listed)
    Ts = _stacked([row for _, _, row in named])
    if Ts is None:
        one_by_one = [
            units.object_in_camera(
                row["cam_R_m2c"],
                row["cam_t_m2c"],
                _name(path, i, k),
                may_touch=row.get(units.AT_THE_LENS) is True,
            )
            for i, k, row in named
        ]
        Ts = np.stack(one_by_one)
    return GroundTruth(
        file=path, rows=rows, start=start, obj_ids=np.array(obj_ids, dtype=np.int64), Ts_cam_obj=Ts
    )


def _name(path: Path, image: int, k: int) -> str:
    return f"object {k} of image {image} of {path}"


def _stacked(rows: Sequence[Json]) -> Array | None:
    """Return all poses (N, 4, 4) [m], or None where a row must be looked at by itself."""
    if not rows:
        return np.zeros((0, 4, 4))
    R = _plain([row["cam_R_m2c"] for row in rows], 9)
    t = _plain([row["cam_t_m2c"] for row in rows], 3)
    if R is None or t is None:
        return None
    distance = np.linalg.norm(t, axis=1)
    touching = np.array([row.get(units.AT_THE_LENS) is True for row in rows])
    if np.any(distance > units.FARTHEST_MM) or np.any((distance < units.NEAREST_MM) & ~touching):
        return None
    if np.any(np.abs(R) > 2):
        return None
    try:
        return se3.check_rigid(
            se3.from_rt(R.reshape(-1, 3, 3), t / units.MM_PER_M), "cam_R_m2c, cam_t_m2c"
        )
    except NotRigidError:
        return None


def _plain(lists: Sequence[Any], count: int) -> Array | None:
    """Return lists of plain numbers as (N, count); None where one is something else."""
    if any(type(numbers) is not list or len(numbers) != count for numbers in lists):
        return None
    if any(type(x) is not float and type(x) is not int for numbers in lists for x in numbers):
        return None
    try:
        return np.array(lists, dtype=np.float64)
    except OverflowError:
        return None
