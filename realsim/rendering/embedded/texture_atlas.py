"""All images of a scene in one buffer, with their halvings, read by the shading kernels.

Values stay 8 bit; colours are averaged as linear light and stored as its square root, which is as
fine as the picture that is made of them. A look-up averages over the footprint of the pixel:
between two halvings, with several probes along the longer side where the surface is seen obliquely.
"""

from typing import NamedTuple

import numpy as np

from realsim.arrays import Array, Array32, Int64, Mask, UInt8
from realsim.compiled import njit
from realsim.geometry.colors import srgb_decoded

MOST_HALVINGS = 16
SAME_HALVING = 0.25
"""A colour so close to one halving is read from that one alone, else from two."""
MOST_PROBES = 6
"""Footprints longer than this many times their width are read somewhat blurred."""


class TextureArrays(NamedTuple):
    """The images as the kernels read them."""

    texels: UInt8
    """(T, 4) texels of all halvings of all images, four values each."""
    layout: Int64
    """(I, MOST_HALVINGS, 3) first texel, rows and columns of each halving."""
    halvings: Int64
    """(I,) number of halvings, the image itself included."""
    wraps: Mask
    """(I,) whether the image repeats; else its border continues."""


class TextureAtlas:
    """Collects images; the same image under the same reading is kept once.

    Colours are kept as the square root of linear light, which a product decodes; normals and
    roughness as they are, both in one texel where they have the same size.
    """

    def __init__(self) -> None:
        """Begin without images."""
        self._index: dict[tuple[int, int, bool], int] = {}
        self._kept: list[UInt8 | None] = []
        self._images: list[list[UInt8]] = []
        self._wraps: list[bool] = []

    def add_color(self, image: UInt8 | None, *, wrap: bool) -> int:
        """Return the number of an sRGB image (H, W, 3), first row at v = 1; -1 = None."""
        if image is None:
            return -1
        key = (id(image), 0, wrap)
        if key not in self._index:
            decode = srgb_decoded(np.arange(256) / 255.0).astype(np.float32)
            self._append(key, (image,), _halvings(decode[image], rooted=True))
        return self._index[key]

    def add_detail(
        self, normal: UInt8 | None, roughness: UInt8 | None, *, wrap: bool
    ) -> tuple[int, int]:
        """Return the numbers of a normal image (H, W, 3) and a roughness image (H, W); -1 = None.

        They are one and the same where both are of one size.
        """
        if normal is not None and roughness is not None and normal.shape[:2] != roughness.shape:
            return (
                self.add_detail(normal, None, wrap=wrap)[0],
                self.add_detail(None, roughness, wrap=wrap)[1],
            )
        of = normal if normal is not None else roughness
        if of is None:
            return -1, -1
        key = (id(normal), id(roughness), wrap)
        if key not in self._index:
            image = np.full((*of.shape[:2], 4), 255, np.uint8)
            if normal is not None:
                image[..., :3] = normal
            if roughness is not None:
                image[..., 3] = roughness
            value = image.astype(np.float32) / np.float32(255)
            self._append(key, (normal, roughness), _halvings(value, rooted=False))
        number = self._index[key]
        return (number if normal is not None else -1), (number if roughness is not None else -1)

    def _append(
        self, key: tuple[int, int, bool], sources: tuple[UInt8 | None, ...], images: list[UInt8]
    ) -> None:
        """Take in the halvings of an image."""
        self._index[key] = len(self._images)
        self._kept.extend(sources)  # an id is only good as long as its object lives
        self._images.append(images)
        self._wraps.append(key[2])

    def arrays(self) -> TextureArrays:
        """Return the buffer."""
        n = len(self._images)
        layout = np.zeros((max(n, 1), MOST_HALVINGS, 3), np.int64)
        first = 0
        for i, images in enumerate(self._images):
            for k, image in enumerate(images):
                layout[i, k] = first, image.shape[0], image.shape[1]
                first += image.shape[0] * image.shape[1]
        flat = [a.reshape(-1, 4) for images in self._images for a in images]
        return TextureArrays(
            texels=np.concatenate(flat) if flat else np.zeros((1, 4), np.uint8),
            layout=layout,
            halvings=np.array([len(images) for images in self._images] or [1], np.int64),
            wraps=np.array(self._wraps or [False], np.bool_),
        )

    def mean_color(self, index: int) -> Array:
        """Return the mean (3,) of a colour image in linear light."""
        coarse = self._images[index][-1][..., :3] / 255.0
        return np.square(coarse).reshape(-1, 3).mean(0)


