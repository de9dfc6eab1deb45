"""Label maps by the formulas of docs/conventions.md, as plainly as they can be written."""

import numpy as np


def coordinate_counts(points, low, high):
    counts = np.rint((points - low) / (high - low) * 65535).clip(0, 65535).astype(np.uint16)
    counts[~counts.any(axis=-1)] = 1  # 0 0 0 says that there is no object
    return counts


def normal_counts(normals):
    counts = np.floor((normals + 1.0) * 32767.5 + 0.5).clip(0, 65535).astype(np.uint16)
    counts[~np.any(normals, axis=-1)] = 0
    return counts
