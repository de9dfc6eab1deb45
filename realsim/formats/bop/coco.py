"""scene_gt_coco.json, put together image by image.

As bop_toolkit writes it (scripts/calc_gt_coco.py): the visible mask as run lengths, its area, the
box of the whole silhouette, objects below 10 % visibility marked to be ignored, none for objects
without a visible pixel. Dates are left out: the same scene gives the same bytes.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from realsim.arrays import Mask
from realsim.formats.bop.labels import bbox_of, mask_entry, rle_of

Json = dict[str, Any]
IGNORED_BELOW = 0.1
"""Visible fraction below which BOP's evaluation does not ask for an object."""


def annotation_entry(
    index: int, obj_id: int, masks: tuple[Mask | None, Mask | None], visible_fraction: float | None
) -> Json | None:
    """Return an object's annotation without its id; None = no visible pixel, or no visible mask.

    Args:
        index: of the image.
        obj_id: the category.
        masks: whole and visible mask (H, W).
        visible_fraction: None = not known.
    """
    whole, visible = masks
    if visible is None:
        return None
    entry = mask_entry(index, obj_id, rle_of(visible))
    if entry is None:
        return None
    if whole is not None:
        entry["bbox"] = list(bbox_of(whole, inclusive=True))
    if visible_fraction is not None:
        entry["ignore"] = visible_fraction < IGNORED_BELOW
    return entry


def document_parts(
    description: str, names: Mapping[int, str], rows: Callable[[], Iterator[tuple[str, Json]]]
) -> Iterator[str]:
    """Yield the document in parts.

    Args:
        description: of the scene.
        names: object id -> name, of all objects of the scene.
        rows: yields (image, {"image": its entry, "annotations": of its objects}); called twice,
            since images come before annotations and neither is kept in memory.
    """
    head = {"info": {"description": description}, "licenses": []}
    categories = [{"id": i, "name": names[i], "supercategory": description} for i in sorted(names)]
    yield json.dumps(head | {"categories": categories})[:-1] + ', "images": [\n'
    for k, (_, value) in enumerate(rows()):
        yield (",\n" if k else "") + json.dumps(value["image"])
    yield '\n], "annotations": [\n'
    number = 0
    for _, value in rows():
        for annotation in value["annotations"]:
            number += 1
            yield (",\n" if number > 1 else "") + json.dumps({"id": number} | annotation)
    yield "\n]}\n"
