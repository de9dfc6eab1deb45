"""How synthetic views are made: which renderer, which depth camera.

Where synthetic cameras stand: spread over a hemisphere.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.stereo.config import StereoConfig
from realsim_sim_bridge.annotation.config import MAPS, checked_maps

Renderer = Literal["embedded", "photoreal"]
Depth = Literal["stereo", "disparity", "clean"]
RENDERERS: tuple[Renderer, ...] = ("embedded", "photoreal")
DEPTHS: tuple[Depth, ...] = ("stereo", "disparity", "clean")
LEAST_UNIT_M = 1e-6
"""Finer counts than micrometres would end at 65 mm."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SyntheticConfig:
    """Settings of synthetic views."""

    renderer: Renderer = "embedded"
    """embedded: sun, panorama and shadows on the labels' own rays, about 2 CPU-seconds a frame, no
    system library. photoreal: path traced with Mitsuba, about six times as long."""
    depth: Depth = "disparity"
    """stereo: both eyes' pictures are rendered and matched, as the camera does it. disparity: a
    noise model on exact disparity with exact occlusion shadows, several times cheaper. clean: exact
    depth."""
    profile: str = "d405"
    """The depth camera, by its name in `depth_profiles.PROFILES`."""
    depth_model: DepthSensorModel | None = None
    """Figures of the noise model, as `realsim depth-fit` finds them for a camera at hand; None =
    the profile's. For `disparity` only."""
    depth_unit_m: float | None = None
    """Metres per count of the depth images; None = the fitted model's, or the profile's own."""
    samples: int = 8
    """Photoreal: paths per pixel before denoising; 8 looks as good as 32 after it."""
    maps: tuple[str, ...] = MAPS
    """Label maps written of every view. Clean depth is always among them: it is exact, and nothing
    else in the session is."""

    def __post_init__(self) -> None:
        """Check the names and ranges.

        Raises:
            InputError: an unknown renderer, depth or profile, or a number that cannot be.
        """
        for what, value, known in (
            ("renderer", self.renderer, RENDERERS), ("depth", self.depth, DEPTHS)
        ):  # fmt: skip
            if value not in known:
                raise InputError(
                    f"there is no {what} '{value}'; these are accepted: {', '.join(known)}."
                )
        profile(self.profile)
        if self.depth_model is not None and self.depth != "disparity":
            raise InputError(
                f"a fitted depth model belongs to the depth 'disparity', and '{self.depth}' was "
                "asked for; leave one of them away."
            )
        if self.depth_unit_m is not None and not LEAST_UNIT_M <= self.depth_unit_m <= 0.01:
            raise InputError(
                f"a depth unit of {self.depth_unit_m} m cannot be; 1e-6 to 0.01 m a count is "
                "accepted (0.001 = millimetres)."
            )
        if self.samples < 1:
            raise InputError(f"{self.samples} samples per pixel; 1 or more are accepted.")
        object.__setattr__(self, "maps", checked_maps(("depth", *self.maps)))

    @property
    def unit_m(self) -> float:
        """Metres per count of the depth images."""
        if self.depth_unit_m is not None:
            return self.depth_unit_m
        fitted = 0.0 if self.depth_model is None else self.depth_model.depth_unit_m
        return fitted if fitted >= LEAST_UNIT_M else profile(self.profile).depth_unit_m

    def depth_sensor(self) -> DepthSensorModel | StereoConfig | None:
        """Return where the depth camera's errors come from; None = it has none."""
        if self.depth == "disparity":
            return self.depth_model or DepthSensorModel.from_profile(self.profile)
        return StereoConfig() if self.depth == "stereo" else None


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
