"""Opening a scene of GraspNet-1Billion: counts, directions and units against the content.

One image of GraspNet-1Billion on its own, as graspnet-baseline's demo has it.

    FOLDER/{color.png, depth.png, meta.mat, workspace_mask.png}

No annotation, no camera pose, no label image: the meta file has the poses and the camera matrix.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from realsim import images
from realsim.arrays import Array, Mask, evenly
from realsim.errors import InputError
from realsim.formats.graspnet import evidence, labelled
from realsim.formats.graspnet.annotations import ANNOTATIONS
from realsim.formats.graspnet.cameras import FIRST, MATRIX, POSES, CameraFiles, read_camera_files
from realsim.formats.graspnet.image_objects import (
    META,
    ImageObjects,
    joined_objects,
    read_image_objects,
    read_meta,
)
from realsim.formats.graspnet.labelled import (
    ENTRY,
    FACTOR_DEPTH,
    OBJECT_LIST,
    GraspnetLabelledScene,
    GraspnetSceneRef,
    number_instances,
    read_object_list,
    stands_at,
)
from realsim.formats.graspnet.models import load_models, mesh_file
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
from realsim.records import ObjectModel

COMPARED = 12
"""Images whose objects are compared with each other, spread over the scene."""
LOOKED_AT = 3
"""Images of them whose labels and depth are decoded."""
SAME_K_PX = 0.5
"""camK.npy and intrinsic_matrix that differ by more contradict each other."""


def open_scene(ref: GraspnetSceneRef) -> GraspnetLabelledScene:
    """Open one scene of one camera and check what a few of its images say.

    Raises:
        InputError: nothing there, a file is damaged, or the files contradict each other or the
            images; see `evidence`.
        NotRigidError: a matrix that is no rigid transform.
        UnitError: millimetres, or a depth unit that the objects' distances contradict.
    """
    notes: list[str] = []
    cameras = read_camera_files(ref.folder)
    indices = _indices(ref.folder, cameras, notes)
    chosen = evenly(indices, COMPARED)
    found = {i: read_image_objects(ref.folder, i) for i in chosen}
    _compare_matrices(found, cameras, ref.folder)
    poses = cameras.poses
    if poses is None:
        notes.append(f"there is no {POSES}: where the camera stood is not known.")
    else:
        _check_movement(found, cameras, ref.folder, notes)
        if cameras.first is None:
            notes.append(f"there is no {FIRST}: world is the first camera, no table is known.")
    standing = [
        ([o.number for o in f.objects], stands_at(f.objects, None if poses is None else poses[i]))
        for i, f in found.items()
    ]
    listed = read_object_list(ref.folder.parent / OBJECT_LIST)
    instances, said = number_instances(listed, standing)
    notes += said + _missing_models(ref, set(instances.places))
    _count_meta(found, notes)
    scene = GraspnetLabelledScene(ref, indices, cameras, instances, notes)
    notes += _check_pixels(scene, {i: found[i] for i in evenly(chosen, LOOKED_AT)})
    return scene


def _indices(folder: Path, cameras: CameraFiles, notes: list[str]) -> tuple[int, ...]:
    """Return the numbers of the images that have annotations.

    Raises:
        InputError: none, or images without a camera pose.
    """
    seen = labelled.numbers_in(folder / labelled.RGB, ".png")
    annotated = labelled.numbers_in(folder / ANNOTATIONS, ".xml")
    annotated |= labelled.numbers_in(folder / META, ".mat")
    indices = tuple(sorted(seen & annotated))
    if not indices:
        raise InputError(
            f"{folder} has {len(seen)} images rgb/0000.png and {len(annotated)} annotations or "
            "meta files, and none of the same number; a GraspNet camera folder is expected."
        )
    count = None if cameras.poses is None else len(cameras.poses)
    if count is not None and indices[-1] >= count:
        raise InputError(
            f"{folder / POSES} holds {count} poses, and there are {len(seen)} images and "
            f"{len(annotated)} annotations, up to number {indices[-1]}; one pose for each image is "
            "needed."
        )
    for what, numbers in (
        ("image(s) without annotation, left out", seen - annotated),
        ("annotation(s) without image", annotated - seen),
        (f"pose(s) in {POSES} without image", set(range(count or 0)) - set(indices)),
    ):
        if numbers:
            first = ", ".join(map(str, sorted(numbers)[:5]))
            notes.append(f"{len(numbers)} {what}: {first}{', ...' * (len(numbers) > 5)}.")
    return indices


def _compare_matrices(found: dict[int, ImageObjects], cameras: CameraFiles, folder: Path) -> None:
    if cameras.K is None:
        return
    for index, f in found.items():
        if f.meta is None:
            continue
        off = float(np.max(np.abs(f.meta.K - cameras.K)))
        if off > SAME_K_PX:
            raise InputError(
                f"{folder / MATRIX} and intrinsic_matrix of {META}/{index:04d}.mat differ by "
                f"{off:.2f} px: {np.round(cameras.K, 2).tolist()} and "
                f"{np.round(f.meta.K, 2).tolist()}. Which one belongs to the images? Take the "
                "other away, or correct it."
            )


def _check_movement(
    found: dict[int, ImageObjects], cameras: CameraFiles, folder: Path, notes: list[str]
) -> None:
    poses = cameras.poses
    if poses is None:
        return
    rigid = se3.check_rigid(poses, str(folder / POSES))
    posed = [
        evidence.PosedImage(index=i, T_0_cam=rigid[i], objects=f.objects) for i, f in found.items()
    ]
    notes += evidence.check_camera_poses(posed, str(folder / POSES))
    evidence.check_quaternions(posed, str(folder / ANNOTATIONS))
    if cameras.first is not None:
        evidence.check_table(posed, cameras.first, str(folder / FIRST))


def _missing_models(ref: GraspnetSceneRef, numbers: set[int]) -> list[str]:
    models = ref.models
    missing = sorted(n for n in numbers if models is None or mesh_file(models, n) is None)
    if not missing:
        return []
    where = "there is no folder 'models'" if models is None else f"{models} has no mesh"
    return [f"{where} for object(s) {', '.join(f'{n:03d}' for n in missing[:10])}."]


def _count_meta(found: dict[int, ImageObjects], notes: list[str]) -> None:
    bare = sum(f.meta is None for f in found.values())
    alone = sum(not f.has_annotation for f in found.values())
    if bare:
        notes.append(
            f"{bare} of {len(found)} images looked at have no meta file: poses have the XML's "
            f"decimals, and depth is taken as {FACTOR_DEPTH:g} counts per metre."
        )
    if alone:
        notes.append(
            f"{alone} of {len(found)} images looked at have no annotation: poses are the meta "
            "files'."
        )


def _check_pixels(scene: GraspnetLabelledScene, found: dict[int, ImageObjects]) -> list[str]:
    units: set[float] = set()
    seen: list[evidence.SeenImage] = []
    without = 0
    for index, f in found.items():
        frame, depth_file = scene.frame(index), scene.depth_file(index)
        label = scene.label(index)
        without += label is None
        depth_m = None
        if depth_file is not None and frame.depth_unit_m is not None:
            units.add(frame.depth_unit_m)
            depth_m = images.read_depth(depth_file, frame.depth_unit_m)
        seen.append(
            evidence.SeenImage(
                index=index,
                intrinsics=frame.intrinsics,
                objects=f.objects,
                label=label,
                depth_m=depth_m,
            )
        )
    notes = evidence.check_labels(seen, str(scene))
    if without:
        notes.append(f"{without} of {len(found)} images looked at have no label image: no masks.")
    for unit_m in units:
        evidence.check_depth(seen, unit_m, str(scene))
    return notes


COLOUR_FILE, DEPTH_FILE, META_FILE = "color.png", "depth.png", "meta.mat"


class GraspnetFrame:
    """One image as a LabelledScene of one frame, number 0."""

    number = 0
    """Nothing tells which scene it is of."""
    split = "train"
    """Without splits."""
    camera = ""
    """Nothing tells which camera took it."""
    indices = (0,)
    """The one image."""
    T_world_table: Array | None = None
    """Not known."""

    def __init__(
        self, folder: Path, models: Path | None, frame: LabelledFrame, notes: list[str]
    ) -> None:
        """Take over what was read; see `open_graspnet_frame`."""
        self.folder = folder
        self.name = folder.resolve().name
        """The folder's."""
        self._models_folder = models
        self._frame = frame
        self._notes = notes

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know."""
        return tuple(self._notes)

    def frame(self, index: int) -> LabelledFrame:
        """Return the frame.

        Raises:
            InputError: another number than 0.
        """
        if index != 0:
            raise InputError(f"{self.folder} holds one image, number 0; there is no {index}.")
        return self._frame

    def colour_file(self, index: int) -> Path:
        """Return the colour image."""
        self.frame(index)
        return self.folder / COLOUR_FILE

    def depth_file(self, index: int) -> Path | None:
        """Return the depth image."""
        self.frame(index)
        return self.folder / DEPTH_FILE

    def mask(self, index: int, k: int, *, visible: bool) -> Mask | None:
        """None: there are no masks of objects."""
        self.frame(index)
        return None

    def models(self) -> Mapping[int, ObjectModel]:
        """Return the models by object id; none unless their folder was given."""
        if self._models_folder is None or not self._models_folder.is_dir():
            return {}
        numbers = {o.obj_id - 1 for o in self._frame.objects}
        return load_models(self._models_folder, numbers, [])

    def grasps(self) -> SceneGrasps | None:
        """None: there are none."""
        return None


def is_graspnet_frame(folder: Path) -> bool:
    """Return whether a folder is one image as GraspNet's demo has it."""
    return all((folder / name).is_file() for name in (COLOUR_FILE, DEPTH_FILE, META_FILE))


