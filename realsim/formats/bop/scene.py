"""Reading BOP datasets (scenewise): cameras, images and ground truth, in metres.

    DATASET/SPLIT/000050/{rgb|gray, depth, scene_camera.json, scene_gt.json}

A session folder is such a scene, too. What a dataset leaves open (the depth scale, which of two
ground truths, a camera that changes) is an error, not a guess. Names of files are in `layout`,
models in `models`, the estimates that come with YCB-V in `keyframes`; `labelled` reads scenes with
everything in them and a camera per image.

Pose estimates that come with YCB-Video: keyframe_poses/SOURCE/SCENE_OBJECT.txt.

Row n of a file belongs to the n-th keyframe of the scene in keyframe.txt (lines SCENE/IMAGE); it
is `qw qx qy qz x y z` [m], object in camera, and all zeros where the method found nothing. Checked
against scene_gt.json: the files of the source 'ground_truth' agree with it to 1e-3 mm and 1e-3 deg
for every object of scenes 50, 51 and 54 (image 1, row 0). 'cosypose' is 2.5 to 25 mm off, and for
objects with symmetries it may be turned by up to 180 degrees.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32, UInt8
from realsim.errors import InputError
from realsim.formats.bop.layout import SceneLayout, cameras_of, scene_number
from realsim.formats.bop.rows import read_cameras, read_ground_truth
from realsim.geometry import se3
from realsim.records import CaptureSession, View, bop_units
from realsim.store.opening import CAMERA_FILE
from realsim.untrusted.files import checked_text

YCB_OBJECTS = (
    "002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can",
    "006_mustard_bottle", "007_tuna_fish_can", "008_pudding_box", "009_gelatin_box",
    "010_potted_meat_can", "011_banana", "019_pitcher_base", "021_bleach_cleanser", "024_bowl",
    "025_mug", "035_power_drill", "036_wood_block", "037_scissors", "040_large_marker",
    "051_large_clamp", "052_extra_large_clamp", "061_foam_brick",
)  # fmt: skip
"""YCB-V's objects in the order of their BOP ids, 1 to 21."""
COLUMNS = 7
MOST_BYTES = 50e6
"""Largest text file that is read [bytes]."""
UNIT_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1: the files have six digits."""


def keyframe_row(root: Path | str, scene_id: int, image_id: int) -> int:
    """Return which row of the pose files belongs to an image.

    Raises:
        InputError: no keyframe.txt, or the image is not a keyframe.
    """
    path = Path(root) / "keyframe.txt"
    if not path.is_file():
        raise InputError(f"{path} does not exist; it says which row belongs to which image.")
    keyframes: list[int] = []
    for line in checked_text(path, MOST_BYTES).split():
        scene, _, image = line.partition("/")
        if not (scene.isdecimal() and image.isdecimal()):
            raise InputError(f"{path}: {line[:40]!r} is no keyframe; SCENE/IMAGE is expected.")
        if int(scene) == scene_id:
            keyframes.append(int(image))
    if image_id not in keyframes:
        raise InputError(
            f"image {image_id} is not a keyframe of scene {scene_id} in {path}; that scene has "
            f"{', '.join(map(str, keyframes[:12])) or 'none'}."
        )
    return keyframes.index(image_id)


def read_keyframe_poses(
    root: Path | str, scene_id: int, image_id: int, source: str = "cosypose"
) -> dict[int, Array]:
    """Return the poses that a source gives for an image.

    Args:
        root: the dataset with keyframe.txt and keyframe_poses/.
        scene_id: number of the scene.
        image_id: number of the image; it must be a keyframe.
        source: a folder of keyframe_poses/.

    Returns:
        Object id -> T_cam_obj (4, 4) [m]; objects that the source did not find are not there.

    Raises:
        InputError: no such source, no poses of this scene, or a broken file.
    """
    root = Path(root)
    folder = root / "keyframe_poses" / source
    if not folder.is_dir():
        there = sorted(p.name for p in (root / "keyframe_poses").glob("*") if p.is_dir())
        raise InputError(
            f"{folder} does not exist; pose sources of this dataset: {', '.join(there) or 'none'}."
        )
    row = keyframe_row(root, scene_id, image_id)
    files = sorted(folder.glob(f"{scene_id:04d}_*.txt"))
    if not files:
        raise InputError(f"{folder} has no poses of scene {scene_id} ({scene_id:04d}_*.txt).")
    poses: dict[int, Array] = {}
    for file in files:
        T = _pose(file, row)
        if T is not None:
            poses[_object_id(file)] = T
    return poses


def _object_id(file: Path) -> int:
    name = file.stem.partition("_")[2]
    if name not in YCB_OBJECTS:
        raise InputError(
            f"{file}: '{name}' is not a YCB-V object; they are {', '.join(YCB_OBJECTS)}."
        )
    return YCB_OBJECTS.index(name) + 1


def _pose(file: Path, row: int) -> Array | None:
    lines = checked_text(file, MOST_BYTES).splitlines()
    if row >= len(lines):
        raise InputError(f"{file} has {len(lines)} rows; row {row + 1} is needed.")
    try:
        numbers = np.array([float(x) for x in lines[row].split()])
        if not np.all(np.isfinite(numbers)):
            raise ValueError
    except ValueError as error:
        raise InputError(f"{file}, row {row + 1} is not numbers: {lines[row]!r}.") from error
    if len(numbers) != COLUMNS:
        raise InputError(
            f"{file}, row {row + 1} has {len(numbers)} numbers; qw qx qy qz x y z are expected."
        )
    if not np.any(numbers[:4]):
        return None
    if (
        np.abs(numbers[:4]).max() > 2
        or abs(float(np.linalg.norm(numbers[:4])) - 1) > UNIT_TOLERANCE
    ):
        raise InputError(
            f"{file}, row {row + 1}: the first four numbers {numbers[:4].tolist()} are no unit "
            "quaternion; qw qx qy qz x y z are expected."
        )
    return se3.from_rt(se3.from_quaternion_wxyz(numbers[:4]), numbers[4:])


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
