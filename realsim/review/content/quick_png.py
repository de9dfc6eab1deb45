"""Photographs and depth decoded in half the time: ISA-L inflates, compiled loops do the rest.

Most of decoding a PNG is inflating it, and the zlib in OpenCV's wheels is three times slower at
that than ISA-L. Only what sessions hold is done here, 8-bit RGB and 16-bit grey without interlace;
whatever else a file is, or is wrong with it, is left to the ordinary reader and its messages.
Specification: ISO/IEC 15948, section 9 (filtering).
"""

import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array32, UInt8
from realsim.compiled import njit
from realsim.images import MOST_PIXELS, png

CHUNK_BYTES = 12
"""Length, name and sum of a chunk."""
IHDR = struct.Struct(">IIBBBBB")
"""Width, height, bits a channel, colour type, compression, filter, interlace."""
LANES = np.uint64(255 | 255 << 21 | 255 << 42)
"""The three bytes of `_lanes`: added at once, no colour of a pixel carries over into another."""
RGB, DEPTH = (8, png.COLOUR), (16, png.GREY)
"""Bits and colour type of what sessions hold."""


def read_rgb(path: Path) -> UInt8:
    """Return a photograph (H, W, 3) uint8.

    Raises:
        InputError: missing, truncated or not an image.
    """
    rows = _rows(path, RGB, 3)
    if rows is None:
        return images.read_rgb(path)
    return rows.reshape(len(rows), -1, 3)


def read_depth(path: Path, unit_m: float) -> Array32:
    """Return a 16-bit depth image as (H, W) float32 [m], 0 = no measurement.

    Args:
        path: the PNG.
        unit_m: metres per count.

    Raises:
        InputError: missing, truncated, or not one channel of 16 bit.
    """
    rows = _rows(path, DEPTH, 2)
    if rows is None:
        return images.read_depth(path, unit_m)
    counts = rows.view(">u2").astype(np.uint16)
    return _metres(unit_m)[counts]


@lru_cache(maxsize=4)
def _metres(unit_m: float) -> Array32:
    """Return the depth (65536,) of every count [m]."""
    return (np.arange(images.DEPTH_MAX + 1) * np.float64(unit_m)).astype(np.float32)


def _rows(path: Path, kind: tuple[int, int], step: int) -> UInt8 | None:
    """Return the rows (H, bytes) of an image; None = it is for the other reader.

    Args:
        path: the PNG.
        kind: bits and colour type that are wanted.
        step: bytes of a pixel.
    """
    from isal import isal_zlib

    damaged: Any = isal_zlib.error
    try:
        header, deflated = _image_data(path.read_bytes())
        width, height, bits, colour, _, _, interlaced = IHDR.unpack(header)
        length = height * (1 + width * step)
        if (bits, colour) != kind or interlaced or not 0 < width * height <= MOST_PIXELS:
            return None
        # Not above what it can unfold into: the header's claim is no reason to fetch memory.
        raw = isal_zlib.decompress(deflated, bufsize=min(length, 1033 * len(deflated)) + 1)
    except (OSError, ValueError, struct.error, damaged):
        return None
    if len(raw) != length:
        return None
    rows = np.empty((height, width * step), np.uint8)
    return rows if _unfilter(np.frombuffer(raw, np.uint8).reshape(height, -1), rows, step) else None


def _chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Yield the chunks up to the end: name and content.

    Raises:
        ValueError: it is no PNG, or it ends early.
    """
    if not data.startswith(png.SIGNATURE):
        raise ValueError("no PNG")
    view, at = memoryview(data), len(png.SIGNATURE)
    while at + CHUNK_BYTES <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        name, start = data[at + 4 : at + 8], at + 8
        if start + length + 4 > len(data):
            break
        yield name, view[start : start + length]
        if name == b"IEND":
            return
        at = start + length + 4
    raise ValueError("truncated")


def _image_data(data: bytes) -> tuple[bytes, bytes | memoryview]:
    """Return the content of IHDR and that of all IDAT.

    Raises:
        ValueError: it is no whole PNG, or has chunks that change what the pixels look like.
    """
    header, parts = b"", list[memoryview]()
    for name, content in _chunks(data):
        if name == b"IHDR":
            header = bytes(content)
        elif name == b"IDAT":
            parts.append(content)
        elif name == b"tRNS" or (name[:1].isupper() and name != b"IEND"):
            raise ValueError("a palette, or a transparent colour")
    return header, parts[0] if len(parts) == 1 else b"".join(parts)


@njit(nogil=True)
def _paeth(a: Any, b: Any, c: Any) -> Any:
    """Return which of left, above and their corner is nearest to left + above - corner."""
    to_a, to_b, to_c = abs(b - c), abs(a - c), abs(a + b - 2 * c)
    if to_a <= to_b and to_a <= to_c:
        return a
    return b if to_b <= to_c else c


@njit(nogil=True)
def _lanes(row: Any, at: int) -> Any:
    """Return three bytes from a place on as one number, each in 21 bits of its own."""
    green, blue = np.uint64(row[at + 1]), np.uint64(row[at + 2])
    return np.uint64(row[at]) | green << np.uint64(21) | blue << np.uint64(42)


@njit(nogil=True)
def _average(coded: Any, above: Any, is_below: Any, row: Any) -> None:
    """Undo the filter Average in a row of RGB pixels, all three colours at once."""
    left = np.uint64(0)
    for x in range(len(row) // 3):
        both = left + is_below * _lanes(above, 3 * x)
        left = (_lanes(coded, 3 * x) + (both >> np.uint64(1))) & LANES
        row[3 * x] = np.uint8(left)
        row[3 * x + 1] = np.uint8(left >> np.uint64(21))
        row[3 * x + 2] = np.uint8(left >> np.uint64(42))


@njit(nogil=True)
def _unfilter(filtered: Any, rows: Any, step: int) -> bool:
    """Undo the filters of the rows; return whether all are known.

    Args:
        filtered: (H, 1 + N) every row after the byte that names its filter.
        rows: (H, N) is filled.
        step: bytes of a pixel.
    """
    height, length = rows.shape
    for y in range(height):
        kind, coded, row, above = filtered[y, 0], filtered[y, 1:], rows[y], rows[max(y - 1, 0)]
        if kind > 4:
            return False
        if kind == 0 or (kind == 2 and y == 0):
            row[:] = coded
        elif kind == 1:
            row[:step] = coded[:step]
            for x in range(step, length):
                row[x] = coded[x] + row[x - step]
        elif kind == 2:
            for x in range(length):
                row[x] = coded[x] + above[x]
        elif kind == 3 and step == 3:
            _average(coded, above, np.uint64(y > 0), row)
        elif kind == 3:
            for x in range(length):
                left = np.int32(row[x - step]) if x >= step else np.int32(0)
                up = np.int32(above[x]) if y > 0 else np.int32(0)
                row[x] = np.uint8((np.int32(coded[x]) + ((left + up) >> 1)) & 255)
        else:
            for x in range(length):
                a = np.int32(row[x - step]) if x >= step else np.int32(0)
                b = np.int32(above[x]) if y > 0 else np.int32(0)
                c = np.int32(above[x - step]) if y > 0 and x >= step else np.int32(0)
                row[x] = np.uint8((np.int32(coded[x]) + _paeth(a, b, c)) & 255)
    return True
