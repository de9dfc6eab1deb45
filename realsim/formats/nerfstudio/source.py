"""The images of a transforms.json as a frame source."""

from collections.abc import Sequence
from pathlib import Path

from realsim.errors import InputError
from realsim.formats.folders.listing import image_header, shown
from realsim.formats.folders.posed_images import (
    PosedImage,
    PosedImages,
    checked_by_depth,
    require_scale,
    same_camera,
)
from realsim.formats.folders.source import require_one_size
from realsim.formats.nerfstudio.transforms import (
    FILE,
    NGP_UNIT,
    Transforms,
    find_transforms,
    read_transforms,
)
from realsim.records import CameraIntrinsics

REMEDY = (
    "transform_matrix is camera to world with y up and -z forward; write it so, or give the images "
    "as a folder with the poses in a file of their own (--kind folder --poses)."
)


def open_nerfstudio(
    root: Path | str,
    *,
    images_folder: Path | str | None = None,
    camera_id: int | None = None,
    metres_per_unit: float | None = None,
    depth_unit_m: float | None = None,
    use_depth: bool = True,
) -> PosedImages:
    """Return a transforms.json with its images as a frame source.

    Where there is depth, it judges the poses: their direction and axes, and their unit.

    Args:
        root: the file, or the folder that holds it.
        images_folder: where the images are, if not where the file says.
        camera_id: which camera's images, 1, 2, ... in the order in which the file has them.
        metres_per_unit: metres per unit of the file's world; None = not known.
        depth_unit_m: metres per count of depth; None = what the file says, or nerfstudio's 0.001.
        use_depth: whether depth is imported.

    Raises:
        InputError: no such file, several cameras, images that are not there or of another size, or
            poses that the depth contradicts.
    """
    path = find_transforms(root)
    if path is None:
        raise InputError(f"{root} holds no {FILE}.")
    require_scale(metres_per_unit)
    transforms = read_transforms(
        path, images_folder=None if images_folder is None else Path(images_folder)
    )
    frames, camera, notes = _of_one_camera(transforms, camera_id)
    notes = [*transforms.notes, *notes]
    unit_m: float | None = None
    deep = [f for f in frames if f.depth is not None]
    if use_depth and deep:
        if len(deep) < len(frames):
            without = [f.name for f in frames if f.depth is None]
            notes.append(
                f"{len(without)} frames have no depth and were left out: {shown(without)}."
            )
        frames = deep
        told_m, source = _unit_of(transforms, deep, depth_unit_m, metres_per_unit)
        unit_m, median_m, said = checked_by_depth(
            deep, camera, told_m, str(path), metres_per_unit, REMEDY
        )
        notes += [f"depth: {unit_m:g} m per count, {source}; median {median_m:.3g} m.", *said]
    elif metres_per_unit is None:
        notes.append(
            f"scale unknown: {FILE} says no unit, and programs that write it often scale the "
            "poses; they are taken as if in metres. Give --scale (metres per unit) once it is "
            "known, such as a measured distance over the same distance in the file's world."
        )
    return PosedImages(
        kind="nerfstudio",
        path=path,
        name=path.resolve().parent.name,
        intrinsics=camera,
        images=tuple(frames),
        depth_unit_m=unit_m,
        metres_per_unit=metres_per_unit,
        notes=tuple(notes),
    )


def _of_one_camera(
    transforms: Transforms, camera_id: int | None
) -> tuple[list[PosedImage], CameraIntrinsics, list[str]]:
    """Return the frames of one camera, the camera, and what was left out.

    Raises:
        InputError: there are several cameras and none was chosen; names them.
    """
    groups: list[list[PosedImage]] = []
    for f in transforms.frames:
        mine = next((g for g in groups if same_camera(g[0].intrinsics, f.intrinsics)), None)
        if mine is None:
            groups.append([f])
        else:
            mine.append(f)
    listed = "; ".join(
        f"{n} ({len(g)} images, {g[0].intrinsics.width}x{g[0].intrinsics.height}, fx "
        f"{g[0].intrinsics.fx:.2f}, first {g[0].name})"
        for n, g in enumerate(groups[:8], start=1)
    )
    if camera_id is None and len(groups) > 1:
        raise InputError(
            f"{transforms.path} has {len(groups)} different cameras: {listed}. A session has one. "
            "Choose with --camera-id N."
        )
    chosen = 1 if camera_id is None else camera_id
    if not 1 <= chosen <= len(groups):
        raise InputError(f"{transforms.path} has no camera {chosen}; it has {listed}.")
    frames = groups[chosen - 1]
    require_one_size([image_header(f.colour) for f in frames[:1]], f"images of {transforms.path}")
    left = len(transforms.frames) - len(frames)
    return (
        frames,
        frames[0].intrinsics,
        [f"{left} images of other cameras were left out."] if left else [],
    )


# --- depth ------------------------------------------------------------------------------------


def _unit_of(
    transforms: Transforms,
    deep: Sequence[PosedImage],
    given_m: float | None,
    metres_per_unit: float | None,
) -> tuple[float, str]:
    """Return the depth unit [m] and from where it is.

    Raises:
        InputError: the depth is no 16-bit images.
    """
    for path in (f.depth for f in deep if f.depth is not None):
        if path.suffix.lower() in (".npy", ".exr"):
            raise InputError(
                f"{path} is no 16-bit image; depth is read as PNG of counts. Convert it, or leave "
                "depth out with --no-depth."
            )
    if given_m is not None:
        return given_m, "as asked"
    if transforms.depth_unit_said == NGP_UNIT:
        unit_m = transforms.depth_unit * (1.0 if metres_per_unit is None else metres_per_unit)
        return unit_m, f"from {NGP_UNIT}, in the unit of the poses"
    said = transforms.depth_unit_said
    return transforms.depth_unit, f"from {said}" if said else "nerfstudio's"
