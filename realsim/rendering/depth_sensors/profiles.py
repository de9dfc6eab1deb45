"""Depth cameras by name: their geometry, range and pattern.

The figures are those of the makers' data sheets; what differs from unit to unit (noise, loss) is
fitted to a user's own frames and is not here.
"""

from dataclasses import dataclass
from typing import Literal

from realsim.errors import InputError


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthProfile:
    """A depth camera that finds depth by disparity."""

    name: str
    baseline_m: float
    """Distance of the two eyes, or of eye and projector [m]."""
    min_z_m: float
    """Nearest depth at 1280x720 [m]."""
    max_z_m: float
    """Farthest depth that is kept [m]."""
    pattern: Literal["none", "dots", "stripes"]
    """What is projected: nothing (passive stereo), infrared dots on both eyes' scene, or the coded
    pattern that takes the second eye's place."""
    second_eye: Literal["camera", "projector"] = "camera"
    """What stands at the other end of the baseline. A projector's shadow is lost like what a second
    camera does not see; it lies on the same side."""
    quantum_px: float = 1 / 32
    """Step of the disparity [px]: what the chip interpolates to."""
    depth_unit_m: float = 1e-3
    """Metres per count of the 16-bit depth image."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not 0.001 <= self.baseline_m <= 1.0 or not 0 <= self.min_z_m < self.max_z_m:
            raise InputError(
                f"depth profile '{self.name}': baseline {self.baseline_m} m, depths "
                f"{self.min_z_m} to {self.max_z_m} m; a baseline from 0.001 to 1 m and a range "
                "that is not empty are accepted. Were millimetres given?"
            )


PROFILES: dict[str, DepthProfile] = {
    p.name: p
    for p in (
        DepthProfile(name="d405", baseline_m=0.018, min_z_m=0.10, max_z_m=1.5, pattern="none",
                     depth_unit_m=1e-4),
        DepthProfile(name="d415", baseline_m=0.055, min_z_m=0.45, max_z_m=6.0, pattern="dots"),
        DepthProfile(name="d435", baseline_m=0.050, min_z_m=0.28, max_z_m=6.0, pattern="dots"),
        DepthProfile(name="structured_light", baseline_m=0.075, min_z_m=0.40, max_z_m=4.0,
                     pattern="stripes", second_eye="projector", quantum_px=1 / 8),
    )
}  # fmt: skip
"""Intel's D400 family data sheet (rev. 018: baselines and min-Z by resolution); structured light
as of PrimeSense's Carmine (baseline 75 mm, disparity in eighths of a pixel: Khoshelham and Oude
Elberink, Sensors 2012)."""


def profile(name: str) -> DepthProfile:
    """Return a profile by its name.

    Raises:
        InputError: there is none of this name.
    """
    if name not in PROFILES:
        raise InputError(
            f"there is no depth camera '{name}'; the profiles are: {', '.join(sorted(PROFILES))}."
        )
    return PROFILES[name]
