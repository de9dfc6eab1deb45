"""What structure from motion may do, and when its result is trusted."""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True, slots=True)
class FeatureConfig:
    """SIFT features and their matches."""

    most_features: int = 4096
    """Features kept in an image, the largest first; matching costs their product."""
    wanted_features: int = 2000
    """The contrast threshold is lowered until the median image has so many: about 300 of them match
    in the next view, which a bundle adjustment of 24 views needs for 1 px -> 0.5 mm."""
    peak_thresholds: tuple[float, ...] = (0.0067, 0.002, 0.001)
    """Contrast thresholds of SIFT, tried in turn: COLMAP's own, then lower. Plain wood under even
    light has 30 features at the first and 2000 at the last; below are only noise's."""
    first_octave: int = 0
    """-1 doubles the image first: five times the time, and on 1280 px not a better scale."""
    probe_images: int = 3
    """Images on which the threshold is chosen, evenly spread."""
    max_angle_deg: float = 60.0
    """Pairs of known poses whose optical axes differ by more are not matched: SIFT is lost."""
    neighbours: int = 14
    """Neighbours of a view, nearest by angle, that it is matched with where poses are known."""
    exhaustive_up_to: int = 40
    """Up to so many views all pairs within the angle are matched."""
    max_ratio: float = 0.8
    """Lowe's ratio of the nearest to the second nearest descriptor."""
    verify_px: float = 2.0
    """Epipolar distance of a right match [px]; COLMAP's 4 px is for photographs from the web."""
    min_inliers: int = 15
    """Matches that a pair of views needs to count (COLMAP's)."""
    threads: int = 2
    """Threads of the extraction and the matching; their result does not depend on it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MappingConfig:
    """From matches to cameras and points."""

    reprojection_px: float = 3.0
    """An observation farther from its point's projection is dropped [px]."""
    min_angle_deg: float = 1.5
    """A point seen under a smaller angle has no depth [deg] (COLMAP's)."""
    init_min_inliers: int = 50
    """Matches of the pair with which mapping begins; COLMAP's 100 is too many for a bare table."""
    unknown_camera: str = "SIMPLE_RADIAL"
    """COLMAP camera model where no intrinsics are given: what few views can determine."""
    robust_px: float = 1.0
    """Scale of the Cauchy loss on reprojection errors [px]: SIFT on weak texture errs by 0.5-1."""
    iterations: int = 30
    """Steps of the refinement, at most."""
    known_error_px: float = 12.0
    """With the robot's poses held, observations may be so far off [px]: 4 mm / 0.7 deg at 0.4 m;
    poses that are worse than that show up in few points."""
    refine_rounds: int = 3
    """Triangulation and refinement alternate so often; later rounds win points back."""
    least_reliability: float = 0.7
    """Cameras are moved from the robot's poses only if two halves of the scene move them alike: of
    what moves them, this share must be signal. At 0.5 a refinement wins nothing; what both halves
    get wrong together (the lens) is not seen, hence more."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotNoise:
    """How wrong the camera poses are that come from the robot, one sigma."""

    position_mm: float = 0.2
    """Error of each camera centre along each axis, differing from view to view [mm]: a calibrated
    arm and the lever of its rotation error; the fit raises it where the views disagree more."""
    rotation_deg: float = 0.03
    """Error about each axis, differing from view to view [deg]."""
    hand_eye_mm: float = 0.5
    """Constant error of the hand-eye in the camera's axes [mm]. Sideways it cancels; along the
    optical axis, with all views aimed at one point from the distance r, it changes the scale by
    error / r (0.5 mm at 0.4 m: 0.13 %)."""
    hand_eye_deg: float = 0.1
    """Constant error of the hand-eye about each axis [deg]."""
    arm_scale_percent: float = 0.03
    """Error of the arm's own metre [%]: 0.1 mm of link length at 0.4 m of motion. No picture can
    show it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AlignmentConfig:
    """The similarity between the reconstruction and the robot, and what is named as wrong."""

    noise: RobotNoise = field(default_factory=RobotNoise)
    """Prior errors of the robot's poses."""
    samples: int = 300
    """Minimal samples of the robust start; with a third of the views wrong, 20 would do."""
    outlier_probability: float = 0.01
    """Chance of naming any view of a faultless set: each one is held against chi^2 of its six
    errors in their own covariance (pictures and robot), raised where the median view disagrees."""
    min_views: int = 3
    """Registered views that a similarity needs."""
    min_line_ratio: float = 0.05
    """Second spread of the camera centres over the first: below it they lie on a line, about which
    the reconstruction may turn."""
    min_baseline_ratio: float = 0.05
    """Spread of the centres over the distance to the scene: below it, their noise is the scale."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrustConfig:
    """When the verdict is 'accepted'."""

    sigma_percent: float = 0.5
    """Accepted up to this sigma of the scale [%]; doubtful up to four times it."""
    registered_share: float = 0.8
    """Accepted from this share of views in one model; rejected below `least_share`."""
    least_share: float = 0.3
    """See `registered_share`."""
    reprojection_px: float = 1.5
    """Accepted up to this median reprojection error [px]."""
    outlier_share: float = 0.2
    """Accepted up to this share of views that disagree with the robot; rejected from half."""
    residual_mm: float = 5.0
    """Accepted up to this median distance of camera centres from the robot's [mm]."""
    depth_sigmas: float = 3.0
    """The depth's scale may differ by so many sigmas of the difference; beyond it is named."""
    depth_floor_percent: float = 0.3
    """Systematic part of the depth scale's sigma [%]: 0.1 px of disparity at 0.3 m is 0.26 %."""
    min_points: int = 100
    """Points that a reconstruction needs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SfmConfig:
    """Everything that decides what structure from motion gives for the same images."""

    features: FeatureConfig = field(default_factory=FeatureConfig)
    """SIFT and matching."""
    mapping: MappingConfig = field(default_factory=MappingConfig)
    """Cameras and points."""
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    """Metric scale."""
    trust: TrustConfig = field(default_factory=TrustConfig)
    """Verdict."""
    seed: int = 0
    """Seed of every random choice, COLMAP's included."""
