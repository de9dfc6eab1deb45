"""PNG files hold every pixel, for every reader, in few bytes, whole or of a window.

What the header of an image claims is looked at before anything is decoded.
"""

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import bounded_memory
from realsim import images
from realsim.formats.bags.pixels import kind_of, rgb_of
from realsim.formats.bags.wire import ImageMessage
from realsim.formats.folders.listing import image_header
from realsim.images import png, png_bytes, read_depth, read_image, require_decodable
from realsim.images.png import encode_png, encode_window
from refusals import refused

KINDS = ("rgb", "grey", "mask", "counts")


def image_of(kind, height, width, texture, seed):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    smooth = (37 * x + 91 * y + (x * y) // 7) % 65536
    values = {
        "noise": rng.integers(0, 65536, (height, width)),
        "smooth": smooth,
        "flat": np.full((height, width), int(rng.integers(0, 65536))),
        "ends": rng.choice([0, 255, 256, 65535], (height, width)),
    }[texture]
    if kind == "counts":
        return values.astype(np.uint16)
    if kind == "mask":
        return values % 2 == 1
    grey = (values % 256).astype(np.uint8)
    return grey if kind == "grey" else np.stack([grey, grey[::-1], 255 - grey], axis=-1)


def strict(data):
    """Decode by the specification, refusing what a strict reader may refuse."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    place, chunks = 8, []
    while place < len(data):
        (length,) = struct.unpack(">I", data[place : place + 4])
        name, body = data[place + 4 : place + 8], data[place + 8 : place + 8 + length]
        crc = data[place + 8 + length : place + 12 + length]
        assert struct.unpack(">I", crc)[0] == zlib.crc32(name + body)
        chunks.append((name, body))
        place += 12 + length
    assert place == len(data) and [n for n, _ in chunks] == [b"IHDR", b"IDAT", b"IEND"]
    width, height, bits, colour, *others = struct.unpack(">IIBBBBB", chunks[0][1])
    assert others == [0, 0, 0]  # method, filters, interlace
    step = {0: 1, 2: 3}[colour] * bits // 8
    stream = chunks[1][1]
    # A reader that trusts the header's window keeps no more than that of what it has decoded.
    window = 8 + (stream[0] >> 4)
    decoder, raw = zlib.decompressobj(window), b""
    for k in range(0, len(stream), 61):
        raw += decoder.decompress(stream[k : k + 61])
    raw += decoder.flush()
    assert decoder.eof and not decoder.unused_data
    rows = np.frombuffer(raw, np.uint8).reshape(height, width * step + 1)
    out = np.zeros((height, width * step + step), np.uint8)  # `step` bytes of 0 at the left
    for k, row in enumerate(rows):
        up = out[k - 1] if k else np.zeros_like(out[0])
        for i in range(step, width * step + step):
            value, a, b = int(row[i - step + 1]), int(out[k, i - step]), int(up[i])
            out[k, i] = (value + {0: 0, 1: a, 2: b, 3: (a + b) // 2}[int(row[0])]) % 256
    pixels = np.ascontiguousarray(out[:, step:])
    if bits == 16:
        return pixels.view(">u2").astype(np.uint16)
    return pixels.reshape(height, width, 3) if colour == 2 else pixels


def decoded(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return image[..., ::-1] if image.ndim == 3 else image


@settings(max_examples=25, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    texture=st.sampled_from(("noise", "smooth", "flat", "ends")),
    seed=st.integers(0, 2**16),
    view=st.sampled_from(("whole", "every other", "backwards", "transposed")),
)
def test_every_pixel_comes_back_from_every_reader(kind, height, width, texture, seed, view):
    image = image_of(kind, height, width, texture, seed)
    image = {
        "whole": image,
        "every other": image[::2, ::2],
        "backwards": image[::-1, ::-1],
        "transposed": image.swapaxes(0, 1),
    }[view]
    data = encode_png(image)
    assert data == encode_png(image.copy())
    expected = image.astype(np.uint8) * 255 if image.dtype == bool else image
    assert np.array_equal(strict(data), expected)
    read = decoded(data)
    assert read.dtype == expected.dtype and np.array_equal(read, expected)
    with Image.open(io.BytesIO(data)) as opened:
        opened.load()
        grey = "L" if expected.itemsize == 1 else "I;16"
        assert opened.mode == ("RGB" if expected.ndim == 3 else grey)
        assert np.array_equal(np.asarray(opened), expected)


def test_big_endian_counts_keep_their_values(tmp_path):
    counts = (np.arange(60).reshape(6, 10) * 1000).astype(">u2")
    (tmp_path / "d.png").write_bytes(png_bytes(counts))
    assert np.array_equal(read_image(tmp_path / "d.png"), counts.astype(np.uint16))
    assert read_depth(tmp_path / "d.png", 1e-4)[5, 9] == pytest.approx(5.9)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((4, 4, 3), np.uint16),
        np.zeros((4, 4), np.float32),
        np.zeros((4, 4, 3), bool),
        np.zeros(4, np.uint8),
        np.zeros((0, 4), np.uint8),
        np.zeros((4, 0, 3), np.uint8),
    ],
)
def test_what_png_cannot_hold_is_refused(image):
    refused(r"(can|cannot) be written", encode_png, image)


WINDOWS = [
    (0, 0, 64, 48), (0, 0, 0, 0), (5, 7, 1, 1), (60, 40, 4, 8), (0, 10, 64, 3), (3, 0, 9, 48),
]  # fmt: skip


@pytest.mark.parametrize(("x", "y", "w", "h"), WINDOWS)
@pytest.mark.parametrize("kind", ["bool", "grey", "deep", "rgb"])
def test_the_image_comes_back_with_zeros_around_the_window(x, y, w, h, kind):
    rng = np.random.default_rng(w * h)
    window = {
        "bool": rng.random((h, w)) < 0.5,
        "grey": rng.integers(0, 256, (h, w), np.uint8),
        "deep": rng.integers(0, 65536, (h, w), np.uint16),
        "rgb": rng.integers(0, 65536, (h, w, 3), np.uint16),
    }[kind]
    whole = np.zeros((48, 64, *window.shape[2:]), window.dtype)
    whole[y : y + h, x : x + w] = window
    data = encode_window(window, (x, y), (64, 48))
    expected = whole.astype(np.uint8) * 255 if kind == "bool" else whole
    np.testing.assert_array_equal(decoded(data), expected)
    assert data == encode_window(window, (x, y), (64, 48))
    if kind != "rgb":
        np.testing.assert_array_equal(decoded(png.encode_png(whole)), decoded(data))


def test_a_mask_is_read_back_by_the_repositorys_own_reader(tmp_path):
    path = tmp_path / "mask.png"
    path.write_bytes(encode_window(np.ones((3, 4), bool), (2, 1), (10, 8)))
    assert np.count_nonzero(images.read_grey(path)) == 12


@pytest.mark.parametrize(("window", "origin", "said"), [
    (np.ones((4, 4), bool), (62, 0), "reaches out"),
    (np.ones((4, 4), bool), (-1, 0), "reaches out"),
    (np.ones((4, 4), np.float32), (0, 0), "can be written"),
    (np.ones((4, 4, 3), np.uint8), (0, 0), "can be written"),
])  # fmt: skip
def test_what_cannot_be_written_is_named(window, origin, said):
    refused(said, encode_window, window, origin, (64, 48))


# --- what headers claim ---------------------------------------------------------------------------


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
    with bounded_memory.below(20e6):
        for read in (images.read_rgb, images.read_grey, images.read_image, images.image_size):
            refused(r"a\.png", read, path)
        refused(r"a\.png", images.read_depth, path, 1e-3)
        refused(r"a\.png", image_header, path)


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
    with bounded_memory.below(1e6):
        found = rgb_of(message(row, "rgb8", 40, 1, 2**31), compressed=False, name="topic")
    assert np.array_equal(found, RGB[:1])
