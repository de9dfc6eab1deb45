"""Visible masks out of scene_gt_coco.json: COCO's run lengths, plain or as its compressed string.

An annotation says its image and object id, not its row in scene_gt.json, and objects without a
visible pixel have none: rows and annotations of one object are paired in their order where their
numbers agree, else not at all.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Int64, Mask
from realsim.errors import InputError
from realsim.formats.bop.labels import mask_of
from realsim.untrusted.json_text import read_json
from realsim.untrusted.values import mapping, numbers, whole

Json = dict[str, Any]
LARGEST_SIDE = 100_000
"""Pixels of an image along one side."""
MOST_PIXELS = 250_000_000
"""Pixels of one mask: beyond it the size is damaged or hostile."""


def read_coco_masks(
    path: Path, rows: Mapping[int, Sequence[Json]], infos: Mapping[int, Sequence[Json]]
) -> tuple[dict[tuple[int, int], Json], tuple[int, ...]]:
    """Return the run lengths of visible masks by (image, row), and the images that are ambiguous.

    Args:
        path: scene_gt_coco.json.
        rows: image -> rows of scene_gt.json.
        infos: image -> rows of scene_gt_info.json; they say which objects are not visible.

    Raises:
        InputError: not such a file.
    """
    document = mapping(read_json(path), str(path))
    listed = document.get("annotations")
    if not isinstance(listed, list):
        raise InputError(f"{path} has no list 'annotations'.")
    items: list[Any] = listed
    found: dict[tuple[int, int], list[Json]] = {}
    for n, item in enumerate(items):
        name = f"annotation {n} of {path}"
        annotation = mapping(item, name)
        key = (
            whole(annotation.get("image_id"), f"image_id of {name}", 0),
            whole(annotation.get("category_id"), f"category_id of {name}", 0),
        )
        found.setdefault(key, []).append(mapping(annotation.get("segmentation"), f"mask of {name}"))
    paired: dict[tuple[int, int], Json] = {}
    ambiguous: list[int] = []
    for index, listed_rows in rows.items():
        for obj_id in {int(row["obj_id"]) for row in listed_rows}:
            places = [k for k, row in enumerate(listed_rows) if int(row["obj_id"]) == obj_id]
            masks = found.get((index, obj_id), [])
            if len(places) != len(masks) and index in infos:
                visible = [k for k in places if infos[index][k].get("px_count_visib") != 0]
                places = visible
            if len(places) != len(masks):
                ambiguous.append(index)
                continue
            paired |= {(index, k): mask for k, mask in zip(places, masks, strict=True)}
    return paired, tuple(sorted(set(ambiguous)))


def decoded(rle: Json, name: str) -> Mask:
    """Return the mask (H, W) of run lengths, plain or compressed.

    Raises:
        InputError: they are damaged, or add up to another number of pixels.
    """
    size = rle.get("size")
    height, width = (
        whole(v, f"size of {name}", 1, LARGEST_SIDE) for v in numbers(size, 2, f"size of {name}")
    )
    if height * width > MOST_PIXELS:
        raise InputError(f"{name} claims {width}x{height} pixels; at most {MOST_PIXELS} are read.")
    counts = rle.get("counts")
    runs = uncompressed(counts, name) if isinstance(counts, str) else _whole_runs(counts, name)
    if np.any(runs < 0):
        raise InputError(f"{name} has run lengths below zero.")
    return mask_of({"counts": runs, "size": [height, width]})


def _whole_runs(counts: Any, name: str) -> Int64:
    runs = numbers(counts, None, f"counts of {name}")
    if np.any(runs != np.floor(runs)) or np.any(np.abs(runs) > MOST_PIXELS):
        raise InputError(f"{name} has run lengths that are not whole numbers of pixels.")
    return runs.astype(np.int64)


def uncompressed(text: str, name: str) -> Int64:
    """Return the run lengths of COCO's compressed string.

    Each number is written five bits a character, the lowest first, from '0' on; bit 6 says that
    more follow, the highest of the last five is the sign. From the fourth on, numbers are
    differences to the one two before (cocoapi, common/maskApi.c, rleFrString).

    Raises:
        InputError: it ends within a number or has other characters.
    """
    runs: list[int] = []
    value, shift = 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift > 60:
            raise InputError(f"{name} is no compressed run length: {text[:20]!r}.")
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= 1 << shift
        runs.append(value + runs[-2] if len(runs) > 2 else value)
        if abs(runs[-1]) > MOST_PIXELS:
            raise InputError(f"{name} has a run of {runs[-1]} pixels.")
        value, shift = 0, 0
    if shift:
        raise InputError(f"{name} ends within a run length: {text[-20:]!r}.")
    return np.array(runs, dtype=np.int64)
