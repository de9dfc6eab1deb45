"""A labelled scene as any data set gives it: images on disk, cameras, objects and their poses.

Readers of data sets give one (BOP, GraspNet, a session of realsim), writers take one, so that every
conversion is one reader and one writer. It is lazy: a frame is read when it is asked for, and a
scene of any length passes through bounded memory.

A labelled scene as a frame source: what is imported into a session, image by image.

A scene whose objects get the ids of a data set of many scenes, where one id is one model.
"""

import hashlib
from collections.abc import Collection, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from realsim import images
from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.formats.folders.source import file_digest
from realsim.formats.frame_source import SourceFrame
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.records.checked_arrays import rigid


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LabelledObject:
    """One object in one frame."""

    obj_id: int
    """realsim's and BOP's id, 1 or more (GraspNet's number + 1)."""
    T_cam_obj: Array
    """(4, 4) object in the frame's camera [m]."""
    instance: int | None = None
    """The same number in all frames of a scene is the same thing; None = the source does not tell.
    Two cans of one model are two instances."""
    visible_fraction: float | None = None
    """Visible pixels / all pixels of the silhouette; None = the source does not tell."""
    gt_info: Mapping[str, Any] | None = None
    """The object's entry of BOP's scene_gt_info.json; None = there is none."""
    entry: Mapping[str, Any] | None = None
    """The source's own row. A writer of the same format writes its numbers again, to the last
    digit, and keys that are not known here survive."""

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze it."""
        object.__setattr__(
            self, "T_cam_obj", rigid(self.T_cam_obj, f"pose of object {self.obj_id}")
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LabelledFrame:
    """One image: its camera, where it stood, what it shows."""

    index: int
    """Number of the image in its scene."""
    intrinsics: CameraIntrinsics
    """Intrinsics of this image; data sets with cropped images have another one for each."""
    depth_unit_m: float | None
    """Metres per count of its depth image; None = it has no depth."""
    objects: tuple[LabelledObject, ...]
    """In the source's order: masks are numbered by it."""
    T_world_cam: Array | None = None
    """(4, 4) camera in world [m]; None = the source does not tell."""
    entry: Mapping[str, Any] | None = None
    """The source's own row of the camera, likewise."""

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze it."""
        if self.T_world_cam is not None:
            T = rigid(self.T_world_cam, f"T_world_cam of image {self.index}")
            object.__setattr__(self, "T_world_cam", T)


class LabelledScene(Protocol):
    """One scene seen by one camera; opened and checked."""

    @property
    def name(self) -> str:
        """What messages and files call it, such as test-000050 or scene_0100-kinect."""
        ...

    @property
    def number(self) -> int:
        """The scene's number in its data set."""
        ...

    @property
    def split(self) -> str:
        """BOP's split, such as test; 'train' where the source has no splits."""
        ...

    @property
    def camera(self) -> str:
        """Which of several cameras: 'kinect', 'cam1'; '' where the source has one."""
        ...

    @property
    def indices(self) -> tuple[int, ...]:
        """Numbers of the images, increasing."""
        ...

    @property
    def T_world_table(self) -> Array | None:
        """(4, 4) supporting plane in world, z up [m]; None = not known."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know: what was left out, what was assumed and why."""
        ...

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame.

        Raises:
            InputError: there is no such image, or what is said of it cannot be.
        """
        ...

    def colour_file(self, index: int) -> Path:
        """Return the file of the colour (or grey) image."""
        ...

    def depth_file(self, index: int) -> Path | None:
        """Return the file of the 16-bit depth image; None = there is none."""
        ...

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return the mask (H, W) of a frame's k-th object; None = the source has none.

        Args:
            index: of the image.
            k: place in the frame's `objects`.
            visible: the visible part; else the whole silhouette, as if nothing stood in front.
        """
        ...

    def models(self) -> Mapping[int, ObjectModel]:
        """Return the models of the objects, by object id; those without a mesh are not there."""
        ...

    def grasps(self) -> SceneGrasps | None:
        """Return the grasps that were tried by physics; None = there are none."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class WrittenScene:
    """What a writer did with one scene."""

    name: str
    """The scene's name in its source."""
    folder: Path
    """Where it was written."""
    frames: int
    """Frames of the scene."""
    frames_written: int
    """Frames written in this run; the others were there from an interrupted one."""
    objects: int
    """Objects in all frames."""
    notes: tuple[str, ...] = ()
    """What was lost or changed on the way: rounded depth, distortion that the format has no place
    for, poses that are not there."""
    counts: Mapping[str, int] = field(default_factory=dict[str, int])
    """What else was written, by name: 'masks', 'grasps' ..."""


