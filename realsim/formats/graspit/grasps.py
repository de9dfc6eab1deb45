"""Where the closing line of a grasp meets the outside of a mesh."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.hdf5_checked import opened
from realsim.geometry import se3
from realsim.geometry.mesh import tensor_mesh
from realsim.interop import import_open3d
from realsim.records import Mesh

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


GRASP_FILE = "grasps.hdf5"
MOST_GRASPS = 1_000_000
"""Most grasps of one object."""
SAMPLED_GRASPS = 40
"""Grasps of an object whose contacts are looked at: enough for a median."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class WorldGrasps:
    """The grasps of one object, each with its half turn about the approach axis."""

    obj_id: int
    instance: int
    Ts_obj_grasp: Array
    """(N, 2, 4, 4) [m]."""
    widths_m: Array
    """(N,) distance of the outer contacts along the closing axis [m]; NaN = it meets no surface."""


def read_grasp_file(path: Path) -> dict[str, Array]:
    """Return Ts_world_grasp (N, 2, 4, 4) by the object's name.

    Raises:
        InputError: no such file, or other content.
        NotRigidError: a pose is not rigid.
    """
    with opened(path) as file:
        names = file.names()
        _require_sizes(path, names)
        found = {n: file.numbers(n, (None, 2, 4, 4)) for n in names}
    return {
        n: se3.check_rigid(T, f"the grasps of '{n}' in {path}") if len(T) else T
        for n, T in found.items()
    }


def _require_sizes(path: Path, names: list[str]) -> None:
    """Raise if an array claims more grasps than are read: a short file can claim gigabytes."""
    import h5py

    with h5py.File(path, "r") as file:
        for name in names:
            data: Any = file[name]
            shape: Any = getattr(data, "shape", None) or ()
            if shape[1:] != (2, 4, 4) or shape[0] > MOST_GRASPS:
                raise InputError(
                    f"{path}: '{name}' has the shape {shape}; (N, 2, 4, 4) is expected, at most "
                    f"{MOST_GRASPS} grasps."
                )