def _halvings(value: Array32, *, rooted: bool) -> list[UInt8]:
    """Return an image (H, W, 3 or 4) of values in [0, 1] and its halvings, four bytes a texel."""
    import cv2

    out: list[UInt8] = []
    while True:
        stored = np.full((*value.shape[:2], 4), 255, np.uint8)
        coded = np.sqrt(value) if rooted else value
        stored[..., : value.shape[2]] = np.round(255.0 * coded)
        out.append(stored)
        if min(value.shape[:2]) == 1 or len(out) == MOST_HALVINGS:
            return out
        size = (max(1, value.shape[1] // 2), max(1, value.shape[0] // 2))
        value = np.asarray(cv2.resize(value, size, interpolation=cv2.INTER_AREA), np.float32)


@njit(inline="always", error_model="numpy")
def _corners(
    tex: TextureArrays, i: int, k: int, u: float, v: float
) -> tuple[int, int, int, int, float, float]:
    """Return the four texels about texture coordinates, v up, and the shares of the later ones."""
    first, rows, columns = tex.layout[i, k, 0], tex.layout[i, k, 1], tex.layout[i, k, 2]
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
    top, below = first + r0 * columns, first + r1 * columns
    return top + c0, top + c1, below + c0, below + c1, a, b


@njit(inline="always", error_model="numpy")
def footprint(
    tex: TextureArrays, i: int, du: tuple[float, float], dv: tuple[float, float], most_probes: int
) -> tuple[float, float, int, float]:
    """Return how the pixel lies on image i: its longer side (2), the probes along it, the halving.

    Args:
        tex: the images.
        i: number of the image.
        du: change of the coordinates over the pixel's width.
        dv: change over its height.
        most_probes: look-ups along the longer side, at most.
    """
    rows, columns = tex.layout[i, 0, 1], tex.layout[i, 0, 2]
    la = (du[0] * columns) ** 2 + (du[1] * rows) ** 2
    lb = (dv[0] * columns) ** 2 + (dv[1] * rows) ** 2
    ax, ay, major, minor = du[0], du[1], np.sqrt(la), np.sqrt(lb)
    if lb > la:
        ax, ay, major, minor = dv[0], dv[1], np.sqrt(lb), np.sqrt(la)
    probes, level = 1, 0.0
    if major > 1.0:
        probes = min(most_probes, int(np.ceil(major / max(minor, 1.0) - 0.25)))
        probes = max(probes, 1)
        level = np.log2(max(major / probes, 1.0))
    return ax, ay, probes, min(level, tex.halvings[i] - 1.0)


@njit(error_model="numpy")
def color_at(
    tex: TextureArrays, i: int, at: tuple[float, float], spread: tuple[float, float, int, float]
) -> tuple[float, float, float]:
    """Return the mean linear colour of image i over a `footprint` about texture coordinates."""
    ax, ay, probes, level = spread
    # Close to one halving, that one alone will do: the difference is below what is seen.
    k = int(level + SAME_HALVING)
    mix = level - k
    levels = 2 if mix > SAME_HALVING else 1
    z = tex.texels
    red, green, blue = 0.0, 0.0, 0.0
    for n in range(probes * levels):
        w = (n // levels + 0.5) / probes - 0.5
        part = 1.0
        if levels == 2:
            part = mix if n % 2 else 1.0 - mix
        p, q, m, o, a, b = _corners(tex, i, k + n % levels, at[0] + w * ax, at[1] + w * ay)
        wp, wq = part * (1 - a) * (1 - b), part * a * (1 - b)
        wm, wo = part * (1 - a) * b, part * a * b
        x0, x1, x2 = float(z[p, 0]), float(z[p, 1]), float(z[p, 2])
        red, green, blue = red + wp * x0 * x0, green + wp * x1 * x1, blue + wp * x2 * x2
        x0, x1, x2 = float(z[q, 0]), float(z[q, 1]), float(z[q, 2])
        red, green, blue = red + wq * x0 * x0, green + wq * x1 * x1, blue + wq * x2 * x2
        x0, x1, x2 = float(z[m, 0]), float(z[m, 1]), float(z[m, 2])
        red, green, blue = red + wm * x0 * x0, green + wm * x1 * x1, blue + wm * x2 * x2
        x0, x1, x2 = float(z[o, 0]), float(z[o, 1]), float(z[o, 2])
        red, green, blue = red + wo * x0 * x0, green + wo * x1 * x1, blue + wo * x2 * x2
    scale = 1.0 / (65025.0 * probes)
    return red * scale, green * scale, blue * scale


@njit(error_model="numpy")
def detail_at(
    tex: TextureArrays, i: int, at: tuple[float, float], level: float
) -> tuple[float, float, float, float]:
    """Return normal and roughness, [0, 1], of image i at texture coordinates.

    Of the nearest halving alone: what changes there is hardly seen.
    """
    z = tex.texels
    p, q, m, o, a, b = _corners(tex, i, int(level + 0.5), at[0], at[1])
    wp, wq, wm, wo = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    s0 = wp * z[p, 0] + wq * z[q, 0] + wm * z[m, 0] + wo * z[o, 0]
    s1 = wp * z[p, 1] + wq * z[q, 1] + wm * z[m, 1] + wo * z[o, 1]
    s2 = wp * z[p, 2] + wq * z[q, 2] + wm * z[m, 2] + wo * z[o, 2]
    s3 = wp * z[p, 3] + wq * z[q, 3] + wm * z[m, 3] + wo * z[o, 3]
    return s0 / 255.0, s1 / 255.0, s2 / 255.0, s3 / 255.0


@njit(error_model="numpy")
def bent_normal(
    n: tuple[float, float, float],
    e: tuple[float, float, float, float, float, float],
    uv: tuple[float, float, float, float],
    bend: tuple[float, float, float, float],
) -> tuple[float, float, float, float]:
    """Return the normal bent by the normal image, and the spread of normals it stands for.

    `e`: the two edges of the face from its first corner.

    The averaged normal of many texels is shorter than 1; the rest widens the highlight (Toksvig,
    "Mipmapping normal maps", 2005).
    """
    ux, uy, vx, vy = uv
    det = ux * vy - uy * vx
    if abs(det) < 1e-20:
        return n[0], n[1], n[2], 0.0
    tx, ty, tz = (
        (e[0] * vy - e[3] * uy) / det,
        (e[1] * vy - e[4] * uy) / det,
        (e[2] * vy - e[5] * uy) / det,
    )
    along = tx * n[0] + ty * n[1] + tz * n[2]
    tx, ty, tz = tx - along * n[0], ty - along * n[1], tz - along * n[2]
    length = max(np.sqrt(tx * tx + ty * ty + tz * tz), 1e-20)
    tx, ty, tz = tx / length, ty / length, tz / length
    # The second axis runs along +v; mirrored coordinates turn it round.
    bx, by, bz = n[1] * tz - n[2] * ty, n[2] * tx - n[0] * tz, n[0] * ty - n[1] * tx
    wx, wy, wz = e[3] * ux - e[0] * vx, e[4] * ux - e[1] * vx, e[5] * ux - e[2] * vx
    if (bx * wx + by * wy + bz * wz) * det < 0:
        bx, by, bz = -bx, -by, -bz
    # 8-bit images say 128 for "not bent", half a step off the middle.
    x, y, z = (255 * bend[0] - 128) / 127, (255 * bend[1] - 128) / 127, (255 * bend[2] - 128) / 127
    size = min(max(np.sqrt(x * x + y * y + z * z), 0.2), 1.0)
    sx, sy, sz = (
        tx * x + bx * y + n[0] * z,
        ty * x + by * y + n[1] * z,
        tz * x + bz * y + n[2] * z,
    )
    length = max(np.sqrt(sx * sx + sy * sy + sz * sz), 1e-12)
    return sx / length, sy / length, sz / length, 2 * (1 - size) / size
