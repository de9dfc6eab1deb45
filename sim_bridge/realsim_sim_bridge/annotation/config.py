"""Settings of the annotation."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from realsim.errors import InputError

MAPS = ("instance", "depth", "coordinates", "normals")
"""Maps of a view that can be written, in the order they are named in files."""
DEFAULT_MAPS = ("instance", "depth")


def maps_of(text: str) -> tuple[str, ...]:
    """Return the maps of 'all', 'none' or a list such as 'instance,depth', in one order.

    Raises:
        InputError: a map that does not exist.
    """
    if text in ("all", "none"):
        return MAPS if text == "all" else ()
    return checked_maps(t.strip() for t in text.split(","))


def checked_maps(names: Iterable[str]) -> tuple[str, ...]:
    """Return the maps named, each once and in one order.

    Raises:
        InputError: a map that does not exist.
    """
    wanted = set(names)
    unknown = sorted(wanted - set(MAPS))
    if unknown:
        raise InputError(
            f"there is no map {', '.join(map(repr, unknown))}; 'all', 'none', or some of "
            f"{', '.join(MAPS)} are accepted."
        )
    return tuple(name for name in MAPS if name in wanted)


@dataclass(frozen=True, kw_only=True, slots=True)
class SightConfig:
    """When a contact counts as seen."""

    clearance_m: float = 0.002
    """How far outside the contact the line of sight ends [m]: half a thin pad. With it a camera
    0.5 m above a 50 mm wide box sees both contacts down to 40 mm below the edge."""
    tolerance_m: float = 0.001
    """How far before the end of the line a surface may lie without hiding it [m]; above float32
    rounding (0.1 um) and the error of a decimated mesh, below the clearance."""


@dataclass(frozen=True, kw_only=True, slots=True)
class OccluderConfig:
    """When a nearer measurement is a thing that is not in the model, and not noise or a bad pose.

    A pixel speaks for a thing where the measurement is nearer than every rendered surface within
    `edge_px` by more than `base_m` + `sigmas` standard deviations of the depth.
    """

    is_on: bool = True
    """Whether the measured depth may take pixels out of the visible masks."""
    base_m: float = 0.010
    """Difference that pose and table may be wrong by [m]; BOP's own tolerance is 0.015."""
    sigmas: float = 4.0
    """Standard deviations of the depth on top; at four, three pixels in 100,000 reach it."""
    disparity_noise_px: float = 0.08
    """Noise of the disparity [px]; the usual figure for RealSense stereo."""
    baseline_m: float = 0.018
    """Distance of the stereo eyes [m]; the D405's, the shortest and so the noisiest in use."""
    edge_px: int = 4
    """Half-width of the stereo matching window [px]: so far a near surface's depth spreads over
    what lies behind it, and 3 mm of pose error move an edge about as far."""
    least_width_px: int = 5
    """Thinner regions are fattened edges [px]; a cable 5 mm thick is 6 px at 0.5 m, f = 650 px."""
    least_region_px: int = 60
    """Smaller regions are speckle [px]; the mean hole of a D405 is about 80 px."""
    suspect_share: float = 0.5
    """Share of an object's measured pixels from which a disagreement may as well be its pose."""
    suspect_farther: float = 0.10
    """Share of an object's measured pixels beyond which a measurement that looks through it speaks
    against its pose: a thing in front is only ever nearer."""
    certain_gap_m: float = 0.05
    """A suspect whose occluder stands nearer than this to it [m] keeps its mask: registration errs
    by millimetres, so that beyond it is a thing, and within it may be a pose or a depth bias."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("base_m", "sigmas", "disparity_noise_px", "edge_px", "certain_gap_m"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name} is {getattr(self, name)}; 0 or more is accepted.")
        for name in ("baseline_m", "least_width_px", "least_region_px"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name)}; more than 0 is accepted.")
        if not 0 < self.suspect_share <= 1:
            raise InputError(f"suspect_share is {self.suspect_share}; above 0, at most 1.")

    def noise_per_z2(self, fx: float) -> float:
        """Return `sigmas` standard deviations of depth divided by depth squared [1/m].

        sigma_z = z^2 sigma_d / (f B), the error propagation of z = f B / d.
        """
        return self.sigmas * self.disparity_noise_px / (fx * self.baseline_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class AnnotationConfig:
    """Settings of the annotation."""

    agreement_tolerance_m: float = 0.01
    """Up to which difference measured and rendered depth agree [m]: about three sigma of a D405 at
    0.5 m plus a few millimetres of pose error; BOP's own tolerance is 0.015."""
    plane_clearance_m: float = 0.002
    """How far under the fitted plane the table that hides things lies [m], so that the error of
    plane and pose does not cut off an object's lowest pixels."""
    table_m: float = 4.0
    """Edge of the table that hides things [m]: larger than any table, seen from any view."""
    table_thickness_m: float = 0.02
    """Thickness of that table [m]; a camera under it sees its underside."""
    maps: tuple[str, ...] = DEFAULT_MAPS
    """Maps written of every view, of `MAPS`."""
    surface_points: int = 4096
    """Points of an object's surface cloud; four times what point networks usually take in."""
    sight: SightConfig = field(default_factory=SightConfig)
    """When a grasp contact counts as seen."""
    occluder: OccluderConfig = field(default_factory=OccluderConfig)
    """When something that is not in the scene hides an object."""

    def __post_init__(self) -> None:
        """Bring the maps into one order.

        Raises:
            InputError: a map that does not exist, or no surface points.
        """
        object.__setattr__(self, "maps", checked_maps(self.maps))
        if self.surface_points < 1:
            raise InputError(f"surface_points is {self.surface_points}; 1 or more is accepted.")
