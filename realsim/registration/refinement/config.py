"""Constants of the joint refinement."""

from dataclasses import dataclass, field

from realsim.records.calibration import DepthBias


@dataclass(frozen=True, kw_only=True, slots=True)
class PointConfig:
    """Which points take part."""

    reach_m: float = 0.005
    """A point further than this from every model is nobody's [m]: the search is right to 3 mm."""
    table_reach_m: float = 0.004
    """A point within this of the table, plus three sigma, may be the table's [m]."""
    foot_m: float = 0.004
    """Near the table a point could be either's: so low over it, points within `reach_m` of a model
    are left out [m]."""
    foot_share: float = 0.2
    """So low is never more than this share of the object's height: plates are nothing but foot."""
    table_margin_m: float = 0.06
    """The table is used up to this far from an object [m]: farther away it may bend."""
    points_per_object: int = 60_000
    """At most so many points of an object over all views: beyond, cameras limit the result."""
    least_points: int = 300
    """An object with fewer points is left where it is."""
    table_points_per_view: int = 1200
    """At most so many of the table in one view."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraPrior:
    """What the cameras' errors may be, 1-sigma per axis."""

    hand_eye_mm: float = 1.0
    """Standard deviation of the constant error of all cameras [mm]: loose, the depth knows it
    better."""
    hand_eye_deg: float = 0.25
    """Standard deviation of the constant turn of all cameras [deg]."""
    arm_constant_mm: float = 0.08
    """Standard deviation per axis of what the arm is off by everywhere alike [mm]: it moves cameras
    and objects together, so that no view shows it. Set on the whole loop, seeds 2000 to 2009 and
    3000 to 3007: a UR5 with calibrated kinematics."""
    view_mm: float = 0.2
    """Standard deviation of each view on its own [mm]: the repeatable part of an arm's error is in
    the hand-eye."""
    view_deg: float = 0.03
    """Standard deviation of each view's own turn [deg]."""
    view_offset_per_m: float = 0.002
    """Standard deviation of a view's own offset of the inverse depth [1/m]: 0.02 px of a D405,
    whose disparity wanders."""
    learn_views: bool = True
    """Whether the views' sigmas are found from the views (if there are `learn_from` or more)."""
    learn_from: int = 6
    """Least number of views from which the views' sigmas are found."""
    learn_factor: tuple[float, float] = (0.25, 40.0)
    """Least and greatest factor by which they may differ from what was said: a real arm in the
    data was off by 4 mm between neighbouring views."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RefineConfig:
    """All constants of the joint refinement."""

    rounds: int = 4
    """Assignments of points to objects; the fourth changes nothing by 0.01 mm."""
    steps: int = 2
    """Gauss-Newton steps in each round."""
    early_share: float = 0.25
    """Share of the points that the rounds before the last use."""
    exact_rounds: int = 1
    """In so many last rounds, thin-walled objects are compared with their triangles instead of the
    distance field, whose cells are as wide as their walls."""
    thin_cells: float = 3.0
    """An object is thin-walled where its wall is thinner than so many cells of its field."""
    thin_share: float = 0.2
    """Share of its surface on which it must be so."""
    flat_m: float = 0.008
    """An object that rises less over the table is placed by the step at its outline [m]."""
    blur_m: tuple[float, ...] = (0.004, 0.002, 0.001)
    """Blur of the step, round by round [m]."""
    free_turn_deg: float = 30.0
    """1-sigma of how far an object may turn from its start [deg]: a body of revolution would turn
    as it likes."""
    bias: DepthBias = field(default_factory=DepthBias.none)
    """Bias of the depth camera with its covariance, from its calibration; the images are as
    measured. `none` has zero covariance and keeps the depth as it is."""
    fit_bias: bool = True
    """Whether the depth's bias is an unknown."""
    unmeasured_scale: float = 0.001
    """1-sigma of the depth's scale if no calibration says it."""
    unmeasured_offset_per_m: float = 0.0035
    """1-sigma of the inverse depth's offset if no calibration says it [1/m]: 0.04 px of a D405."""
    points: PointConfig = field(default_factory=PointConfig)
    prior: CameraPrior = field(default_factory=CameraPrior)
