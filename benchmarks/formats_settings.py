"""Which PNG settings: filters, windows and levels of four encoders, on colour, depth and masks.

Part `settings` of `formats.py`: it has no figure, it prints the tables of docs/decisions/0027. Of
every kind of frame the CPU [ms] and the bytes are scaled to 1280x720 and averaged over the kinds,
so that five small frames of one data set do not outweigh another's large one.
"""

import io
import struct
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from figures import Found
from formats_frames import Picture, real, simulated
from numpy.typing import NDArray

from realsim.images import png

Image = NDArray[Any]
Encoder = Callable[[Image], bytes]
FILTERS = {"none": 0, "sub": 1, "up": 2, "average": 3, "paeth": 4}
ADAPTIVE = "adaptive"
"""Each row has the filter whose differences have the least sum, as libpng chooses."""
WINDOWS = (9, 12, 15)
ROWS_SHOWN = 14
OF_A_KIND = 2
"""Frames of one kind."""
TIMED_S, MOST_REPEATS = 0.05, 5
"""An image is encoded again until it took so long, at most so often; the least time counts."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """One way to write an image."""

    encoder: str
    words: str
    encode: Encoder


@dataclass(frozen=True, kw_only=True, slots=True)
class Cost:
    """What a setting costs a frame of 1280x720."""

    setting: Setting
    ms: float
    kb: float


def settings_table(seed: int, quick: bool) -> Found:
    """Measure all settings; print the tables; keep all rows in the JSON."""
    pictures = _few_of_each((*simulated(seed, 2), *real()))
    found = Found()
    for name, images_of in (("colour", _colours), ("depth", _depths), ("masks", _masks)):
        costs = [_cost(s, pictures, images_of) for s in _settings(name, quick=quick)]
        found.cases[f"png_{name}"] = [
            [c.setting.encoder, c.setting.words, round(c.ms, 2), round(c.kb, 1)] for c in costs
        ]
        found.notes.append(_text(name, costs))
    kinds = sorted({p.kind for p in pictures})
    found.over["settings"] = f"a frame of 1280x720, mean over {', '.join(kinds)}"
    return found


def _few_of_each(pictures: Sequence[Picture]) -> list[Picture]:
    kinds = [p.kind for p in pictures]
    return [p for k, p in enumerate(pictures) if kinds[:k].count(p.kind) < OF_A_KIND]


def _colours(picture: Picture) -> Iterator[Image]:
    yield picture.rgb


def _depths(picture: Picture) -> Iterator[Image]:
    yield picture.depth


def _masks(picture: Picture) -> Iterator[Image]:
    for mask in picture.masks[:4]:
        yield mask.astype(np.uint8) * np.uint8(255)


def _cost(
    setting: Setting,
    pictures: Sequence[Picture],
    images_of: Callable[[Picture], Iterator[Image]],
) -> Cost:
    """Return the mean over the kinds, of each the mean of its frames; of time the least."""
    by_kind: dict[str, list[tuple[float, float]]] = {}
    for picture in pictures:
        for image in images_of(picture):
            times: list[float] = []
            data = b""
            while not times or (sum(times) < TIMED_S and len(times) < MOST_REPEATS):
                start = time.process_time()
                data = setting.encode(image)
                times.append(time.process_time() - start)
            share = picture.share_of_720p
            row = (1e3 * min(times) / share, len(data) / 1e3 / share)
            by_kind.setdefault(picture.kind, []).append(row)
    means = np.mean([np.mean(rows, axis=0) for rows in by_kind.values()], axis=0)
    return Cost(setting=setting, ms=float(means[0]), kb=float(means[1]))


def _settings(kind: str, *, quick: bool) -> Iterator[Setting]:
    """Yield the settings: ours first."""
    yield Setting(encoder="realsim", words="as it is", encode=png.encode_png)
    filters = ("none", "average") if quick else (*FILTERS, ADAPTIVE)
    windows = (9, 15) if quick else WINDOWS
    for row_filter, bits, level in product(filters, windows, (1,) if quick else (0, 1, 2, 3)):
        yield Setting(
            encoder="ISA-L",
            words=f"{row_filter}, 2^{bits}, level {level}",
            encode=lambda i, f=row_filter, b=bits, n=level: _isal(i, f, b, n),
        )
    if not quick:
        strategies = {"": zlib.Z_DEFAULT_STRATEGY, ", huffman": zlib.Z_HUFFMAN_ONLY,
                      ", runs": zlib.Z_RLE}  # fmt: skip
        for row_filter, level, (word, code) in product(
            ("none", "up", "average", ADAPTIVE), (1, 6), strategies.items()
        ):
            if level == 1 or not word:  # those strategies have no levels
                yield Setting(
                    encoder="zlib", words=f"{row_filter}, level {level}{word}",
                    encode=lambda i, f=row_filter, n=level, c=code: _zlib(i, f, n, c),
                )  # fmt: skip
    yield from _opencv(kind, quick=quick)
    for level in (1, 6) if quick else (1, 3, 6, 9):
        yield Setting(
            encoder="Pillow", words=f"level {level}", encode=lambda i, n=level: _pillow(i, n)
        )


def _opencv(kind: str, *, quick: bool) -> Iterator[Setting]:
    import cv2

    yield Setting(encoder="OpenCV", words="default", encode=lambda i: opencv_png(i, ()))
    for level in (1, 3) if quick else (1, 2, 3, 6, 9):
        flags = (cv2.IMWRITE_PNG_COMPRESSION, level)
        yield Setting(
            encoder="OpenCV", words=f"level {level}", encode=lambda i, f=flags: opencv_png(i, f)
        )
    strategies = {} if quick else {
        "default": cv2.IMWRITE_PNG_STRATEGY_DEFAULT, "filtered": cv2.IMWRITE_PNG_STRATEGY_FILTERED,
        "huffman": cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY, "runs": cv2.IMWRITE_PNG_STRATEGY_RLE,
    }  # fmt: skip
    filters = {
        "up": cv2.IMWRITE_PNG_FILTER_UP, "average": cv2.IMWRITE_PNG_FILTER_AVG,
        "adaptive": cv2.IMWRITE_PNG_ALL_FILTERS, "none": cv2.IMWRITE_PNG_FILTER_NONE,
    }  # fmt: skip
    for (s, strategy), (f, code) in product(strategies.items(), filters.items()):
        flags = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, strategy,
                 cv2.IMWRITE_PNG_FILTER, code)  # fmt: skip
        yield Setting(
            encoder="OpenCV", words=f"level 1, {s}, {f}",
            encode=lambda i, given=flags: opencv_png(i, given),
        )  # fmt: skip
    if kind == "masks":
        flags = (cv2.IMWRITE_PNG_BILEVEL, 1)
        yield Setting(encoder="OpenCV", words="1 bit", encode=lambda i: opencv_png(i, flags))


def opencv_png(image: Image, flags: tuple[int, ...]) -> bytes:
    """Return OpenCV's PNG; the channels of RGB are exchanged first, as its callers have to."""
    import cv2

    given = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    done, data = cv2.imencode(".png", given, list(flags))
    assert done
    return data.tobytes()


