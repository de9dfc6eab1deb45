"""From linear light to the picture: exposure, noise of the sensor, highlights, sRGB."""

import numpy as np

from realsim.arrays import Array32, UInt8
from realsim.compiled import njit
from realsim.geometry.colors import srgb_encoded

SHOULDER = 0.8
"""Above this share of white the picture approaches white instead of clipping, so that highlights
keep their shape; below it, it is linear light in sRGB. A value of 1 becomes 247 of 255."""


def _encoding() -> Array32:
    """Return the 8-bit value (before rounding) at 4096 steps of the root of the light, to 4."""
    light = np.square(np.linspace(0.0, 2.0, 4096))
    bent = SHOULDER + (1 - SHOULDER) * (1 - np.exp(-(light - SHOULDER) / (1 - SHOULDER)))
    return (255.0 * srgb_encoded(np.where(light < SHOULDER, light, bent))).astype(np.float32)


ENCODING = _encoding()


def developed(
    light: Array32,
    rng: np.random.Generator | None = None,
    full_well: float = 9000.0,
    read_noise: float = 8.0,
) -> UInt8:
    """Return the picture (H, W, 3) of exposed linear light (H, W, 3), 1 = white.

    Args:
        light: radiance times exposure, not negative.
        rng: source of the sensor's noise; None = no noise.
        full_well: electrons at white; their square root is the shot noise.
        read_noise: electrons of noise in the dark.
    """
    noise = np.zeros((1, 1, 3), np.float32)
    if rng is not None:
        noise = rng.standard_normal(light.shape, dtype=np.float32)
    out = np.empty(light.shape, np.uint8)
    _develop(light, noise, rng is not None, (full_well, read_noise), ENCODING, out)
    return out


@njit(error_model="numpy")
def _develop(
    light: Array32,
    noise: Array32,
    is_noisy: bool,
    sensor: tuple[float, float],
    encoding: Array32,
    out: UInt8,
) -> None:
    """Fill the picture (H, W, 3); `noise` (H, W, 3) has the standard deviation 1."""
    full_well, dark = np.float32(sensor[0]), np.float32(sensor[1] * sensor[1])
    steps = np.float32(0.5 * (len(encoding) - 1))
    for y in range(light.shape[0]):
        for x in range(light.shape[1]):
            for k in range(3):
                value = min(max(light[y, x, k], np.float32(0)), np.float32(4))
                if is_noisy:
                    deviation = np.sqrt(value * full_well + dark) / full_well
                    value += noise[y, x, k] * deviation
                    value = min(max(value, np.float32(0)), np.float32(4))
                at = np.sqrt(value) * steps
                step = min(int(at), len(encoding) - 2)
                low = encoding[step]
                low += (at - np.float32(step)) * (encoding[step + 1] - low)
                out[y, x, k] = np.uint8(low + np.float32(0.5))
