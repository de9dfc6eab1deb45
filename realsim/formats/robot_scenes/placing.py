"""A registered scene put together with its matter, so that an engine can take it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.robot_scenes.placed_scene import (
    GRAVITY,
    PlacedObject,
    PlacedScene,
    RigidBody,
    SceneCamera,
    TableBox,
    convex_part,
    unique_names,
)
from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties
from realsim.records import ObjectModel, Scene, names_of

FRICTION = 1.0
"""Coulomb coefficient of an object on the table; 1 is that of Robot School's worlds."""
TABLE_MARGIN_M = 0.5
"""The table reaches so far beyond the objects [m]: what is knocked over stays on it."""
TABLE_THICKNESS_M = 0.05
"""[m]: thick enough that no fast object passes through it in a step."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Matter:
    """What is known of a model besides its mesh."""

    mass_kg: float
    center_of_mass: Array
    """(3,) [m]."""
    inertia: Array
    """(3, 3) about the centre of mass, along the object's axes [kg m^2]."""
    parts: Sequence[Array]
    """Corners (V, 3) of its convex parts [m]."""


def place_scene(
    scene: Scene,
    models: Mapping[int, ObjectModel],
    matter: Mapping[int, Matter] | None = None,
    *,
    cameras: Sequence[SceneCamera] = (),
) -> PlacedScene:
    """Return a registered scene as engines take it.

    Args:
        scene: the objects' poses; its plane is the table, whose normal is up.
        models: by object id.
        matter: by object id. An object without it gets the mass of its model's density and
            collides as its hull, and a note says so.
        cameras: to be written too.

    Raises:
        InputError: no plane, no objects, an object without a model, or a flat mesh.
    """
    matter = matter or {}
    if scene.plane is None:
        raise InputError(
            f"scene '{scene.name}' has no supporting plane, so neither the table nor the direction "
            "of gravity is known. Register it with a table, or give plane=SupportPlane(...)."
        )
    if not scene.objects:
        raise InputError(f"scene '{scene.name}' has no objects; there is nothing to simulate.")
    missing = [o.obj_id for o in scene.objects if o.obj_id not in models]
    if missing:
        raise InputError(
            f"object {missing[0]} of scene '{scene.name}' has no model; there are: "
            f"{names_of(list(models.values()))}."
        )
    notes: list[str] = []
    bodies = {
        i: _body(models[i], matter.get(i), notes) for i in sorted({o.obj_id for o in scene.objects})
    }
    names = unique_names({o.instance: models[o.obj_id].name for o in scene.objects})
    objects = tuple(
        PlacedObject(
            instance=o.instance, name=names[o.instance], obj_id=o.obj_id, T_world_obj=o.T_world_obj
        )
        for o in scene.objects
    )
    T_world_table = scene.plane.T_world_table
    return PlacedScene(
        name=scene.name,
        bodies=bodies,
        objects=objects,
        table=_table(T_world_table, objects, bodies),
        gravity=-GRAVITY * T_world_table[:3, 2],
        cameras=tuple(cameras),
        notes=tuple(notes),
    )


def _body(model: ObjectModel, known: Matter | None, notes: list[str]) -> RigidBody:
    if known is not None:
        return RigidBody(
            model=model,
            mass_kg=known.mass_kg,
            center_of_mass=known.center_of_mass,
            inertia=known.inertia,
            friction=FRICTION,
            parts=tuple(
                convex_part(p, f"part {k} of object '{model.name}'")
                for k, p in enumerate(known.parts)
            ),
        )
    try:
        solid = mass_properties(model.mesh, model.density)
    except InputError as error:
        raise InputError(f"object '{model.name}' cannot be simulated: {error}") from error
    of_what = "mesh" if solid.is_watertight else "hull: its mesh is not closed"
    notes.append(
        f"'{model.name}' collides as its hull, and weighs {solid.mass_kg:.3g} kg "
        f"({model.density:g} kg/m^3 in the volume of its {of_what})."
    )
    return RigidBody(
        model=model,
        mass_kg=solid.mass_kg,
        center_of_mass=solid.center_of_mass,
        inertia=solid.inertia,
        friction=FRICTION,
    )


def _table(
    T_world_table: Array, objects: tuple[PlacedObject, ...], bodies: Mapping[int, RigidBody]
) -> TableBox:
    """Return a box under all objects, its top in the plane."""
    T_table_world = se3.invert(T_world_table)
    points = [
        se3.transform(T_table_world @ o.T_world_obj, bodies[o.obj_id].model.mesh.vertices)
        for o in objects
    ]
    low = np.min([p.min(axis=0) for p in points], axis=0)
    high = np.max([p.max(axis=0) for p in points], axis=0)
    middle, size = (low + high) / 2.0, high - low + 2.0 * TABLE_MARGIN_M
    return TableBox(
        T_world_table=T_world_table @ se3.from_translation([middle[0], middle[1], 0.0]),
        size_m=(float(size[0]), float(size[1])),
        thickness_m=TABLE_THICKNESS_M,
    )