def _pillow(image: Image, level: int) -> bytes:
    from PIL import Image as pillow

    buffer = io.BytesIO()
    pillow.fromarray(image).save(buffer, "PNG", compress_level=level)
    return buffer.getvalue()


# --- an encoder with every filter ---------------------------------------------------------------


def _isal(image: Image, row_filter: str, window_bits: int, level: int) -> bytes:
    from isal import isal_zlib

    deflate = isal_zlib.compressobj(level, isal_zlib.DEFLATED, window_bits)
    data = deflate.compress(_rows(image, row_filter)) + deflate.flush()
    return _file(image, data)


def _zlib(image: Image, row_filter: str, level: int, strategy: int) -> bytes:
    deflate = zlib.compressobj(level, zlib.DEFLATED, 15, 9, strategy)
    data = deflate.compress(_rows(image, row_filter)) + deflate.flush()
    return _file(image, data)


def _file(image: Image, data: bytes) -> bytes:
    colour = png.COLOUR if image.ndim == 3 else png.GREY
    head = struct.pack(
        ">IIBBBBB", image.shape[1], image.shape[0], 8 * image.itemsize, colour, 0, 0, 0
    )
    body = b"".join(
        struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d))
        for n, d in ((b"IHDR", head), (b"IDAT", data), (b"IEND", b""))
    )
    return png.SIGNATURE + body


def _rows(image: Image, row_filter: str) -> NDArray[np.uint8]:
    """Return the filtered rows (H, N + 1), the filter's byte first."""
    step = image.itemsize * (3 if image.ndim == 3 else 1)
    pixels = image.astype(">u2") if image.itemsize == 2 else image
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(image), -1)
    if row_filter in FILTERS:
        number = FILTERS[row_filter]
        return _with_number(_differences(rows, step, number), number)
    parts = np.stack([_differences(rows, step, n) for n in FILTERS.values()])
    # |x| of the difference as a signed byte
    least = np.abs(parts.view(np.int8).astype(np.int16)).sum(axis=2, dtype=np.int64).argmin(axis=0)
    return _with_number(parts[least, np.arange(len(rows))], least)


def _with_number(body: NDArray[np.uint8], number: Any) -> NDArray[np.uint8]:
    out = np.empty((body.shape[0], body.shape[1] + 1), np.uint8)
    out[:, 0], out[:, 1:] = number, body
    return out


def _differences(rows: NDArray[np.uint8], step: int, number: int) -> NDArray[np.uint8]:
    """Return the rows (H, N) less their prediction; ISO/IEC 15948, 9.2."""
    if number == FILTERS["none"]:
        return rows
    up = np.zeros_like(rows)
    up[1:] = rows[:-1]
    if number == FILTERS["up"]:
        return rows - up
    left = np.zeros_like(rows)
    left[:, step:] = rows[:, :-step]
    if number == FILTERS["sub"]:
        return rows - left
    if number == FILTERS["average"]:
        return rows - ((left & up) + ((left ^ up) >> 1))
    corner = np.zeros_like(rows)
    corner[1:, step:] = rows[:-1, :-step]
    a, b, c = (x.astype(np.int16) for x in (left, up, corner))
    pa, pb, pc = np.abs(b - c), np.abs(a - c), np.abs(a + b - 2 * c)
    nearest = np.where((pa <= pb) & (pa <= pc), left, np.where(pb <= pc, up, corner))
    return rows - nearest


# --- the tables ---------------------------------------------------------------------------------


def _text(name: str, costs: list[Cost]) -> str:
    """Return the settings that none is both quicker and smaller than, and the named ones."""
    ours = costs[0]
    best = [c for c in costs if not any(o.ms < c.ms and o.kb < c.kb for o in costs)]
    named = [c for c in costs if c.setting.encoder in ("OpenCV", "Pillow")]
    shown = {id(c): c for c in (ours, *best, *named[: ROWS_SHOWN - 6])}
    lines = [f"{name}: the encoder's way, CPU ms, kB; * = none is quicker and smaller"]
    for c in sorted(shown.values(), key=lambda c: c.ms):
        star = "*" if c in best else " "
        words = f"{c.setting.encoder}, {c.setting.words}"
        lines.append(f"  {star} {words:40} {c.ms:8.2f} {c.kb:9.1f}")
    return "\n".join(lines)
