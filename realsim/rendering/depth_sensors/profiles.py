"""Depth cameras by name, and fitted ones as records of plain numbers in files.

The profiles' figures are those of the makers' data sheets; what differs from unit to unit (noise,
loss) is fitted to a user's own frames and stands in a sensor's file.
"""

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from realsim.errors import InputError
from realsim.untrusted import json_text


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

NOMINAL_FOCAL_PX = {"d405": {(1280, 720): 646.0, (640, 480): 386.3}}
"""Focal length of a kind by image size, where a folder of frames brings no camera: a typical unit's
calibration; and what makes the step of real frames 1/32 px (0.6 x the other, to 0.4 %)."""


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


class SensorRecord:
    """What a sensor's dataclass inherits; all of its fields have plain defaults."""

    __slots__ = ()
    FORMAT: ClassVar[str]
    """What the key "format" of its JSON files says."""
    KEY: ClassVar[str]
    """The key of its fields in them."""
    NAME: ClassVar[str]
    """How messages call it."""
    COMMAND: ClassVar[str]
    """What writes such files."""

    @classmethod
    def from_fields(cls, values: Mapping[str, Any], source: str) -> Self:
        """Return the record of named values; fields that are not named keep their defaults.

        Args:
            values: field and value.
            source: where they are from, for the message.

        Raises:
            InputError: a name is no field, a value has the wrong type or is out of range.
        """
        known: dict[str, type[Any]] = {f.name: type(f.default) for f in fields(cls)}  # type: ignore[arg-type]
        for name, value in values.items():
            if name not in known:
                raise InputError(
                    f"{source}: {cls.NAME} has no '{name}'; it has: {', '.join(known)}."
                )
            kind = known[name]
            right = isinstance(value, bool) if kind is bool else _is_number(value, kind)
            if not right:
                raise InputError(
                    f"{source}: {name} is {value!r:.60}; a finite {kind.__name__} is accepted."
                )
        return cls(**{n: known[n](v) for n, v in values.items()})

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Return the sensor in a JSON file that `realsim depth-fit` wrote.

        Raises:
            InputError: the file cannot be read, is of another kind, or holds a wrong value.
        """
        path = Path(path)
        try:
            document = json_text.read_json(path)
        except InputError as error:
            raise InputError(f"{error} Give the file that `{cls.COMMAND}` writes.") from error
        if not isinstance(document, dict) or document.get("format") != cls.FORMAT:
            raise InputError(
                f"{path} is no {cls.FORMAT.removeprefix('realsim ').rstrip(' 0123456789')} model: "
                f"its format is not '{cls.FORMAT}'. Give the file that `{cls.COMMAND}` writes."
            )
        values = document.get(cls.KEY)
        if not isinstance(values, dict):
            raise InputError(f"{path} has no object '{cls.KEY}'.")
        return cls.from_fields(values, str(path))

    def document(self) -> dict[str, Any]:
        """Return what `load` reads, ready for JSON."""
        return {"format": self.FORMAT, self.KEY: asdict(self)}  # type: ignore[call-overload]


def _is_number(value: object, kind: type) -> bool:
    """Return whether a value is a finite number, and a whole one where that is wanted."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    is_finite = abs(value) <= sys.float_info.max  # of whole numbers beyond all floats as well
    return is_finite and (kind is float or float(value).is_integer())
