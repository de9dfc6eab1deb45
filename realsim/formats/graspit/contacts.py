"""Where the closing line of a grasp meets the outside of a mesh."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from realsim.geometry.mesh import tensor_mesh
from realsim.interop import import_open3d
from realsim.records import Mesh

Array = NDArray[np.float64]
Axis = Literal["x", "y", "z"]
OUTSIDE_M = 0.3
"""Rays start so far from the grasp [m]: outside of everything that a hand holds."""


def contact_distances(mesh: Mesh, Ts_obj_grasp: Array, axis: Axis) -> Array:
    """Return how far the outer contacts lie from the grasps' origins (N, 2) [m].

    Rays come in from both sides along an axis of the grasp frame (the first column is the positive
    side); the first surface met is the contact. NaN = none between the start and the far side.
    """
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(tensor_mesh(mesh))
    column = Ts_obj_grasp[:, :3, "xyz".index(axis)]
    found = np.full((len(Ts_obj_grasp), 2), np.nan)
    for k, sign in enumerate((1.0, -1.0)):
        start = Ts_obj_grasp[:, :3, 3] + sign * OUTSIDE_M * column
        rays = np.concatenate([start, -sign * column], axis=1).astype(np.float32)
        t = scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)["t_hit"].numpy().astype(np.float64)
        found[:, k] = np.where(t < 2 * OUTSIDE_M, OUTSIDE_M - t, np.nan)
    return found


def midway_error(mesh: Mesh, Ts_obj_grasp: Array, axis: Axis) -> Array:
    """Return how far each origin (N,) lies from the middle of its contacts along an axis [m].

    A line that misses the object counts as off by the length of its ray.
    """
    reach = contact_distances(mesh, Ts_obj_grasp, axis)
    off: Array = np.abs(reach[:, 0] - reach[:, 1]) / 2.0
    return np.where(np.isnan(off), OUTSIDE_M, off)
