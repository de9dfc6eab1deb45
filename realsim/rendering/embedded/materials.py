"""What a surface looks like: smooth normals, mipmapped textures, and wood for the table.

Reflectances are linear light in [0, 1]. Texture look-ups average over the footprint of the pixel
(trilinear mipmaps), so that a printed edge stays where it was printed.
"""

from functools import lru_cache

import numpy as np

from realsim.arrays import Array, Array32, UInt8
from realsim.errors import InputError
from realsim.geometry.colors import srgb_decoded, srgb_encoded
from realsim.records import Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.rays import BACKGROUND, PlacedMesh

CREASE_COS = float(np.cos(np.radians(30.0)))
"""Faces that meet at a sharper angle keep their edge instead of being shaded as one surface."""
PLAIN_COLORS = (
    (196, 84, 60), (72, 118, 168), (214, 172, 84), (96, 146, 104), (150, 106, 160),
    (206, 130, 96), (84, 148, 152), (182, 186, 172), (142, 112, 84), (168, 64, 92),
)  # fmt: skip
"""sRGB-like paints of objects that have neither texture nor colours, by instance."""


WOOD_PERIOD_M = 0.5
SPECKLE_PERIOD_M = 0.12
OBJECT_ROUGHNESS = 0.42
"""Roughness of meshes without a material: satin plastic and printed cardboard."""
TABLE_ROUGHNESS = 0.62
"""Roughness of background without a material: oiled wood, printed paper."""


class MipTexture:
    """A texture and its successive halvings, each the mean of the one before."""

    def __init__(self, image: UInt8, gamma: float, wrap: bool) -> None:
        """Build the halvings.

        Args:
            image: (H, W, 3) encoded values, first row at v = 1.
            gamma: exponent that decodes them to linear light.
            wrap: whether the texture repeats; else its border continues.
        """
        import cv2

        decode = np.round(65535.0 * (np.arange(256) / 255.0) ** gamma).astype(np.uint16)
        level = decode[image]
        self.levels = [level]
        self.wrap = wrap
        while min(level.shape[:2]) > 1:
            height, width = level.shape[:2]
            size = (max(1, width // 2), max(1, height // 2))
            level = np.asarray(cv2.resize(level, size, interpolation=cv2.INTER_AREA), np.uint16)
            self.levels.append(level)


def corner_normals(mesh: Mesh) -> Array32:
    """Return unit normals (F, 3, 3) per face corner, smooth except across creases.

    A vertex's normal is the mean of its faces' weighted by their angle; a corner whose face
    deviates from it by more than the crease angle keeps the face's own normal. Vertices at the
    same place count as one, because STL files repeat them.
    """
    corners = mesh.vertices[mesh.faces]
    edges = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.maximum(length, 1e-30)
    unit = edges / np.maximum(np.linalg.norm(edges, axis=-1, keepdims=True), 1e-30)
    cosine = -np.sum(unit * np.roll(unit, 1, axis=1), axis=-1)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))

    key = np.round((mesh.vertices - mesh.vertices.min(0)) / 1e-6).astype(np.int64)
    span = key.max(0) + 1
    flat = (key[:, 0] * span[1] + key[:, 1]) * span[2] + key[:, 2]
    _, place = np.unique(flat, return_inverse=True)
    at = place[mesh.faces]
    total = np.stack(
        [np.bincount(at.ravel(), (angle * normal[:, None, k]).ravel()) for k in range(3)], -1
    )
    total /= np.maximum(np.linalg.norm(total, axis=-1, keepdims=True), 1e-30)
    smooth = total[at]
    keep = np.sum(smooth * normal[:, None], axis=-1, keepdims=True) > CREASE_COS
    return np.where(keep, smooth, normal[:, None]).astype(np.float32)


