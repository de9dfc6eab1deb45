"""Reading BOP datasets (scenewise): cameras, images and ground truth, in metres.

    DATASET/SPLIT/000050/{rgb|gray, depth, scene_camera.json, scene_gt.json}

A session folder is such a scene, too. What a dataset leaves open (the depth scale, which of two
ground truths, a camera that changes) is an error, not a guess. Names of files are in `layout`,
models in `models`, the estimates that come with YCB-V in `keyframes`; `labelled` reads scenes with
everything in them and a camera per image.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32, UInt8
from realsim.errors import InputError
from realsim.formats.bop.keyframes import read_keyframe_poses
from realsim.formats.bop.layout import SceneLayout, cameras_of, scene_number
from realsim.formats.bop.rows import read_cameras, read_ground_truth
from realsim.records import CaptureSession, View, bop_units
from realsim.store.session_store import CAMERA_FILE

__all__ = [
    "BopAnnotation",
    "BopScene",
    "BopSceneRef",
    "find_scenes",
    "read_keyframe_poses",
    "read_scene",
]

GT_FILE = "scene_gt.json"
NOT_GT = ("scene_gt_info", "scene_gt_coco")
"""Other files that begin like the ground truth."""
SAME_K_PX = 1e-6
"""Camera matrices that differ by less are the same camera, written by another program."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BopSceneRef:
    """Where a scene is."""

    split: str
    scene_id: int
    """The scene's number; the object's for onboarding_static/obj_000001_up."""
    folder: Path
    camera: str = ""
    """Type of the camera, of scenes with several: that of scene_camera_CAMTYPE.json."""

    @property
    def layout(self) -> SceneLayout:
        """Names of its files."""
        return SceneLayout(folder=self.folder, camera=self.camera)

    @property
    def name(self) -> str:
        """Split, scene and camera, such as test-000050 or val-000003-cam1."""
        return "-".join([self.split, self.folder.name, *([self.camera] if self.camera else [])])


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

    def rgb(self, index: int) -> UInt8:
        """Return the image (H, W, 3) uint8."""
        return images.read_rgb(self.rgb_path(index))

    def depth_m(self, index: int) -> Array32:
        """Return the depth (H, W) float32 [m], 0 = no measurement."""
        return images.read_depth(self.depth_path(index), self.session.depth_unit_m)


def find_scenes(root: Path | str) -> list[BopSceneRef]:
    """Return all scenes of a dataset root, of a split folder, or of one scene folder.

    A scene with several cameras is there once for each; onboarding folders are scenes.

    Raises:
        InputError: there is none; the message lists where it was looked for.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder; a BOP data set, split or scene is expected.")
    if cameras_of(root):
        return _refs(root)
    pattern = f"{Path(CAMERA_FILE).stem}*.json"
    scenes = {p.parent for p in root.glob(f"*/{pattern}") if cameras_of(p.parent)}
    scenes = scenes or {p.parent for p in root.glob(f"*/*/{pattern}") if cameras_of(p.parent)}
    if not scenes:
        found = ", ".join(sorted(p.name for p in root.iterdir())[:12]) or "nothing"
        raise InputError(
            f"{root} holds no BOP scene. Looked for {CAMERA_FILE} here (a scene), in */ (a split) "
            f"and in */*/ (a dataset: SPLIT/000001/{CAMERA_FILE}); the folder has: {found}."
        )
    return [ref for scene in sorted(scenes) for ref in _refs(scene)]


def _refs(folder: Path) -> list[BopSceneRef]:
    folder = folder.resolve()
    return [
        BopSceneRef(
            split=folder.parent.name,
            scene_id=scene_number(folder.name),
            folder=folder,
            camera=camera,
        )
        for camera in cameras_of(folder)
    ]


def cameras_with_images(
    ref: BopSceneRef,
) -> tuple[dict[int, dict[str, Any]], dict[int, Path], tuple[int, ...]]:
    """Return the rows of scene_camera, the colour images they are of, and those that are missing.

    Raises:
        InputError: no image is there.
    """
    path, there = ref.layout.document("scene_camera"), ref.layout.colour_files()
    cameras = read_cameras(path)
    missing = tuple(i for i in cameras if i not in there)
    cameras = {i: row for i, row in cameras.items() if i in there}
    if not cameras:
        raise InputError(
            f"{ref.folder} is an empty scene: {path.name} lists {len(missing)} images and none "
            f"of them is in rgb{ref.layout.suffix}/ or gray{ref.layout.suffix}/."
        )
    return cameras, {i: there[i] for i in cameras}, missing


def read_scene(ref: BopSceneRef) -> BopScene:
    """Read the cameras and the ground truth of a scene.

    Raises:
        InputError: no image, no depth_scale, a camera that changes, two ground truths.
        NotRigidError: a rotation that is none.
        UnitError: a translation that is not in millimetres.
    """
    cameras, color, missing = cameras_with_images(ref)
    file, annotations = _read_ground_truth(ref)
    deep = ref.layout.depth_files()
    return BopScene(
        ref=ref,
        session=_read_session(ref, cameras, color),
        ground_truth={i: annotations.get(i, []) for i in cameras} if file else {},
        ground_truth_file=file,
        approximate=file not in (None, ref.layout.document("scene_gt").name),
        missing_images=missing,
        color_files=color,
        depth_files={i: deep[i] for i in cameras if i in deep},
    )


def _read_session(
    ref: BopSceneRef, cameras: dict[int, Any], color: dict[int, Path]
) -> CaptureSession:
    """Return the session of a scene whose images all have one camera."""
    path = ref.layout.document("scene_camera")
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
                "`realsim export` converts such data sets without a session."
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


def ground_truth_file(ref: BopSceneRef) -> Path | None:
    """Return the file of the annotations: scene_gt.json, or the only other scene_gt*.json.

    Raises:
        InputError: there is no scene_gt.json, but several others.
    """
    expected = ref.layout.document("scene_gt")
    if expected.is_file() or ref.camera:
        return expected if expected.is_file() else None
    others = sorted(p for p in ref.folder.glob("scene_gt*.json") if not _is_of_others(p))
    if len(others) > 1:
        raise InputError(
            f"{ref.folder} has no {GT_FILE}, but {', '.join(p.name for p in others)}: which one "
            f"holds is not known. Rename the right one to {GT_FILE}."
        )
    return others[0] if others else None


def _is_of_others(path: Path) -> bool:
    """Return whether a scene_gt*.json holds something else, or what another camera saw."""
    if path.name.startswith(NOT_GT):
        return True
    camera = path.stem.removeprefix("scene_gt_")
    return SceneLayout(folder=path.parent, camera=camera).document("scene_camera").is_file()


def _read_ground_truth(ref: BopSceneRef) -> tuple[str | None, dict[int, list[BopAnnotation]]]:
    """Return the ground-truth file's name and its annotations, by image."""
    path = ground_truth_file(ref)
    if path is None:
        return None, {}
    truth = read_ground_truth(path, least_id=0)
    annotations = {
        i: [
            BopAnnotation(obj_id=int(obj_id), T_cam_obj=T)
            for obj_id, T in zip(
                truth.obj_ids[truth.places(i)], truth.Ts_cam_obj[truth.places(i)], strict=True
            )
        ]
        for i in truth.rows
    }
    return path.name, annotations
