"""The residual map: where the real surface lies outside or inside of the scaled mesh."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.records import Mesh
from realsim.scanning.scale.joint import Outlook
from realsim.scanning.scale.shape import INNER_EXTENT, ScanShape

Array = NDArray[np.float64]
REACH = 0.03
"""Points within this share of the size speak for a vertex."""
NEIGHBOURS = 12
"""At most so many of them."""
FEWEST = 3
"""Fewer do not make a median."""


def residual_per_vertex(mesh: Mesh, shape: ScanShape, look: Outlook) -> Array:
    """Return the signed distance (V,) of the real surface at each vertex of the given mesh [mm].

    The median of the measured points around the vertex, positive outside; NaN where fewer than
    three were measured.
    """
    from scipy.spatial import KDTree

    vertices = (mesh.vertices - shape.center) * shape.unit
    # Points far off are not fitted to, but they are there to be seen.
    known = np.isfinite(look.residuals)
    out = np.full(len(vertices), np.nan)
    if np.count_nonzero(known) < FEWEST:
        return out
    distance, gradient = shape.field.distance_gradient(look.local[known])
    # A point speaks for the place of the surface that it is nearest to.
    tree: Any = KDTree(look.local[known] - distance[:, None] * gradient)
    residuals = np.append(look.residuals[known], np.nan)
    distance, index = tree.query(vertices, k=NEIGHBOURS, distance_upper_bound=REACH * INNER_EXTENT)
    near = np.isfinite(distance)
    enough = near.sum(axis=1) >= FEWEST
    values = np.where(near, residuals[np.minimum(index, len(residuals) - 1)], np.nan)
    out[enough] = 1e3 * np.nanmedian(values[enough], axis=1)
    return out
