"""The images of a GraspNet camera folder: sizes read from headers, labels and depth checked."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import images
from realsim.arrays import Array, UInt16
from realsim.errors import InputError
from realsim.records import CameraIntrinsics

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
