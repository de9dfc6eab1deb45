"""Depth images beside a COLMAP project: joined by name, and what they say of its poses and unit."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim import images
from realsim.errors import InputError
from realsim.formats.camera_scale import poses_checked_by_depth
from realsim.formats.folders.depth_evidence import depth_evidence, require_unit
from realsim.formats.folders.listing import image_header, shown
from realsim.formats.folders.source import require_one_size
from realsim.records import CameraIntrinsics

Array = NDArray[np.float64]
FOLDER = "depth"
"""Where `realsim export` puts depth in a COLMAP project."""
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


def checked_by_depth(
    paths: Sequence[Path],
    Ts_world_cam: Array,
    camera: CameraIntrinsics,
    unit_m: float | None,
    where: str,
    metres_per_unit: float | None,
) -> tuple[float, list[str]]:
    """Return the depth unit [m], and what depth says of the poses.

    Args:
        paths: depth images, in the order of the poses.
        Ts_world_cam: (N, 4, 4) camera poses, `metres_per_unit` applied.
        camera: of all images.
        unit_m: metres per count as told.
        where: for messages.
        metres_per_unit: as told, None = not told.

    Raises:
        InputError: no unit, another size than the colour's, or poses that the depth contradicts.
    """
    size = require_one_size([image_header(p) for p in paths], f"depth images of {where}")
    if size != (camera.width, camera.height):
        raise InputError(
            f"{where}: the depth images are {size[0]}x{size[1]} px, the colour images "
            f"{camera.width}x{camera.height} px: depth is not on the colour's pixels."
        )
    unit = require_unit(unit_m, depth_evidence(paths), "plain", where)

    def depth_of(k: int) -> tuple[NDArray[np.float32], CameraIntrinsics]:
        return images.read_depth(paths[k], unit), camera

    return unit, poses_checked_by_depth(Ts_world_cam, depth_of, where, metres_per_unit, REMEDY)
