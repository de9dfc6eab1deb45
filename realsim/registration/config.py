"""All constants of a registration, by part."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from realsim.records.depth_bias import DepthBias
from realsim.registration.blind import BlindConfig, CovarianceConfig
from realsim.registration.compare import CompareConfig
from realsim.registration.evidence import EvidenceConfig
from realsim.registration.find_table import TableSearchConfig
from realsim.registration.judging.held_out import HeldOutConfig
from realsim.registration.judging.scene_checks import SceneCheckConfig
from realsim.registration.judging.surface_residuals import ResidualConfig
from realsim.registration.judging.verdict import VerdictConfig
from realsim.registration.near_rivals import RivalConfig
from realsim.registration.near_start import JointConfig, SearchConfig
from realsim.registration.odometry.cross_check import CheckConfig
from realsim.registration.photo_fit import PhotoFitConfig
from realsim.registration.refinement.config import RefineConfig
from realsim.registration.rivals_around import AroundConfig
from realsim.registration.search.find import FindConfig
from realsim.registration.single_view import SingleViewConfig
from realsim.registration.solver import SolverConfig
from realsim.registration.table_planes import PlaneConfig
from realsim.registration.verify import OffsetConfig, SinkingConfig, VerifyConfig
from realsim.registration.view_agreement import ViewCheckConfig
from realsim.registration.views import SampleConfig

Method = Literal["joint", "top-down"]
METHODS: tuple[Method, ...] = ("joint", "top-down")


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgingConfig:
    """How poses are judged without ground truth."""

    residuals: ResidualConfig = field(default_factory=ResidualConfig)
    held_out: HeldOutConfig = field(default_factory=HeldOutConfig)
    verdict: VerdictConfig = field(default_factory=VerdictConfig)
    scene: SceneCheckConfig = field(default_factory=SceneCheckConfig)
    views: ViewCheckConfig = field(default_factory=ViewCheckConfig)


@dataclass(frozen=True, kw_only=True, slots=True)
class SecondLookConfig:
    """When a joint fit is made again."""

    on_table_m: float = 0.003
    """A point so near to the plane is on it [m]."""
    beside_m: float = 0.012
    """A point so far from all objects is beside them [m]."""
    cell_m: float = 0.01
    """Cells by which areas on the plane are measured [m]."""
    least_beside: float = 1.0
    """Least area of a table that is seen beside the placed objects, as a share of what all wanted
    ones cover: an invented one lies on the objects, or on some that were not placed."""
    odd_m: float = 0.0015
    """A view is odd whose camera was moved by so much, seen at the objects [m]."""
    odd_factor: float = 3.5
    """It was moved by so many times the median of all views, too. One view whose depth lay 9 px
    beside its image moved 4.2 times as far, because it pulls the others along. Of 144 sound views
    none moved more than 3.0 times as far, nor by more than 0.9 mm."""
    most_odd: float = 0.25
    """Share of the views that may be odd: of more, the others are no measure."""
    moved_m: float = 0.0015
    """If all cameras were moved by so much in the median, that is told [m]: an arm is not so
    coarse."""
    unsure_m: float = 0.003
    """If by more, which is what a right pose may be off, no pose is accepted [m]: cameras follow a
    model of another size, and then everything fits it."""
    explained_sigmas: float = 5.0
    """So many sigmas per axis of what the arm, or a hand that holds the camera, is said to be off
    by are no reason to doubt."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RegistrationConfig:
    """All constants of a registration."""

    method: Method = "joint"
    """'joint': all views, objects and cameras together. 'top-down': the paper's way, ICP in the one
    view that looks down, carried to the others by the claimed cameras."""
    refine_cameras: bool = True
    """Whether cameras are refined with the objects; else they are taken at their word."""
    refine_from: int = 4
    """Least views for that: of fewer, an error of a camera is one of the object."""
    field_cells: int = 96
    """Cells of a distance field along the object's longest side; 56 doubled the scale error."""
    samples: int = 600
    """Surface samples per object for free space and penetration."""
    free_space: bool = True
    """Whether models are kept out of space the cameras looked through (few views)."""
    field_folder: Path | None = None
    """Where what is derived from meshes is kept between runs; None = in memory only."""
    with_single_view: bool = True
    """Whether the single-view baseline is computed as well."""
    start_radius_m: float = 0.045
    """How far an object may be from a start pose: 1.5 times what a start may be off by."""
    start_turn_deg: float = 38.0
    """How far an object may be turned from a start pose, with the same factor."""
    regather_m: float = 0.012
    """If an object moved further than this, its points are collected again around its new pose."""
    dense_views: int = 48
    """With more views, every second point is enough: neighbours share their noise."""
    hand_eye_sigma_mm: float | None = None
    """1-sigma of the hand-eye [mm], from its calibration; None = the refinement's own prior."""
    hand_eye_sigma_deg: float | None = None
    """1-sigma of the hand-eye's rotation [deg]; None = the refinement's own prior."""
    arm_sigma_mm: float | None = None
    """1-sigma of each robot pose [mm]; None = the refinement's own prior."""
    arm_sigma_deg: float | None = None
    """1-sigma of each robot pose's rotation [deg]; None = the refinement's own prior."""
    bias: DepthBias = field(default_factory=DepthBias.none)
    """Bias of the depth camera, from its calibration; the images are given as measured."""
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    table: TableSearchConfig = field(default_factory=TableSearchConfig)
    plane: PlaneConfig = field(default_factory=PlaneConfig)
    compare: CompareConfig = field(default_factory=CompareConfig)
    odometry: bool = False
    """Whether the claimed camera poses are checked by odometry from depth (KISS-ICP): 0.03 CPU-s a
    view, and it names a mount that slipped or images that belong to other poses."""
    odometry_deg: float = 15.0
    """Only where views lie this near to their neighbours [deg]: 24 views all around, 20 degrees
    apart, raised false alarms."""
    kinematics: CheckConfig = field(default_factory=CheckConfig)
    """How."""
    find: FindConfig = field(default_factory=FindConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    blind: BlindConfig = field(default_factory=BlindConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    rivals: RivalConfig = field(default_factory=RivalConfig)
    second_look: SecondLookConfig = field(default_factory=SecondLookConfig)
    photo_fit: PhotoFitConfig = field(default_factory=PhotoFitConfig)
    around: AroundConfig = field(default_factory=AroundConfig)
    judging: JudgingConfig = field(default_factory=JudgingConfig)
    offset: OffsetConfig = field(default_factory=OffsetConfig)
    sinking: SinkingConfig = field(default_factory=SinkingConfig)
    single_view: SingleViewConfig = field(default_factory=SingleViewConfig)
