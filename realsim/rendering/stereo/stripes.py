"""Structured light: a projector takes the second eye's place and writes its column on the scene.

Each pixel decodes the projector's column from a phase, so nothing is searched; what goes wrong is
light. The phase's noise falls with the pattern's light (photon noise: Malacara, Optical Shop
Testing, ch. 14: sigma_phase ~ 1 / contrast), pixels that see two depths blend two phases, and what
the projector does not reach has none.
"""

import numpy as np

from realsim.arrays import Array32
from realsim.compiled import njit
from realsim.rendering.depth_sensors.noise import correlated
from realsim.rendering.stereo.config import StereoConfig
from realsim.rendering.stereo.shading import SHADOW_SLACK

SATURATION = 6.0
"""Pattern light beyond which a pixel is overexposed; 1 = white paper at 1 m, facing. The highest
level that automatic exposure leaves room for."""
LEAST_NOISE_RATIO = 0.05
"""Light beyond this many times white paper's at 1 m makes the phase no better."""


def decoded(
    depth_m: Array32,
    projector_depth_m: Array32,
    signal: Array32,
    room: Array32,
    disparity_per_inverse_depth: float,
    config: StereoConfig,
    rng: np.random.Generator,
) -> Array32:
    """Return the decoded disparity (H, W) [px], 0 = none.

    Args:
        depth_m: (H, W) first hits of the eye; 0 = nothing.
        projector_depth_m: (H, W) first hits of the projector, rectified with the eye.
        signal: (H, W) what comes back of an evenly lit field: 1 = white paper at 1 m, facing.
        room: (H, W) the room's light, 1 = white paper.
        disparity_per_inverse_depth: focal length times baseline [px m].
        config: noise and limits.
        rng: source of chance.
    """
    import cv2

    fB = np.float32(disparity_per_inverse_depth)
    noise = correlated(rng, depth_m.shape, config.stripe_correlation_px)
    exact = np.where(depth_m > 0, fB / np.where(depth_m > 0, depth_m, 1), 0).astype(np.float32)
    lit = np.empty(depth_m.shape, np.float32)
    _reached(depth_m, exact, projector_depth_m, signal, lit)
    per_px = np.float32(2 * np.pi / config.stripe_period_px)
    cosine, sine = np.empty_like(lit), np.empty_like(lit)
    _phasors(exact, lit, per_px, cosine, sine)

    blurred = [np.asarray(a, np.float32) for a in (cosine, sine, lit)]
    if config.psf_px > 0:
        blurred = [np.asarray(cv2.GaussianBlur(a, (0, 0), config.psf_px)) for a in blurred]
    limits = np.array(
        [per_px, config.stripe_noise_px, config.least_signal, config.least_modulation], np.float32
    )
    out = np.empty_like(lit)
    _decode(exact, (blurred[0], blurred[1], blurred[2]), room, noise, limits, out)
    return out


@njit
def _reached(
    depth: Array32, exact: Array32, projector_depth: Array32, signal: Array32, out: Array32
) -> None:
    """Write the pattern's light where the projector reaches, 0 in its shadow and outside it."""
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            out[v, u] = np.float32(0.0)
            x = np.float32(u) - exact[v, u]
            i = int(np.floor(x))
            if depth[v, u] <= 0 or i < 0 or i + 1 >= width:
                continue
            limit = depth[v, u] * np.float32(1.0 - SHADOW_SLACK)
            near, far = projector_depth[v, i], projector_depth[v, i + 1]
            if not (0 < near < limit and 0 < far < limit):
                out[v, u] = signal[v, u]


@njit(fastmath=True)
def _phasors(
    exact: Array32, lit: Array32, per_px: float | np.float32, cosine: Array32, sine: Array32
) -> None:
    """Write the pattern's light times the cosine and sine of its phase."""
    for v in range(exact.shape[0]):
        for u in range(exact.shape[1]):
            cosine[v, u] = lit[v, u] * np.cos(per_px * exact[v, u])
            sine[v, u] = lit[v, u] * np.sin(per_px * exact[v, u])


@njit
def _decode(
    exact: Array32,
    blurred: tuple[Array32, Array32, Array32],
    room: Array32,
    noise: Array32,
    limits: Array32,
    out: Array32,
) -> None:
    """Write the disparity of the blended phase, with noise, or 0 where it cannot be read."""
    cosine, sine, lit = blurred
    per_px, noise_px, least_signal, least_modulation = limits
    turn = np.float32(2 * np.pi)
    for v in range(exact.shape[0]):
        for u in range(exact.shape[1]):
            out[v, u] = np.float32(0.0)
            light = lit[v, u]
            if exact[v, u] <= 0 or light < least_signal or light > np.float32(SATURATION):
                continue
            contrast = np.sqrt(cosine[v, u] ** 2 + sine[v, u] ** 2)
            if contrast < least_modulation * light:
                continue
            # The coarse stripes settle the period; the finest one says where in it.
            shift = np.arctan2(sine[v, u], cosine[v, u]) - per_px * exact[v, u]
            shift -= turn * np.round(shift / turn)
            photons = np.sqrt(light + room[v, u] + np.float32(0.01)) / contrast
            sigma = noise_px * max(photons, np.float32(LEAST_NOISE_RATIO))
            out[v, u] = exact[v, u] + shift / per_px + sigma * noise[v, u]
