"""Images that a COLMAP model places, with depth beside them: joined by name."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from realsim.errors import InputError
from realsim.formats.colmap.model import ColmapImage, ColmapModel, find_model, read_model
from realsim.formats.folders import posed_images
from realsim.formats.folders.listing import image_header, natural_key, shown
from realsim.formats.folders.source import require_one_size
from realsim.records import CameraIntrinsics

FOLDER = "depth"
"""Where depth is looked for in a COLMAP project."""
REMEDY = "COLMAP's poses are world to camera, with OpenCV's axes; export the model again."


def find_depth(
    root: Path, given: Path | str | None, names: Sequence[str], notes: list[str]
) -> dict[str, Path]:
    """Return the depth image of each image name that has one: the same name, as PNG.

    Args:
        root: the project.
        given: folder of the depth images; None = depth/ in the project.
        names: of the images.
        notes: what is left out is added.

    Raises:
        InputError: a folder was given and no image has depth there.
    """
    places = [root / FOLDER] if given is None else [Path(given), root / given]
    for place in places:
        found = {n: place / Path(n).with_suffix(".png") for n in names}
        found = {n: p for n, p in found.items() if p.is_file()}
        if found:
            absent = [n for n in names if n not in found]
            if absent:
                notes.append(f"{len(absent)} images have no depth, left out: {shown(absent)}.")
            return found
    if given is not None:
        raise InputError(
            f"{given} holds no depth image of the name of an image, such as "
            f"{Path(names[0]).with_suffix('.png') if names else '000000.png'}."
        )
    return {}


IMAGE_FOLDERS = ("images", "image", "rgb", "input", "")
"""Where in a project's folder its images may be."""


def open_colmap(
    root: Path | str,
    *,
    images_folder: Path | str | None = None,
    camera_id: int | None = None,
    metres_per_unit: float | None = None,
    depth_folder: Path | str | None = None,
    depth_unit_m: float | None = None,
    use_depth: bool = True,
) -> posed_images.PosedImages:
    """Return a COLMAP model with its images as a frame source.

    Args:
        root: the model's folder, or a project that holds it (sparse/0 and images).
        images_folder: where the images are; None = looked for in the project.
        camera_id: which camera's images, where the model has several cameras.
        metres_per_unit: metres per unit of the model's world; None = not known.
        depth_folder: 16-bit PNG of the images' names; None = depth/ in the project, if a unit is
            given. Depth judges the direction of the poses and the scale.
        depth_unit_m: metres per count of depth.
        use_depth: whether depth is imported.

    Raises:
        InputError: no model, several cameras, images that are not there or of another size.
    """
    root = Path(root)
    folder = find_model(root)
    if folder is None:
        raise InputError(
            f"{root} holds no COLMAP model: cameras and images (.bin or .txt) were looked for "
            "there and in sparse/0, sparse, model, colmap and dense/sparse."
        )
    posed_images.require_scale(metres_per_unit)
    model = read_model(folder)
    chosen, camera, notes = _of_one_camera(model, camera_id)
    there = _images_there(_images_place(root, folder, images_folder, chosen), chosen, camera, notes)
    if model.unregistered:
        notes.append(
            f"{len(model.unregistered)} images have no pose in the model and were left out: "
            f"{shown(model.unregistered)}."
        )
    depth: dict[str, Path] = {}
    unit_m: float | None = None
    if use_depth and (depth_folder is not None or depth_unit_m is not None):
        depth = find_depth(root, depth_folder, [i.name for i, _ in there], notes)
    posed = [
        posed_images.PosedImage(
            name=i.name, colour=p, depth=depth.get(i.name), intrinsics=camera,
            T_world_cam=i.T_world_cam,
        )
        for i, p in there
        if not depth or i.name in depth
    ]  # fmt: skip
    if depth:
        unit_m, _, said = posed_images.checked_by_depth(
            posed, camera, depth_unit_m, str(folder), metres_per_unit, REMEDY
        )
        notes += said
    elif metres_per_unit is None:
        notes.append(
            "scale unknown: a COLMAP model has an arbitrary scale and world; camera poses are "
            "taken as if its unit were the metre. Give --scale (metres per unit) once it is known, "
            "such as a measured distance over the same distance in the model."
        )
    return posed_images.PosedImages(
        kind="colmap",
        path=model.folder,
        name=root.resolve().name if folder != root else folder.resolve().parent.name,
        intrinsics=camera,
        images=tuple(posed),
        depth_unit_m=unit_m,
        metres_per_unit=metres_per_unit,
        notes=tuple(notes),
    )


