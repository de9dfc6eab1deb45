"""What an eye sees: grey brightness of the first hits, and the bytes its sensor makes of it.

One compiled pass per eye: base colour, micro texture, room light, highlights and the projected
dots. Shadows of the room's own lamps are left out: they are soft, and they move no match. The
projector's shadow is nearly exact (from what both eyes see).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from realsim.arrays import Array, Array32, Int32, UInt8, UInt16
from realsim.compiled import njit
from realsim.rendering.stereo.config import StereoConfig
from realsim.rendering.stereo.light import RoomLight
from realsim.rendering.stereo.shading import shade
from realsim.rendering.stereo.surfaces import SurfaceTables, block_axes, packed_noise


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Projector:
    """The dot projector as one eye sees it."""

    pattern: Array32
    """(h, w) brightness over the tangent plane."""
    offset_m: float
    """Where it stands along this eye's x axis [m]."""
    power: float
    """Light of a dot on white at 1 m."""
    depth_m: Array32
    """(H, W) first hits from the projector with the eyes' intrinsics; 0 = nothing."""


def no_projector(shape: tuple[int, int]) -> Projector:
    """Return a projector that is off."""
    off = np.zeros((2, 2), np.float32)
    return Projector(pattern=off, offset_m=0.0, power=0.0, depth_m=np.zeros(shape, np.float32))


def radiance(
    hits: tuple[Array32, Int32, Int32],
    pinhole: tuple[float, float, float, float],
    Ts_obj_cam: Array,
    R_world_cam: Array,
    scene: tuple[SurfaceTables, RoomLight],
    projector: Projector,
    ambient: float,
) -> Array32:
    """Return the light (H, W) that comes in at every pixel, before lens and sensor.

    Args:
        hits: depth [m], placed mesh and face (H, W) of this eye; mesh -1 = nothing.
        pinhole: fx, fy, cx, cy [px].
        Ts_obj_cam: (G, 4, 4) this eye in each mesh's frame.
        R_world_cam: (3, 3).
        scene: what the surfaces look like, and the light.
        projector: the dots.
        ambient: factor of the room's light.
    """
    surfaces, light = scene
    grain = np.einsum("ij,gjk->gik", block_axes(), Ts_obj_cam[:, :3])
    grain[:, :, 3] += surfaces.looks[:, 5:8]
    placed = np.concatenate([Ts_obj_cam[:, :3], grain], 1).astype(np.float32)
    out = np.empty(hits[0].shape, np.float32)
    shade(
        hits,
        (np.array(pinhole, np.float32), placed, R_world_cam.astype(np.float32)),
        (surfaces.faces, surfaces.first_face, surfaces.looks, surfaces.images),
        (surfaces.texels, surfaces.levels, packed_noise()),
        (light.harmonics, light.reflections, light.sun_direction, np.float32(light.sun)),
        (
            projector.pattern,
            projector.depth_m,
            np.float32(projector.offset_m),
            np.float32(projector.power),
        ),
        np.float32(ambient),
        out,
    )
    return out


def exposed(light: Array32, gain: float, config: StereoConfig, rng: np.random.Generator) -> UInt8:
    """Return the sensor's bytes (H, W) uint8 of incoming light, times `gain` 1 = white.

    Lens blur, photon noise (Poisson's is Gaussian at tens of electrons and more), read noise.
    """
    import cv2

    if config.psf_px > 0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), config.psf_px), np.float32)
    noise = rng.integers(0, 1 << 16, light.shape, dtype=np.uint16)
    dark, per_value = config.electron_noise
    out = np.empty(light.shape, np.uint8)
    _to_bytes(light, noise, _quantiles(), np.array([gain, dark, per_value], np.float32), out)
    return out


@lru_cache(maxsize=1)
def _quantiles() -> Array32:
    """Return the normal distribution at 65536 equal steps of probability: to 4.3 deviations.

    Looked up by sixteen random bits it costs a quarter of a normal random number.
    """
    from scipy.special import ndtri

    return np.asarray(ndtri((np.arange(1 << 16) + 0.5) / (1 << 16)), np.float32)


@njit(fastmath=True)
def _to_bytes(light: Array32, noise: UInt16, normal: Array32, sensor: Array32, out: UInt8) -> None:
    """Write bytes from light: value + sqrt(dark + value per_value) noise, clipped and rounded."""
    gain, dark, per_value = sensor
    white, half = np.float32(255.0), np.float32(0.5)
    for v in range(light.shape[0]):
        for u in range(light.shape[1]):
            value = min(max(light[v, u] * gain, np.float32(0.0)), np.float32(1.0))
            value += np.sqrt(dark + value * per_value) * normal[noise[v, u]]
            out[v, u] = np.uint8(min(max(value * white + half, np.float32(0.0)), white))
