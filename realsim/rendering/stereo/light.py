"""The room's light in the two forms that shading reads: irradiance and blurred reflections.

Irradiance is the nine spherical harmonics of Ramamoorthi and Hanrahan (SIGGRAPH 2001). What a
surface mirrors is looked up in octahedral maps (Cigolle et al., JCGT 2014), one per roughness:
unlike a panorama they need no arc tangent per pixel. Only brightness counts: the eyes see grey.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from realsim.arrays import Array, Array32
from realsim.geometry.colors import LUMINANCE
from realsim.rendering.appearance import Environment
from realsim.rendering.procedural.skies import directions

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
