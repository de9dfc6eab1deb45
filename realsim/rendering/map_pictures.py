"""Label maps as pictures for people: instances, normals, object coordinates.

Depth is in `overlay.depth_picture`.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Image
from realsim.errors import InputError
from realsim.rendering.overlay import Color, instance_color

NOTHING: Color = (18, 20, 24)
"""Where a map says nothing: nearly black, but not the black of a missing picture."""


def instance_picture(ids: ArrayLike, rgb: Image | None = None, strength: float = 0.65) -> Image:
    """Return every instance in its colour.

    Args:
        ids: (H, W) instance per pixel, negative = none.
        rgb: (H, W, 3) photograph to lay the colours on; None = a dark ground.
        strength: of the colours over the photograph [0, 1].

    Raises:
        InputError: the photograph has another size.
    """
    number = _map(ids, 2, "instances").astype(np.int64)
    known, where = np.unique(number, return_inverse=True)
    table = np.array([NOTHING if i < 0 else instance_color(int(i)) for i in known], np.float64)
    picture = table[where].reshape(*number.shape, 3)
    if rgb is not None:
        if rgb.shape != picture.shape:
            raise InputError(
                f"the photograph is {rgb.shape[1]}x{rgb.shape[0]} and the instances are "
                f"{number.shape[1]}x{number.shape[0]}; both must be of the same view."
            )
        share = np.where(number < 0, 0.0, strength)[..., None]
        picture = rgb + share * (picture - rgb)
    return np.round(picture).astype(np.uint8)


def normals_picture(normals: ArrayLike) -> Image:
    """Return normals as colours: red to the right, green up, blue towards the viewer.

    Args:
        normals: (H, W, 3) unit vectors in camera axes (x right, y down, z away), zeros where none.
    """
    n = _map(normals, 3, "normals").astype(np.float32)
    some = np.any(np.isfinite(n) & (n != 0), axis=-1)
    color = 127.5 * (np.nan_to_num(n) * np.array([1, -1, -1], np.float32) + 1.0)
    out = np.round(np.clip(color, 0, 255)).astype(np.uint8)
    out[~some] = NOTHING
    return out


def coordinates_picture(
    coordinates_m: ArrayLike, ids: ArrayLike, boxes: Mapping[int, ArrayLike] | None = None
) -> Image:
    """Return object coordinates as colours: x red, y green, z blue over each object's box.

    Args:
        coordinates_m: (H, W, 3) point of the object's frame seen by each pixel [m].
        ids: (H, W) instance per pixel, negative = none.
        boxes: (2, 3) least and greatest corner of each instance's model [m]; None = of what is
            seen of it, so that colours change from view to view.

    Raises:
        InputError: the maps differ in size, or an instance has no box.
    """
    at = _map(coordinates_m, 3, "object coordinates").astype(np.float32)
    number = _map(ids, 2, "instances").astype(np.int64)
    if at.shape[:2] != number.shape:
        raise InputError(
            f"object coordinates of {at.shape[:2]} pixels and instances of {number.shape}; both "
            "must be of the same view."
        )
    out = np.empty(at.shape, np.uint8)
    out[:] = NOTHING
    for instance in np.unique(number[number >= 0]).tolist():
        mask = number == instance
        points = at[mask]
        if boxes is not None and instance not in boxes:
            raise InputError(
                f"instance {instance} has no box; those of {sorted(boxes)} were given."
            )
        box = np.stack([points.min(0), points.max(0)]) if boxes is None else boxes[instance]
        low, high = np.asarray(box, np.float32)
        share = np.clip((points - low) / np.maximum(high - low, 1e-9), 0, 1)
        out[mask] = np.round(255 * share).astype(np.uint8)
    return out


def _map(values: ArrayLike, dimensions: int, name: str) -> NDArray[np.generic]:
    """Return a map whose dimensions are right.

    Raises:
        InputError: it is no map of that kind.
    """
    out = np.asarray(values)
    if out.ndim != dimensions or (dimensions == 3 and out.shape[2] != 3):
        wanted = "(H, W, 3)" if dimensions == 3 else "(H, W)"
        raise InputError(f"the map of {name} has shape {out.shape}; {wanted} is accepted.")
    return out