SAME_K_PX = 1e-6
"""Camera matrices that differ by less are one camera, written by another program."""


class LabelledFrames:
    """A `FrameSource` of a `LabelledScene`; a session has one camera, which is checked here."""

    def __init__(self, scene: LabelledScene, kind: str, *, use_depth: bool = True) -> None:
        """Check that all images are of one camera and one depth unit.

        Args:
            scene: the scene.
            kind: of the data set, for the session's notes: 'bop', 'graspnet'.
            use_depth: whether depth is imported.

        Raises:
            InputError: it has no image, or several cameras, depth units or image sizes.
        """
        self.scene, self._kind = scene, kind
        self.name = scene.name
        """The scene's name."""
        frames = [scene.frame(i) for i in scene.indices]
        if not frames:
            raise InputError(f"{scene.name} has no images; there is nothing to import.")
        self.intrinsics = frames[0].intrinsics
        """The camera of all images."""
        for frame in frames[1:]:
            _require_same_camera(frames[0], frame, scene.name)
        deep = [f for f in frames if f.depth_unit_m is not None] if use_depth else []
        units_m = sorted({f.depth_unit_m for f in deep if f.depth_unit_m is not None})
        if len(units_m) > 1:
            raise InputError(
                f"{scene.name} has depth in units of {units_m[0]:g} and {units_m[-1]:g} m, and a "
                "session has one. Convert it with `realsim export` instead, or import a part."
            )
        self.depth_unit_m = units_m[0] if units_m else None
        """Metres per count; None = no depth."""
        taken = deep if deep else frames
        self.indices = tuple(f.index for f in taken)
        """Numbers of the images, in the order of the frames."""
        notes = list(scene.notes)
        if len(taken) < len(frames):
            notes.append(
                f"{len(frames) - len(taken)} of {len(frames)} images have no depth and were left "
                "out, their frames are not complete."
            )
        self.notes = tuple(notes)
        """What a person should know."""

    @property
    def extra(self) -> dict[str, Any]:
        """Where it came from: scene, image numbers, content key."""
        return {
            "kind": self._kind,
            "path": str(self._colour(self.indices[0]).parent.parent),
            "scene": self.scene.number,
            "frames": list(self.indices),
            "content_key": self._content_key(),
        }

    def _colour(self, index: int) -> Path:
        return self.scene.colour_file(index)

    def _content_key(self) -> str:
        digest = hashlib.sha256()
        for index in self.indices:
            for path in (self._colour(index), self.scene.depth_file(index)):
                if path is not None:
                    digest.update(file_digest(path, path.name))
        return digest.hexdigest()

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.indices)

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the images from place `start` on, in the order of their numbers.

        Raises:
            InputError: an image cannot be read; the message names it.
        """
        for index in self.indices[start:]:
            deep = self.scene.depth_file(index) if self.depth_unit_m is not None else None
            yield SourceFrame(
                name=f"image {index} of {self.scene.name}",
                time_s=float(index),
                rgb=images.read_rgb(self._colour(index)),
                depth_counts=None if deep is None else images.read_counts(deep),
                T_world_cam=self.scene.frame(index).T_world_cam,
            )


def _require_same_camera(first: LabelledFrame, other: LabelledFrame, name: str) -> None:
    a, b = first.intrinsics, other.intrinsics
    same_size = (a.width, a.height) == (b.width, b.height)
    same_lens = np.array_equal(a.distortion, b.distortion)
    if not same_size or not same_lens or np.abs(a.K - b.K).max() > SAME_K_PX:
        raise InputError(
            f"images {first.index} and {other.index} of {name} have different cameras "
            f"({a.width}x{a.height}, fx {a.fx:.3f}, cx {a.cx:.3f}; {b.width}x{b.height}, fx "
            f"{b.fx:.3f}, cx {b.cx:.3f}), and a session has one. `realsim export` converts such "
            "data sets without a session."
        )


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
