"""The maps of one view as files: instances, exact depth, object coordinates, normals.

Depth and normals are those of the model, also where something that is not in it stands in front;
instances and coordinates are set where the object is visible.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from realsim import images
from realsim.formats import label_maps
from realsim.images.png import encode_window
from realsim.rendering.labels import Labels
from realsim_sim_bridge.annotation import map_counts
from realsim_sim_bridge.annotation.object_masks import ObjectMasks, Window, union_of

Masks = Sequence[tuple[int, ObjectMasks]]


def map_path(name: str, view: int) -> str:
    """Return where a map of a view is, relative to the session."""
    return f"labels/{name}/{view:06d}.png"


def map_files(
    wanted: Sequence[str],
    view: int,
    labels: Labels,
    masks: Masks,
    boxes: NDArray[np.float64],
    depth_unit_m: float,
) -> dict[str, bytes]:
    """Return the maps wanted of a view, by path.

    Args:
        wanted: names of maps.
        view: number of the view.
        labels: its rendered labels.
        masks: (instance, masks) of its objects.
        boxes: (G, 2, 3) least and greatest corner of every placed mesh [m]: coordinates run over
            them.
        depth_unit_m: metres per count of the depth.
    """
    size = (labels.ids.shape[1], labels.ids.shape[0])
    files: dict[str, bytes] = {}
    window = union_of([m.window for _, m in masks])
    ids = _instances(masks, window)
    if "instance" in wanted:
        counts = label_maps.instance_counts(ids)
        files[map_path("instance", view)] = encode_window(counts, _origin(window), size)
    if "depth" in wanted:
        counts = images.depth_counts(labels.depth_m, depth_unit_m)
        files[map_path("depth", view)] = images.png_bytes(counts)
    if "coordinates" in wanted:
        counts = map_counts.coordinate_counts(labels, window, ids >= 0, boxes)
        files[map_path("coordinates", view)] = encode_window(counts, _origin(window), size)
    if "normals" in wanted:
        counts = map_counts.normal_counts(labels)
        files[map_path("normals", view)] = encode_window(counts, (0, 0), size)
    return files


def _origin(window: Window) -> tuple[int, int]:
    return window[1].start, window[0].start


def _shape(window: Window) -> tuple[int, int]:
    return window[0].stop - window[0].start, window[1].stop - window[1].start


def _inner(window: Window, outer: Window) -> Window:
    """Return a window of the image as a window of another one that holds it."""
    top, left = outer[0].start, outer[1].start
    return (
        slice(window[0].start - top, window[0].stop - top),
        slice(window[1].start - left, window[1].stop - left),
    )


def _instances(masks: Masks, window: Window) -> NDArray[np.int32]:
    """Return the instances (h, w) visible in a window that holds all masks, -1 = none."""
    ids = np.full(_shape(window), label_maps.NO_OBJECT, np.int32)
    for instance, m in masks:
        if m.visible.size:
            ids[_inner(m.window, window)][m.visible] = instance
    return ids
