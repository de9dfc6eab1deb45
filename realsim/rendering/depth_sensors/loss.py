"""What a depth sensor loses: too little light comes back, the surface shines, or chance.

The light that a point returns from the sensor's own projector, or what texture has left of its
contrast at that distance, falls as 1/z^2, with the cosine of the angle of view, and with the
surface's reflectance (Lambert). A pixel is lost when that signal is under a threshold that varies
from place to place: a normal distribution in the logarithm of the signal.
"""

import numpy as np

from realsim.arrays import Array, Array32, Mask, UInt8
from realsim.geometry.colors import light_of_bytes, luminance
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Material
from realsim.rendering.rays import PlacedMesh

DARK_REFLECTANCE, DARK_SPREAD = 0.03, 0.6
"""Linear reflectance at which half of a dark surface is lost, and how soft that limit is [ln]:
sRGB 48 of 255, black plastic and rubber, which projected patterns show in patches."""
SHINY_LOSS = 0.6
"""Share lost of a polished metal seen from the working distance: its highlight blinds, and its
mirror image of the surroundings gives wrong matches."""
TEXELS = 10_000
"""Number of texels, evenly spread, that make a texture's mean."""


def signal_loss(
    depth_m: Array32,
    cosine: Array32,
    range_m: float,
    spread: float,
    reflectance: Array32 | None = None,
) -> Array32:
    """Return the share (H, W) of pixels lost for want of signal: Phi(-ln(S) / spread).

    S = (range / z)^2 cos(angle) reflectance is the signal over the threshold.

    Args:
        depth_m: (H, W) exact depth [m], 0 = nothing.
        cosine: (H, W) of the angle between ray and surface normal.
        range_m: depth at which half of a white surface seen frontally is lost [m].
        spread: standard deviation of the threshold [natural logarithm].
        reflectance: (H, W) linear [0, 1]; None = white.
    """
    from scipy.special import ndtr

    z = np.where(depth_m > 0, depth_m, np.float32(range_m))
    signal = np.square(np.float32(range_m) / z) * np.maximum(cosine, 1e-6)
    if reflectance is not None:
        signal = signal * np.maximum(reflectance, 1e-6)
    return np.asarray(ndtr(-np.log(signal) / np.float32(spread)), np.float32)


def cosine_of_view(disparity: Array32, intrinsics: CameraIntrinsics) -> Array32:
    """Return the cosine (H, W) of the angle between each pixel's ray and its surface's normal.

    On a plane n . X = 1 inverse depth is w = n . ray, linear in the pixel: with its slopes
    n = (fx w_u, fy w_v, w - (u - cx) w_u - (v - cy) w_v) and cos = w / (|n| |ray|). Disparity
    is w times a constant, which cancels.
    """
    i = intrinsics
    u = np.arange(i.width, dtype=np.float32)[None] - np.float32(i.cx)
    v = np.arange(i.height, dtype=np.float32)[:, None] - np.float32(i.cy)
    du, dv = _smooth_slope(disparity, 1), _smooth_slope(disparity, 0)
    nx, ny, nz = np.float32(i.fx) * du, np.float32(i.fy) * dv, disparity - u * du - v * dv
    ray = np.sqrt((u / np.float32(i.fx)) ** 2 + (v / np.float32(i.fy)) ** 2 + 1)
    length = np.maximum(np.sqrt(nx * nx + ny * ny + nz * nz) * ray, 1e-9)
    return (disparity / length).astype(np.float32, copy=False)


def grazing_loss(cosine: Array32, from_deg: float, to_deg: float) -> Array32:
    """Return the share (H, W) lost because the surface is seen edge-on: a ramp in the angle."""
    angle = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    span = max(to_deg - from_deg, 1e-6)
    return np.clip((angle - from_deg) / span, 0, 1).astype(np.float32)


def _smooth_slope(values: Array32, axis: int) -> Array32:
    """Return the slope per pixel, the smaller of both sides', so that edges do not count."""
    if values.shape[axis] < 2:
        return np.zeros_like(values)
    step = np.diff(values, axis=axis)
    first, last = np.take(step, [0], axis=axis), np.take(step, [-1], axis=axis)
    ahead = np.concatenate([step, last], axis=axis)
    behind = np.concatenate([first, step], axis=axis)
    return np.where(np.abs(ahead) < np.abs(behind), ahead, behind)


def blob_mask(
    rng: np.random.Generator, shape: tuple[int, int], per_megapixel: float, radius_px: float
) -> Mask:
    """Return where (H, W) holes without cause lie: ellipses at random."""
    import cv2

    height, width = shape
    mask = np.zeros(shape, np.uint8)
    for _ in range(int(rng.poisson(per_megapixel * height * width / 1e6))):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        half = np.maximum(1, np.round(rng.gamma(4.0, radius_px / 4.0, 2)))
        angle = float(rng.uniform(0, 180))
        cv2.ellipse(mask, center, (int(half[0]), int(half[1])), angle, 0, 360, 1, -1)
    return mask > 0


def material_loss(material: Material) -> float:
    """Return the share of pixels that a surface of this material is expected to lose.

    Two causes, independent of each other: dark surfaces return too little light, and polished metal
    returns it in one direction. A rough guess, for materials that nobody has measured; a fit to
    real frames of the object (benchmarks/labels_losses.py) is better.
    """
    from scipy.special import ndtr

    bright = max(float(luminance(_mean_color(material))), 1e-4)
    dark = float(ndtr(np.log(DARK_REFLECTANCE / bright) / DARK_SPREAD))
    shiny = SHINY_LOSS * material.metallic * (1 - material.roughness) ** 2
    return 1 - (1 - dark) * (1 - shiny)


def look_of(placed: PlacedMesh) -> Material:
    """Return a mesh's material with its mean colour as the base colour, without images.

    A mesh without a material has the mean of its texture or colours, else a light grey.
    """
    look, mesh = placed.material, placed.mesh
    if look is None:
        look = Material()
        own = mesh.colors if mesh.texture is None else mesh.texture
        mean = np.array(look.base_color) if own is None else _mean_srgb(own)
    else:
        mean = _mean_color(look)
    r, g, b = np.clip(mean, 0.0, 1.0).tolist()
    return Material(base_color=(r, g, b), roughness=look.roughness, metallic=look.metallic)


def _mean_color(material: Material) -> Array:
    """Return the linear base colour (3,), averaged over the image where there is one."""
    base = np.array(material.base_color)
    image = material.base_color_image
    return base if image is None else base * _mean_srgb(image)


def _mean_srgb(values: UInt8) -> Array:
    """Return the mean linear light (3,) of 8-bit sRGB values (..., 3)."""
    flat = values.reshape(-1, 3)
    flat = flat[:: max(1, len(flat) // TEXELS)]
    return light_of_bytes(flat).mean(0)
