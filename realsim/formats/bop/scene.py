"""Reading BOP datasets (scenewise): cameras, images and ground truth, in metres.

    DATASET/SPLIT/000050/{rgb|gray, depth, scene_camera.json, scene_gt.json}

A session folder is such a scene, too. What a dataset leaves open (the depth scale, which of two
ground truths, a camera that changes) is an error, not a guess. Writing is in `bop_labels`, models
are in `bop_models`, and the estimates that come with YCB-V in `bop_keyframes`.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats import images
from realsim.formats.bop import units as bop_units
from realsim.formats.bop.keyframes import read_keyframe_poses
from realsim.formats.bop.models import require_meshes
from realsim.records import CaptureSession, View
from realsim.store.session_store import CAMERA_FILE, read_json_file

__all__ = [
    "BopAnnotation",
    "BopScene",
    "BopSceneRef",
    "check_models",
    "find_scenes",
    "read_keyframe_poses",
    "read_scene",
]

Array = NDArray[np.float64]
COLOR_PLACES = ("rgb/{:06d}.png", "rgb/{:06d}.jpg", "gray/{:06d}.png", "gray/{:06d}.tif")
DEPTH_PLACES = ("depth/{:06d}.png", "depth/{:06d}.tif")
GT_FILE = "scene_gt.json"
NOT_GT = ("scene_gt_info.json", "scene_gt_coco.json")
"""Other files that begin like the ground truth."""
SAME_K_PX = 1e-6
"""Camera matrices that differ by less are the same camera, written by another program."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BopSceneRef:
    """Where a scene is."""

    split: str
    scene_id: int
    folder: Path


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BopAnnotation:
    """One annotated object of one image."""

    obj_id: int
    T_cam_obj: Array
    """(4, 4) object in the image's camera [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BopScene:
    """A scene of a BOP dataset; its images stay on disk."""

    ref: BopSceneRef
    session: CaptureSession
    """Camera, views (with T_world_cam where the dataset has it) and depth unit."""
    ground_truth: dict[int, list[BopAnnotation]]
    """Image -> its annotated objects; empty without a ground-truth file."""
    ground_truth_file: str | None
    """Name of the file that the annotations come from."""
    approximate: bool
    """Whether that file is another than scene_gt.json: no reference, only a rough start."""
    missing_images: tuple[int, ...] = ()
    """Images that scene_camera.json lists and the folder does not have; they are no views."""
    color_files: dict[int, Path] = field(default_factory=dict[int, Path])
    depth_files: dict[int, Path] = field(default_factory=dict[int, Path])

    @property
    def Ts_world_cam(self) -> dict[int, Array] | None:
        """Image -> T_world_cam (4, 4) [m]; None unless the dataset has it for every image."""
        poses = {v.index: v.T_world_cam for v in self.session.views if v.T_world_cam is not None}
        return poses if len(poses) == len(self.session.views) else None

    def rgb_path(self, index: int) -> Path:
        """Return the colour (or grey) image's file."""
        self.session.view(index)
        return self.color_files[index]

    def depth_path(self, index: int) -> Path:
        """Return the depth image's file.

        Raises:
            InputError: the image has no depth.
        """
        self.session.view(index)
        if index not in self.depth_files:
            raise InputError(f"image {index} of {self.ref.folder} has no depth image.")
        return self.depth_files[index]

    def has_depth(self, index: int) -> bool:
        """Return whether the image has depth."""
        return index in self.depth_files

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """Return the image (H, W, 3) uint8."""
        return images.read_rgb(self.rgb_path(index))

    def depth_m(self, index: int) -> NDArray[np.float32]:
        """Return the depth (H, W) float32 [m], 0 = no measurement."""
        return images.read_depth(self.depth_path(index), self.session.depth_unit_m)


