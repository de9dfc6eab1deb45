"""Writing BOP's annotations into a session: poses, masks, visibility and COCO.

The n-th object of an image is the same one in scene_gt.json, in scene_gt_info.json and in the mask
files IMAGE_n.png; keep the order.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics, bop_units
from realsim.store.atomic import json_bytes
from realsim.store.session_store import SessionStore, rgb_path

Bbox = tuple[int, int, int, int]
"""x, y, width, height [px]."""
Json = dict[str, Any]

NO_BBOX: Bbox = (-1, -1, -1, -1)
"""What BOP writes for an object that is not visible."""


def mask_path(index: int, k: int, *, visible: bool) -> str:
    """Return where the mask of the k-th object of an image is, relative to the session."""
    return f"{'mask_visib' if visible else 'mask'}/{index:06d}_{k:06d}.png"


def bbox_of(mask: Mask, *, inclusive: bool = False) -> Bbox:
    """Return the box of a mask.

    BOP's scene_gt_info has width = max - min, COCO (`inclusive`) has max - min + 1.
    """
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if len(columns) == 0:
        return NO_BBOX
    more = 1 if inclusive else 0
    return (
        int(columns[0]),
        int(rows[0]),
        int(columns[-1] - columns[0]) + more,
        int(rows[-1] - rows[0]) + more,
    )


def rle_of(
    mask: Mask, *, origin: tuple[int, int] = (0, 0), shape: tuple[int, ...] | None = None
) -> Json:
    """Return a mask as COCO's uncompressed run lengths: column by column, zeros first.

    Args:
        mask: (h, w).
        origin: column x and row y of its first pixel in the image.
        shape: (height, width) of the image, which is not set elsewhere; None = the mask's own.

    Raises:
        InputError: the mask reaches out of the image.
    """
    mask = np.asarray(mask, dtype=np.bool_)
    (x, y), (h, w) = origin, mask.shape
    height, width = mask.shape if shape is None else shape
    if x < 0 or y < 0 or x + w > width or y + h > height:
        raise InputError(
            f"a mask of {w}x{h} pixels at ({x}, {y}) reaches out of an image of {width}x{height}."
        )
    # A row of zeros above and below: every run of a column begins and ends inside it.
    padded = np.zeros((w, h + 2), np.int8)
    padded[:, 1:-1] = mask.T
    step = np.diff(padded, axis=1)
    column, row = np.nonzero(step)
    at = (column + x) * height + row + y
    starts, ends = at[0::2], at[1::2]
    if len(starts):  # a run down to the last row goes on in the first row of the next column
        is_joined = ends[:-1] == starts[1:]
        starts = starts[np.concatenate([[True], ~is_joined])]
        ends = ends[np.concatenate([~is_joined, [True]])]
    edges = np.stack([starts, ends], 1).ravel()
    runs = np.diff(np.concatenate([[0], edges, [height * width]]))
    counts: list[int] = runs.tolist()
    if len(counts) > 1 and counts[-1] == 0:
        counts.pop()
    return {"counts": counts, "size": [int(height), int(width)]}


def rle_area_and_bbox(rle: Json) -> tuple[int, Bbox]:
    """Return the pixels of a mask's run lengths, and its box as COCO has it (width = columns)."""
    height = int(rle["size"][0])
    edges = np.cumsum(np.asarray(rle["counts"], dtype=np.int64))
    edges = edges[: len(edges) // 2 * 2]
    starts, ends = edges[0::2], edges[1::2]
    area = int(np.sum(ends - starts))
    if area == 0:
        return 0, NO_BBOX
    first, last = starts // height, (ends - 1) // height
    # A run over several columns covers the last row of one and the first row of the next.
    crosses = first != last
    top = int(np.where(crosses, 0, starts % height).min())
    bottom = int(np.where(crosses, height - 1, (ends - 1) % height).max())
    left, right = int(first.min()), int(last.max())
    return area, (left, top, right - left + 1, bottom - top + 1)


def mask_of(rle: Json) -> Mask:
    """Return the mask (H, W) of COCO's uncompressed run lengths."""
    height, width = rle["size"]
    counts = np.asarray(rle["counts"], dtype=np.int64)
    if counts.sum() != height * width:
        raise InputError(
            f"run lengths add up to {counts.sum()} pixels; {height} x {width} are needed."
        )
    values = np.arange(len(counts)) % 2 == 1
    return np.repeat(values, counts).reshape((height, width), order="F")


def gt_info_entry(
    mask: Mask,
    mask_visib: Mask,
    depth_m: NDArray[Any] | None,
    *,
    px_count_all: int | None = None,
    bbox_obj: Bbox | None = None,
) -> Json:
    """Return one object's entry of scene_gt_info.json.

    Args:
        mask: (H, W) the whole silhouette, as if nothing stood in front.
        mask_visib: (H, W) its visible part.
        depth_m: (H, W) measured depth [m], for px_count_valid; None = no depth.
        px_count_all: pixels of the silhouette also beyond the image; None = those inside.
        bbox_obj: box of the silhouette, also beyond the image; None = of the part inside.
    """
    inside, visible = int(np.count_nonzero(mask)), int(np.count_nonzero(mask_visib))
    everything = inside if px_count_all is None else int(px_count_all)
    if everything < inside or np.any(mask_visib & ~mask):
        raise InputError(
            f"a mask of {inside} pixels, {visible} of them visible, {everything} in all: the "
            "visible part must lie in the silhouette, and that in the whole."
        )
    valid = 0 if depth_m is None else int(np.count_nonzero(np.asarray(depth_m)[mask] > 0))
    box = bbox_of(mask) if bbox_obj is None else bbox_obj
    return {
        "bbox_obj": list(box) if visible else list(NO_BBOX),
        "bbox_visib": list(bbox_of(mask_visib)),
        "px_count_all": everything,
        "px_count_valid": valid,
        "px_count_visib": visible,
        "visib_fract": visible / everything if everything else 0.0,
    }


def gt_row(obj_id: int, T_cam_obj: ArrayLike) -> Json:
    """Return the row of scene_gt.json of an object whose pose is known in metres."""
    rotation, translation = bop_units.lists_from_rigid(T_cam_obj)
    row: Json = {"cam_R_m2c": rotation, "cam_t_m2c": translation, "obj_id": obj_id}
    if float(np.linalg.norm(translation)) < bop_units.NEAREST_MM:
        row[bop_units.AT_THE_LENS] = True
    return row


def write_scene_gt(
    store: SessionStore, annotations: Mapping[int, Sequence[tuple[int, ArrayLike]]]
) -> None:
    """Write scene_gt.json.

    Args:
        store: the session.
        annotations: image -> (object id, T_cam_obj (4, 4) [m]) of each object.

    Raises:
        UnitError: an object would be farther than any table.
    """
    scene: Json = {}
    for index in sorted(annotations):
        rows: list[Json] = []
        for obj_id, T_cam_obj in annotations[index]:
            row = gt_row(int(obj_id), T_cam_obj)
            name = f"object {obj_id} of image {index}"
            bop_units.object_in_camera(row["cam_R_m2c"], row["cam_t_m2c"], name, may_touch=True)
            rows.append(row)
        scene[str(index)] = rows
    store.write_json("scene_gt.json", scene)


def write_scene_gt_info(store: SessionStore, entries: Mapping[int, Sequence[Json]]) -> None:
    """Write scene_gt_info.json from the entries of `gt_info_entry`, by image."""
    store.write_json("scene_gt_info.json", {str(i): list(entries[i]) for i in sorted(entries)})


def image_entry(index: int, file_name: str, camera: CameraIntrinsics) -> Json:
    """Return an image's entry in scene_gt_coco.json."""
    return {"id": index, "file_name": file_name, "width": camera.width, "height": camera.height}


def mask_entry(index: int, obj_id: int, rle: Json) -> Json | None:
    """Return the annotation of a mask without its id; None = no pixel."""
    area, box = rle_area_and_bbox(rle)
    if area == 0:
        return None
    height, width = rle["size"]
    return {
        "image_id": index,
        "category_id": obj_id,
        "iscrowd": 0,
        "area": area,
        "bbox": list(box),
        "segmentation": rle,
        "width": width,
        "height": height,
    }


def write_scene_gt_coco(
    store: SessionStore,
    masks: Mapping[int, Sequence[tuple[int, Mask | Json]]],
    names: Mapping[int, str],
) -> None:
    """Write scene_gt_coco.json with the visible masks as run lengths.

    Objects without a visible pixel get no annotation, as in BOP's own files.

    Args:
        store: the session.
        masks: image -> (object id, visible mask (H, W), or its `rle_of`) of each object.
        names: object id -> name.
    """
    pictures: list[Json] = []
    annotations: list[Json] = []
    for index in sorted(masks):
        pictures.append(image_entry(index, rgb_path(index), store.session.intrinsics))
        for obj_id, given in masks[index]:
            rle = given if isinstance(given, dict) else rle_of(given)
            entry = mask_entry(index, int(obj_id), rle)
            if entry is not None:
                annotations.append({"id": len(annotations) + 1} | entry)
    categories = [
        {"id": int(i), "name": names[i], "supercategory": store.session.name} for i in sorted(names)
    ]
    info = {"description": store.session.name, "date_created": store.created}
    document = {
        "info": info,
        "licenses": [],
        "categories": categories,
        "images": pictures,
        "annotations": annotations,
    }
    # On one line: run lengths, indented one number a line, would be most of the session.
    store.write_bytes("scene_gt_coco.json", json_bytes(document, indent=None))