def _spectral_noise(rng: np.random.Generator, size: int, fx: float, fy: float) -> Array32:
    """Return periodic noise (size, size), mean 0, sd 1, with about fx and fy waves per side."""
    k = np.fft.fftfreq(size, 1.0 / size)
    spectrum = np.fft.fft2(rng.normal(size=(size, size)))
    spectrum *= np.exp(-0.5 * ((k[None, :] / fx) ** 2 + (k[:, None] / fy) ** 2))
    spectrum[0, 0] = 0.0
    noise = np.fft.ifft2(spectrum).real
    return (noise / noise.std()).astype(np.float32)


@lru_cache(maxsize=4)
def wood_texture(size: int = 1024, seed: int = 7) -> UInt8:
    """Return a tileable picture (size, size, 3) of light wood, its grain along u."""
    rng = np.random.default_rng(seed)
    y = np.arange(size, dtype=np.float32)[:, None] / size
    bend = _spectral_noise(rng, size, 1.0, 2.5)
    rings = np.sin(2 * np.pi * (18 * y + 1.1 * bend))
    pores = _spectral_noise(rng, size, 10.0, 220.0)
    cloud = _spectral_noise(rng, size, 3.0, 5.0)
    tone = 0.45 * rings + 0.25 * pores + 0.5 * cloud
    light, dark = np.array([202.0, 172.0, 134.0]), np.array([170.0, 134.0, 96.0])
    mix = np.clip(0.5 + 0.3 * tone, 0.0, 1.0)[..., None]
    return np.round(light + (dark - light) * mix).astype(np.uint8)


