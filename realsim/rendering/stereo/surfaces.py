"""Placed meshes packed into flat tables that a compiled loop can shade from, and their grain.

On a face everything that is interpolated between its corners is an affine function of the point:
24 numbers per face replace the barycentric weights and the look-ups through vertices.

The micro texture fills space, fixed to the object, so that both eyes see the same grain. Every
octave is the same periodic block of noise at twice the size; finer ones than the pixels resolve are
left out, or they would alias differently in the two eyes, and coarser ones match nothing. Like
natural surfaces it has the same contrast at every octave, so at every distance (Field, JOSA A
1987).

The room's light in the two forms that shading reads: irradiance and blurred reflections.

Irradiance is the nine spherical harmonics of Ramamoorthi and Hanrahan (SIGGRAPH 2001). What a
surface mirrors is looked up in octahedral maps (Cigolle et al., JCGT 2014), one per roughness:
unlike a panorama they need no arc tangent per pixel. Only brightness counts: the eyes see grey.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32, Int32, Int64, UInt8, UInt16
from realsim.geometry.colors import LUMINANCE, light_of_bytes
from realsim.records import Mesh
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.embedded.materials import corner_normals, speckle_texture, wood_texture
from realsim.rendering.procedural.skies import directions
from realsim.rendering.rays import BACKGROUND, PlacedMesh

MAP_SIDE = 64
"""Edge of the octahedral maps [texels]: 3 deg each, finer than what a roughness of 0.1 keeps."""
ROUGH_ROWS = 32
"""Rows of the panorama from which irradiance and rough reflections are made: 6 deg each."""
MAP_ROUGHNESS = (0.1, 0.25, 0.45, 0.75)
"""Roughnesses for which reflections are prepared; the first is the panorama itself."""
BAND_GAIN = np.array([1.0, 2 / 3, 2 / 3, 2 / 3, 1 / 4, 1 / 4, 1 / 4, 1 / 4, 1 / 4])
"""Cosine lobe per harmonic, divided by pi: a white matte surface returns its own irradiance."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RoomLight:
    """Grey light from far away, ready for shading."""

    harmonics: Array32
    """(9,) what a white matte surface returns, over the harmonics of its normal."""
    reflections: Array32
    """(L, S, S) radiance around the mirrored direction, one octahedral map per roughness."""
    sun_direction: Array32
    """(3,) unit, world."""
    sun: float
    """What the sun adds on a white surface that faces it."""


def room_light(environment: Environment | None) -> RoomLight:
    """Return the light of surroundings; None = a room with a bright ceiling lamp."""
    return _plain_light() if environment is None else _light_of(environment)


@lru_cache(maxsize=1)
def _plain_light() -> RoomLight:
    """Return the light of the plain room, computed once."""
    return _light_of(_plain_room())


def _light_of(environment: Environment) -> RoomLight:
    """Return the light of surroundings."""
    panorama = np.asarray(environment.panorama, np.float64) @ LUMINANCE
    coarse = _shrunk(panorama, ROUGH_ROWS)
    directions, weights = _sphere(coarse.shape[0])
    coefficients = (_harmonics(directions) * (coarse.ravel() * weights)[:, None]).sum(0)
    sun = np.array(environment.sun_direction, np.float64)
    reflections = np.empty((len(MAP_ROUGHNESS), MAP_SIDE, MAP_SIDE), np.float32)
    target = octahedral_directions(MAP_SIDE).reshape(-1, 3)
    reflections[0] = _looked_up(_shrunk(panorama, MAP_SIDE), target).reshape(MAP_SIDE, MAP_SIDE)
    for level, roughness in enumerate(MAP_ROUGHNESS[1:], 1):
        blurred = _blurred(directions, weights, coarse.ravel(), target, roughness)
        reflections[level] = blurred.reshape(MAP_SIDE, MAP_SIDE)
    return RoomLight(
        harmonics=np.asarray(coefficients * BAND_GAIN, np.float32),
        reflections=reflections,
        sun_direction=(sun / np.linalg.norm(sun)).astype(np.float32),
        sun=float(np.asarray(environment.sun, np.float64) @ LUMINANCE),
    )


