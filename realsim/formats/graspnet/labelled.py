"""A scene of GraspNet-1Billion as a LabelledScene: its world is the table's frame, z up.

    SCENE/{object_id_list.txt, kinect/, realsense/}
    CAMERA/{rgb,depth,label}/0000.png, annotations/0000.xml, meta/0000.mat,
           camera_poses.npy, cam0_wrt_table.npy, camK.npy

Metres, OpenCV cameras. Object ids are GraspNet's numbers + 1, as in cls_indexes and in the label
images, which show the visible pixels only.

The images of a GraspNet camera folder: sizes read from headers, labels and depth checked.

Which of two equal objects is which: instances numbered by their place in object_id_list.txt.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import images
from realsim.arrays import Array, Mask, UInt16
from realsim.errors import InputError
from realsim.formats.graspnet.annotations import LARGEST_NUMBER
from realsim.formats.graspnet.cameras import CameraFiles
from realsim.formats.graspnet.image_objects import ImageObject, ImageObjects, read_image_objects
from realsim.formats.graspnet.models import load_models
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.untrusted.files import checked_text

OBJECT_LIST = "object_id_list.txt"
MOST_OBJECTS = 10_000
LARGEST_LIST = 100_000
"""[bytes]"""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Instances:
    """The instances of a scene."""

    places: Mapping[int, tuple[int, ...]]
    """Object number -> its places in the list; more than one where equal objects lie there."""
    points: Mapping[int, Array]
    """Number of an object that is there several times -> (n, 3) where they stand [m]."""

    def of(self, numbers: Sequence[int], points: Array | None) -> list[int | None]:
        """Return the instances of an image's objects; None where nothing tells.

        Args:
            numbers: (N,) object numbers.
            points: (N, 3) where they stand, in the frame of `self.points` [m]; None = not known.
        """
        from scipy.optimize import linear_sum_assignment

        found: list[int | None] = [None] * len(numbers)
        for number in set(numbers):
            rows = [k for k, n in enumerate(numbers) if n == number]
            places = self.places.get(number, ())
            if len(places) == 1 and len(rows) == 1:
                found[rows[0]] = places[0]
            elif points is not None and number in self.points:
                apart = np.linalg.norm(points[rows][:, None] - self.points[number][None], axis=2)
                for r, p in zip(*linear_sum_assignment(apart), strict=True):
                    found[rows[int(r)]] = places[int(p)]
        return found


def read_object_list(path: Path) -> tuple[int, ...] | None:
    """Return the object numbers of a scene, None where there is no list.

    Raises:
        InputError: something else than a whole number in each line.
    """
    if not path.is_file():
        return None
    words = checked_text(path, LARGEST_LIST).split()
    ok = len(words) <= MOST_OBJECTS and all(w.isascii() and w.isdigit() for w in words)
    if not ok or any(len(w) > 6 or int(w) > LARGEST_NUMBER for w in words):
        raise InputError(
            f"{path} holds {' '.join(words[:5])[:60]!r}; one object number from 0 to "
            f"{LARGEST_NUMBER} in each line is expected."
        )
    return tuple(int(w) for w in words)


def number_instances(
    listed: Sequence[int] | None, images: Sequence[tuple[Sequence[int], Array | None]]
) -> tuple[Instances, list[str]]:
    """Return the instances of a scene, and what must be said about them.

    Args:
        listed: object_id_list.txt; None = there is none.
        images: of some images, the object numbers (N,) and where they stand (N, 3) [m] in one
            frame for all images; None = not known.
    """
    notes: list[str] = []
    order = list(listed or ())
    for numbers, _ in images:
        counts, there = Counter(numbers), Counter(order)
        for number in numbers:
            if there[number] < counts[number]:
                order.append(number)
                there[number] += 1
    added = order[len(listed or ()) :]
    if listed is None:
        notes.append(f"there is no {OBJECT_LIST}: instances are numbered as annotations name them.")
    elif added:
        notes.append(
            f"{OBJECT_LIST} does not name object(s) {', '.join(map(str, added))}, which the "
            "annotations have; they are counted on after its end."
        )
    places = {n: tuple(k for k, m in enumerate(order) if m == n) for n in order}
    points: dict[int, Array] = {}
    for number in [n for n, p in places.items() if len(p) > 1]:
        for numbers, where in images:
            rows = [k for k, n in enumerate(numbers) if n == number]
            if where is not None and len(rows) == len(places[number]):
                points[number] = where[rows]
                break
        known = "told apart by where they stand" if number in points else "not told apart"
        notes.append(
            f"object {number} is there {len(places[number])} times; GraspNet's label images have "
            f"one value for all of them, so they have no masks. They are {known}."
        )
    return Instances(places=places, points=points), notes


RGB, DEPTH, LABEL = "rgb", "depth", "label"
MOST_PX = 50e6
"""An image with more is not decoded."""


def image_file(folder: Path, kind: str, index: int) -> Path:
    """Return the file of an image: kind is rgb, depth or label."""
    return folder / kind / f"{index:04d}.png"


def numbers_in(folder: Path, suffix: str) -> set[int]:
    """Return the numbers of the files of a folder that are named as the format names them."""
    stems = [p.stem for p in folder.glob(f"*{suffix}")]
    numbers = {s: int(s) for s in stems if s.isascii() and s.isdigit() and len(s) <= 9}
    return {n for s, n in numbers.items() if s == f"{n:04d}"}


def same_size(files: list[Path]) -> tuple[int, int]:
    """Return (width, height) of images that belong together.

    Raises:
        InputError: one is damaged, enormous, or of another size.
    """
    sizes = [images.image_size(file) for file in files]
    width, height = sizes[0]
    if width * height > MOST_PX:
        raise InputError(
            f"{files[0]} claims {width}x{height} pixels; at most {MOST_PX / 1e6:g} million are."
        )
    for file, size in zip(files, sizes, strict=True):
        if size != sizes[0]:
            raise InputError(
                f"{file} has {size[0]}x{size[1]} pixels and {files[0]} {width}x{height}; the "
                "images of one view have one size. Restore the one that was resized."
            )
    return width, height


def intrinsics_of(K: Array, size: tuple[int, int], where: str) -> CameraIntrinsics:
    """Return the camera of an image.

    Raises:
        InputError: no camera matrix, or its principal point is not in the image.
    """
    try:
        camera = CameraIntrinsics.from_K(K, *size)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    if not (0 <= camera.cx < size[0] and 0 <= camera.cy < size[1]):
        raise InputError(
            f"{where} puts the principal point at ({camera.cx:.1f}, {camera.cy:.1f}), outside the "
            f"image of {size[0]}x{size[1]} pixels. It belongs to images of another size."
        )
    return camera


def read_label(path: Path) -> UInt16:
    """Return a label image (H, W): object numbers + 1, 0 = none.

    Raises:
        InputError: damaged, or not one channel.
    """
    same_size([path])
    label: NDArray[Any] = images.read_image(path)
    if label.ndim != 2 or label.dtype.kind != "u":
        raise InputError(
            f"{path} has the shape {label.shape} and the type {label.dtype}; a label image is one "
            "channel of object numbers + 1. Is it a coloured picture of the labels?"
        )
    return label.astype(np.uint16)


FACTOR_DEPTH = 1000.0
"""Counts per metre where no meta file says it; graspnetAPI takes nothing else."""
FIRST_TEST_SCENE = 100
"""First scene for testing, of the data set's own 190; those before are for training."""
ENTRY = "graspnet"
"""Key of a row's own values, so that no other format takes them for its own."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GraspnetSceneRef:
    """Where a scene of one camera is."""

    number: int
    camera: str
    """'kinect' or 'realsense'."""
    folder: Path
    """Folder of the camera."""
    models: Path | None
    """Folder of the models; None = there is none."""

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"scene_{self.number:04d}-{self.camera}"


class GraspnetLabelledScene:
    """A scene that `open_scene` has opened and checked."""

    def __init__(
        self, ref: GraspnetSceneRef, indices: tuple[int, ...], cameras: CameraFiles,
        instances: Instances, notes: list[str],
    ) -> None:  # fmt: skip
        """Take over what was read; see `open_scene`."""
        self.ref = ref
        self.name = ref.name
        """Such as scene_0100-kinect."""
        self.number = ref.number
        """The scene's number."""
        self.split = "train" if ref.number < FIRST_TEST_SCENE else "test"
        """The data set's own: its scenes 0 to 99 are for training."""
        self.camera = ref.camera
        """'kinect' or 'realsense'."""
        self.files = cameras
        has_table = cameras.first is not None and cameras.poses is not None
        self.T_world_table = np.eye(4) if has_table else None
        """The identity: world is the table's frame; None without cam0_wrt_table.npy."""
        self.indices = indices
        """Numbers of the images, increasing."""
        self._instances = instances
        self._notes = notes
        self._models: dict[int, ObjectModel] | None = None
        self._label: tuple[int, UInt16] | None = None
        self._objects: tuple[int, ImageObjects] | None = None
        poses = cameras.poses
        self._Ts_0_cam = None if poses is None else se3.check_rigid(poses, "camera_poses")
        first = cameras.first
        self._T_world_0 = np.eye(4) if first is None else se3.check_rigid(first, "cam0_wrt_table")

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know."""
        return tuple(self._notes)

    @property
    def object_numbers(self) -> tuple[int, ...]:
        """GraspNet's numbers of the objects, in the order of object_id_list.txt."""
        places = [(p, n) for n, many in self._instances.places.items() for p in many]
        return tuple(n for _, n in sorted(places))

    def frame(self, index: int) -> LabelledFrame:
        """Return one frame.

        Raises:
            InputError: there is no such image, or its files contradict each other.
            UnitError: millimetres.
        """
        found = self._image_objects(index)
        T_0_cam = None if self._Ts_0_cam is None else self._Ts_0_cam[index]
        T_world_cam = None if T_0_cam is None else self._T_world_0 @ T_0_cam
        K = self._matrix(found, index)
        kinds = (RGB, DEPTH, LABEL)
        files = [self._image(kind, index) for kind in kinds]
        size = same_size([file for file in files if file is not None])
        instances = self._instances.of(
            [o.number for o in found.objects], stands_at(found.objects, T_0_cam)
        )
        factor = FACTOR_DEPTH if found.meta is None else found.meta.factor_depth
        return LabelledFrame(
            index=index,
            intrinsics=intrinsics_of(K, size, f"the camera of image {index} of {self}"),
            depth_unit_m=None if self.depth_file(index) is None else 1.0 / factor,
            objects=tuple(_labelled(o, i) for o, i in zip(found.objects, instances, strict=True)),
            T_world_cam=T_world_cam,
            entry={ENTRY: self._entry(found, index)},
        )

    def colour_file(self, index: int) -> Path:
        """Return the file of the colour image."""
        self._require(index)
        return image_file(self.ref.folder, RGB, index)

    def depth_file(self, index: int) -> Path | None:
        """Return the file of the 16-bit depth image; None = there is none."""
        return self._image(DEPTH, index)

    def label_file(self, index: int) -> Path | None:
        """Return the file of the label image; None = there is none."""
        return self._image(LABEL, index)

    def label(self, index: int) -> UInt16 | None:
        """Return the label image (H, W) of object ids, 0 = none; None = there is none.

        Raises:
            InputError: it is damaged.
        """
        path = self.label_file(index)
        if path is None:
            return None
        if self._label is None or self._label[0] != index:
            self._label = (index, read_label(path))
        return self._label[1]

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """Return the visible mask (H, W) of a frame's k-th object.

        None for the whole silhouette, without a label image, and for objects that are there
        several times, whose pixels have one value.

        Raises:
            InputError: there is no such object, or the label image is damaged.
        """
        numbers = [o.number for o in self._image_objects(index).objects]
        if not 0 <= k < len(numbers):
            raise InputError(
                f"image {index} of {self} has no object {k}; it has {len(numbers)}, from 0."
            )
        label = self.label(index) if visible and numbers.count(numbers[k]) == 1 else None
        return None if label is None else label == numbers[k] + 1

    def models(self) -> Mapping[int, ObjectModel]:
        """Return the models of the objects, by object id; those without a mesh are not there."""
        if self._models is None:
            folder, notes = self.ref.models, list[str]()
            self._models = {} if folder is None else load_models(
                folder, self._instances.places.keys(), notes
            )  # fmt: skip
            self._notes += notes
        return self._models

    def grasps(self) -> SceneGrasps | None:
        """None: GraspNet's grasps are computed, not tried; they are in grasp_label."""
        return None

    def rect_file(self, index: int) -> Path | None:
        """Return the file of the rectangle grasps of an image; None = there is none."""
        self._require(index)
        path = self.ref.folder / "rect" / f"{index:04d}.npy"
        return path if path.is_file() else None

    def __str__(self) -> str:
        """Return its place, for messages."""
        return str(self.ref.folder)

    def _require(self, index: int) -> None:
        if index not in self.indices:
            raise InputError(
                f"{self} has no image {index}; it has {len(self.indices)}, "
                f"{self.indices[0]} to {self.indices[-1]}."
            )

    def _image_objects(self, index: int) -> ImageObjects:
        """Return what the files of an image say; the last image's are kept, masks come one by one.

        Raises:
            InputError: there is no such image, or its files are damaged.
        """
        self._require(index)
        if self._objects is None or self._objects[0] != index:
            self._objects = (index, read_image_objects(self.ref.folder, index))
        return self._objects[1]

    def _image(self, kind: str, index: int) -> Path | None:
        self._require(index)
        path = image_file(self.ref.folder, kind, index)
        return path if path.is_file() else None

    def _matrix(self, found: ImageObjects, index: int) -> Array:
        """Return the camera matrix (3, 3) of an image [px]: of its meta file, or of all images."""
        K = self.files.K if found.meta is None else found.meta.K
        if K is None:
            raise InputError(
                f"{self} has neither camK.npy nor meta/{index:04d}.mat; the camera matrix is in "
                "them."
            )
        return K

    def _entry(self, found: ImageObjects, index: int) -> dict[str, Any]:
        """Return the numbers as the files have them."""
        poses, first, K = self.files.poses, self.files.first, self.files.K
        return {
            "camera_pose": None if poses is None else poses[index].tolist(),
            "cam0_wrt_table": None if first is None else first.tolist(),
            "camK": None if K is None else K.tolist(),
            "intrinsic_matrix": None if found.meta is None else found.meta.K.tolist(),
        }


def stands_at(objects: tuple[ImageObject, ...], T_0_cam: Array | None) -> Array | None:
    """Return where objects stand (N, 3) in the first camera [m]; None without camera poses."""
    if T_0_cam is None:
        return None
    points = np.array([o.T_cam_obj[:3, 3] for o in objects]).reshape(-1, 3)
    return se3.transform(T_0_cam, points)


def _labelled(o: ImageObject, instance: int | None) -> LabelledObject:
    return LabelledObject(
        obj_id=o.number + 1, T_cam_obj=o.T_cam_obj, instance=instance, entry={ENTRY: o.entry}
    )
