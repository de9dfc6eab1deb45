"""Where the closing line of a grasp meets the outside of a mesh."""

from collections.abc import Mapping
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
from realsim.records import Mesh, ObjectModel, Scene, SupportPlane

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
ON_SURFACE_M = 0.005
"""Grasps whose middle misses the contacts' middle by more (median) are not of these objects."""
HAND_M = 0.1
"""The palm stands about so far behind the fingertips."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class WorldGrasps:
    """The grasps of one object, each with its half turn about the approach axis."""

    obj_id: int
    instance: int
    Ts_obj_grasp: Array
    """(N, 2, 4, 4) [m]."""
    widths_m: Array
    """(N,) distance of the outer contacts along the closing axis [m]; NaN = it meets no surface."""


def object_grasps(
    path: Path,
    scene: Scene,
    models: Mapping[int, ObjectModel],
    names: Mapping[int, str] | None = None,
) -> list[WorldGrasps]:
    """Return the grasps of a scene's objects, in the objects' frames.

    Args:
        path: grasps.hdf5.
        scene: the objects' poses.
        models: by object id.
        names: of the objects in the file, by instance; None = those of their models.

    Raises:
        InputError: damaged, of other objects, or in another frame than its authors' code writes:
            y does not close on the surface, or z points out of the table.
    """
    by_name = read_grasp_file(path)
    sets: list[WorldGrasps] = []
    for o in scene.objects:
        model = models[o.obj_id]
        name = model.name if names is None else names[o.instance]
        Ts_world = by_name.get(name)
        if Ts_world is None:
            continue
        where = f"{path.name}, '{name}'"
        half_turn = se3.invert(Ts_world[:, 0]) @ Ts_world[:, 1]
        if np.abs(half_turn - np.diag([-1.0, -1.0, 1.0, 1.0])).max(initial=0.0) > 1e-4:
            raise InputError(
                f"{where}: the second pose of a grasp is not its half turn about z; pairs of a "
                "grasp and its flip about the approach axis are expected."
            )
        Ts_obj = se3.invert(o.T_world_obj) @ Ts_world
        reach = contact_distances(model.mesh, Ts_obj[:, 0], "y")
        _require_our_frame(model.mesh, Ts_obj[:, 0], where)
        _require_from_above(Ts_world[:, 0], scene.plane, where)
        sets.append(
            WorldGrasps(
                obj_id=o.obj_id, instance=o.instance, Ts_obj_grasp=Ts_obj, widths_m=reach.sum(1)
            )
        )
    if not sets:
        raise InputError(
            f"{path} has grasps of {', '.join(by_name) or 'nothing'}, and the scene "
            f"has {', '.join(m.name for m in models.values())}: none of them is common."
        )
    return sets


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


def _require_our_frame(mesh: Mesh, Ts_obj_grasp: Array, where: str) -> None:
    """Raise unless the grasps close along y, midway between two contacts."""
    some = Ts_obj_grasp[:: max(1, len(Ts_obj_grasp) // SAMPLED_GRASPS)]
    if len(some) == 0:
        return
    off = float(np.median(midway_error(mesh, some, "y")))
    if off > ON_SURFACE_M:
        others = ", ".join(
            f"{1e3 * float(np.median(midway_error(mesh, some, a))):.1f} mm along {a}"
            for a in ("x", "z")
        )
        raise InputError(
            f"{where}: the grasps' origins are {1e3 * off:.1f} mm (median) off the middle of their "
            f"contacts along y ({others}); at most {1e3 * ON_SURFACE_M:g} mm is accepted. Are they "
            "of another scene, or is y not the closing axis?"
        )


def _require_from_above(Ts_world_grasp: Array, plane: SupportPlane | None, where: str) -> None:
    """Raise if more hands would stand in the table than behind the opposite approach."""
    if plane is None or len(Ts_world_grasp) == 0:
        return
    z, at = Ts_world_grasp[:, 2, 2], Ts_world_grasp[:, 2, 3] - plane.T_world_table[2, 3]
    inside, opposite = np.mean(at - HAND_M * z < 0), np.mean(at + HAND_M * z < 0)
    if inside > opposite and inside > 0.1:
        raise InputError(
            f"{where}: in {100 * inside:.0f} % of the grasps the palm would stand below the table; "
            "z is not the approach direction of these grasps."
        )
