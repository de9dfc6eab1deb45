"""Size, volume, mass, centre of mass and inertia of an object, and of what they are."""

import math

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.geometry.mesh import MassProperties, diameter, hull_vertices, mass_properties
from realsim.geometry.mesh_shape import hull_triangles
from realsim.models.convex_hulls import hull_volume
from realsim.models.model_records import ConvexParts, PhysicalProperties
from realsim.records import Mesh

DEFAULT_DENSITY = 1000.0
"""[kg/m^3]: the paper's for every object."""
PLAUSIBLE_DENSITY = (20.0, 20000.0)
"""[kg/m^3]: a foam cushion, and tungsten or gold. Beyond, a mass or a length has another unit."""


def physical_properties(
    mesh: Mesh,
    *,
    density: float | None = None,
    mass_kg: float | None = None,
    parts: ConvexParts | None = None,
) -> PhysicalProperties:
    """Return size and matter of an object of one density.

    A closed mesh has exact figures. An open one has no volume: its convex parts stand for it if
    they are given, else its hull. Neighbouring parts overlap a little, so their sum is an upper
    bound.

    Args:
        mesh: the shape [m].
        density: [kg/m^3]; neither this nor a mass: 1000.
        mass_kg: the weighed mass [kg], instead of a density.
        parts: convex parts of the same mesh; used where the mesh is open.

    Raises:
        InputError: both a density and a mass are given, one is not positive, or the mesh is flat.
        UnitError: the weighed mass gives a density that no solid has.
    """
    if density is not None and mass_kg is not None:
        raise InputError(
            f"a density ({density:g} kg/m^3) and a mass ({mass_kg:g} kg) are given; one follows "
            "from the other and the volume. Give one of them: the weighed mass if there is one."
        )
    if mass_kg is not None and not (math.isfinite(mass_kg) and mass_kg > 0):
        raise InputError(f"the weighed mass is {mass_kg} kg; a positive number is needed.")
    if density is not None and not (math.isfinite(density) and density > 0):
        raise InputError(f"the density is {density} kg/m^3; a positive number is needed.")
    solid = mass_properties(mesh, density=1.0)
    volume_of = "mesh" if solid.is_watertight else "hull"
    if not solid.is_watertight and parts is not None:
        solid, volume_of = (
            _of_parts(parts, hull_volume(hull_vertices(mesh.vertices))),
            "convex parts",
        )
    if mass_kg is None:
        density = DEFAULT_DENSITY if density is None else density
    else:
        density = mass_kg / solid.volume_m3
        _check_density(density, mass_kg, solid.volume_m3, volume_of)
    return PhysicalProperties(
        extent_m=mesh.extent,
        diameter_m=diameter(mesh),
        centroid=_area_center(mesh),
        volume_m3=solid.volume_m3,
        volume_of=volume_of,
        hull_volume_fraction=solid.hull_volume_fraction,
        density=density,
        mass_kg=density * solid.volume_m3,
        mass_from="density" if mass_kg is None else "weighed",
        center_of_mass=solid.center_of_mass,
        inertia=density * solid.inertia,
    )


def _check_density(density: float, mass_kg: float, volume_m3: float, volume_of: str) -> None:
    low, high = PLAUSIBLE_DENSITY
    if low <= density <= high:
        return
    if low <= density / 1000 <= high:
        guess = f"Were grams given? {mass_kg:g} g would be {density / 1000:.0f} kg/m^3."
    elif density < low:
        guess = "Is the mesh too large (its unit, its scale), or were tonnes given?"
    else:
        guess = "Is the mesh too small (its unit, its scale)? Were grams given?"
    raise UnitError(
        f"{mass_kg:g} kg in {1e6 * volume_m3:.4g} cm^3 (of the {volume_of}) is a density of "
        f"{density:.4g} kg/m^3; {low:g} to {high:g} kg/m^3 is accepted, water is 1000. {guess}"
    )


def _of_parts(parts: ConvexParts, hull_m3: float) -> MassProperties:
    """Return the sum of the parts, of density 1.

    The inertias add up about the common centre c (Steiner): I = sum I_k + m_k (|d|^2 1 - d d'),
    d = c_k - c.
    """
    solids: list[MassProperties] = []
    for part in parts.parts:
        corners, faces = hull_triangles(part)
        hull = Mesh(vertices=corners, faces=faces.astype(np.int32))
        solids.append(mass_properties(hull, density=1.0))
    volume = sum(s.volume_m3 for s in solids)
    first = np.sum([s.volume_m3 * s.center_of_mass for s in solids], axis=0)
    center: Array = first / volume
    inertia = np.zeros((3, 3))
    for s in solids:
        d = s.center_of_mass - center
        inertia += s.inertia + s.volume_m3 * (d @ d * np.eye(3) - np.outer(d, d))
    return MassProperties(
        volume_m3=volume,
        mass_kg=volume,
        center_of_mass=center,
        inertia=inertia,
        is_watertight=False,
        hull_volume_fraction=volume / hull_m3,
    )


def _area_center(mesh: Mesh) -> Array:
    """Return the centre (3,) of the surface's area [m]."""
    origin = mesh.vertices[0]
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - origin, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    center: Array = origin + area @ ((a + b + c) / 3.0) / area.sum()
    return center