def open_graspnet_frame(folder: Path | str, *, models: Path | str | None = None) -> GraspnetFrame:
    """Open a folder of one image and check its depth against its objects.

    Args:
        folder: holds color.png, depth.png and meta.mat.
        models: folder of the models; None = without.

    Raises:
        InputError: a file is missing or damaged, or the images differ in size.
        UnitError: the objects are not as far as the depth image says.
    """
    folder = Path(folder)
    needed = (COLOUR_FILE, DEPTH_FILE, META_FILE)
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"{folder} has no {', '.join(missing)}; one image of GraspNet has {', '.join(needed)}."
        )
    meta = read_meta(folder / META_FILE)
    size = labelled.same_size([folder / COLOUR_FILE, folder / DEPTH_FILE])
    intrinsics = labelled.intrinsics_of(meta.K, size, str(folder / META_FILE))
    objects = joined_objects(None, meta, str(folder / META_FILE))
    unit_m = 1.0 / meta.factor_depth
    seen = evidence.SeenImage(
        index=0, intrinsics=intrinsics, objects=objects, label=None,
        depth_m=images.read_depth(folder / DEPTH_FILE, unit_m),
    )  # fmt: skip
    evidence.check_depth([seen], unit_m, str(folder))
    instances, notes = number_instances(meta.numbers, [(meta.numbers, None)])
    frame = LabelledFrame(
        index=0,
        intrinsics=intrinsics,
        depth_unit_m=unit_m,
        objects=tuple(
            LabelledObject(
                obj_id=o.number + 1, T_cam_obj=o.T_cam_obj, instance=i, entry={ENTRY: o.entry}
            )
            for o, i in zip(objects, instances.of(meta.numbers, None), strict=True)
        ),
    )
    notes.append("one image on its own: no camera pose, no table, no masks.")
    return GraspnetFrame(folder, None if models is None else Path(models), frame, notes)
