"""What the header of an image claims is looked at before anything is decoded."""

import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim import images
from realsim.formats.bags.pixels import kind_of, rgb_of
from realsim.formats.bags.wire import ImageMessage
from realsim.formats.folders.listing import image_header
from realsim.images import require_decodable
from refusals import refused

RGB = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
ENDINGS = ("png", "jpg", "tif", "webp", "bmp", "ppm")


def claiming(width: int, height: int) -> bytes:
    """Return a PNG of few bytes whose header claims so many pixels, with the right checksums."""

    def chunk(name: bytes, data: bytes) -> bytes:
        body = name + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(100_000))
    end = chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + end


def jpeg_claiming(width: int, height: int) -> bytes:
    """Return a JPEG whose frame header claims so many pixels."""
    data = bytearray(cv2.imencode(".jpg", RGB)[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_kind_that_was_read_is_read(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    assert cv2.imwrite(str(path), RGB[..., ::-1])
    found = images.read_rgb(path)
    assert found.shape == RGB.shape
    assert ending in ("jpg", "webp") or np.array_equal(found, RGB)
    assert images.image_size(path) == (40, 30)


@pytest.mark.parametrize(
    "data",
    [claiming(60_000, 60_000), claiming(2**31 - 1, 2**31 - 1), jpeg_claiming(65_000, 65_000)],
    ids=["png", "huge png", "jpeg"],
)
def test_sixty_thousand_by_sixty_thousand_pixels_are_refused_at_once(
    tmp_path: Path, data: bytes
) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        for read in (images.read_rgb, images.read_grey, images.read_image, images.image_size):
            refused(r"a\.png", read, path)
        refused(r"a\.png", images.read_depth, path, 1e-3)
        refused(r"a\.png", image_header, path)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


def test_a_png_that_claims_more_than_its_bytes_can_hold_is_refused() -> None:
    require_decodable(claiming(100, 100), "x")
    refused("too few", require_decodable, claiming(9_000, 9_000), "x")


def test_the_largest_cameras_images_are_not_refused(tmp_path: Path) -> None:
    data = cv2.imencode(".png", np.zeros((8_000, 12_000), np.uint8))[1].tobytes()
    require_decodable(data, "x")
    (path := tmp_path / "large.png").write_bytes(data)
    assert images.image_size(path) == (12_000, 8_000)


@pytest.mark.parametrize(
    "data", [b"", b"\x89PNG\r\n\x1a\n", b"BM", b"\xff\xd8\xff", b"P6 9", b"GIF89a"]
)
def test_heads_alone_are_no_images(data: bytes) -> None:
    refused("not a readable image", require_decodable, data, "x")


# --- messages of recordings -----------------------------------------------------------------------


def message(pixels: bytes, encoding: str, width: int, height: int, step: int) -> ImageMessage:
    return ImageMessage(
        stamp_ns=0, frame_id="c", encoding=encoding, pixels=np.frombuffer(pixels, np.uint8),
        width=width, height=height, step=step,
    )  # fmt: skip


def test_a_compressed_message_that_claims_gigapixels_is_no_picture() -> None:
    sent = message(claiming(60_000, 60_000), "rgb8; png compressed", 0, 0, 0)
    assert kind_of(sent, compressed=True).kind == "other"
    refused("topic", rgb_of, sent, compressed=True, name="topic")


def test_a_row_that_claims_gigabytes_of_padding_costs_none() -> None:
    row = RGB[:1].tobytes()
    tracemalloc.start()
    try:
        found = rgb_of(message(row, "rgb8", 40, 1, 2**31), compressed=False, name="topic")
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()
    assert np.array_equal(found, RGB[:1])
