"""The lens models that are tried, from the pinhole to the rational, and beliefs about a lens."""

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim_calibration.fit.view_system import camera_vector
from realsim_calibration.lens.bundle import CAMERA_TERMS, GLOBALS, Prior

TERM_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Order of every camera vector and covariance (OpenCV's)."""
MODELS: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "k1": ("k1",),
    "k1 k2": ("k1", "k2"),
    "k1 k2 p1 p2": ("k1", "k2", "p1", "p2"),
    "Brown 5": ("k1", "k2", "p1", "p2", "k3"),
    "rational 8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Distortion terms that each model estimates, the smallest model first."""
SMALLEST_RADIUS = 0.1
"""Least half field of view (as a tangent) that the distortion's priors are scaled with."""


FOCAL_SD = 0.02
"""Focal length about the one given in `start`, relative; without a start it is free."""
ASPECT_SD = 0.004
"""fx / fy about 1 (or that of `start`), relative: pixels are square, resampled images nearly.
Without it a print that is too tall cannot be told from such a sensor unless the board rolls."""
CENTER_SD = 0.03
"""Principal point about the image's middle (or that of `start`), in longer image sides."""
RADIAL_SD = (0.25, 0.25, 0.15)
"""Displacement in the image's corner due to k1, k2, k3 (and k4, k5, k6), relative to the
corner's distance from the centre. Stated in the image's corner because k1 means nothing
without the field of view: 0.1 is nothing on a long lens and a fisheye on a wide one."""
TANGENTIAL_SD = 0.004
"""The same of p1 and p2: a lens that is off its axis or tilted."""
BOARD_ASPECT_SD = 0.003
"""Height of the print relative to its width: printers stretch the paper by up to 0.5 %."""
BOARD_WARP_SD = 0.01
"""Bending of the board, lift at its end relative to half its longer side: 1 mm at 0.1 m."""


def corner_radius(camera: Array, image_size: tuple[int, int]) -> float:
    """Return the distance of the farthest image corner from the axis, as a tangent."""
    width, height = image_size
    x = max(camera[2] + 0.5, width - 0.5 - camera[2]) / camera[0]
    y = max(camera[3] + 0.5, height - 0.5 - camera[3]) / camera[1]
    return float(max(np.hypot(x, y), SMALLEST_RADIUS))


def lens_prior(focal: float, image_size: tuple[int, int], start: CameraIntrinsics | None) -> Prior:
    """Return the prior of a lens and a board, all terms free.

    Args:
        focal: rough focal length, which sets the distortion's scale [px].
        image_size: width and height.
        start: known intrinsics, the prior's centre; None = the middle of the image, no distortion.
    """
    width, height = image_size
    mean = np.zeros(GLOBALS)
    mean[:4] = focal, focal, (width - 1) / 2, (height - 1) / 2
    if start is not None:
        mean[:CAMERA_TERMS] = camera_vector(start)
    radius = corner_radius(mean, image_size)
    k = np.array(RADIAL_SD) / radius ** np.array([2, 4, 6])
    # A point at the radius r moves by up to 3 p r^2.
    p = TANGENTIAL_SD / (3 * radius)
    f = np.inf if start is None else FOCAL_SD
    center = CENTER_SD * max(image_size)
    board = [BOARD_ASPECT_SD] + [BOARD_WARP_SD] * 3
    sd = np.array([f, f, center, center, k[0], k[1], p, p, k[2], *k, *board])
    return Prior(mean=mean, sd=sd, aspect_sd=ASPECT_SD, free=np.ones(GLOBALS, dtype=bool))


def free_terms(model: str, held: tuple[str, ...] = (), board: bool = True) -> Mask:
    """Return the mask (16,) of the globals that a model estimates.

    Args:
        model: a name in MODELS.
        held: terms that are held nevertheless.
        board: whether the board's shape is estimated.

    Raises:
        InputError: there is no such model.
    """
    if model not in MODELS:
        raise InputError(
            f"the lens model '{model}' is not known; {', '.join(repr(m) for m in MODELS)} are."
        )
    names = ("fx", "fy", "cx", "cy", *MODELS[model])
    camera = [name in names and name not in held for name in TERM_NAMES]
    return np.array(camera + [board] * (GLOBALS - CAMERA_TERMS))
