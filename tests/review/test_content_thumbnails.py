"""Small photographs that are kept, and the quick decoder: always what the slow way gives."""

import re
import struct
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from realsim import InputError, images
from realsim.review.content import quick_png
from realsim.review.content.content import FOLDER, Thumbnails, thumbnail
from realsim.store import SessionStore
from reviewed_boxes import boxes_session

INDICES = (0, 1, 2, 3)
FILTERS = (0, 1, 2, 3, 4)


@pytest.fixture
def store(tmp_path: Path) -> SessionStore:
    return boxes_session(tmp_path / "boxes")


def opened(store: SessionStore, width_px: int = 40, quality: int = 70) -> Thumbnails:
    return Thumbnails(SessionStore.open(store.folder), width_px, quality)


def fresh(store: SessionStore, index: int, width_px: int = 40, quality: int = 70) -> bytes:
    return thumbnail(store.rgb(index), width_px, quality)


def flipped(data: bytes, place: int) -> bytes:
    """Return bytes of which one is another."""
    return data[:place] + bytes([data[place] ^ 0x10]) + data[place + 1 :]


# --- what is kept -----------------------------------------------------------------------------


def test_the_kept_ones_equal_fresh_ones_and_nothing_is_decoded_for_them(
    store: SessionStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = dict(opened(store).of(INDICES, {}))
    assert first == {i: fresh(store, i) for i in INDICES}
    before = {p: p.stat().st_mtime_ns for p in (store.folder / FOLDER).iterdir()}
    assert len(before) == len(INDICES)
    for index in INDICES:  # a photograph that were read would be an error
        (store.folder / f"rgb/{index:06d}.png").write_bytes(b"gone")
    assert dict(Thumbnails(store, 40, 70).of(INDICES, {})) == first
    assert {p: p.stat().st_mtime_ns for p in (store.folder / FOLDER).iterdir()} == before


@pytest.mark.parametrize("damage", ["cut", "flipped", "emptied", "other", "unsigned", "swapped"])
def test_a_damaged_or_foreign_one_is_made_anew(store: SessionStore, damage: str) -> None:
    opened(store).of(INDICES, {})
    file = store.folder / FOLDER / "000001.jpg"
    whole = file.read_bytes()
    spoiled = {
        "cut": whole[: len(whole) // 2], "flipped": flipped(whole, len(whole) // 3), "emptied": b"",
        "other": b"not a picture", "unsigned": whole[: whole.rfind(b"\nrealsim ")],
        "swapped": (store.folder / FOLDER / "000002.jpg").read_bytes(),
    }  # fmt: skip
    file.write_bytes(spoiled[damage])
    assert opened(store).of([1], {})[1] == fresh(store, 1)
    assert file.read_bytes() == whole


def test_one_of_another_photograph_size_or_quality_is_made_anew(store: SessionStore) -> None:
    opened(store).of(INDICES, {})
    assert opened(store, 20).of([0], {})[0] == fresh(store, 0, 20)
    assert opened(store, 20, 90).of([0], {})[0] == fresh(store, 0, 20, 90)
    darker = (store.rgb(3) // 2).astype(np.uint8)
    store.write_bytes("rgb/000003.png", images.png_bytes(darker))
    assert opened(store).of([3], {})[3] == thumbnail(darker, 40, 70)


def test_progress_comes_to_its_end_and_a_missing_photograph_is_named(store: SessionStore) -> None:
    steps: list[tuple[int, int]] = []
    opened(store).of(INDICES, {}, lambda done, of: steps.append((done, of)))
    assert steps == [(k, 4) for k in (1, 2, 3, 4)]
    (store.folder / "rgb/000002.png").write_bytes(b"\x89PNG\r\n\x1a\n damaged")
    (store.folder / FOLDER / "000002.jpg").unlink()
    damaged: dict[int, str] = {}
    assert list(Thumbnails(store, 40, 70).of(INDICES, damaged)) == [0, 1, 3]
    assert list(damaged) == [2] and "000002.png" in damaged[2]


# --- the quick decoder ------------------------------------------------------------------------


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png_of(rows: np.ndarray, width: int, bits: int, colour: int, parts: int = 1) -> bytes:
    """Return a PNG of rows that are filtered already: whatever they mean, it is a valid file."""
    header = struct.pack(">IIBBBBB", width, len(rows), bits, colour, 0, 0, 0)
    data = zlib.compress(rows.tobytes(), 6)
    cuts = np.linspace(0, len(data), parts + 1).astype(int)
    idat = b"".join(chunk(b"IDAT", data[a:b]) for a, b in pairwise(cuts))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + idat + chunk(b"IEND", b"")


@pytest.mark.parametrize("row_filter", [*FILTERS, None])
def test_all_row_filters_are_undone_as_opencv_does(tmp_path: Path, row_filter: int | None) -> None:
    rng = np.random.default_rng(0)
    for width, height, bits, colour, step in ((7, 9, 8, 2, 3), (1, 1, 8, 2, 3), (33, 5, 16, 0, 2)):
        rows = rng.integers(0, 256, (height, 1 + width * step), dtype=np.uint8)
        rows[:, 0] = rng.integers(0, 5, height) if row_filter is None else row_filter
        path = tmp_path / f"{width}_{bits}.png"
        path.write_bytes(png_of(rows, width, bits, colour, parts=1 + width % 3))
        assert quick_png._rows(path, (bits, colour), step) is not None  # type: ignore[reportPrivateUsage]
        if bits == 8:
            np.testing.assert_array_equal(quick_png.read_rgb(path), images.read_rgb(path))
        else:
            ours = quick_png.read_depth(path, 2.5e-4)
            np.testing.assert_array_equal(ours, images.read_depth(path, 2.5e-4))
            assert ours.dtype == np.float32


@pytest.mark.parametrize("kind", ["alpha", "palette", "jpeg", "depth"])
def test_other_files_come_out_as_the_ordinary_reader_has_them(tmp_path: Path, kind: str) -> None:
    from PIL import Image

    rgb = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    path = tmp_path / "image.png"
    if kind == "depth":
        path.write_bytes(images.png_bytes(rgb[..., 0].astype(np.uint16)))
    else:
        mode = {"grey": "L", "alpha": "RGBA", "palette": "P", "jpeg": "RGB"}[kind]
        Image.fromarray(rgb).convert(mode).save(path, "JPEG" if kind == "jpeg" else "PNG")
    np.testing.assert_array_equal(quick_png.read_rgb(path), images.read_rgb(path))


@pytest.mark.parametrize("damage", ["cut", "flipped", "filter", "claim", "empty", "text", "gone"])
def test_damaged_files_are_the_ordinary_readers_errors(tmp_path: Path, damage: str) -> None:
    rng = np.random.default_rng(0)
    rows = rng.integers(0, 256, (20, 91), dtype=np.uint8)
    rows[:, 0] = 9 if damage == "filter" else 3
    data = png_of(rows, 30, 8, 2)
    spoiled = {
        "cut": data[:-30], "flipped": flipped(data, len(data) // 2), "filter": data,
        "claim": data[:16] + struct.pack(">II", 200_000, 400) + data[24:], "empty": b"",
        "text": b"hello",
    }  # fmt: skip
    path = tmp_path / "image.png"
    if damage != "gone":
        path.write_bytes(spoiled[damage])
    try:
        expected = images.read_rgb(path)
    except InputError as error:
        with pytest.raises(InputError) as ours:
            quick_png.read_rgb(path)
        address = r"0x[0-9a-f]+"
        assert re.sub(address, "", str(ours.value)) == re.sub(address, "", str(error))
    else:  # OpenCV shows what it could read of it
        np.testing.assert_array_equal(quick_png.read_rgb(path), expected)
