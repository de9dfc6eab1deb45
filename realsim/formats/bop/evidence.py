"""What a BOP scene says of its own conventions: units, directions and order of its numbers.

Millimetres, world to camera and rows first are BOP's; data sets made by other programs have metres,
camera to world or columns first. Each leaves traces: static objects do not stay in their place from
view to view, or what was measured at an object is not where the object is said to be.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError, UnitError
from realsim.formats.evidence import (
    AGREES_MM,
    STATED,
    limit_mm,
    objects_evidence,
    require_direction,
)
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics
from realsim.records.bop_units import MM_PER_M

Thing = list[tuple[int, Array]]
COLUMNS_FIRST = "cam_R_w2c is written column by column"
IN_METRES = "cam_t_w2c is in metres"
TWICE = "cam_t_w2c was multiplied by 1000 once too often"
TURNED_DEG = 5.0
"""Static objects whose orientation differs more than this between views [deg] are suspicious."""
TURNED_BY = 5.0
"""Columns are taken for rows if the other reading is this many times better."""
UNIT_FACTOR = 3.0
"""Measured depth within an object's visible part is at most this many times its distance, or less:
what lies in front of an object's origin, or behind it where the label is rough, changes it by
tenths; units differ by ten and more."""
LEAST_BOXES = 8
"""Objects whose box is compared with the projected one, at least."""
BOX_VOTES = 0.8
"""Share of them that must fit better with columns first."""
BOX_GAIN = 0.1
"""Least median gain of their overlap (intersection over union)."""
LEAST_SEEN = 4
"""Objects that must be looked at before their places say anything."""
SEEN_SHARE = 0.5
SEEN_ROOM = 0.1
"""Share of the projected box's size: annotations are some pixels off."""
MOST_BOXES = 300
FIT_MARGIN = 0.02
"""Overlaps that differ by less do not tell rows from columns."""


def check_camera_poses(Ts_world_cam: Array, things: Sequence[Thing], where: str) -> str:
    """Return a note on the camera poses if static objects do not contradict them.

    Args:
        Ts_world_cam: (N, 4, 4) [m].
        things: of each static object its (view, T_cam_obj) pairs.
        where: for messages.

    Raises:
        InputError: the poses of the objects agree between views under another direction or order.
        UnitError: they agree under another unit of the camera's position.
    """
    evidence = objects_evidence(Ts_world_cam, things)
    stated = evidence.spreads[STATED].mm
    others = {
        name: objects_evidence(Ts, things).spreads[STATED].mm
        for name, Ts in _other_readings(Ts_world_cam).items()
    }
    best = min(others, key=lambda name: others[name])
    least = others[best]
    is_worse = stated > limit_mm(least) and least <= AGREES_MM
    if evidence.compared and is_worse and all(least <= s.mm for s in evidence.spreads.values()):
        kind = InputError if best == COLUMNS_FIRST else UnitError
        remedy = {
            COLUMNS_FIRST: "Write it row by row.",
            IN_METRES: "Multiply cam_t_w2c by 1000.",
            TWICE: "Divide cam_t_w2c by 1000.",
        }[best]
        raise kind(
            f"{where}: {best}. Read as stated, the positions of {evidence.compared} spread by "
            f"{stated:.1f} mm in the world; read that way, by {least:.1f} mm. {remedy}"
        )
    note = require_direction(
        evidence,
        where,
        remedy="cam_R_w2c and cam_t_w2c lead from world to camera, z forward, y down: invert or "
        "turn them, and write them again.",
    )
    _require_rows_first(Ts_world_cam, things, evidence.compared, where)
    return note


def _other_readings(Ts_world_cam: Array) -> dict[str, Array]:
    Ts_cam_world = se3.invert(Ts_world_cam)
    R, t = Ts_cam_world[:, :3, :3], Ts_cam_world[:, :3, 3]
    return {
        COLUMNS_FIRST: se3.invert(se3.from_rt(np.swapaxes(R, 1, 2), t)),
        IN_METRES: se3.invert(se3.from_rt(R, t * MM_PER_M)),
        TWICE: se3.invert(se3.from_rt(R, t / MM_PER_M)),
    }


def _require_rows_first(
    Ts_world_cam: Array, things: Sequence[Thing], compared: str, where: str
) -> None:
    """Raise if orientations agree between views only with cam_R_m2c transposed."""
    swapped = [[(view, transposed(T)) for view, T in thing] for thing in things]
    stated = objects_evidence(Ts_world_cam, things).spreads[STATED].deg
    other = objects_evidence(Ts_world_cam, swapped).spreads[STATED].deg
    if stated is None or other is None or not stated > TURNED_DEG:
        return
    if other * TURNED_BY < stated and other < TURNED_DEG:
        raise InputError(
            f"{where}: cam_R_m2c is written column by column. Read as stated, the orientations of "
            f"{compared} spread by {stated:.1f} deg in the world; transposed, by {other:.1f} deg. "
            "Write it row by row."
        )


def transposed(T: Array) -> Array:
    """Return a pose (4, 4) whose rotation is read column by column."""
    return se3.from_rt(T[:3, :3].T, T[:3, 3])


# --- depth --------------------------------------------------------------------------------------


