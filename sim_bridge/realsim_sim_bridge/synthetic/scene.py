"""A scene that can be rendered: objects at exact poses, what stands around them, and the light."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.records import Mesh, ObjectModel, ObjectPose, Scene, names_of
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import SessionStore
from realsim.untrusted.arrays import read_npz

SURROUNDINGS_FILE = "synthetic/surroundings.npz"
"""What stands around the objects, kept in the session, so that labels can be made again exactly."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SyntheticScene:
    """Everything that is seen in a synthetic view, besides the camera."""

    name: str
    """Name of the session that the views become."""
    scene: Scene
    """Where the objects stand, and the table's plane; rejected objects are not shown."""
    models: Mapping[int, ObjectModel]
    """obj_id -> model of every object that is shown."""
    environment: Environment
    """The light from far away."""
    materials: Mapping[int, Material] = field(default_factory=dict[int, Material])
    """Instance -> its look; an instance that is not here shows its model's texture or colours."""
    surroundings: tuple[PlacedMesh, ...] = ()
    """What is seen and hides things but carries no label: table, floor, walls; instance -1."""
    provenance: dict[str, Any] = field(default_factory=dict[str, Any])
    """Where the scene comes from, as plain JSON values: kept in the session."""

    def __post_init__(self) -> None:
        """Check that every object shown has a model and that surroundings carry no label.

        Raises:
            InputError: a model is missing, or a surrounding is numbered as an object.
        """
        missing = sorted({o.obj_id for o in self.shown} - set(self.models))
        if missing:
            raise InputError(
                f"synthetic scene '{self.name}' holds objects {missing} without a model; the "
                f"models given are: {names_of(list(self.models.values())) or 'none'}. Put the "
                "missing ones into models/."
            )
        labelled = [p.instance for p in self.surroundings if p.instance != BACKGROUND]
        if labelled:
            raise InputError(
                f"synthetic scene '{self.name}': surroundings have the instances {labelled}; "
                "what carries a label belongs to the scene's objects, surroundings are -1."
            )

    @property
    def shown(self) -> tuple[ObjectPose, ...]:
        """The objects that are not rejected, by instance."""
        kept = (o for o in self.scene.objects if o.verdict != "rejected")
        return tuple(sorted(kept, key=lambda o: o.instance))

    @property
    def left_out(self) -> tuple[int, ...]:
        """Instances that are not shown because they are rejected."""
        return tuple(o.instance for o in self.scene.objects if o.verdict == "rejected")

    def placed(self) -> list[PlacedMesh]:
        """Return all meshes with their materials: objects by instance, then surroundings."""
        objects = [
            PlacedMesh(
                o.instance, self.models[o.obj_id].mesh, o.T_world_obj,
                self.materials.get(o.instance),
            )
            for o in self.shown
        ]  # fmt: skip
        return [*objects, *self.surroundings]

    def exact(self) -> Scene:
        """Return the scene as the truth that it is: accepted, without error, nothing rejected."""
        objects = tuple(
            replace(o, verdict="accepted", covariance=None, checks={}, reasons=())
            for o in self.shown
        )
        return replace(self.scene, objects=objects)

    def digests(self) -> dict[str, str]:
        """Return a digest of each part, so that two scenes that differ can be told in words."""
        objects, looks, around, light = (hashlib.sha256() for _ in range(4))
        for placed in self.placed()[: len(self.shown)]:
            obj_id = self.scene.object(placed.instance).obj_id
            objects.update(f"{placed.instance} {obj_id} {self.models[obj_id].name} ".encode())
            _add_mesh(objects, placed.mesh)
            objects.update(placed.T_world_obj.tobytes())
            _add_record(looks, placed.material)
        for placed in self.surroundings:
            _add_mesh(around, placed.mesh)
            around.update(placed.T_world_obj.tobytes())
            _add_record(around, placed.material)
        if self.scene.plane is not None:
            around.update(self.scene.plane.T_world_table.tobytes())
        _add_record(light, self.environment)
        return {
            "objects": objects.hexdigest(),
            "materials": looks.hexdigest(),
            "surroundings": around.hexdigest(),
            "environment": light.hexdigest(),
        }


def _add_mesh(digest: Any, mesh: Mesh) -> None:
    """Add a mesh and its colours to a digest."""
    for array in (mesh.vertices, mesh.faces, mesh.colors, mesh.uv, mesh.texture):
        digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())


def _add_record(digest: Any, record: Material | Environment | None) -> None:
    """Add all fields of a material or an environment to a digest."""
    if record is None:
        digest.update(b"none ")
        return
    for f in fields(record):
        value = getattr(record, f.name)
        digest.update(f"{f.name} ".encode())
        if isinstance(value, np.ndarray):
            digest.update(str(value.shape).encode() + np.ascontiguousarray(value).tobytes())
        else:
            digest.update(repr(value).encode())


def save_surroundings(store: SessionStore, placed: tuple[PlacedMesh, ...]) -> None:
    """Write the shapes and places of what hides things without carrying a label."""
    arrays: dict[str, NDArray[np.generic]] = {"count": np.array(len(placed))}
    for k, p in enumerate(placed):
        arrays[f"vertices_{k}"] = p.mesh.vertices
        arrays[f"faces_{k}"] = p.mesh.faces
        arrays[f"T_world_obj_{k}"] = p.T_world_obj
    store.write_npz(SURROUNDINGS_FILE, **arrays)


def load_surroundings(store: SessionStore) -> tuple[PlacedMesh, ...] | None:
    """Return what hides things in a synthetic session; None = the session is not synthetic.

    Raises:
        InputError: the file is broken.
    """
    if not store.has(SURROUNDINGS_FILE):
        return None
    try:
        npz = read_npz(store.path(SURROUNDINGS_FILE))
        return tuple(
            PlacedMesh(
                BACKGROUND,
                Mesh(vertices=npz[f"vertices_{k}"], faces=npz[f"faces_{k}"]),
                npz[f"T_world_obj_{k}"],
            )
            for k in range(int(npz["count"]))
        )
    except (InputError, TypeError, ValueError, KeyError) as error:
        raise InputError(
            f"{SURROUNDINGS_FILE} of '{store.folder}' is broken ({error}). Run the command that "
            "rendered the session again: it writes this file anew."
        ) from error
