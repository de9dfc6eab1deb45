"""All constants of a registration, by part."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from realsim.records.depth_bias import DepthBias
from realsim.registration.blind import CovarianceConfig
from realsim.registration.compare import CompareConfig
from realsim.registration.evidence import EvidenceConfig
from realsim.registration.find_table import TableSearchConfig
from realsim.registration.judging.verdict import VerdictConfig
from realsim.registration.near_start import JointConfig, SearchConfig
from realsim.registration.refinement.config import RefineConfig
from realsim.registration.search.find import FindConfig
from realsim.registration.solver import SolverConfig
from realsim.registration.table_planes import PlaneConfig
from realsim.registration.verify import VerifyConfig
from realsim.registration.view_agreement import ViewCheckConfig
from realsim.registration.views import SampleConfig

Method = Literal["joint", "top-down"]
METHODS: tuple[Method, ...] = ("joint", "top-down")


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgingConfig:
    """How poses are judged without ground truth."""

    verdict: VerdictConfig = field(default_factory=VerdictConfig)
    views: ViewCheckConfig = field(default_factory=ViewCheckConfig)


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
    find: FindConfig = field(default_factory=FindConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    judging: JudgingConfig = field(default_factory=JudgingConfig)
