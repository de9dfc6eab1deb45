"""The maps of one view as files: instances, exact depth, object coordinates, normals.

Depth and normals are those of the model, also where something that is not in it stands in front;
instances and coordinates are set where the object is visible.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.formats import images, label_maps
from realsim.formats.png_window import encode_window
from realsim.records import Mesh
from realsim.rendering.labels import Labels
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
    meshes: Mapping[int, Mesh],
    depth_unit_m: float,
) -> dict[str, bytes]:
    """Return the maps wanted of a view, by path.

    Args:
        wanted: names of maps.
        view: number of the view.
        labels: its rendered labels.
        masks: (instance, masks) of its objects.
        meshes: instance -> mesh; its box scales the coordinates.
        depth_unit_m: metres per count of the depth.
    """
    size = (labels.ids.shape[1], labels.ids.shape[0])
    files: dict[str, bytes] = {}
    if "instance" in wanted:
        window, counts = _instances(masks)
        files[map_path("instance", view)] = encode_window(counts, _origin(window), size)
    if "depth" in wanted:
        counts = images.depth_counts(labels.depth_m, depth_unit_m)
        files[map_path("depth", view)] = images.png_bytes(counts)
    if "coordinates" in wanted:
        window, counts = _coordinates(labels.object_coordinates(), masks, meshes)
        files[map_path("coordinates", view)] = encode_window(counts, _origin(window), size)
    if "normals" in wanted:
        counts = label_maps.normal_counts(labels.normals())
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


def _instances(masks: Masks) -> tuple[Window, NDArray[np.uint16]]:
    """Return the window of all objects and the instance map in it."""
    window = union_of([m.window for _, m in masks])
    ids = np.full(_shape(window), label_maps.NO_OBJECT, np.int32)
    for instance, m in masks:
        if m.visible.size:
            ids[_inner(m.window, window)][m.visible] = instance
    return window, label_maps.instance_counts(ids)


def _coordinates(
    points: NDArray[np.float32], masks: Masks, meshes: Mapping[int, Mesh]
) -> tuple[Window, NDArray[np.uint16]]:
    """Return the window of all objects and the coordinate map in it."""
    window = union_of([m.window for _, m in masks])
    out = np.zeros((*_shape(window), 3), np.uint16)
    for instance, m in masks:
        rows, columns = np.nonzero(m.visible)
        if len(rows):
            # Numbers instead of masks: three channels behind a mask are gathered one by one.
            seen = points[rows + m.origin[1], columns + m.origin[0]]
            low, high = meshes[instance].bounds
            x, y = _origin(window)
            out[rows + (m.origin[1] - y), columns + (m.origin[0] - x)] = (
                label_maps.coordinate_counts(seen, low, high)
            )
    return window, out