def _shrunk(panorama: Array, rows: int) -> Array:
    """Return a panorama averaged to about `rows` rows; smaller ones stay as they are."""
    step = max(1, panorama.shape[0] // rows)
    kept = panorama.shape[0] // step
    cut = panorama[: kept * step, : 2 * kept * step]
    return cut.reshape(kept, step, 2 * kept, step).mean((1, 3))


def _looked_up(panorama: Array, directions: Array) -> Array:
    """Return the radiance (N,) of a panorama in unit directions (N, 3), nearest pixel."""
    rows = panorama.shape[0]
    theta = np.arccos(np.clip(directions[:, 2], -1, 1))
    phi = np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi)
    row = np.minimum((theta / np.pi * rows).astype(int), rows - 1)
    return panorama[row, (phi / np.pi * rows).astype(int) % (2 * rows)]


def _plain_room() -> Environment:
    """Return a grey room: floor, walls, a brighter ceiling with one lamp, and soft sun."""
    directions, _ = _sphere(32)
    up = directions[:, 2]
    lamp = directions @ (np.array([0.3, -0.4, 0.87]) / np.linalg.norm([0.3, -0.4, 0.87]))
    grey = 0.30 + 0.15 * up + 3.0 * (lamp > np.cos(np.radians(12.0)))
    panorama = np.repeat(grey.reshape(32, 64, 1), 3, axis=-1).astype(np.float32)
    return Environment(panorama=panorama, sun=(0.25, 0.25, 0.25), name="plain room")


def _sphere(rows: int) -> tuple[Array, Array]:
    """Return directions (2 rows^2, 3) of a panorama's pixels and their solid angles."""
    sine = np.sin(np.pi * (np.arange(rows) + 0.5) / rows)
    return directions(rows).reshape(-1, 3), np.repeat(sine, 2 * rows) * (np.pi / rows) ** 2


def _harmonics(d: Array) -> Array:
    """Return the nine real spherical harmonics (N, 9) of unit directions (N, 3)."""
    x, y, z = d.T
    return np.stack(
        [
            np.full_like(x, 0.282095), 0.488603 * y, 0.488603 * z, 0.488603 * x,
            1.092548 * x * y, 1.092548 * y * z, 0.315392 * (3 * z * z - 1),
            1.092548 * x * z, 0.546274 * (x * x - y * y),
        ], -1,
    )  # fmt: skip


