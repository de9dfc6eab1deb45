"""Everything Robot School can be told."""

from dataclasses import dataclass, field

from realsim.models.convex import ConvexConfig
from realsim.robots.hand import Hand, find_hand
from realsim_sim_bridge.arm.reach import ReachConfig
from realsim_sim_bridge.grasping.analytic import AnalyticConfig
from realsim_sim_bridge.grasping.candidates import CandidateConfig
from realsim_sim_bridge.hold.calibration import Calibration
from realsim_sim_bridge.hold.draws import HoldConfig
from realsim_sim_bridge.school.sweep import SweepConfig
from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class SchoolConfig:
    """Everything a grasp's score depends on; `asdict` of it is plain JSON."""

    seed: int = 0
    """Seed of all chance; each object has its own stream, whatever the others do."""
    max_candidates: int = 60
    """Candidates kept per object, chosen to be far apart."""
    least_mass_kg: float = 0.001
    """Lighter objects are not tried [kg]: below a gram a mesh has the wrong unit."""
    greatest_mass_kg: float = 20.0
    """Heavier ones neither [kg]: the arm carries 3."""
    hand: Hand = field(default_factory=find_hand)
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    analytic: AnalyticConfig | None = None
    """Try analytic grasps, with the friction from which they close, instead of sampled ones."""
    convex: ConvexConfig = field(default_factory=ConvexConfig)
    reach: ReachConfig = field(default_factory=ReachConfig)
    slip: SlipConfig = field(default_factory=SlipConfig)
    score: ScoreLimits = field(default_factory=ScoreLimits)
    hold: HoldConfig | None = field(default_factory=HoldConfig)
    """What is uncertain where the grasps are executed, for p_hold; None = p_hold is not told."""
    calibration: Calibration | None = None
    """What makes p_hold of the evidence; None = what realsim ships."""
    sweep: SweepConfig | None = None
    """Frictions and forces at which each grasp is tried besides, for its margin; None = none."""
    second_engine: BulletSettings | MujocoSettings | None = None
    """The engine that judges every grasp a second time; None = none does."""

    @classmethod
    def of(cls, hand: Hand) -> "SchoolConfig":
        """Return the School with a hand: its force, pads, friction and speed."""
        return cls(hand=hand, slip=SlipConfig.of(hand))
