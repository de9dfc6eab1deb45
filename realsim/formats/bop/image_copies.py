"""Colour and depth images of any source as BOP holds them: copied where they already fit."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from realsim import images
from realsim.errors import InputError
from realsim.formats.export_folder import Content
from realsim.formats.folders.listing import image_header

ColourFormat = Literal["copy", "png", "jpeg"]
ENDINGS = {"PNG": ".png", "JPEG": ".jpg", "TIFF": ".tif"}
"""Endings that BOP's data sets have, by Pillow's names of formats."""
GREY_MODES = ("1", "L", "LA", "I;16", "I;16B", "I;16L", "I")
"""Pillow's modes of one channel."""
TAIL_BYTES = 32


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageContent:
    """An image as it is to be written."""

    content: Content
    """Bytes, or the file to copy."""
    ending: str
    grey: bool
    """Whether it has one channel and belongs in gray/."""
    changed: bool
    """Whether its pixels are not those of the source: JPEG loses some."""


def colour_content(path: Path, wanted: ColourFormat, jpeg_quality: int) -> ImageContent:
    """Return a colour (or grey) image in the wanted format; copied byte for byte if it has it.

    Raises:
        InputError: it is missing, truncated or not an image.
    """
    form, grey = _form(path)
    keeps = {"copy": tuple(ENDINGS), "png": ("PNG",), "jpeg": ("JPEG",)}[wanted]
    if form in keeps:
        return ImageContent(content=path, ending=ENDINGS[form], grey=grey, changed=False)
    pixels = images.read_grey(path) if grey else images.read_rgb(path)
    if wanted == "jpeg":
        import cv2

        bgr = pixels if grey else pixels[..., ::-1]
        is_done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
        if not is_done:
            raise InputError(f"{path} cannot be written as JPEG.")
        return ImageContent(
            content=np.asarray(data).tobytes(), ending=".jpg", grey=grey, changed=True
        )
    return ImageContent(content=images.png_bytes(pixels), ending=".png", grey=grey, changed=False)


def depth_content(path: Path) -> ImageContent:
    """Return a 16-bit depth image, to be copied byte for byte.

    Raises:
        InputError: it is missing, truncated, or not one channel of 16 bit.
    """
    form, grey = _form(path)
    if not (grey and image_header(path).deep):
        raise InputError(f"{path} is no depth image: one channel of 16 bit is expected.")
    if form in ("PNG", "TIFF"):
        return ImageContent(content=path, ending=ENDINGS[form], grey=True, changed=False)
    return ImageContent(
        content=images.png_bytes(images.read_image(path)), ending=".png", grey=True, changed=False
    )


def _form(path: Path) -> tuple[str, bool]:
    """Return the format by content, and whether the image is grey; a truncated one is refused."""
    from PIL import Image

    image_header(path)
    with Image.open(path) as image:
        form, grey = str(image.format), image.mode in GREY_MODES
    if form == "PNG":
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - TAIL_BYTES, 0))
            if images.PNG_END not in file.read():
                raise InputError(
                    f"{path} is truncated. Copy it again from where it came, or delete it."
                )
    return form, grey
