"""Images as files: 8-bit colour, 16-bit depth, masks; a broken file is an error that names it."""

import contextlib
import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array32, UInt8, UInt16
from realsim.errors import InputError
from realsim.images import png
from realsim.untrusted.files import require_permission

PNG_END = b"IEND\xaeB`\x82"
DEPTH_MAX = 65535
RGB_CHANNELS = 3
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


def png_bytes(image: NDArray[Any]) -> bytes:
    """Return an image as PNG: (H, W, 3) uint8 RGB, (H, W) uint8, bool (as 0/255) or uint16.

    Raises:
        InputError: another shape or type.
    """
    return png.encode_png(image)


def _decoded(path: Path, flags: int) -> NDArray[Any]:
    import cv2

    if not path.is_file():
        raise InputError(f"{path} does not exist; an image was expected there.")
    require_permission(path)
    data = path.read_bytes()
    # The end is looked for, so that the message can say 'truncated', whatever the decoder does.
    torn = data.startswith(png.SIGNATURE) and PNG_END not in data[-32:]
    image: Any = None
    if data and not torn:
        require_decodable(data, str(path))
        with contextlib.suppress(cv2.error):  # of files that end within a header
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    if image is None:
        raise InputError(
            f"{path} is {'truncated' if torn or not data else 'not a readable image'} "
            f"({len(data)} bytes). Copy the file again from where it came; of a capture, delete it "
            "and its view, and capture the view again."
        )
    return np.asarray(image)


def read_rgb(path: Path | str) -> UInt8:
    """Return an image file as (H, W, 3) uint8 RGB; grey images have three equal channels.

    Raises:
        InputError: missing, truncated or not an image.
    """
    import cv2

    bgr = _decoded(Path(path), cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_image(path: Path | str) -> NDArray[Any]:
    """Return an image file as it is: (H, W, 3) uint8 RGB, or (H, W) of 8 or 16 bit."""
    import cv2

    image = _decoded(Path(path), cv2.IMREAD_UNCHANGED)
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image[..., :RGB_CHANNELS], cv2.COLOR_BGR2RGB))


def read_grey(path: Path | str) -> UInt8:
    """Return an image file as (H, W) uint8, e.g. a mask."""
    import cv2

    return np.asarray(_decoded(Path(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def read_depth(path: Path | str, unit_m: float) -> Array32:
    """Return a 16-bit depth image as (H, W) float32 metres, 0 = no measurement.

    Args:
        path: the PNG.
        unit_m: metres per count.

    Raises:
        InputError: missing, truncated, or not one channel of 16 bit.
    """
    return (read_counts(path) * np.float64(unit_m)).astype(np.float32)


def read_counts(path: Path | str) -> UInt16:
    """Return a 16-bit depth image (H, W) as it is stored.

    Raises:
        InputError: missing, truncated, or not one channel of 16 bit.
    """
    image = read_image(path)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(
            f"{path} has the shape {image.shape} and the type {image.dtype}; a depth image is one "
            "channel of 16 bit. Is it a colour picture of the depth? Convert it, or leave it out."
        )
    return image


def depth_counts(depth_m: NDArray[Any], unit_m: float) -> UInt16:
    """Return depth (H, W) [m] as 16-bit counts; what does not fit becomes 0 = no measurement.

    Counted in the type of `depth_m`: of float32, whole counts come back exactly (to 0.004 of one).
    """
    is_single = depth_m.dtype == np.float32
    counts = np.divide(depth_m, unit_m, dtype=np.float32 if is_single else np.float64)
    np.rint(counts, out=counts)
    fits = (counts > 0) & (counts <= DEPTH_MAX)
    counts[~fits] = 0
    return counts.astype(np.uint16)


def image_size(path: Path | str) -> tuple[int, int]:
    """Return (width, height) of an image file without decoding its pixels.

    Raises:
        InputError: missing, not an image, or of more than 100 million pixels.
    """
    path = Path(path)
    require_permission(path)
    size = header_size(path, str(path))
    require_few_pixels(*size, str(path))
    return size


def resized(picture: UInt8, width_px: int) -> UInt8:
    """Return a picture at another width, every pixel the mean of what it covers."""
    import cv2

    height = max(1, round(picture.shape[0] * width_px / picture.shape[1]))
    made = cv2.resize(picture, (width_px, height), interpolation=cv2.INTER_AREA)
    return np.asarray(made, dtype=np.uint8)


# --- what a header claims, looked at before a decoder allocates it -------------------------------


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