def _of_one_camera(
    model: ColmapModel, camera_id: int | None
) -> tuple[list[ColmapImage], CameraIntrinsics, list[str]]:
    """Return the images of one camera, the camera, and what was left out.

    Raises:
        InputError: there are several cameras and none was chosen; names them.
    """
    if not model.images:
        raise InputError(f"the COLMAP model {model.folder} has no registered image.")
    groups: dict[int, list[int]] = {}
    for k, camera in sorted(model.cameras.items()):
        first = next((g for g in groups if posed_images.same_camera(camera, model.cameras[g])), k)
        groups.setdefault(first, []).append(k)
    counts = {g: sum(i.camera_id in members for i in model.images) for g, members in groups.items()}
    listed = "; ".join(
        f"{g} ({counts[g]} images, {model.cameras[g].width}x{model.cameras[g].height}, "
        f"fx {model.cameras[g].fx:.2f})"
        for g in groups
    )
    notes: list[str] = []
    if camera_id is None:
        if len(groups) > 1:
            raise InputError(
                f"the COLMAP model {model.folder} has {len(groups)} different cameras: {listed}. "
                "A session has one. Choose with --camera-id N."
            )
        group = next(iter(groups))
    else:
        group = next((g for g, members in groups.items() if camera_id in members), -1)
        if group < 0:
            raise InputError(
                f"the COLMAP model {model.folder} has no camera {camera_id}; it has {listed}."
            )
        left = len(model.images) - counts[group]
        notes += [f"{left} images of other cameras were left out."] if left else []
    chosen = [i for i in model.images if i.camera_id in groups[group]]
    return chosen, model.cameras[group], notes


def _images_there(
    place: Path, chosen: Sequence[ColmapImage], camera: CameraIntrinsics, notes: list[str]
) -> list[tuple[ColmapImage, Path]]:
    """Return the images whose files are there, in natural order; those absent go to the notes.

    Raises:
        InputError: they are of another size than the model's camera, or one has several poses.
    """
    there = [(i, place / i.name) for i in chosen if (place / i.name).is_file()]
    absent = [i.name for i in chosen if not (place / i.name).is_file()]
    for name, count in Counter(i.name for i, _ in there).items():
        if count > 1:
            raise InputError(f"the model has {count} images named {name}: which pose is its own?")
    if absent:
        notes.append(f"{len(absent)} images are not in {place} and were left out: {shown(absent)}.")
    size = require_one_size([image_header(p) for _, p in there], f"images of {place}")
    if size != (camera.width, camera.height):
        raise InputError(
            f"the images in {place} are {size[0]}x{size[1]} px, the model's camera is of "
            f"{camera.width}x{camera.height} px. Give the images that COLMAP was run on with "
            "--images."
        )
    return sorted(there, key=lambda pair: natural_key(pair[0].name))


def _images_place(
    root: Path, folder: Path, given: Path | str | None, wanted: Sequence[ColmapImage]
) -> Path:
    """Return the folder in which the model's images are.

    Raises:
        InputError: none has any of them.
    """
    if given is not None:
        places = [Path(given), root / given]
    else:
        parents = [root, folder, folder.parent, folder.parent.parent]
        places = [p / name for p in parents for name in IMAGE_FOLDERS]
    found = next((p for p in places if any((p / i.name).is_file() for i in wanted)), None)
    if found is None:
        looked = shown([str(p) for p in dict.fromkeys(places)], 8)
        raise InputError(
            f"none of the {len(wanted)} images of the COLMAP model {folder} was found "
            f"({shown([i.name for i in wanted], 3)}); looked in {looked}. Give --images FOLDER."
        )
    return found
