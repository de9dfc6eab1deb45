"""Pose estimates that come with YCB-Video: keyframe_poses/SOURCE/SCENE_OBJECT.txt.

Row n of a file belongs to the n-th keyframe of the scene in keyframe.txt (lines SCENE/IMAGE); it
is `qw qx qy qz x y z` [m], object in camera, and all zeros where the method found nothing. Checked
against scene_gt.json: the files of the source 'ground_truth' agree with it to 1e-3 mm and 1e-3 deg
for every object of scenes 50, 51 and 54 (image 1, row 0). 'cosypose' is 2.5 to 25 mm off, and for
objects with symmetries it may be turned by up to 180 degrees.
"""

from pathlib import Path

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
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
