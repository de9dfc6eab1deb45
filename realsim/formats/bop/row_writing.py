"""One image's rows of scene_camera.json, scene_gt.json and scene_gt_info.json.

A row that came from a BOP file is repeated, its unknown keys with it; a number in it is only
written anew where it no longer says what the frame says.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.formats.bop.instances import INSTANCE
from realsim.formats.bop.labels import gt_info_entry
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
from realsim.records import bop_units as units

Json = dict[str, Any]
SAME = 1e-12
"""Rotations (their entries) and positions [m] that differ by less are the row's own: reading makes
them orthonormal and may round the last digit."""
STEPS = 3
"""Neighbouring doubles looked at on each side: two roundings move a number by less."""
NO_DEPTH_SCALE = 1.0
"""depth_scale of images without depth: nothing is scaled, and tools ask for the key."""


def camera_row(frame: LabelledFrame) -> Json:
    """Return an image's row of scene_camera.json."""
    entry = frame.entry
    row: Json = {} if entry is None or "cam_K" not in entry else dict(entry)
    name = f"image {frame.index}"
    camera = frame.intrinsics
    if not _has_camera(row, frame, name):
        row["cam_K"] = camera.K.ravel().tolist()
        row.pop("cam_distortion", None)
        if camera.is_distorted:
            row["cam_distortion"] = camera.distortion.tolist()
    if frame.depth_unit_m is None:
        row.setdefault("depth_scale", NO_DEPTH_SCALE)
    elif not _has_unit(row, frame.depth_unit_m, name):
        row["depth_scale"] = exact_mm(frame.depth_unit_m)
    if frame.T_world_cam is None:
        row.pop("cam_R_w2c", None)
        row.pop("cam_t_w2c", None)
    elif not _has_pose(row, frame.T_world_cam, name):
        T_cam_world = se3.invert(frame.T_world_cam)
        row["cam_R_w2c"] = T_cam_world[:3, :3].ravel().tolist()
        row["cam_t_w2c"] = exact_mm_list(T_cam_world[:3, 3])
    return row


def _has_camera(row: Json, frame: LabelledFrame, name: str) -> bool:
    camera = frame.intrinsics
    try:
        found = units.intrinsics_of(row, camera.width, camera.height, name)
    except InputError:
        return False
    return bool(
        np.array_equal(found.K, camera.K) and np.array_equal(found.distortion, camera.distortion)
    )


def _has_unit(row: Json, unit_m: float, name: str) -> bool:
    try:
        return units.depth_unit_of(row, name) == unit_m
    except InputError:
        return False


def _has_pose(row: Json, T_world_cam: Array, name: str) -> bool:
    try:
        found = units.T_world_cam_of(row, name)
    except InputError:
        return False
    return found is not None and float(np.abs(found - T_world_cam).max()) < SAME


def object_row(o: LabelledObject) -> Json:
    """Return an object's row of scene_gt.json.

    Raises:
        UnitError: it would be farther than any table.
    """
    entry = o.entry
    from_bop = entry is not None and "cam_R_m2c" in entry
    row: Json = dict(entry) if entry is not None and from_bop else {}
    name = f"object {o.obj_id}"
    distance_mm = float(np.linalg.norm(o.T_cam_obj[:3, 3])) * units.MM_PER_M
    touches = distance_mm < units.NEAREST_MM
    if not (from_bop and _has_object_pose(row, o.T_cam_obj, name)):
        row["cam_R_m2c"] = o.T_cam_obj[:3, :3].ravel().tolist()
        row["cam_t_m2c"] = exact_mm_list(o.T_cam_obj[:3, 3])
    units.object_in_camera(row["cam_R_m2c"], row["cam_t_m2c"], name, may_touch=True)
    if touches or units.AT_THE_LENS in row:
        row[units.AT_THE_LENS] = touches
    if row.get("obj_id") != o.obj_id:
        row["obj_id"] = o.obj_id
    if not from_bop and o.instance is not None:
        row[INSTANCE] = o.instance
    return row


def _has_object_pose(row: Json, T_cam_obj: Array, name: str) -> bool:
    try:
        found = units.rigid_from_lists(row["cam_R_m2c"], row.get("cam_t_m2c"), name)
    except InputError:
        return False
    return float(np.abs(found - T_cam_obj).max()) < SAME


def info_rows(
    objects: Sequence[LabelledObject],
    masks: Sequence[tuple[Mask | None, Mask | None]],
    depth_m: NDArray[Any] | None,
) -> list[Json] | None:
    """Return an image's rows of scene_gt_info.json: the source's own, or counted in the masks.

    Args:
        objects: of the image.
        masks: whole and visible mask (H, W) of each.
        depth_m: (H, W) measured depth [m]; None = there is none.

    Returns:
        One row for each object; None where an object has neither.

    Raises:
        InputError: a visible part reaches out of its silhouette.
    """
    rows: list[Json] = []
    for o, (whole, visible) in zip(objects, masks, strict=True):
        if o.gt_info is not None:
            rows.append(dict(o.gt_info))
        elif whole is not None and visible is not None:
            rows.append(gt_info_entry(whole, visible, depth_m))
        else:
            return None
    return rows


def exact_mm(metres: float) -> float:
    """Return the shortest decimal [mm] that divides to these metres.

    x = d / 1000 is rounded, and so is x * 1000: 0.1 mm would come back as 0.09999999999999999.
    Decimals of up to 15 digits lie farther apart than the doubles that divide to the same metres,
    so whatever had at most 15 digits comes back. Not every double is a thousandth of one; then the
    product is returned, one bit off at most.
    """
    middle = metres * units.MM_PER_M
    candidates = [middle]
    for direction in (-math.inf, math.inf):
        x = middle
        for _ in range(STEPS):
            x = math.nextafter(x, direction)
            candidates.append(x)
    same = [x for x in candidates if x / units.MM_PER_M == metres]
    return min(same, key=lambda x: len(repr(x))) if same else middle


def exact_mm_list(metres: ArrayLike) -> list[float]:
    """Return a vector (N,) [m] as shortest decimals [mm]."""
    return [exact_mm(float(x)) for x in np.asarray(metres, dtype=np.float64).ravel()]
