"""What the header of an image claims, looked at before a decoder allocates it."""

import io
import struct
from pathlib import Path

from realsim.errors import InputError
from realsim.formats import png

MOST_PIXELS = 100_000_000
"""Pixels of one image: the largest cameras have 60 million, a header can claim any number, and
decoders allocate what it claims."""
PNG_HEADER = struct.Struct(">IIBB")
"""Width, height, bits a channel, colour type."""
PNG_HEADER_AT = 16
"""Bytes before it: signature, length and name of the chunk."""
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Channels by PNG's colour type."""
DEFLATE_RATIO = 1033
"""Bytes that one byte of a PNG can unfold into, at most."""
OTHER_FORMATS = ("JPEG", "TIFF", "BMP", "WEBP", "PPM", "GIF")
"""What is decoded besides PNG, by PIL's names."""


def require_decodable(data: bytes, where: str) -> None:
    """Check what the header of an image claims.

    Args:
        data: the file.
        where: its name, for messages.

    Raises:
        InputError: more than 100 million pixels, more than a PNG of that length can hold, or
            another kind of file.
    """
    if data.startswith(png.SIGNATURE) and len(data) >= PNG_HEADER_AT + PNG_HEADER.size:
        width, height, bits, kind = PNG_HEADER.unpack_from(data, PNG_HEADER_AT)
        row_bytes = width * bits * PNG_CHANNELS.get(kind, 4) // 8
        if height * row_bytes > DEFLATE_RATIO * len(data):
            raise InputError(
                f"{where} claims {width}x{height} pixels, for which its {len(data)} bytes are too "
                "few. It is damaged: copy it again from where it came."
            )
    else:
        width, height = header_size(io.BytesIO(data), where, OTHER_FORMATS)
    require_few_pixels(width, height, where)


def require_few_pixels(width: int, height: int, where: str) -> None:
    """Check that an image is not larger than any camera's.

    Raises:
        InputError: it has more than 100 million pixels.
    """
    if width * height > MOST_PIXELS:
        raise InputError(
            f"{where} claims {width}x{height} pixels; at most {MOST_PIXELS / 1e6:.0f} million are "
            "read. It is damaged, or no image of a camera."
        )


def header_size(
    file: Path | io.BytesIO, where: str, formats: tuple[str, ...] | None = None
) -> tuple[int, int]:
    """Return (width, height) [px] as the header says, without decoding the pixels.

    Args:
        file: the image.
        where: its name, for messages.
        formats: PIL's names of those that are looked for; None = all.

    Raises:
        InputError: it is no image.
    """
    from PIL import Image

    try:
        with Image.open(file, formats=formats) as image:
            return image.size
    except Exception as error:  # a reader of a damaged header raises nearly anything
        raise InputError(
            f"{where} is not a readable image ({type(error).__name__}: {str(error)[:200]}). Copy "
            "it again from where it came."
        ) from error
