"""How things look: the material of a surface and the light of the surroundings.

Both renderers read these: the embedded one and the photoreal one. Colours are linear light unless
a field says sRGB. The material follows the metallic-roughness model of glTF 2.0 (base colour,
metallic, roughness), which Mitsuba's `principled` and Isaac Sim's OmniPBR share.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array32, UInt8
from realsim.errors import InputError
from realsim.records.checked_arrays import frozen

Color = tuple[float, float, float]
LEAST_ROUGHNESS = 0.04
"""Smoother surfaces are mirrors, which neither renderer can sample."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Material:
    """The look of a surface: base colour, roughness, metal or not, and how images lie on it."""

    base_color: Color = (0.8, 0.8, 0.8)
    """Linear reflectance [0, 1]; multiplies the image where there is one."""
    base_color_image: UInt8 | None = None
    """(H, W, 3) sRGB, first row at v = 1; None = the base colour alone."""
    roughness: float = 0.5
    """Perceptual roughness [0.04, 1] (alpha = roughness^2); multiplies its image."""
    roughness_image: UInt8 | None = None
    """(H, W) linear, 255 = `roughness` itself; None = even."""
    metallic: float = 0.0
    """0 = plastic, wood, stone; 1 = metal."""
    normal_image: UInt8 | None = None
    """(H, W, 3) tangent-space normals (glTF, OpenGL's y up): (value - 128) / 127, so that 128 is
    exactly "not tilted" and (128, 128, 255) is flat; None = flat."""
    projection: Literal["uv", "box"] = "box"
    """uv: the mesh's own texture coordinates. box: the image is laid on along each face's dominant
    axis of the mesh's frame, for meshes without coordinates and for procedural materials."""
    period_m: float = 0.3
    """Edge of one tile of the images where the projection is `box` [m]."""
    name: str = "plain"
    """What it is, for people: 'oak', 'brushed steel'."""

    def __post_init__(self) -> None:
        """Check the ranges and freeze the images."""
        if not all(0 <= c <= 1 for c in self.base_color):
            raise InputError(
                f"material '{self.name}': the base colour is {self.base_color}; linear values from "
                "0 to 1 are accepted (divide 8-bit values by 255 and decode sRGB)."
            )
        if not LEAST_ROUGHNESS <= self.roughness <= 1 or not 0 <= self.metallic <= 1:
            raise InputError(
                f"material '{self.name}': roughness {self.roughness}, metallic {self.metallic}; "
                f"roughness from {LEAST_ROUGHNESS} to 1 and metallic from 0 to 1 are accepted."
            )
        if not self.period_m > 0:
            raise InputError(f"material '{self.name}': a tile of {self.period_m} m has no size.")
        for field, shape in (
            ("base_color_image", (None, None, 3)),
            ("roughness_image", (None, None)),
            ("normal_image", (None, None, 3)),
        ):
            image = getattr(self, field)
            if image is not None:
                name = f"material '{self.name}': {field}"
                object.__setattr__(self, field, frozen(image, np.uint8, shape, name))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Environment:
    """The light that comes from far away: a panorama of the sky or the room, and a sun in it."""

    panorama: Array32
    """(H, 2H, 3) linear radiance, equirectangular. Row 0 looks straight up (+z of the world), the
    last row straight down. Column c looks along azimuth phi = 2 pi (c + 0.5) / 2H, so towards
    (cos phi, sin phi): +x at the left border, +y a quarter of the way to the right. The sun, if
    one is given below, is NOT in it."""
    sun_direction: Color = (0.35, -0.45, 1.0)
    """World direction towards the sun; of any length."""
    sun: Color = (0.0, 0.0, 0.0)
    """What the sun adds to the radiance of a white matte surface that faces it (its irradiance
    divided by pi); zeros = no sun."""
    sun_radius_deg: float = 0.5
    """Half the angle under which the sun is seen [deg]: how soft shadows are. 0 = hard."""
    exposure: float = 1.0
    """Factor from radiance to the value in which 1 is white in the picture."""
    name: str = "sky"
    """What it is, for people."""

    def __post_init__(self) -> None:
        """Check shape and ranges and freeze the panorama."""
        p = frozen(self.panorama, np.float32, (None, None, 3), f"environment '{self.name}'")
        if p.shape[1] != 2 * p.shape[0]:
            raise InputError(
                f"environment '{self.name}': the panorama is {p.shape[1]}x{p.shape[0]}; an "
                "equirectangular one is twice as wide as high."
            )
        if not np.all(np.isfinite(p)) or float(p.min()) < 0:
            raise InputError(
                f"environment '{self.name}': radiances must be finite and not negative; found "
                f"{float(np.min(p)):g} to {float(np.max(p)):g}."
            )
        if not np.linalg.norm(self.sun_direction) > 0:
            raise InputError(
                f"environment '{self.name}': the sun has no direction; (0, 0, 1) is overhead."
            )
        if min(self.sun) < 0 or not self.exposure > 0 or not 0 <= self.sun_radius_deg < 45:
            raise InputError(
                f"environment '{self.name}': sun {self.sun}, exposure {self.exposure}, sun radius "
                f"{self.sun_radius_deg} deg; a sun of 0 or more, a positive exposure and a radius "
                "from 0 to 45 deg are accepted."
            )
        object.__setattr__(self, "panorama", p)
