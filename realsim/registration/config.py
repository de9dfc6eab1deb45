"""All constants of a registration, by part."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from realsim.records.calibration import DepthBias
from realsim.registration.blind import CovarianceConfig
from realsim.registration.evidence import EvidenceConfig
from realsim.registration.refinement.config import RefineConfig
from realsim.registration.search.find import FindConfig
from realsim.registration.table_planes import PlaneConfig
from realsim.registration.views import SampleConfig

Method = Literal["joint", "top-down"]
METHODS: tuple[Method, ...] = ("joint", "top-down")


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
    field_folder: Path | None = None
    """Where what is derived from meshes is kept between runs; None = in memory only."""
    with_single_view: bool = True
    """Whether the single-view baseline is computed as well."""
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
    plane: PlaneConfig = field(default_factory=PlaneConfig)
    odometry: bool = False
    """Whether the claimed camera poses are checked by odometry from depth (KISS-ICP): 0.03 CPU-s a
    view, and it names a mount that slipped or images that belong to other poses."""
    odometry_deg: float = 15.0
    """Only where views lie this near to their neighbours [deg]: 24 views all around, 20 degrees
    apart, raised false alarms."""
    find: FindConfig = field(default_factory=FindConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
