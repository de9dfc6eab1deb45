"""Label maps as 16-bit PNG: instance ids, exact depth, object coordinates and normals.

instance      one channel: instance + 1; 0 = no object
depth         one channel: counts of the session's depth unit; 0 = nothing
coordinates   three channels: 0..65535 over the model's bounding box; 0 0 0 = no object
normals       three channels: round((n + 1) * 32767.5), camera axes; 0 0 0 = nothing
"""

import numpy as np

from realsim.arrays import Array32, Counts, Int32
from realsim.errors import InputError

FULL = 65535
NO_OBJECT = -1


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


def normals_of(counts: Counts) -> Array32:
    """Return normals (..., 3) of counts, unit to 3e-5; zeros where there is nothing."""
    normals = (counts / np.float32(FULL / 2) - 1).astype(np.float32)
    normals[~counts.any(axis=-1)] = 0
    return normals
