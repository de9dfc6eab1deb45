"""PNG of an image that is zero outside one window: the cost is that of the window.

A mask of one object, or a map of the objects alone, is mostly zeros. Only the window is filtered;
the zeros around it cost one pass of the deflater (0.1 ms per million). What can be read from the
file is the whole image, bit for bit. PNG: ISO/IEC 15948.
"""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats import png

DEEP_RGB = 3
"""Channels of a map with three values a pixel."""


def encode_window(
    window: NDArray[Any], origin: tuple[int, int], size: tuple[int, int]
) -> bytes:  # fmt: skip
    """Return the PNG of an image that holds `window` and is zero elsewhere.

    Args:
        window: (h, w) bool (as 0 and 255), (h, w) uint8 or uint16 grey, or (h, w, 3) uint16 RGB;
            empty for an image of zeros.
        origin: column x and row y of the window's first pixel.
        size: width and height of the image.

    Raises:
        InputError: another type, or a window that reaches out of the image.
    """
    from isal import isal_zlib

    if window.dtype == np.bool_:
        window = window.astype(np.uint8) * np.uint8(png.MASK_VALUE)
    channels = window.shape[2] if window.ndim == DEEP_RGB else 1
    bits = 8 * window.dtype.itemsize if window.dtype.kind == "u" else 0
    if window.ndim not in (2, 3) or (channels, bits) not in ((1, 8), (1, 16), (DEEP_RGB, 16)):
        raise InputError(
            f"a window of shape {window.shape} and type {window.dtype} was given; (h, w) bool, "
            "uint8 or uint16, and (h, w, 3) uint16 can be written."
        )
    (x, y), (width, height) = origin, size
    h, w = window.shape[:2]
    if x < 0 or y < 0 or x + w > width or y + h > height or width < 1 or height < 1:
        raise InputError(
            f"a window of {w}x{h} pixels at ({x}, {y}) reaches out of an image of {width}x{height}."
        )
    coding = png.MASK if bits == 8 else png.COUNTS
    data = _rows(window, (x, y), size, coding.row_filter).data
    deflate = isal_zlib.compressobj(coding.level, isal_zlib.DEFLATED, coding.window_bits)
    body = deflate.compress(data) + deflate.flush()
    color = png.COLOUR if channels == DEEP_RGB else png.GREY
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", body), (b"IEND", b""))
    return b"".join([png.SIGNATURE, *(_chunk(name, content) for name, content in chunks)])


def _rows(
    window: NDArray[Any], origin: tuple[int, int], size: tuple[int, int], row_filter: int
) -> NDArray[np.uint8]:
    """Return the filtered rows of the image, each after the byte that names its filter."""
    (x, y), (width, height) = origin, size
    h, w = window.shape[:2]
    pixel = window.dtype.itemsize * (window.shape[2] if window.ndim == DEEP_RGB else 1)
    out = np.zeros((height, 1 + width * pixel), np.uint8)
    out[:, 0] = row_filter
    if h == 0 or w == 0:
        return out
    big_endian = window.astype(">u2") if window.dtype.itemsize == 2 else window
    rows = np.ascontiguousarray(big_endian).view(np.uint8).reshape(h, w * pixel)
    columns = slice(1 + x * pixel, 1 + (x + w) * pixel)
    if row_filter == png.NONE:
        out[y : y + h, columns] = rows
        return out
    out[y, columns] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=out[y + 1 : y + h, columns])
    if y + h < height:  # the first row of zeros is predicted from the window's last
        np.subtract(0, rows[-1], out=out[y + h, columns])
    return out


def _chunk(name: bytes, data: bytes) -> bytes:
    from isal import isal_zlib

    checksum = isal_zlib.crc32(data, isal_zlib.crc32(name))
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", checksum)
