"""Intel's Open Image Denoise on linear pictures, guided by albedo and normals."""

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]
RIM_PX = 16
"""Mirrored pixels around the picture while it is denoised: the network errs by a tenth of the
light in the last pixels of a corner."""


def has_denoiser() -> bool:
    """Return whether Open Image Denoise can be loaded."""
    try:
        import pyoidn  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except (ImportError, OSError):
        return False
    return True


def denoised(color: Array32, albedo: Array32, normal: Array32) -> Array32:
    """Return a picture without the noise of its few samples.

    The picture must be made with a box filter: a wider one correlates the noise of neighbouring
    pixels, and the network takes that for texture.

    Args:
        color: (H, W, 3) linear radiance.
        albedo: (H, W, 3) mean reflectance of what the pixels see, [0, 1].
        normal: (H, W, 3) mean normal of what the pixels see.
    """
    import pyoidn

    around = ((RIM_PX, RIM_PX), (RIM_PX, RIM_PX), (0, 0))
    images = [np.pad(image, around, mode="symmetric") for image in (color, albedo, normal)]
    clean = pyoidn.denoise(images[0], albedo=images[1], normal=images[2], hdr=True)
    inside = np.asarray(clean, np.float32)[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX]
    return np.maximum(inside, 0.0)