def octahedral_directions(side: int) -> Array:
    """Return the unit direction (side, side, 3) of each texel centre of an octahedral map."""
    a = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(a, a)
    z = 1 - np.abs(x) - np.abs(y)
    below = z < 0
    fold_x = (1 - np.abs(y)) * np.where(x >= 0, 1, -1)
    fold_y = (1 - np.abs(x)) * np.where(y >= 0, 1, -1)
    d = np.stack([np.where(below, fold_x, x), np.where(below, fold_y, y), z], -1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def _blurred(
    directions: Array, weights: Array, radiance: Array, target: Array, roughness: float
) -> Array32:
    """Return radiance blurred by a rough mirror's lobe, in the directions `target` (N, 3).

    The lobe exp(k (cos - 1)) with k = 2 / alpha^2 is the width of the GGX highlight about the
    mirrored direction (Karis, SIGGRAPH 2013 course, after Lagarde).
    """
    k = np.float32(2.0 / roughness**4)
    x, y, z = directions.T.astype(np.float32)
    light, even = (radiance * weights).astype(np.float32), weights.astype(np.float32)
    parts: list[Array32] = []
    for part in np.array_split(target.astype(np.float32), 32):
        # Written out: BLAS threads that spin cost more than this sum.
        cosine = part[:, :1] * x + part[:, 1:2] * y + part[:, 2:3] * z
        lobe = np.exp(k * (cosine - np.float32(1)))
        total = np.maximum((lobe * even).sum(1), np.float32(1e-12))
        parts.append(np.asarray((lobe * light).sum(1) / total, np.float32))
    return np.concatenate(parts)


BLOCK = 64
"""Edge of the periodic block [cells], a power of two: 45 px or more. The block is turned against
the object, so that a row of pixels runs askew through it and does not repeat."""
FINEST_CELL_M = 2e-5
"""Cell of the finest octave [m]: a hundredth of a pixel at arm's length."""
NOISE_STEPS = 32
"""Standard deviation of the block [counts]: four of them before it is clipped."""
CELLS_PER_PIXEL = 0.70
"""The finest octave shown has cells of at least this many pixels and ends there: its waves are 4 to
8 cells, so 2.8 px or longer."""

FIRST_OCTAVE = float(np.log2(CELLS_PER_PIXEL / FINEST_CELL_M))
"""Octave shown by pixels of 1 m."""


@lru_cache(maxsize=1)
def noise_block() -> NDArray[np.int8]:
    """Return (BLOCK, BLOCK, BLOCK) periodic noise, mean 0, sd NOISE_STEPS.

    It holds waves of 4 to 8 cells only, which trilinear interpolation keeps.
    """
    rng = np.random.default_rng(20)
    spectrum = np.fft.rfftn(rng.standard_normal((BLOCK,) * 3))
    k = np.fft.fftfreq(BLOCK)
    last = np.fft.rfftfreq(BLOCK)
    radius = np.sqrt(k[:, None, None] ** 2 + k[None, :, None] ** 2 + last[None, None, :] ** 2)
    spectrum *= (radius >= 1 / 8) & (radius <= 1 / 4)
    noise = np.fft.irfftn(spectrum, s=(BLOCK,) * 3, axes=(0, 1, 2))
    # Bytes: the whole block stays in the processor's second cache.
    block = np.clip(np.round(noise * (NOISE_STEPS / noise.std())), -127, 127).astype(np.int8)
    block.setflags(write=False)
    return block


@lru_cache(maxsize=1)
def packed_noise() -> Int32:
    """Return the block (BLOCK^3,) with four neighbours in every number.

    The bytes of (i, j, k), from the lowest, are the noise + 128 at (j, k), (j, k + 1), (j + 1, k)
    and (j + 1, k + 1): interpolation reads two numbers in place of eight.
    """
    shifted = (noise_block().astype(np.int16) + 128).astype(np.uint32)
    after = np.roll(shifted, -1, axis=2)
    packed = shifted | (after << 8)
    packed |= (np.roll(shifted, -1, axis=1) << 16) | (np.roll(after, -1, axis=1) << 24)
    flat = packed.view(np.int32).ravel()
    flat.setflags(write=False)
    return flat


@lru_cache(maxsize=1)
def block_axes() -> Array:
    """Return the rotation (3, 3) of the block against the object: no plane of it is aligned."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec([0.61, -0.43, 1.07]).as_matrix()


LEVELS = 14
"""Halvings kept of an image: enough for 8192 texels."""
WOOD_PERIOD_M = 0.5
SPECKLE_PERIOD_M = 0.12
"""Tiles of the looks of meshes without material, as in the colour pictures [m]."""
FULL_GRAIN_ROUGHNESS = 0.5
"""From this roughness on a surface has the whole micro texture; polished ones less."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SurfaceTables:
    """The look of every face of every placed mesh."""

    faces: Array32
    """(F, 24) affine functions of the point in mesh axes (x, y, z, 1): normal x, y, z, texture u,
    v, brightness of the vertex colours."""
    first_face: Int64
    """(G,) where a placed mesh's faces begin."""
    looks: Array32
    """(G, 9) tint, roughness, metallic, micro texture, level of its reflections, three offsets of
    its grain [m], binary logarithm of its image's texels per metre."""
    images: Int64
    """(G,) image of a placed mesh; -1 = none."""
    texels: UInt16
    """(T,) linear brightness of all images and their halvings, 65535 = 1."""
    levels: Int64
    """(I, LEVELS, 3) start, height and width of each halving; beyond the last it is repeated."""


def packed_surfaces(placed: Sequence[PlacedMesh], texture_contrast: float) -> SurfaceTables:
    """Return the tables of placed meshes.

    Args:
        placed: the meshes; one that is placed several times is stored once per look.
        texture_contrast: rms micro texture of a rough surface, relative.
    """
    store = _ImageStore()
    blocks: list[Array32] = []
    starts: dict[tuple[int, int | None, float], int] = {}
    numbers: dict[tuple[int, int | None, float], int] = {}
    total = 0
    first, looks, images = [], [], []
    for number, p in enumerate(placed):
        material, image = _look(p)
        on_uv = material.projection == "uv" and p.mesh.uv is not None
        key = (id(p.mesh), None if on_uv else 0, 0.0 if on_uv else material.period_m)
        if key not in starts:
            starts[key] = total
            numbers[key] = len(blocks)
            blocks.append(_face_functions(p.mesh, None if on_uv else material.period_m))
            total += len(blocks[-1])
        first.append(starts[key])
        images.append(-1 if image is None else store.add(image))
        tint = float(np.array(material.base_color) @ LUMINANCE)
        level = np.interp(material.roughness, MAP_ROUGHNESS, np.arange(len(MAP_ROUGHNESS)))
        grain = texture_contrast * min(1.0, material.roughness / FULL_GRAIN_ROUGHNESS)
        offset = np.random.default_rng([31, number, p.instance + 1]).uniform(0, 0.1, 3)
        of_faces = blocks[numbers[key]]
        fine = 0.0 if image is None else np.log2(_texels_per_m(p.mesh, of_faces, image.shape))
        looks.append(
            [tint, material.roughness, material.metallic, grain, round(level), *offset, fine]
        )
    texels, levels = store.packed()
    return SurfaceTables(
        faces=np.concatenate(blocks) if blocks else np.zeros((0, 24), np.float32),
        first_face=np.array(first, np.int64),
        looks=np.array(looks, np.float32).reshape(-1, 9),
        images=np.array(images, np.int64),
        texels=texels,
        levels=levels,
    )


def _look(p: PlacedMesh) -> tuple[Material, UInt8 | None]:
    """Return the material of a placed mesh and its image (H, W, 3), sRGB, if it has one."""
    mesh = p.mesh
    if p.material is not None:
        return p.material, p.material.base_color_image
    if mesh.texture is not None and mesh.uv is not None:
        return Material(base_color=(1, 1, 1), projection="uv", name="scanned"), mesh.texture
    if mesh.colors is not None:
        return Material(base_color=(1, 1, 1), name="scanned"), None
    if p.instance == BACKGROUND:
        wood = Material(base_color=(1, 1, 1), roughness=0.8, period_m=WOOD_PERIOD_M, name="wood")
        return wood, wood_texture()
    # Infrared sees most paints alike: plain objects share one grey.
    paint = Material(base_color=(0.45, 0.45, 0.45), period_m=SPECKLE_PERIOD_M, name="paint")
    return paint, speckle_texture()


def _face_functions(mesh: Mesh, period_m: float | None) -> Array32:
    """Return the affine functions (F, 24) of a mesh's faces.

    Args:
        mesh: the mesh.
        period_m: tile of a projection along each face's dominant axis; None = the mesh's own
            texture coordinates.
    """
    corners = mesh.vertices[mesh.faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    square = np.maximum(np.einsum("ij,ij->i", normal, normal), 1e-30)[:, None]
    # Gradients of the second and third corner's weight: the weight is 1 there, 0 at the others.
    along = np.stack([np.cross(b, normal) / square, np.cross(normal, a) / square], 1)
    out = np.zeros((len(corners), 6, 4))

    def interpolate(rows: slice, values: Array) -> None:
        """Write the functions that take `values` (F, 3 corners, C) at the corners."""
        step = values[:, 1:] - values[:, :1]
        gradient = np.einsum("fkc,fkx->fcx", step, along)
        out[:, rows, :3] = gradient
        out[:, rows, 3] = values[:, 0] - np.einsum("fcx,fx->fc", gradient, corners[:, 0])

    interpolate(slice(0, 3), corner_normals(mesh).astype(np.float64))
    if period_m is None:
        assert mesh.uv is not None
        interpolate(slice(3, 5), mesh.uv[mesh.faces])
    else:
        # The projection is affine in space itself; no need to go through the corners.
        axis = np.argmax(np.abs(normal), axis=1)
        kept = np.array([[1, 2], [0, 2], [0, 1]])[axis]
        rows = np.arange(len(corners))
        for k in range(2):
            out[rows, 3 + k, kept[:, k]] = 1.0 / period_m
    out[:, 5, 3] = 1.0
    if mesh.colors is not None and mesh.texture is None:
        linear = light_of_bytes(np.arange(256))
        grey = linear[mesh.colors].astype(np.float64) @ LUMINANCE
        interpolate(slice(5, 6), grey[mesh.faces][:, :, None])
    return out.reshape(-1, 24).astype(np.float32)


def _texels_per_m(mesh: Mesh, faces: Array32, shape: tuple[int, ...]) -> float:
    """Return how finely an image lies on a mesh: the root of its texels over its area."""
    gradient = faces.reshape(-1, 6, 4)[:, 3:5, :3].astype(np.float64)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    )
    share = np.linalg.norm(np.cross(gradient[:, 0], gradient[:, 1]), axis=-1)
    mean = float((share * area).sum() / max(float(area.sum()), 1e-30))
    return float(np.sqrt(max(mean * shape[0] * shape[1], 1e-12)))


class _ImageStore:
    """Images as linear brightness with their halvings, each stored once."""

    def __init__(self) -> None:
        """Begin empty."""
        self._numbers: dict[int, int] = {}
        self._kept: list[UInt8] = []  # keeps the ids above from being used again
        self._parts: list[UInt16] = []
        self._levels: list[list[tuple[int, int, int]]] = []
        self._end = 0

    def add(self, image: UInt8) -> int:
        """Return the number of an image (H, W, 3), sRGB."""
        import cv2

        if id(image) in self._numbers:
            return self._numbers[id(image)]
        weights = LUMINANCE
        table = 65535.0 * light_of_bytes(np.arange(256))
        grey = sum((table[image[..., c]] * weights[c]).astype(np.float32) for c in range(3))
        level = np.asarray(grey, np.float32)
        rows: list[tuple[int, int, int]] = []
        while True:
            height, width = level.shape
            rows.append((self._end, height, width))
            self._parts.append(np.round(level).astype(np.uint16).ravel())
            self._end += height * width
            if min(height, width) <= 1 or len(rows) == LEVELS:
                break
            size = (width // 2, height // 2)
            level = np.asarray(cv2.resize(level, size, interpolation=cv2.INTER_AREA), np.float32)
        rows += [rows[-1]] * (LEVELS - len(rows))
        self._levels.append(rows)
        self._numbers[id(image)] = len(self._kept)
        self._kept.append(image)
        return len(self._kept) - 1

    def packed(self) -> tuple[UInt16, Int64]:
        """Return all texels and where each image's halvings begin."""
        if not self._kept:
            return np.zeros(1, np.uint16), np.zeros((1, LEVELS, 3), np.int64)
        return np.concatenate(self._parts), np.array(self._levels, np.int64)
