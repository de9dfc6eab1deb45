"""Image files of a folder: which are colour and which depth, and reading them as they are."""

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import UInt8
from realsim.errors import InputError
from realsim.formats.folders.listing import natural_key
from realsim.untrusted.files import require_permission

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
"""Endings of image files."""
MAX_IMAGES = 20_000
"""Images in one folder."""
MAX_PIXELS = 250_000_000
"""Pixels of one image: beyond it the file is a decompression bomb."""
MAX_BYTES = 512 * 2**20
"""Size of one image file."""
SHOWN = 8
"""Images that cannot be used, and folders with images, that a message lists."""
AGAIN = (
    " Copy it again from where it came, or delete it together with its pose: its file, line, or "
    "in an array its row (numpy.delete(poses, k, axis=0) for image k, counted from 0). Where the "
    "poses name their images, delete the image alone."
)
"""What to do about a file that was not copied well."""
TAIL_BYTES = 512
"""A file whose last so many bytes are zero was not copied completely."""
_KIND_WORDS = re.compile(
    r"(?:^|(?<=[_\-. ]))(aligned|color|colour|rgb|image|img|depth|d)(?=$|[_\-. \d])", re.IGNORECASE
)
_DEEP_MODES = ("I;16", "I;16B", "I;16L", "I", "F")
_EXIF_ORIENTATION = 0x0112


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageListing:
    """The images of a folder, in natural order."""

    images: tuple[Path, ...]
    """8-bit images."""
    depths: tuple[Path | None, ...]
    """The 16-bit depth image that belongs to each, or None."""
    ignored: tuple[tuple[str, str], ...]
    """(file name, reason) of image files that are neither."""


