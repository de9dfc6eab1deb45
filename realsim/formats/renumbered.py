"""A scene whose objects get the ids of a data set of many scenes, where one id is one model."""

from collections.abc import Collection, Mapping, MutableMapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Mask
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject, LabelledScene
from realsim.records import ObjectModel


def shared_ids(
    models: MutableMapping[int, ObjectModel],
    new: Mapping[int, ObjectModel],
    taken: Collection[int] = (),
) -> dict[int, int]:
    """Return the ids of a scene's models in the data set, and add those that it has not yet.

    A model keeps its id where that is free or has the same model; else it shares the id of the same
    model, or gets the next one that is free.

    Args:
        models: of the data set so far, by id.
        new: of the scene, by its own ids.
        taken: ids in the data set of objects without a mesh.
    """
    ids: dict[int, int] = {}
    for obj_id, model in new.items():
        known = models.get(obj_id)
        if (obj_id not in taken) if known is None else is_same(known, model):
            ids[obj_id] = obj_id
        else:
            same = (i for i, m in models.items() if is_same(m, model))
            ids[obj_id] = next(same, max(*models, *new, *taken) + 1)
        shared = ids[obj_id]
        models.setdefault(
            shared, model if shared == obj_id else replace(model, obj_id=shared)
        )  # fmt: skip
    return ids


def ids_without_mesh(
    scene: LabelledScene,
    owner: object,
    models: Collection[int],
    bare: MutableMapping[tuple[object, int], int],
) -> dict[int, int]:
    """Return the ids in the data set of a scene's objects that have no mesh, and note them.

    Nothing says that two of them are the same object but that one owner gave them one id.

    Args:
        scene: the scene.
        owner: of its ids: a session, or a data set.
        models: ids in the data set that have a mesh.
        bare: (owner, id) -> id in the data set of those of earlier scenes; added to.
    """
    used = {o.obj_id for i in scene.indices for o in scene.frame(i).objects}
    ids: dict[int, int] = {}
    for i in sorted(used - scene.models().keys()):
        taken = {*models, *bare.values()}
        ids[i] = bare.setdefault((owner, i), max(taken) + 1 if i in taken else i)
    return ids


def is_same(one: ObjectModel, other: ObjectModel) -> bool:
    """Return whether two models are the same object: name and vertices."""
    return one.name == other.name and np.array_equal(one.mesh.vertices, other.mesh.vertices)


class RenumberedScene:
    """A labelled scene with other object ids; images, masks and poses are the scene's own."""

    def __init__(self, scene: LabelledScene, ids: Mapping[int, int]) -> None:
        """Take the scene, and the new id of each of its ids; others stay as they are."""
        self._scene, self._ids = scene, dict(ids)
        self.name, self.number, self.split = scene.name, scene.number, scene.split
        self.camera, self.indices = scene.camera, scene.indices
        self.T_world_table: Array | None = scene.T_world_table
        self.notes = scene.notes

    def _id(self, obj_id: int) -> int:
        return self._ids.get(obj_id, obj_id)

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame; see `LabelledScene`."""
        frame = self._scene.frame(index)
        return replace(frame, objects=tuple(self._object(o) for o in frame.objects))

    def _object(self, given: LabelledObject) -> LabelledObject:
        obj_id = self._id(given.obj_id)
        entry = given.entry
        if entry is not None and "obj_id" in entry:
            entry = {**entry, "obj_id": obj_id}
        return replace(given, obj_id=obj_id, entry=entry)

    def colour_file(self, index: int) -> Path:
        """Return the file of the colour image."""
        return self._scene.colour_file(index)

    def depth_file(self, index: int) -> Path | None:
        """Return the file of the depth image, None where there is none."""
        return self._scene.depth_file(index)

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return a mask; see `LabelledScene`."""
        return self._scene.mask(index, k, visible=visible)

    def models(self) -> dict[int, ObjectModel]:
        """Return the models of the objects, by their new ids."""
        return {
            self._id(i): replace(m, obj_id=self._id(i)) for i, m in self._scene.models().items()
        }

    def grasps(self) -> SceneGrasps | None:
        """Return the grasps with the new ids."""
        found = self._scene.grasps()
        if found is None:
            return None
        return replace(
            found,
            sets=tuple(replace(s, obj_id=self._id(s.obj_id)) for s in found.sets),
            names={self._id(i): name for i, name in found.names.items()},
        )
