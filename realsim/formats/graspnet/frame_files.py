"""The files of one image as GraspNet-1Billion has them, and what was lost on the way."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.export_folder import Content
from realsim.formats.graspnet.annotations import annotation_bytes, object_fields
from realsim.formats.graspnet.image_objects import meta_bytes
from realsim.formats.graspnet.labelled import ENTRY, FACTOR_DEPTH, GraspnetLabelledScene
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject, LabelledScene
from realsim.images import png

UNIT_M = 1.0 / FACTOR_DEPTH
SAME_UNIT = 1e-9
"""Relative; 0.001 and 1 / 1000 are the same unit."""
MOST_IN_8_BIT = 255


@dataclass(frozen=True, kw_only=True, slots=True)
class Loss:
    """What the format could not keep of a frame."""

    depth_mm: float = 0.0
    """Largest rounding of a depth pixel [mm]."""
    too_far_px: int = 0
    """Depth pixels beyond 65.5 m, written as 'no measurement'."""
    shared_px: int = 0
    """Pixels in the masks of two objects; the nearer object has them."""
    merged: int = 0
    """Objects that have a label value in common with an equal one."""


def frame_files(
    scene: LabelledScene, frame: LabelledFrame, order: Sequence[int], numbers: Mapping[int, int],
    *, with_label: bool,
) -> tuple[dict[str, Content], Loss]:  # fmt: skip
    """Return the files of an image: kind/suffix such as 'rgb/.png' -> content; and the loss.

    Args:
        scene: the source.
        frame: the image.
        order: places of the frame's objects in the order in which they are written.
        numbers: object id -> GraspNet's number.
        with_label: whether a label image is written.

    Raises:
        InputError: no depth image, no masks, or an image of another size than the camera's.
    """
    objects = [frame.objects[k] for k in order]
    fields = [_fields(o, numbers[o.obj_id]) for o in objects]
    depth, rounded_mm, too_far = _depth(scene, frame)
    shared, merged = 0, 0
    files: dict[str, Content] = {
        "rgb/.png": _colour(scene.colour_file(frame.index)),
        "depth/.png": depth,
        "annotations/.xml": annotation_bytes(fields),
        "meta/.mat": meta_bytes(
            [numbers[o.obj_id] for o in objects],
            np.array([_meta_pose(o) for o in objects]).reshape(-1, 3, 4),
            _matrix(frame),
            FACTOR_DEPTH,
        ),
    }
    if with_label:
        files["label/.png"], shared, merged = _label(scene, frame, numbers)
    loss = Loss(depth_mm=rounded_mm, too_far_px=too_far, shared_px=shared, merged=merged)
    return files, loss


def own_values(entry: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """Return what a row of GraspNet's own files says; empty for rows of other formats."""
    values = (entry or {}).get(ENTRY)
    return values if isinstance(values, Mapping) else {}  # pyright: ignore[reportUnknownVariableType]


def _unchanged(o: LabelledObject) -> Mapping[str, Any]:
    """Return the object's own values if they still say where it is, else nothing."""
    own = own_values(o.entry)
    same = "T_cam_obj" in own and np.array_equal(np.array(own["T_cam_obj"]), o.T_cam_obj)
    return own if same else {}


def _fields(o: LabelledObject, number: int) -> Mapping[str, str]:
    own = _unchanged(o).get("fields")
    if own is not None and int(float(own["obj_id"])) == number:
        return own
    return object_fields(number, o.T_cam_obj)


def _meta_pose(o: LabelledObject) -> Array:
    own = _unchanged(o).get("pose")
    return o.T_cam_obj[:3] if own is None else np.array(own)


def _matrix(frame: LabelledFrame) -> Array:
    """Return the camera matrix [px]: as the source's file has it, if it is still that."""
    own = own_values(frame.entry).get("intrinsic_matrix")
    K = frame.intrinsics.K
    return K if own is None or not np.allclose(own, K, rtol=0, atol=1e-9) else np.array(own)


