"""Where synthetic cameras stand: spread over a hemisphere."""

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3

GOLDEN_ANGLE_RAD = np.pi * (3.0 - np.sqrt(5.0))
"""Turn between neighbours on a Fibonacci lattice [rad] (Gonzalez, Math. Geosci. 42, 2010)."""
JITTER = 0.35
"""Random offset of a camera in units of the lattice's pitch: breaks the pattern, and two cameras
still never meet."""
AIM_SHARE = 0.15
"""Spread of the points that are looked at, as a share of the camera's distance: objects come to
lie all over the picture, not always in its middle."""


def hemisphere_cameras(
    center: ArrayLike,
    radius_m: tuple[float, float],
    count: int,
    rng: np.random.Generator,
    elevation_deg: tuple[float, float] = (15.0, 85.0),
) -> Array:
    """Return cameras (N, 4, 4) spread evenly over a band of the hemisphere above a point.

    Directions are a Fibonacci lattice, even in area, each moved by a random part of its pitch and
    the whole turned at random; distances and the points looked at are drawn evenly. The picture's
    up is the world's z.

    Args:
        center: (3,) what the cameras look at, more or less, in world [m].
        radius_m: least and greatest distance from it [m].
        count: how many.
        rng: source of all chance.
        elevation_deg: lowest and highest elevation above the horizon [deg].

    Raises:
        InputError: no cameras, or an empty range.
    """
    low, high = radius_m
    bottom, top = elevation_deg
    if count < 1 or not 0 < low <= high or not -90 < bottom < top <= 90:
        raise InputError(
            f"{count} cameras at {low} to {high} m and {bottom} to {top} deg cannot be; 1 or more, "
            "a positive distance, and elevations that rise from above -90 to 90 are accepted."
        )
    k = np.arange(count) + 0.5 + JITTER * rng.uniform(-1.0, 1.0, count)
    least, most = np.sin(np.radians([bottom, top]))
    height = np.clip(least + (most - least) * k / count, least, most)
    # One pitch of the lattice is the golden angle's neighbour at the distance sqrt(area / N).
    pitch_rad = np.sqrt(2 * np.pi * (most - least) / count) / np.sqrt(1 - height**2)
    azimuth = GOLDEN_ANGLE_RAD * np.arange(count) + rng.uniform(0, 2 * np.pi)
    azimuth = azimuth + JITTER * pitch_rad * rng.uniform(-1.0, 1.0, count)
    level = np.sqrt(1 - height**2)
    away = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], -1)
    distance = rng.uniform(low, high, count)
    middle = np.asarray(center, dtype=np.float64)
    aims = middle + AIM_SHARE * distance[:, None] * rng.uniform(-0.5, 0.5, (count, 3))
    eyes = middle + distance[:, None] * away
    return np.stack([se3.look_at(e, a) for e, a in zip(eyes, aims, strict=True)])
