"""How large a mesh is, as a person with a caliper would say it: the smallest box around it."""

import numpy as np
from numpy.typing import NDArray

from realsim.records import Mesh

Array = NDArray[np.float64]


def smallest_box(mesh: Mesh) -> Array:
    """Return the sides (3,) of the smallest box around a mesh, longest first [its units].

    The box is turned as it likes, so that its sides do not depend on the mesh's axes. The first is
    what `--measured longest=...` measures.
    """
    import trimesh

    from realsim.geometry.mesh import hull_vertices

    corners = hull_vertices(mesh.vertices)
    # At unit size: the library's tolerances are absolute, and a mesh may be in any unit.
    size = float(np.ptp(corners, axis=0).max())
    if not size > 0:
        return np.zeros(3)
    try:
        _, sides = trimesh.bounds.oriented_bounds((corners - corners.min(0)) / size)
    except Exception:  # a flat mesh has no hull; its box along the axes of most spread is the same
        centred = corners - corners.mean(0)
        axes = np.linalg.svd(centred, full_matrices=False)[2]
        return np.sort(np.ptp(centred @ axes.T, axis=0))[::-1].copy()
    return size * np.sort(np.asarray(sides, dtype=np.float64))[::-1]


def box_mm_of(mesh: Mesh, scale: float) -> Array:
    """Return the sides (3,) of the smallest box at a scale [m per unit], longest first [mm]."""
    return 1e3 * scale * smallest_box(mesh)
