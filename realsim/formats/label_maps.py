"""Label maps as 16-bit PNG: instance ids, exact depth, object coordinates and normals.

instance      one channel: instance + 1; 0 = no object
depth         one channel: counts of the session's depth unit; 0 = nothing
coordinates   three channels: 0..65535 over the model's bounding box; 0 0 0 = no object
normals       three channels: round((n + 1) * 32767.5), camera axes; 0 0 0 = nothing
"""

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array32, Counts, Int32
from realsim.errors import InputError

FULL = 65535
NO_OBJECT = -1
BLOCK_PX = 1 << 13
"""Pixels converted at a time: what is computed in between stays in the cache."""


def instance_counts(ids: Int32) -> Counts:
    """Return the instance map (H, W) of instances (H, W), -1 = none.

    Raises:
        InputError: an instance that does not fit into 16 bit.
    """
    if ids.size and (ids.max() >= FULL or ids.min() < NO_OBJECT):
        raise InputError(
            f"instances {ids.min()} to {ids.max()} are in this view; an instance map holds "
            f"-1 (none) to {FULL - 1}. Number the scene's instances from 0."
        )
    return (ids + 1).astype(np.uint16)


def instances_of(counts: Counts) -> Int32:
    """Return instances (H, W), -1 = none, of an instance map."""
    return counts.astype(np.int32) - 1


def coordinate_counts(points_m: ArrayLike, low_m: ArrayLike, high_m: ArrayLike) -> Counts:
    """Return points (N, 3) of one object as counts (N, 3) over its box.

    The corner of the box itself is 1 1 1, because 0 0 0 says that there is no object.

    Args:
        points_m: (N, 3) in the object's frame [m].
        low_m: (3,) least corner of the model's box [m].
        high_m: (3,) greatest corner [m]; an axis without extent is all zeros.
    """
    low = np.asarray(low_m, dtype=np.float32)
    extent = np.asarray(high_m, dtype=np.float32) - low
    scale = np.where(extent > 0, FULL / np.where(extent > 0, extent, 1), 0).astype(np.float32)
    counts = (np.asarray(points_m, dtype=np.float32) - low) * scale
    np.rint(counts, out=counts)
    np.clip(counts, 0, FULL, out=counts)
    out = counts.astype(np.uint16)
    out[(out[:, 0] == 0) & (out[:, 1] == 0) & (out[:, 2] == 0)] = 1
    return out


def normal_counts(normals: Array32) -> Counts:
    """Return unit normals (..., 3) as counts; zero vectors (nothing) become 0 0 0."""
    flat = np.ascontiguousarray(normals).reshape(-1, 3)
    out = np.empty(flat.shape, np.uint16)
    for first in range(0, len(flat), BLOCK_PX):
        n, counts = flat[first : first + BLOCK_PX], out[first : first + BLOCK_PX]
        scaled = n * np.float32(FULL / 2)
        scaled += np.float32(FULL / 2 + 0.5)  # the half, cut off by the conversion, rounds
        np.clip(scaled, 0, FULL, out=scaled)
        counts[:] = scaled
        # Compared axis by axis: a reduction over a short last axis takes ten times as long.
        counts[(n[:, 0] == 0) & (n[:, 1] == 0) & (n[:, 2] == 0)] = 0
    return out.reshape(normals.shape)


def normals_of(counts: Counts) -> Array32:
    """Return normals (..., 3) of counts, unit to 3e-5; zeros where there is nothing."""
    normals = (counts / np.float32(FULL / 2) - 1).astype(np.float32)
    normals[~counts.any(axis=-1)] = 0
    return normals
