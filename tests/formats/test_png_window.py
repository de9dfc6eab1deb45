"""PNGs of windows: any reader gives back the whole image."""

import cv2
import numpy as np
import pytest

from realsim import images
from realsim.images import png
from realsim.images.png import encode_window
from refusals import refused

WINDOWS = [
    (0, 0, 64, 48), (0, 0, 0, 0), (5, 7, 1, 1), (60, 40, 4, 8), (0, 10, 64, 3), (3, 0, 9, 48),
]  # fmt: skip


def decoded(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return image[..., ::-1] if image.ndim == 3 else image


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
