"""Where images and poses lie: beside each other, in images/ and poses/, one folder a pose.

| layout | what is read |
|---|---|
| beside each other | FOLDER/*.png with FOLDER/poses.csv or FOLDER/*.json |
| below | FOLDER/images/*.png with FOLDER/poses.csv, FOLDER/poses/*.yaml or poses in images/ |
| one folder a pose | FOLDER/pose_00/image.png with FOLDER/pose_00/data.json |
"""

from dataclasses import dataclass
from pathlib import Path

from realsim.errors import InputError
from realsim.formats.folders.listing import natural_key
from realsim_calibration.inputs.image_files import (
    IMAGE_ENDINGS,
    ImageListing,
    image_files,
    list_images,
    require_readable,
)
from realsim_calibration.inputs.pose_file import pose_files_in, read_pose_file, read_single_files
from realsim_calibration.inputs.raw_poses import RawPoses

IMAGE_FOLDERS = frozenset("images image imgs img rgb color colour photos pictures".split())
"""Names of a folder that holds the images of the set that it lies in."""
POSE_FOLDERS = frozenset("poses pose robot_poses robot tcp tcp_poses ee_poses arm_poses".split())
"""Names of a folder that holds the poses."""
MADE_OF = "calibrated_of.json"
"""File that says of which images the results beside it are: they are replaced, and never read."""
MIN_FOLDERS = 3
"""Folders with one image each that are one folder a pose."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseFolders:
    """A set with one folder a pose, in natural order."""

    listing: ImageListing
    raw: RawPoses
    names: tuple[str, ...]
    """What each image is called: "pose_00/image.png"."""


def image_folder(folder: Path) -> Path:
    """Return the folder that holds the images: the given one, or its images/ where it has none."""
    if not folder.is_dir() or _has_images(folder):
        return folder
    below = [d for d in folder.iterdir() if d.is_dir() and d.name.lower() in IMAGE_FOLDERS]
    below = [d for d in below if _has_images(d)]
    return below[0] if len(below) == 1 else folder


def poses_of(folder: Path, images: Path) -> Path:
    """Return where the poses lie of a set whose images lie in `images` below it."""
    if folder == images or not folder.is_dir() or pose_files_in(folder):
        return folder
    below = [d for d in folder.iterdir() if d.is_dir() and d.name.lower() in POSE_FOLDERS]
    below = [d for d in below if pose_files_in(d)]
    return below[0] if len(below) == 1 else images


def pose_folders(folder: Path, key: str | None) -> PoseFolders | None:
    """Return a set with one folder a pose, None where the folder is no such set.

    Raises:
        InputError: a folder lacks its image or its pose, or it is not clear which file is which.
    """
    if not folder.is_dir() or _has_images(folder) or pose_files_in(folder):
        return None
    below = sorted((d for d in folder.iterdir() if d.is_dir()), key=lambda d: natural_key(d.name))
    below = [d for d in below if not d.name.startswith(".") and any(d.iterdir())]
    below = [d for d in below if not (d / MADE_OF).is_file()]
    with_both = [d for d in below if _has_images(d) and pose_files_in(d)]
    if len(with_both) < MIN_FOLDERS:
        return None
    missing = [d.name for d in below if d not in with_both]
    try:
        listings = [list_images(d) for d in with_both]
    except InputError:
        require_readable([p for d in with_both for p in image_files(d)])
        raise
    for d, listing in zip(with_both, listings, strict=True):
        if len(listing.images) > 1:
            names = ", ".join(p.name for p in listing.images[:4])
            raise InputError(
                f"{d} holds {len(listing.images)} images ({names}); with one folder a pose each "
                "holds one image and one pose file. Take the others out."
            )
    files = [_one_pose_file(d) for d in with_both]
    images = tuple(listing.images[0] for listing in listings)
    names = tuple(f"{p.parent.name}/{p.name}" for p in images)
    raw = read_single_files(folder, files, [f"{p.parent.name}/{p.name}" for p in files], key)
    reason = "this folder holds no image with a pose file"
    return PoseFolders(
        listing=ImageListing(
            images=images,
            depths=tuple(listing.depths[0] for listing in listings),
            ignored=tuple((name, reason) for name in missing),
        ),
        raw=raw,
        names=names,
    )


def _one_pose_file(folder: Path) -> Path:
    """Return the one pose file of a folder: of several, the only one that holds a pose."""
    files = pose_files_in(folder)
    if len(files) > 1:
        readable: list[Path] = []
        for file in files:
            try:
                read_pose_file(file)
            except InputError:
                continue
            readable.append(file)
        files = readable or files
    if len(files) != 1:
        names = ", ".join(p.name for p in files[:4])
        raise InputError(
            f"{folder} holds {len(files)} pose files ({names}); with one folder a pose each holds "
            "one image and one pose file. Take the others out."
        )
    return files[0]


def _has_images(folder: Path) -> bool:
    return any(p.suffix.lower() in IMAGE_ENDINGS and p.is_file() for p in folder.iterdir())
