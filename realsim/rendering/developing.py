"""From linear light to the picture: exposure, noise of the sensor, highlights, sRGB."""

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]
SHOULDER = 0.8
"""Above this share of white the picture approaches white instead of clipping, so that highlights
keep their shape; below it, it is linear light in sRGB. A value of 1 becomes 247 of 255."""


def srgb_encoded(value: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return sRGB [0, 1] of linear light [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.power(value, 1 / 2.4) - 0.055)


def srgb_decoded(value: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return linear light [0, 1] of sRGB [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, np.power((value + 0.055) / 1.055, 2.4))


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
) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) of exposed linear light (H, W, 3), 1 = white.

    Args:
        light: radiance times exposure, not negative.
        rng: source of the sensor's noise; None = no noise.
        full_well: electrons at white; their square root is the shot noise.
        read_noise: electrons of noise in the dark.
    """
    value = np.clip(light, 0.0, 4.0)
    if rng is not None:
        variance = (value * np.float32(full_well) + np.float32(read_noise**2)) / np.float32(
            full_well**2
        )
        noise = rng.standard_normal(value.shape, dtype=np.float32)
        noise *= np.sqrt(variance)
        value = np.clip(value + noise, 0.0, 4.0)
    at = np.sqrt(value) * np.float32(0.5 * (len(ENCODING) - 1))
    step = np.minimum(at.astype(np.int32), len(ENCODING) - 2)
    low = ENCODING[step]
    low += (at - step) * (ENCODING[step + 1] - low)
    return np.round(low).astype(np.uint8)
