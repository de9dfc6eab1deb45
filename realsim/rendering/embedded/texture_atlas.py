"""All images of a scene in one buffer, with their halvings, read by the shading kernels.

Values stay 8 bit; colours are averaged as linear light and stored as sRGB again, which is finer
than the picture that is made of them. A look-up averages over the footprint of the pixel: between
two halvings, with several probes along the longer side where the surface is seen obliquely.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from realsim.rendering.developing import srgb_decoded, srgb_encoded

Array32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
MOST_HALVINGS = 16
MOST_PROBES = 6
"""Footprints longer than this many times their width are read somewhat blurred."""


class TextureArrays(NamedTuple):
    """The images as the kernels read them."""

    texels: UInt8
    """All values of all halvings of all images."""
    layout: NDArray[np.int64]
    """(T, MOST_HALVINGS, 3) first value, rows and columns of each halving."""
    halvings: NDArray[np.int64]
    """(T,) number of halvings, the image itself included."""
    channels: NDArray[np.int64]
    """(T,) values per texel, 1 or 3."""
    wraps: NDArray[np.bool_]
    """(T,) whether the image repeats; else its border continues."""
    decode: Array32
    """(2, 256) values as stored: linear in [0, 1], and sRGB decoded."""
    is_srgb: NDArray[np.int64]
    """(T,) row of `decode`."""


class TextureAtlas:
    """Collects images; the same image under the same reading is kept once."""

    def __init__(self) -> None:
        """Begin without images."""
        self._index: dict[tuple[int, bool, bool], int] = {}
        self._kept: list[UInt8] = []
        self._images: list[list[UInt8]] = []
        self._srgb: list[bool] = []
        self._wraps: list[bool] = []

    def add(self, image: UInt8 | None, *, srgb: bool, wrap: bool) -> int:
        """Return the number of an image (H, W) or (H, W, 3), first row at v = 1; -1 = None."""
        if image is None:
            return -1
        key = (id(image), srgb, wrap)
        if key not in self._index:
            self._index[key] = len(self._images)
            self._kept.append(image)  # an id is only good as long as its object lives
            self._images.append(_halvings(image, srgb))
            self._srgb.append(srgb)
            self._wraps.append(wrap)
        return self._index[key]

    def arrays(self) -> TextureArrays:
        """Return the buffer."""
        n = len(self._images)
        layout = np.zeros((max(n, 1), MOST_HALVINGS, 3), np.int64)
        first = 0
        for i, images in enumerate(self._images):
            for k, image in enumerate(images):
                layout[i, k] = first, image.shape[0], image.shape[1]
                first += image.size
        flat = [a.ravel() for images in self._images for a in images]
        ramp = np.arange(256) / 255.0
        return TextureArrays(
            texels=np.concatenate(flat) if flat else np.zeros(1, np.uint8),
            layout=layout,
            halvings=np.array([len(images) for images in self._images] or [1], np.int64),
            channels=np.array([1 if a[0].ndim == 2 else 3 for a in self._images] or [1], np.int64),
            wraps=np.array(self._wraps or [False], np.bool_),
            decode=np.stack([ramp, srgb_decoded(ramp)]).astype(np.float32),
            is_srgb=np.array([int(s) for s in self._srgb] or [0], np.int64),
        )

    def mean(self, index: int) -> NDArray[np.float64]:
        """Return the mean (3,) of an image as decoded values."""
        coarse = self._images[index][-1] / 255.0
        value = srgb_decoded(coarse) if self._srgb[index] else coarse
        flat = np.asarray(value, np.float64).reshape(-1, 1 if value.ndim == 2 else 3).mean(0)
        return np.broadcast_to(flat, (3,)).copy()


def _halvings(image: UInt8, srgb: bool) -> list[UInt8]:
    """Return the image and its halvings, down to one row or column."""
    import cv2

    out = [np.ascontiguousarray(image)]
    ramp = np.arange(256, dtype=np.float32) / np.float32(255)
    value = (srgb_decoded(ramp).astype(np.float32) if srgb else ramp)[image]
    while min(value.shape[:2]) > 1 and len(out) < MOST_HALVINGS:
        size = (max(1, value.shape[1] // 2), max(1, value.shape[0] // 2))
        value = np.asarray(cv2.resize(value, size, interpolation=cv2.INTER_AREA), np.float32)
        stored = srgb_encoded(value) if srgb else value
        out.append(np.round(255.0 * stored).astype(np.uint8))
    return out


@numba.njit(cache=True, inline="always", error_model="numpy")  # pyright: ignore[reportUntypedFunctionDecorator]
def _bilinear(tex: TextureArrays, i: int, k: int, u: float, v: float) -> tuple[float, float, float]:
    """Return the value of halving k of image i at texture coordinates, v up."""
    first, rows, columns = tex.layout[i, k]
    lut, channels = tex.decode[tex.is_srgb[i]], tex.channels[i]
    s, t = u, 1.0 - v
    if tex.wraps[i]:
        s, t = s - np.floor(s), t - np.floor(t)
    x, y = s * columns - 0.5, t * rows - 0.5
    x, y = min(max(x, -0.5), columns - 0.5), min(max(y, -0.5), rows - 0.5)
    c0, r0 = int(np.floor(x)), int(np.floor(y))
    a, b = x - c0, y - r0
    c1, r1 = c0 + 1, r0 + 1
    if tex.wraps[i]:
        c0, r0 = c0 if c0 >= 0 else columns - 1, r0 if r0 >= 0 else rows - 1
        c1, r1 = c1 if c1 < columns else 0, r1 if r1 < rows else 0
    else:
        c0, c1, r0, r1 = max(c0, 0), min(c1, columns - 1), max(r0, 0), min(r1, rows - 1)
    p = first + (r0 * columns + c0) * channels
    q = first + (r0 * columns + c1) * channels
    m = first + (r1 * columns + c0) * channels
    n = first + (r1 * columns + c1) * channels
    wp, wq, wm, wn = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    z = tex.texels
    red = wp * lut[z[p]] + wq * lut[z[q]] + wm * lut[z[m]] + wn * lut[z[n]]
    if channels == 1:
        return red, red, red
    green = wp * lut[z[p + 1]] + wq * lut[z[q + 1]] + wm * lut[z[m + 1]] + wn * lut[z[n + 1]]
    blue = wp * lut[z[p + 2]] + wq * lut[z[q + 2]] + wm * lut[z[m + 2]] + wn * lut[z[n + 2]]
    return red, green, blue


@numba.njit(cache=True, error_model="numpy")  # pyright: ignore[reportUntypedFunctionDecorator]
def texture_at(
    tex: TextureArrays, i: int, at: tuple[float, float], du: tuple[float, float],
    dv: tuple[float, float], most_probes: int,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the mean of image i over a footprint.

    Args:
        tex: the images.
        i: number of the image.
        at: texture coordinates of its middle.
        du: change of the coordinates over the pixel's width.
        dv: change over its height.
        most_probes: look-ups along the longer side, at most.
    """
    rows, columns = tex.layout[i, 0, 1], tex.layout[i, 0, 2]
    la = np.hypot(du[0] * columns, du[1] * rows)
    lb = np.hypot(dv[0] * columns, dv[1] * rows)
    ax, ay, major, minor = du[0], du[1], la, lb
    if lb > la:
        ax, ay, major, minor = dv[0], dv[1], lb, la
    probes = 1
    if major > 1.0:
        probes = min(most_probes, int(np.ceil(major / max(minor, 1.0) - 0.25)))
        probes = max(probes, 1)
    level = np.log2(max(major / probes, 1.0))
    level = min(level, tex.halvings[i] - 1.0)
    # Close to one halving, that one alone will do: the difference is below what is seen.
    k = int(level + 0.1)
    mix = level - k
    red, green, blue = 0.0, 0.0, 0.0
    for p in range(probes):
        w = (p + 0.5) / probes - 0.5
        u, v = at[0] + w * ax, at[1] + w * ay
        r, g, b = _bilinear(tex, i, k, u, v)
        if mix > 0.1:
            r1, g1, b1 = _bilinear(tex, i, k + 1, u, v)
            r, g, b = r + mix * (r1 - r), g + mix * (g1 - g), b + mix * (b1 - b)
        red, green, blue = red + r, green + g, blue + b
    return red / probes, green / probes, blue / probes
