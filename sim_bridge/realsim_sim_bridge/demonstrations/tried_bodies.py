"""An object as the school's engine had it, checked against what the school wrote down."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry.mesh import mass_properties
from realsim.models.convex import convex_parts
from realsim.models.library_records import KnownSolid
from realsim.records import GraspSet, Mesh, ObjectModel
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.slip.body import SlipBody

Array = NDArray[np.float64]
SAME_POSE = 1e-6
"""Largest difference of a pose's numbers that is rounding of the files it came through."""
SAME_MATTER = 1e-6
"""Largest relative difference of mass and centre of mass, likewise."""


def tried_body(
    grasps: GraspSet,
    model: ObjectModel,
    T_table_obj: Array,
    config: SchoolConfig,
    solid: KnownSolid | None,
    cache: Path | None,
) -> SlipBody:
    """Return an object as the slip test had it.

    Args:
        grasps: its set, which says where it stood and what it weighed.
        model: its mesh and density.
        T_table_obj: (4, 4) where it stands [m].
        config: the school's.
        solid: convex parts and matter where a library knows them.
        cache: folder of the school's convex parts.

    Raises:
        InputError: it stands elsewhere or weighs something else than when it was tried.
    """
    stored = grasps.parameters
    named = f"'{model.name}' (instance {grasps.instance})"
    then = np.array((stored.get("inputs") or {}).get("T_table_obj", np.nan), dtype=np.float64)
    if then.shape != (4, 4) or not np.allclose(then, T_table_obj, rtol=0.0, atol=SAME_POSE):
        moved = ""
        if then.shape == (4, 4):
            moved = f" by {1e3 * float(np.linalg.norm((then - T_table_obj)[:3, 3])):.1f} mm"
        raise InputError(
            f"{named} does not stand where its grasps were tried: it has been moved{moved} since. "
            "Run `realsim school` again on the scene as it is."
        )
    mesh = Mesh(vertices=model.mesh.vertices, faces=model.mesh.faces)
    density = float(stored.get("density", model.density))
    matter = solid.matter if solid else mass_properties(mesh, density)
    center = np.array(stored.get("center_of_mass_m", [np.nan] * 3), dtype=np.float64)
    mass = float(stored.get("mass_kg", np.nan))
    same = abs(mass - matter.mass_kg) <= SAME_MATTER * matter.mass_kg and np.allclose(
        center, matter.center_of_mass, rtol=0.0, atol=SAME_MATTER
    )
    if not same:
        raise InputError(
            f"{named} weighs {matter.mass_kg:.4g} kg by its model and {mass:.4g} kg when its "
            "grasps were tried: the mesh, its density or a weighed mass (--mass) is another one. "
            "Give what the school was given, or run it again."
        )
    parts = solid.parts if solid else convex_parts(mesh, config.convex, cache)
    return SlipBody(
        parts=parts.parts,
        mass_kg=matter.mass_kg,
        center_of_mass=np.asarray(matter.center_of_mass),
        inertia=np.asarray(matter.inertia),
    )
