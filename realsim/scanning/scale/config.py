"""The constants of a scale fit, each with its reason."""

from dataclasses import dataclass, field

from realsim.registration.evidence import EvidenceConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class TableConfig:
    """How the table and what stands on it are found."""

    tolerance_m: float = 0.004
    """Points within this of the plane carry it: tables are flat to 2 mm, depth is noisy."""
    least_share: float = 0.15
    """A plane with fewer of the measured points is no table [share]."""
    cell_m: float = 0.004
    """Cells of the map of heights from which the object is cut out [m]."""
    height_m: float = 0.003
    """What stands this far above the plane is no table [m]; plus three sigma of the depth."""
    bridge_m: float = 0.008
    """Parts of an object nearer than this are one object: depth has holes [m]."""
    least_points: int = 200
    """Fewer measured points than this are a speck, no object."""
    speck_share: float = 0.03
    """Clusters with a smaller share of the largest one's points are specks too."""
    margin_m: float = 0.10
    """The table is used up to this far around the object [m]."""
    clear_m: float = 0.008
    """Nearer to the object than this, table points may be its foot's [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SampleConfig:
    """How many measurements enter the fit."""

    object_points: int = 700
    """Measured points of the object wanted per view: depth noise is correlated over about 50
    pixels, so a 6 cm object has no more than 250 independent ones."""
    table_points: int = 400
    """Measured points of the table per view."""
    rays: int = 900
    """Rays per view by which a hypothesis is rendered and compared."""
    rim_points: int = 220
    """Points of the model's outline per view."""
    noise_area_px: float = 50.0
    """Pixels over which depth noise is one: 4 pi s^2 of a matching window of s = 2 px. Real
    windows are 5 to 9 px wide."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PriorConfig:
    """What is known of the errors before the fit; a session's own calibration says better."""

    hand_eye_mm: float = 0.4
    """1-sigma of the hand-eye along each axis [mm]."""
    hand_eye_deg: float = 0.08
    """1-sigma of the hand-eye about each axis [deg]."""
    arm_mm: float = 0.25
    """1-sigma of each robot pose along each axis [mm]."""
    arm_deg: float = 0.04
    """1-sigma of each robot pose about each axis [deg]."""
    bias_per_m: float = 0.0009
    """1-sigma of c in dz = c z^2 [1/m]: 0.01 px of a D405's disparity, what its calibration leaves;
    0.1 mm at 35 cm."""
    rim_px: float = 0.5
    """1-sigma of the constant by which depth outlines lie outside of the true ones [px]."""
    contact_m: float = 0.0004
    """1-sigma of the lowest point's height over the table [m]: what a cloth or burr lifts."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ShapeConfig:
    """How the error of the mesh's own shape is measured and weighed."""

    patches: int = 40
    """Patches of the surface with an offset of their own: a third of the object wide each."""
    normal_share: float = 0.25
    """A right angle between two normals counts as this share of the size in telling patches apart:
    the sides of a wall and of an edge are two."""
    amplitudes: tuple[float, ...] = (
        0.0005, 0.0015, 0.004, 0.008, 0.013, 0.020, 0.035,
    )  # fmt: skip
    """1-sigma of the shape's error tried, as shares of the size: exact CAD to bad guesses."""
    lengths: tuple[float, ...] = (0.05,)
    """Correlation lengths tried, as shares of the size. Longer ones describe smooth distortions
    better but trust themselves too much: with 0.3 the scale was 4 sigma off, with 0.05 1.6."""
    floor_m: float = 0.00010
    """Least 1-sigma of the shape [m]: no mesh, however exact, is nearer to the real thing."""
    nugget: float = 0.25
    """Variance of a patch's mean that is its own, as a share of the field's variance inside it."""
    pieces: float = 4.0
    """Independent values of the field inside a patch: what a patch's many points are worth."""
    trust: float = 2.6
    """By this the shape's part of the scale's sigma is multiplied: measured on 2 % distortions,
    whose effect patches with constant offsets describe only roughly."""
    rim_sigma_m: float = 0.0003
    """1-sigma of a patch's outline as a whole [m]: depth outlines are off by half a pixel."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchConfig:
    """How many scales and poses are tried."""

    near_first: int = 3
    """Starts at a given one, with two other scales, before its turns are tried."""
    half_turns: int = 3
    """Half turns about the box axes, the last of the starts near a given one."""
    turn_gain: float = 0.02
    """A half turn must explain so much more than the given start to be taken."""
    enough_gain: float = 0.75
    """A given start that explains this much is not turned about."""
    least_gain: float = 0.5
    """A given start that explains less than this is forgotten, and everything is searched."""
    starts: int = 10
    """Starts that are fitted of those that were found: the right one is among the first."""
    few_starts: int = 4
    """If there are fewer, their scales are varied as well."""
    rough_views: int = 6
    """Views in which every start is compared."""
    rough_every: int = 3
    """Every so many rays of them."""
    compared: int = 4
    """Starts that are compared in all views."""
    compared_points: int = 100
    """Points of the surface by which two of them are told apart."""
    same_share: float = 0.02
    """Two are one if no point differs by more than this share of the size."""
    size_factor: float = 1.5
    """Starts are of the size that was said if they differ by less than this factor: people guess
    to a quarter, and the longest side of a turned box is up to 1.2 times that of a straight one."""
    mirror_gain: float = 0.05
    """The mirror image must explain so much more for the mesh to be called mirrored."""
    sure_gain: float = 0.93
    """A mesh that explains this much is not asked whether it is mirrored: exact ones explain 0.96
    and more."""
    rivals: int = 1
    """Other solutions of another scale that are fitted to the end."""


@dataclass(frozen=True, kw_only=True, slots=True)
class VerdictConfig:
    """When a result may be trusted."""

    reject_gain: float = 0.3
    """A mesh that explains less of the object than this is rejected."""
    least_gain: float = 0.5
    """One that explains less than this is doubtful."""
    least_iou: float = 0.86
    """Least overlap of the model's outline with the measured one."""
    part_agree: float = 0.8
    """Overlap from which a mesh agrees wherever it is seen."""
    part_cover: float = 0.7
    """Such a mesh that covers less than this of what was measured is of a part of what stands
    there."""
    rival_change: float = 0.04
    """A rival solution counts if its scale differs by more than this [share of the scale]."""
    rival_gain: float = 0.02
    """Its gain must come within this of the best one's, too."""
    doubtful_sigma: float = 0.03
    """A 1-sigma above this share of the scale is no metric scale."""
    worst_shape: float = 0.04
    """A mesh whose surface is off by more than this share of its size is another object."""
    far_share: float = 0.06
    """A measured point further than this share of the size from the mesh is not of it."""
    most_far: float = 0.01
    """More than this share of such points makes the result doubtful: a handle elsewhere."""
    view_sigmas: float = 4.0
    """A view whose camera must be moved by so many sigma is left out."""
    view_share: float = 0.7
    """A view whose outline overlaps less than this share of the usual is left out."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScaleConfig:
    """All constants of a scale fit."""

    field_cells: int = 96
    """Cells of the distance field along the longest side; 56 double the error of thin walls."""
    fit_faces: int = 60_000
    """Meshes with more faces are simplified for the fit; nothing else changes."""
    hand_eye_sigma_mm: float | None = None
    """1-sigma of the hand-eye per axis [mm], from the session's calibration; None = the prior's."""
    hand_eye_sigma_deg: float | None = None
    """1-sigma of the hand-eye about each axis [deg]; None = the prior's."""
    arm_sigma_mm: float | None = None
    """1-sigma of each robot pose per axis [mm]; None = the prior's."""
    arm_sigma_deg: float | None = None
    """1-sigma of each robot pose about each axis [deg]; None = the prior's."""
    seed: int = 0
    """Seed of everything that is drawn."""
    table: TableConfig = field(default_factory=TableConfig)
    samples: SampleConfig = field(default_factory=SampleConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    verdict: VerdictConfig = field(default_factory=VerdictConfig)
    noise: EvidenceConfig = field(default_factory=EvidenceConfig)
    """How the depth noise is measured."""
