"""A scene as the physics needs it: where the objects stand, of what they are, what carries them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.models.convex import ConvexConfig, convex_parts
from realsim.models.model_records import KnownSolid
from realsim.models.properties import physical_properties
from realsim.records import Mesh, ObjectModel, Scene, names_of


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Support:
    """A body besides the table that stands still: a shelf, a bin, a fixture."""

    name: str
    T_world_support: Array
    """(4, 4) its frame in world [m]."""
    mesh: Mesh | None = None
    """Its surface in its frame [m]; its convex parts are what collides."""
    urdf: Path | None = None
    """URDF file instead of a mesh, which stands at its base link's frame."""

    def __post_init__(self) -> None:
        """Check that there is exactly one shape and that its file exists."""
        T = se3.check_rigid(self.T_world_support, f"the pose of the support '{self.name}'")
        object.__setattr__(self, "T_world_support", T)
        if (self.mesh is None) == (self.urdf is None):
            raise InputError(
                f"the support '{self.name}' has "
                f"{'neither a mesh nor' if self.mesh is None else 'a mesh and'} a URDF file; one "
                "of the two is needed."
            )
        if self.urdf is not None and not self.urdf.is_file():
            raise InputError(
                f"the support '{self.name}' is to be {self.urdf}, which does not exist; a URDF "
                "file is needed there. Correct the path, or leave the support out."
            )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SchoolScene:
    """A scene whose objects have everything that a physics engine needs."""

    scene: Scene
    """Its plane is the table, whose normal is up."""
    models: dict[int, ObjectModel]
    solids: dict[int, KnownSolid]
    """Convex parts and matter by object id."""
    supports: tuple[Support, ...] = ()
    notes: tuple[str, ...] = ()
    """What was found out while reading: what was assumed, what is doubtful."""

    def __post_init__(self) -> None:
        """Check that every object has a model and a solid, and that up is known."""
        if self.scene.plane is None:
            raise InputError(
                f"scene '{self.scene.name}' has no supporting plane, so neither the table nor up "
                "is known; give plane=SupportPlane(T_world_table=...)."
            )
        if not self.scene.objects:
            raise InputError(f"scene '{self.scene.name}' has no object; there is nothing to stand.")
        for o in self.scene.objects:
            if o.obj_id not in self.models:
                raise InputError(
                    f"object {o.obj_id} of scene '{self.scene.name}' has no model; there are: "
                    f"{names_of(list(self.models.values()))}."
                )
            if o.obj_id not in self.solids:
                raise InputError(
                    f"object {o.obj_id} of scene '{self.scene.name}' has no convex parts; "
                    "known_solids() makes them."
                )

    @property
    def T_table_world(self) -> Array:
        """(4, 4) world in the table's frame [m]."""
        assert self.scene.plane is not None
        return se3.invert(self.scene.plane.T_world_table)

    def names(self) -> dict[int, str]:
        """Return the objects' names by instance; equal ones are numbered."""
        names = [self.models[o.obj_id].name for o in self.scene.objects]
        return {
            o.instance: name if names.count(name) == 1 else f"{name} #{o.instance}"
            for o, name in zip(self.scene.objects, names, strict=True)
        }


@dataclass(frozen=True, kw_only=True, slots=True)
class Matter:
    """What the objects weigh, and how finely they are cut into convex parts."""

    masses_kg: Mapping[int, float] = field(default_factory=dict[int, float])
    """Weighed masses by object id [kg]; the others have their model's density."""
    convex: ConvexConfig = field(default_factory=ConvexConfig)
    """How finely meshes are cut."""
    cache: Path | None = None
    """Folder for convex parts; cutting takes seconds an object. None = nothing is kept."""

    def __post_init__(self) -> None:
        """Check the masses."""
        for obj_id, mass in self.masses_kg.items():
            if not (math.isfinite(mass) and mass > 0):
                raise InputError(
                    f"the weighed mass of object {obj_id} is {mass} kg; a positive one is needed."
                )


def known_solids(
    models: Mapping[int, ObjectModel],
    matter: Matter | None = None,
    known: Mapping[int, KnownSolid] | None = None,
) -> dict[int, KnownSolid]:
    """Return convex parts and matter of every model.

    Args:
        models: by object id.
        matter: weighed masses and how to cut.
        known: solids of a model library; they are not computed again, unless weighed.

    Raises:
        InputError: a mesh is flat, or a weighed mass is of no object; the object is named.
    """
    matter, known = matter or Matter(), known or {}
    strangers = sorted(set(matter.masses_kg) - set(models))
    if strangers:
        raise InputError(
            f"a mass is given for object {strangers[0]}, which is not among: "
            f"{names_of(list(models.values()))}."
        )
    solids: dict[int, KnownSolid] = {}
    for obj_id, model in models.items():
        have, mass = known.get(obj_id), matter.masses_kg.get(obj_id)
        if have is not None and mass is None:
            solids[obj_id] = have
            continue
        density = model.density if mass is None else None
        try:
            parts = have.parts if have else convex_parts(model.mesh, matter.convex, matter.cache)
            solids[obj_id] = KnownSolid(
                parts=parts,
                matter=physical_properties(model.mesh, density=density, mass_kg=mass, parts=parts),
            )
        except InputError as error:
            raise InputError(
                f"object '{model.name}' ({obj_id}) cannot be simulated: {error}"
            ) from error
    return solids