def require_depth_unit(ratios: Sequence[float], unit_m: float, where: str) -> str:
    """Return a note on depth_scale if measured depth fits the objects' distances.

    Args:
        ratios: of each object: median measured depth / distance of its origin.
        unit_m: metres per count as stated.
        where: for messages.

    Raises:
        UnitError: depth is several times too far or too near.
    """
    if not ratios:
        return f"{where}: depth_scale could not be checked: no labelled object has measured depth."
    ratio = float(np.median(ratios))
    said = (
        f"depth measured at {len(ratios)} labelled objects is {ratio:.3g} times as far as they are"
    )
    if not 1 / UNIT_FACTOR < ratio < UNIT_FACTOR:
        scale = unit_m * MM_PER_M
        power = 10.0 ** round(-np.log10(ratio))
        raise UnitError(
            f"{where}: {said}, with depth_scale {scale:g}. One of depth_scale and cam_t_m2c has "
            f"another unit: with depth_scale {scale * power:g} depth would be {ratio * power:.3g} "
            "times as far. Correct the wrong one."
        )
    return (
        f"checked: depth fits the labels, surfaces of {len(ratios)} objects are measured at "
        f"{ratio:.3g} of the distance of their origins."
    )


# --- boxes --------------------------------------------------------------------------------------


def require_boxes(
    boxes: Sequence[tuple[Sequence[float], int, Array, CameraIntrinsics]],
    corners: Mapping[int, Array],
    where: str,
) -> None:
    """Raise if the boxes in the images fit the objects' boxes only with cam_R_m2c transposed.

    Args:
        boxes: of each label: bbox_obj, object id, T_cam_obj (4, 4) [m], camera.
        corners: object id -> (8, 3) corners of its box [m], of models_info.json.
        where: for messages.

    Raises:
        InputError: columns were taken for rows.
    """
    known = [b for b in boxes if b[1] in corners and b[0][2] > 0 and b[0][3] > 0]
    known = known[:: max(1, -(-len(known) // MOST_BOXES))]
    overlaps: list[tuple[float, float]] = []
    for box, obj_id, T, intrinsics in known:
        pair = [_overlap(box, _box(intrinsics, U, corners[obj_id])) for U in (T, transposed(T))]
        if abs(pair[0] - pair[1]) > FIT_MARGIN:
            overlaps.append((pair[0], pair[1]))
    if len(overlaps) < LEAST_BOXES:
        return
    stated, other = np.array(overlaps).T
    votes = float(np.mean(other > stated))
    if votes >= BOX_VOTES and float(np.median(other - stated)) > BOX_GAIN:
        raise InputError(
            f"{where}: cam_R_m2c is written column by column. {votes:.0%} of {len(overlaps)} boxes "
            f"bbox_obj fit the projected models better with it transposed (median overlap "
            f"{np.median(other):.2f} instead of {np.median(stated):.2f}). Write it row by row."
        )


def require_projection(found: Sequence[bool], where: str) -> None:
    """Raise if the objects do not project to where they are seen.

    Args:
        found: of each object: whether the middle of its visible mask lies in the projection of its
            box.
        where: for messages.

    Raises:
        InputError: most of them lie elsewhere.
    """
    if len(found) >= LEAST_SEEN and np.mean(found) < SEEN_SHARE:
        raise InputError(
            f"{where}: {len(found) - sum(found)} of {len(found)} objects are not seen where cam_K "
            "and their poses project them to. cam_K belongs to another image size or is "
            "normalised, the masks belong to other objects, or the poses to other images. Correct "
            "what is wrong."
        )


def is_seen_in_box(mask: Mask, intrinsics: CameraIntrinsics, T: Array, corners: Array) -> bool:
    """Return whether the middle of a visible mask (H, W) lies in the projected box of a model.

    Args:
        mask: of the visible part; not empty.
        intrinsics: of the image.
        T: (4, 4) object in camera [m].
        corners: (8, 3) of the model's box [m].
    """
    rows, columns = np.nonzero(mask)
    x0, y0, x1, y1 = _box(intrinsics, T, corners)
    room = SEEN_ROOM * max(x1 - x0, y1 - y0)
    inside_x = x0 - room <= columns.mean() <= x1 + room
    return bool(inside_x and y0 - room <= rows.mean() <= y1 + room)


def _box(intrinsics: CameraIntrinsics, T: Array, points: Array) -> Array:
    """Return x0 y0 x1 y1 [px] of projected points; NaN where one is behind the camera."""
    with np.errstate(invalid="ignore", over="ignore"):
        uv = project(intrinsics, se3.transform(T, points))
    return np.concatenate([uv.min(axis=0), uv.max(axis=0)])


def _overlap(box: Sequence[float], projected: Array) -> float:
    """Return intersection over union of bbox_obj (x, y, w, h) and x0 y0 x1 y1."""
    if not np.all(np.isfinite(projected)):
        return 0.0
    x0, y0, w, h = (float(v) for v in box)
    a = np.array([x0, y0, x0 + w, y0 + h])
    size = np.minimum(a[2:], projected[2:]) - np.maximum(a[:2], projected[:2])
    inside = float(np.prod(np.maximum(size, 0)))
    both = float(np.prod(a[2:] - a[:2]) + np.prod(projected[2:] - projected[:2]))
    return inside / (both - inside) if both > inside else 0.0