def _colour(path: Path) -> Content:
    """Return an 8-bit RGB PNG: the file itself, if it is one."""
    if _png_kind(path) == (8, png.COLOUR):
        return path
    return images.png_bytes(images.read_rgb(path))


def _png_kind(path: Path) -> tuple[int, int] | None:
    """Return bits per channel and colour type of a PNG, None for other files."""
    with path.open("rb") as file:
        head = file.read(26)
    if len(head) < 26 or not head.startswith(png.SIGNATURE):
        return None
    bits, kind = struct.unpack(">BB", head[24:26])
    return int(bits), int(kind)


def _depth(scene: LabelledScene, frame: LabelledFrame) -> tuple[Content, float, int]:
    """Return the depth [mm counts], its largest rounding [mm], and the pixels that are too far."""
    path, unit_m = scene.depth_file(frame.index), frame.depth_unit_m
    if path is None or unit_m is None:
        raise InputError(
            f"image {frame.index} of {scene.name} has no depth image; GraspNet's tree has one for "
            "each image."
        )
    if abs(unit_m / UNIT_M - 1) < SAME_UNIT and _png_kind(path) == (16, png.GREY):
        return path, 0.0, 0
    counts = images.read_counts(path)
    exact = counts * (unit_m / UNIT_M)
    rounded = np.rint(exact)
    # A measurement does not become 'none' by rounding, and none stays none.
    rounded[(counts > 0) & (rounded == 0)] = 1
    too_far = rounded > images.DEPTH_MAX
    rounded[too_far] = 0
    off = np.abs(rounded - exact)[~too_far]
    largest = float(off.max()) if off.size else 0.0
    return images.png_bytes(rounded.astype(np.uint16)), largest, int(np.count_nonzero(too_far))


def _label(
    scene: LabelledScene, frame: LabelledFrame, numbers: Mapping[int, int]
) -> tuple[Content, int, int]:
    """Return the label image, the pixels that are in two masks, and the merged objects.

    Raises:
        InputError: an object has no visible mask, or one of another size.
    """
    values = [numbers[o.obj_id] + 1 for o in frame.objects]
    merged = sum(values.count(v) > 1 for v in values)
    if isinstance(scene, GraspnetLabelledScene) and scene.label_file(frame.index) is not None:
        return _own_label(scene, frame, numbers), 0, merged
    size = (frame.intrinsics.height, frame.intrinsics.width)
    label = np.zeros(size, _label_type(numbers))
    shared = 0
    # The nearer one is in front: it is painted last.
    depths = [float(o.T_cam_obj[2, 3]) for o in frame.objects]
    for k in sorted(range(len(values)), key=lambda k: -depths[k]):
        mask = scene.mask(frame.index, k, visible=True)
        if mask is None:
            raise InputError(
                f"object {frame.objects[k].obj_id} of image {frame.index} of {scene.name} has no "
                "mask of its visible pixels, of which GraspNet's label images are made. Compute "
                "the masks first (realsim upgrade), or ask for a tree without labels "
                "(--no-masks)."
            )
        if mask.shape != size:
            raise InputError(
                f"a mask of image {frame.index} of {scene.name} has the shape {mask.shape}; the "
                f"image has {size}."
            )
        shared += int(np.count_nonzero(label[mask]))
        label[mask] = values[k]
    return images.png_bytes(label), shared, merged


def _own_label(
    scene: GraspnetLabelledScene, frame: LabelledFrame, numbers: Mapping[int, int]
) -> Content:
    """Return the label image of a GraspNet source, its values exchanged where numbers are."""
    path, label = scene.label_file(frame.index), scene.label(frame.index)
    assert path is not None and label is not None
    if all(number + 1 == obj_id for obj_id, number in numbers.items()):
        return path
    values = np.zeros(int(label.max()) + 1, _label_type(numbers))
    for obj_id, number in numbers.items():
        if obj_id < len(values):
            values[obj_id] = number + 1
    return images.png_bytes(values[label])


def _label_type(numbers: Mapping[int, int]) -> Any:
    return np.uint8 if max(numbers.values(), default=0) + 1 <= MOST_IN_8_BIT else np.uint16
