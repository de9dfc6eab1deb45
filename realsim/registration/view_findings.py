"""What can be wrong with a view, and when it is said to be."""

from dataclasses import dataclass, field
from typing import Literal

from realsim.registration.find_table import TableSearchConfig

Kind = Literal[
    "no_depth", "little_depth", "table_off", "foreign", "partly_foreign", "pose_of_another",
    "slipped", "all_disagree", "objects_off", "odometry",
]  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewCheckConfig:
    """When a view is said to be wrong. Measured on simulated and real scenes: see the tests."""

    table: TableSearchConfig = field(default_factory=TableSearchConfig)
    """How a view's own table is found."""
    least_view_points: int = 50
    """Views with fewer trusted points are left out."""
    little_share: float = 0.25
    """A view with less than this share of the others' median depth pixels is named."""
    table_height_m: float = 0.008
    """The table may be this far from where the others see it [m]: a hand-eye off by 1.5 mm and
    0.4 deg moves it by 2 mm, forward kinematics by 1 mm."""
    table_tilt_deg: float = 2.0
    """And be tilted by so much [deg]: the same hand-eye tilts it by 0.6 deg."""
    table_spreads: float = 6.0
    """Or by so many median absolute deviations of the views, if that is more."""
    table_kept: float = 0.8
    """The common table holds less than this share of the points on the view's own: it is off."""
    above_m: float = 0.008
    """Points higher than this over the table are of what stands there [m]."""
    margin_m: float = 0.008
    """Depths that differ by less agree [m]: twice what a 0.4 deg hand-eye does at 0.5 m."""
    sigmas: float = 3.0
    """Plus so many sigma_z."""
    points: int = 300
    """Points of a view that others are asked about, of each kind."""
    near: int = 3
    """Partners of a view: the nearest."""
    spread: int = 5
    """And views spread over the session."""
    worst_share: float = 0.6
    """At first only views with this share of the worst one's contradictions are set aside."""
    rounds: int = 6
    """Views are held against sound ones only; which these are settles in 2 or 3 rounds."""
    least_decided: int = 60
    """With fewer points that partners decide upon, nothing is said."""
    foreign_share: float = 0.30
    """More than this share of a view's points looked through by most others: another scene's, or
    another pose's. Clean views: up to 0.015 (0.4 deg hand-eye); foreign ones: 0.5 to 1."""
    partly_share: float = 0.10
    """More than this: something was moved, or the pose is off by a centimetre."""
    spreads: float = 8.0
    """Or so many median absolute deviations of the views above their median, if that is more."""
    solved_share: float = 0.3
    """Another pose explains a view if it leaves less than this share of its contradictions."""
    scene_support: float = 0.2
    """Points that agree less those looked through; below it the views are not of one scene. Clean
    scenes: 0.55 to 0.7."""
    trial_gain: float = 0.2
    """A mistake of all poses is named if undoing it raises the support by this."""
    trial_views: int = 24
    """Views by which mistakes of all poses are tried."""
    object_reach_m: float = 0.01
    """After registration: a point this far from every object is not explained [m]."""
    object_share: float = 0.35
    """A view with so much more of them than the median view does not fit the objects."""
    seed: int = 0
    """Of the choice of points."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewFinding:
    """What is wrong with a view."""

    index: int | None
    """Number of the view; None = all of them."""
    kind: Kind
    words: str
    """One sentence for a person."""
    exclude: bool
    """Whether the view is to be left out of the registration."""
