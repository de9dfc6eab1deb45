"""The maps of one view as files: instances, exact depth, object coordinates, normals.

Depth and normals are those of the model, also where something that is not in it stands in front;
instances and coordinates are set where the object is visible.
"""

from collections.abc import Sequence

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32, Counts, Int32, Int64, Mask
from realsim.compiled import njit
from realsim.formats import label_maps
from realsim.geometry.point_loops import turn_back
from realsim.images.png import encode_window
from realsim.rendering.labels import Labels
from realsim_sim_bridge.annotation.unmodelled import ObjectMasks, Window, union_of

Masks = Sequence[tuple[int, ObjectMasks]]


def map_path(name: str, view: int) -> str:
    """Return where a map of a view is, relative to the session."""
    return f"labels/{name}/{view:06d}.png"


def map_files(
    wanted: Sequence[str],
    view: int,
    labels: Labels,
    masks: Masks,
    boxes: Array,
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
        counts = coordinate_counts(labels, window, ids >= 0, boxes)
        files[map_path("coordinates", view)] = encode_window(counts, _origin(window), size)
    if "normals" in wanted:
        counts = normal_counts(labels)
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


def _instances(masks: Masks, window: Window) -> Int32:
    """Return the instances (h, w) visible in a window that holds all masks, -1 = none."""
    ids = np.full(_shape(window), label_maps.NO_OBJECT, np.int32)
    for instance, m in masks:
        if m.visible.size:
            ids[_inner(m.window, window)][m.visible] = instance
    return ids


# --- Coordinate and normal maps as 16-bit counts, in one walk over the pixels each ---------------
# Codes of `label_maps` for `Labels.object_coordinates()` and `Labels.normals()`, without the maps
# of float32 in between: those are twice as large, and allocating them costs as much as filling
# them.


FULL = np.float32(label_maps.FULL)


def coordinate_counts(
    labels: Labels, window: tuple[slice, slice], seen: Mask, boxes: Array
) -> Counts:
    """Return the object coordinates of a window as counts (h, w, 3) over each object's box.

    Args:
        labels: the rendered labels of the view.
        window: rows and columns.
        seen: (h, w) pixels of the window that show an object.
        boxes: (G, 2, 3) least and greatest corner of every placed mesh [m].
    """
    low = boxes[:, 0].astype(np.float32)
    extent = boxes[:, 1].astype(np.float32) - low
    scale = np.where(extent > 0, FULL / np.where(extent > 0, extent, 1), 0).astype(np.float32)
    s = labels.surfaces
    return _coordinates(
        s.rays[window], labels.depth_m[window], labels.geometry[window], s.Ts_obj_cam, seen,
        low, scale,
    )  # fmt: skip


@njit
def _coordinates(
    rays: Array32,
    depth: Array32,
    geometry: Int32,
    Ts_obj_cam: Array,
    seen: Mask,
    low: Array32,
    scale: Array32,
) -> Counts:
    """Return the counts (h, w, 3) of what is seen, 0 0 0 elsewhere."""
    height, width = seen.shape
    out = np.zeros((height, width, 3), np.uint16)
    for v in range(height):
        for u in range(width):
            g = geometry[v, u]
            if not seen[v, u] or g < 0:
                continue
            z = np.float64(depth[v, u])
            x, y = z * rays[v, u, 0], z * rays[v, u, 1]
            is_zero = True
            for k in range(3):
                T = Ts_obj_cam[g]
                at = np.float32(T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3])
                count = np.rint((at - low[g, k]) * scale[g, k])
                count = min(max(count, np.float32(0)), FULL)
                out[v, u, k] = np.uint16(count)
                is_zero &= count == 0
            if is_zero:  # 0 0 0 says that there is no object
                out[v, u, 0] = out[v, u, 1] = out[v, u, 2] = 1
    return out


def normal_counts(labels: Labels) -> Counts:
    """Return the normals of a view as counts (H, W, 3), background included."""
    s = labels.surfaces
    return _normals(s.rays, labels.geometry, labels.face, s.Ts_obj_cam, s.normals, s.starts)


@njit
def _normals(
    rays: Array32, geometry: Int32, face: Int32, Ts_obj_cam: Array, normals: Array32, starts: Int64
) -> Counts:
    """Return the counts (H, W, 3) of the faces' normals towards the eye, 0 0 0 where nothing is."""
    height, width = geometry.shape
    out = np.zeros((height, width, 3), np.uint16)
    half = np.float32(label_maps.FULL / 2)
    middle = np.float32(label_maps.FULL / 2 + 0.5)  # the half, cut off by the conversion, rounds
    last = np.int64(-1)
    x = y = z = 0.0
    for v in range(height):
        for u in range(width):
            g = geometry[v, u]
            if g < 0:
                continue
            number = starts[g] + face[v, u]
            if number != last:  # neighbours mostly lie on the same face
                last = number
                T, n = Ts_obj_cam[g], normals[number]
                # R_cam_obj is the transpose of R_obj_cam.
                x, y, z = turn_back(T, n[0], n[1], n[2])
            away = x * rays[v, u, 0] + y * rays[v, u, 1] + z > 0.0
            side = -1.0 if away else 1.0
            a, b, c = np.float32(side * x), np.float32(side * y), np.float32(side * z)
            if a == 0 and b == 0 and c == 0:  # a face without area has no normal
                continue
            out[v, u, 0] = np.uint16(min(max(a * half + middle, np.float32(0)), FULL))
            out[v, u, 1] = np.uint16(min(max(b * half + middle, np.float32(0)), FULL))
            out[v, u, 2] = np.uint16(min(max(c * half + middle, np.float32(0)), FULL))
    return out