@lru_cache(maxsize=4)
def speckle_texture(size: int = 512, seed: int = 11) -> UInt8:
    """Return a tileable grey picture (size, size, 3) of slight unevenness, mean near 228."""
    rng = np.random.default_rng(seed)
    coarse, fine = _spectral_noise(rng, size, 6.0, 6.0), _spectral_noise(rng, size, 60.0, 60.0)
    grey = np.clip(np.round(228.0 + 7.0 * coarse + 4.0 * fine), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


class Surface:
    """The look of one placed mesh: normals in world and reflectance at any point of any face."""

    def __init__(self, placed: PlacedMesh, gamma: float) -> None:
        """Choose the look: the material's colours, texture, vertex colours, wood or paint.

        Of a material only the base colour counts: how glossy a surface is, the `Lighting` says.
        """
        mesh, material = placed.mesh, placed.material
        self.local_normals = corner_normals(mesh)
        self.is_glossy = placed.instance != BACKGROUND
        corners = mesh.vertices[mesh.faces]
        self._colors: Array32 | None = None
        self.texture: MipTexture | None = None
        self.tint = np.ones(3, np.float32)
        self.texels_per_m = np.zeros(len(mesh.faces), np.float32)
        if material is not None:
            stored = srgb_encoded(np.array(material.base_color))
            self.tint = np.asarray(stored**gamma, np.float32)
            image = material.base_color_image
            if image is None:
                image = np.full((1, 1, 3), 255, np.uint8)
            wrap = True
            self._uv = box_uv(mesh, material.period_m)
            if material.projection == "uv" and mesh.uv is not None:
                wrap = repeats(mesh.uv)
                self._uv = mesh.uv[mesh.faces].astype(np.float32)
            self.texture = MipTexture(image, gamma, wrap=wrap)
        elif mesh.texture is not None and mesh.uv is not None:
            self.texture = MipTexture(mesh.texture, gamma, wrap=repeats(mesh.uv))
            self._uv = mesh.uv[mesh.faces].astype(np.float32)
        elif mesh.colors is not None:
            decode = (np.arange(256) / 255.0) ** gamma
            self._colors = decode[mesh.colors][mesh.faces].astype(np.float32)
            return
        elif placed.instance == BACKGROUND:
            self.texture = _shared_texture("wood", gamma)
            self._uv = box_uv(mesh, WOOD_PERIOD_M)
        else:
            paint = np.array(PLAIN_COLORS[placed.instance % len(PLAIN_COLORS)])
            self.tint = ((paint / 255.0) ** gamma).astype(np.float32)
            self.texture = _shared_texture("speckle", gamma)
            self._uv = box_uv(mesh, SPECKLE_PERIOD_M)
        self.texels_per_m = _texel_density(corners, self._uv, self.texture.levels[0].shape)

    @property
    def paint(self) -> Array32:
        """Linear colours of the corners (F, 3, 3), or texture coordinates with a 0 behind them."""
        if self._colors is not None:
            return self._colors
        return np.concatenate([self._uv, np.zeros_like(self._uv[..., :1])], axis=-1)


def check_projection(number: int, placed: PlacedMesh) -> None:
    """Raise where a material needs texture coordinates that its mesh does not have."""
    material = placed.material
    if material is not None and material.projection == "uv" and placed.mesh.uv is None:
        raise InputError(
            f"placed mesh {number} (instance {placed.instance}) has no texture coordinates, but "
            f"its material '{material.name}' has the projection 'uv'. Give the mesh uv (V, 2), or "
            "the material projection='box', which needs none."
        )


def look_of(number: int, placed: PlacedMesh) -> tuple[Material, UInt8 | None]:
    """Return the material of a placed mesh and its vertex colours (V, 3), None = they are unused.

    Its own material; else the mesh's texture, its vertex colours, wood for the background, or
    paint by its instance.

    Args:
        number: of the mesh in the scene, for messages.
        placed: the mesh.

    Raises:
        InputError: the material needs texture coordinates and the mesh has none.
    """
    mesh, material = placed.mesh, placed.material
    if material is not None:
        check_projection(number, placed)
        return material, None
    rough = TABLE_ROUGHNESS if placed.instance == BACKGROUND else OBJECT_ROUGHNESS
    white = (1.0, 1.0, 1.0)
    if mesh.texture is not None and mesh.uv is not None:
        own = Material(
            base_color=white, base_color_image=mesh.texture, roughness=rough, projection="uv",
            name="the mesh's own texture",
        )  # fmt: skip
        return own, None
    if mesh.colors is not None:
        return Material(base_color=white, roughness=rough, name="vertex colours"), mesh.colors
    if placed.instance == BACKGROUND:
        wood = Material(
            base_color=white, base_color_image=wood_texture(), roughness=rough,
            period_m=WOOD_PERIOD_M, name="light wood",
        )  # fmt: skip
        return wood, None
    paint = srgb_decoded(np.array(PLAIN_COLORS[placed.instance % len(PLAIN_COLORS)]) / 255.0)
    painted = Material(
        base_color=(float(paint[0]), float(paint[1]), float(paint[2])),
        base_color_image=speckle_texture(), roughness=rough,
        period_m=SPECKLE_PERIOD_M, name="paint",
    )  # fmt: skip
    return painted, None


@lru_cache(maxsize=8)
def _shared_texture(name: str, gamma: float) -> MipTexture:
    """Return a procedural texture, built once for all surfaces."""
    return MipTexture(wood_texture() if name == "wood" else speckle_texture(), gamma, wrap=True)


def repeats(uv: Array) -> bool:
    """Return whether texture coordinates leave [0, 1], so that the texture must repeat."""
    return bool(uv.min() < -1e-6 or uv.max() > 1 + 1e-6)


def box_uv(mesh: Mesh, period_m: float) -> Array32:
    """Return texture coordinates (F, 3, 2) by projection along each face's dominant axis.

    In the mesh's frame, one tile every `period_m` [m]: (y, z) on faces that look along x, (x, z)
    along y, (x, y) along z.
    """
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.argmax(np.abs(normal), axis=1)
    kept = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return (np.take_along_axis(corners, kept[:, None, :], axis=2) / period_m).astype(np.float32)


def _texel_density(corners: Array, uv: Array32, shape: tuple[int, ...]) -> Array32:
    """Return texels per metre (F,) of each face: the root of the ratio of the two areas."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    texels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) * shape[0] * shape[1]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    )
    return np.sqrt(texels / np.maximum(area, 1e-18)).astype(np.float32)