def find_scenes(root: Path | str) -> list[BopSceneRef]:
    """Return all scenes of a dataset root, of a split folder, or of one scene folder.

    Raises:
        InputError: there is none; the message lists where it was looked for.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder; the root of a BOP dataset is expected.")
    if (root / CAMERA_FILE).is_file():
        return [_ref(root)]
    scenes = sorted(p.parent for p in root.glob(f"*/{CAMERA_FILE}"))
    scenes = scenes or sorted(p.parent for p in root.glob(f"*/*/{CAMERA_FILE}"))
    if not scenes:
        found = ", ".join(sorted(p.name for p in root.iterdir())[:12]) or "nothing"
        raise InputError(
            f"{root} holds no BOP scene. Looked for {CAMERA_FILE} here (a scene), in */ (a split) "
            f"and in */*/ (a dataset: SPLIT/000001/{CAMERA_FILE}); the folder has: {found}."
        )
    return [_ref(scene) for scene in scenes]


def _ref(folder: Path) -> BopSceneRef:
    folder = folder.resolve()
    scene_id = int(folder.name) if folder.name.isdecimal() else 0
    return BopSceneRef(split=folder.parent.name, scene_id=scene_id, folder=folder)


def read_scene(ref: BopSceneRef, image_ids: Sequence[int] | None = None) -> BopScene:
    """Read the cameras and the ground truth of a scene.

    Args:
        ref: a scene of `find_scenes`.
        image_ids: only these images; None = all.

    Raises:
        InputError: no image, no depth_scale, a camera that changes, two ground truths.
        NotRigidError: a rotation that is none.
        UnitError: a translation that is not in millimetres.
    """
    cameras = _by_image(read_json_file(ref.folder / CAMERA_FILE), ref.folder / CAMERA_FILE)
    if image_ids is not None:
        absent = sorted(set(image_ids) - set(cameras))
        if absent:
            raise InputError(
                f"image {', '.join(map(str, absent))} is not in {ref.folder / CAMERA_FILE}; it has "
                f"{', '.join(map(str, sorted(cameras)[:12]))}."
            )
        cameras = {i: cameras[i] for i in image_ids}
    color = _files(ref.folder, cameras, COLOR_PLACES)
    missing = tuple(sorted(set(cameras) - set(color)))
    cameras = {i: cameras[i] for i in sorted(color)}
    if not cameras:
        raise InputError(
            f"{ref.folder} is an empty scene: {CAMERA_FILE} lists {len(missing)} images and none "
            "of them is in rgb/ or gray/."
        )
    file, annotations = _read_ground_truth(ref.folder)
    return BopScene(
        ref=ref,
        session=_read_session(ref, cameras, color),
        ground_truth={i: annotations.get(i, []) for i in cameras} if file else {},
        ground_truth_file=file,
        approximate=file not in (None, GT_FILE),
        missing_images=missing,
        color_files=color,
        depth_files=_files(ref.folder, cameras, DEPTH_PLACES),
    )


def check_models(scene: BopScene, obj_ids: Collection[int]) -> None:
    """Raise if an annotated object has no model among these ids.

    Raises:
        InputError: names the ids that are missing and those that are there.
    """
    used = {a.obj_id for rows in scene.ground_truth.values() for a in rows}
    require_meshes(used, obj_ids, f"the models given for scene {scene.ref.scene_id}")


def _by_image(data: Any, path: Path) -> dict[int, Any]:
    try:
        return {int(key): value for key, value in data.items()}
    except (AttributeError, ValueError) as error:
        raise InputError(
            f"{path} is not an object with one entry per image number ({error})."
        ) from error


def _files(folder: Path, wanted: Collection[int], places: Sequence[str]) -> dict[int, Path]:
    found: dict[int, Path] = {}
    for index in wanted:
        for place in places:
            if (folder / place.format(index)).is_file():
                found[index] = folder / place.format(index)
                break
    return found


def _read_session(
    ref: BopSceneRef, cameras: dict[int, Any], color: dict[int, Path]
) -> CaptureSession:
    """Return the session of a scene whose images all have one camera."""
    path = ref.folder / CAMERA_FILE
    names = {i: f"image {i} of {path}" for i in cameras}
    first = next(iter(cameras))
    width, height = images.image_size(color[first])
    intrinsics = bop_units.intrinsics_of(cameras[first], width, height, names[first])
    unit_m = bop_units.depth_unit_of(cameras[first], names[first])
    views: list[View] = []
    for i, entry in cameras.items():
        other = bop_units.intrinsics_of(entry, width, height, names[i])
        same_lens = np.array_equal(other.distortion, intrinsics.distortion)
        if np.abs(other.K - intrinsics.K).max() > SAME_K_PX or not same_lens:
            raise InputError(
                f"{path}: images {first} and {i} have different cameras, and a session has one. "
                f"Read the images of one camera at a time (image_ids=[{first}])."
            )
        if bop_units.depth_unit_of(entry, names[i]) != unit_m:
            raise InputError(
                f"{path}: images {first} and {i} have different depth_scale, and a session has "
                "one. Convert the depth images to one scale."
            )
        views.append(View(index=i, T_world_cam=bop_units.T_world_cam_of(entry, names[i])))
    return CaptureSession(
        name=f"{ref.split}/{ref.folder.name}",
        intrinsics=intrinsics,
        views=tuple(views),
        depth_unit_m=unit_m,
    )


def _read_ground_truth(folder: Path) -> tuple[str | None, dict[int, list[BopAnnotation]]]:
    """Return the ground-truth file's name and its annotations, by image."""
    candidates = sorted(p.name for p in folder.glob("scene_gt*.json") if p.name not in NOT_GT)
    if GT_FILE in candidates:
        name = GT_FILE
    elif len(candidates) > 1:
        raise InputError(
            f"{folder} has no {GT_FILE}, but {', '.join(candidates)}: which one holds is not "
            f"known. Rename the right one to {GT_FILE}."
        )
    elif not candidates:
        return None, {}
    else:
        name = candidates[0]
    path = folder / name
    annotations = {
        i: [_annotation(a, f"object {k} of image {i} of {path}") for k, a in enumerate(rows)]
        for i, rows in _by_image(read_json_file(path), path).items()
    }
    return name, annotations


def _annotation(data: Any, name: str) -> BopAnnotation:
    keys = ("obj_id", "cam_R_m2c", "cam_t_m2c")
    if not isinstance(data, dict) or any(key not in data for key in keys):
        raise InputError(f"{name} must be an object with {', '.join(keys)}; found {data!r}.")
    touching = data.get(bop_units.AT_THE_LENS) is True
    T = bop_units.object_in_camera(data["cam_R_m2c"], data["cam_t_m2c"], name, may_touch=touching)
    return BopAnnotation(obj_id=int(data["obj_id"]), T_cam_obj=T)