def list_images(folder: Path) -> ImageListing:
    """Return the images of a folder; 16-bit ones of the same name are their depth.

    Raises:
        InputError: no folder, no images in it, two of the same name, or one that is no image.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; a folder of images was expected there.")
    files = image_files(folder)
    if len(files) > MAX_IMAGES:
        raise InputError(f"{folder} holds {len(files)} images; at most {MAX_IMAGES} are read.")
    try:
        deep = [p for p in files if is_deep(p)]
    except InputError:
        require_readable(files)
        raise
    images = [p for p in files if p not in set(deep)]
    if not images:
        raise InputError(_nothing(folder, deep))
    by_stem: dict[str, Path] = {}
    for p in images:
        if p.stem in by_stem:
            raise InputError(
                f"{folder} holds {by_stem[p.stem].name} and {p.name}: two images of one name. Keep "
                "the one that was taken with the pose."
            )
        by_stem[p.stem] = p
    depths, ignored = _with_depth(images, deep)
    return ImageListing(images=tuple(images), depths=depths, ignored=ignored)


def image_files(folder: Path) -> list[Path]:
    """Return the files of a folder that have the ending of an image, in natural order."""
    found = (p for p in folder.glob("[!.]*") if p.suffix.lower() in IMAGE_ENDINGS and p.is_file())
    return sorted(found, key=lambda p: natural_key(p.name))


def require_readable(files: Sequence[Path]) -> None:
    """Raise one error for all images that cannot be used, if they are several."""
    faults: list[str] = []
    for path in files:
        try:
            _ = is_deep(path) or load_image(path)
        except InputError as error:
            faults.append(str(error))
    if len(faults) > 1:
        told = [f.removesuffix(AGAIN) for f in faults]
        more = [f"... and {len(faults) - SHOWN} more"] * (len(faults) > SHOWN)
        advice = [AGAIN.strip()] * (told != faults)
        head = f"{len(faults)} of {len(files)} images cannot be used:"
        raise InputError("\n".join([head, *told[:SHOWN], *more, *advice]))


def _nothing(folder: Path, deep: Sequence[Path]) -> str:
    """Return what to say of a folder without 8-bit images."""
    if deep:
        return (
            f"{folder} holds {len(deep)} images of 16 bit and none of 8 bit ({deep[0].name}): "
            "depth cannot be calibrated with. Give the folder of the colour images."
        )
    inside = [p for depth in ("*/*", "*/*/*") for p in folder.glob(depth)]
    images = [p for p in inside if p.suffix.lower() in IMAGE_ENDINGS]
    below = sorted({str(p.parent.relative_to(folder)) for p in images})
    advice = "Give the folder of the board's pictures, with the robot's poses there or in --poses."
    if below:
        which = "that folder" if len(below) == 1 else "one of them"
        advice = f"There are images in {', '.join(below[:SHOWN])}: give {which}."
    return f"{folder} holds no images ({', '.join(IMAGE_ENDINGS)}). {advice}"


def _with_depth(
    images: Sequence[Path], deep: Sequence[Path]
) -> tuple[tuple[Path | None, ...], tuple[tuple[str, str], ...]]:
    """Return the depth image of each image, and the 16-bit images that belong to none."""
    by_name: dict[str, list[Path]] = {}
    for p in deep:
        by_name.setdefault(_bare(p.stem), []).append(p)
    depths: list[Path | None] = []
    for p in images:
        found = by_name.get(_bare(p.stem), [])
        depths.append(found[0] if len(found) == 1 else None)
    used = {d for d in depths if d is not None}
    reason = "16 bit, and no 8-bit image of the same name"
    return tuple(depths), tuple((p.name, reason) for p in deep if p not in used)


def _bare(stem: str) -> str:
    """Return a name without the words for the kind of image: "color_7" and "depth_7" agree."""
    return re.sub(r"[_\-. ]+", "_", _KIND_WORDS.sub("", stem)).strip("_").lower()


def is_deep(path: Path) -> bool:
    """Return whether an image file has more than 8 bits a channel, by its header.

    Raises:
        InputError: the header is none of an image.
    """
    return _opened(path, _deep)


def _deep(path: Path, image: Any) -> bool:
    """Return whether an opened image has more than 8 bits a channel."""
    if image.mode in _DEEP_MODES:
        return True
    if image.format == "PNG":  # PIL calls 48-bit colour "RGB" and drops the lower bytes
        with path.open("rb") as file:
            return file.read(25)[24] == 16
    return bool(image.format == "TIFF" and max(image.tag_v2.get(258, (8,))) > 8)


def _opened(path: Path, action: Callable[[Path, Any], Any]) -> Any:
    """Return what an action makes of an opened image; decoders' errors name the file."""
    import warnings

    from PIL import Image, UnidentifiedImageError

    if not path.is_file():
        raise InputError(f"{path} does not exist; an image was expected there.")
    require_permission(path)
    size = path.stat().st_size
    if not 0 < size <= MAX_BYTES:
        what = "is empty" if size == 0 else f"has {size / 2**20:.0f} MB"
        raise InputError(f"{path} {what}; an image was expected.{AGAIN}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of size, checked below, and of odd metadata
            with Image.open(path) as image:
                if image.width * image.height > MAX_PIXELS:
                    raise InputError(
                        f"{path} has {image.width}x{image.height} pixels; at most {MAX_PIXELS} "
                        "are read."
                    )
                return action(path, image)
    except InputError:
        raise
    except UnidentifiedImageError as error:
        raise InputError(
            f"{path} is not an image that can be read ({size} bytes).{AGAIN}"
        ) from error
    except Exception as error:  # decoders raise nearly anything on damaged files
        raise InputError(
            f"{path} is damaged or truncated ({size} bytes; {error}).{AGAIN}"
        ) from error


def load_image(path: Path | str) -> UInt8:
    """Return an image as (H, W, 3) uint8 RGB, exactly the stored pixels.

    Grey images get three equal channels. Nothing is turned, scaled or filled in.

    Raises:
        InputError: missing, damaged, truncated, of more than 8 bits a channel, partly transparent,
            or marked to be shown turned.
    """
    path = Path(path)
    if path.is_file() and path.suffix.lower() in (".jpg", ".jpeg"):
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - TAIL_BYTES, 0))
            tail = file.read()
        if tail and not any(tail):  # decoders fill the rest in grey without a word
            raise InputError(
                f"{path} is truncated: it ends in zeros, so it was not copied completely.{AGAIN}"
            )
    return _opened(path, _pixels)


def _pixels(path: Path, image: Any) -> UInt8:
    """Return the pixels of an opened image as RGB."""
    if _deep(path, image):
        raise InputError(
            f"{path} has more than 8 bits a channel ({image.mode}): a depth or raw image. Give the "
            "8-bit colour or grey image, or convert it with a fixed scale."
        )
    turned = image.getexif().get(_EXIF_ORIENTATION, 1)
    if turned != 1:
        raise InputError(
            f"{path} is marked to be shown turned (EXIF orientation {turned}): tools differ in "
            "whether they obey. Store it upright without the mark, all images alike."
        )
    if getattr(image, "n_frames", 1) != 1:
        raise InputError(f"{path} holds {image.n_frames} images; one is expected.")
    if image.mode == "CMYK":
        raise InputError(f"{path} is a CMYK print image; RGB or grey is expected.")
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        alpha = np.asarray(image.convert("RGBA"))[..., 3]
        if alpha.min() < 255:
            raise InputError(
                f"{path} is partly transparent (alpha down to {alpha.min()}): a camera image has "
                "no transparency. Was it edited?"
            )
    image.load()
    return np.array(image.convert("RGB"), dtype=np.uint8)


def content_of(path: Path) -> bytes:
    """Return a digest of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").digest()
