"""What the validation suite tries, and what it asks for."""

from dataclasses import dataclass, field, replace

from realsim.robots.hand import Hand, find_hand
from realsim_sim_bridge.slip.slip_test import SlipConfig
from realsim_sim_bridge.slip.world import Closing, PadModel, SlipPhysics

CHECKS = (
    "settings",
    "coulomb",
    "torque",
    "creep",
    "box",
    "capacity",
    "repeat",
    "convergence",
    "replay",
    "full_arm",
    "reference",
)
"""The suite's parts in the order in which they run: cheap ones that explain others come first."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LimitConfig:
    """Loads around the computed limit."""

    cases: tuple[tuple[float, float], ...] = ((2.0, 0.25), (20.0, 0.25), (70.0, 0.25), (70.0, 1.0))
    """Force of a finger [N] and friction: limits from 1 N to the hand's 140 N."""
    directions_deg: tuple[float, ...] = (0.0, 45.0, 90.0, 135.0, 180.0, 270.0)
    """Directions of the pull in the pad's plane, from x to the approach z [deg]. Errors of a
    friction pyramid show between the axes, those of an uneven pad along them."""
    coulomb_shares: tuple[float, ...] = (
        0.9, 0.94, 0.97, 0.98, 0.99, 0.995, 1.005, 1.01, 1.02, 1.03, 1.06, 1.1,
    )  # fmt: skip
    """Loads in units of the limit, one pair of hand and object each."""
    coulomb_pct: float = 3.0
    """Greatest error of the limit of a straight pull [%]."""
    torque_cases: tuple[tuple[float, float], ...] = ((20.0, 0.25), (70.0, 1.0))
    """Force of a finger [N] and friction for the loads that turn the object."""
    arms_m: tuple[float, ...] = (0.01, 0.03, 0.05)
    """How far beside the pads' centre a load pulls [m]."""
    torque_shares: tuple[float, ...] = (
        0.8, 0.9, 0.95, 0.97, 0.99, 1.01, 1.03, 1.05, 1.1, 1.2,
    )  # fmt: skip
    torque_pct: float = 10.0
    """Greatest error of the limit of a load that turns the object [%]."""
    limit_acceleration: float = 20.0
    """The cube's mass is the limit divided by this [m/s^2]: its weight is half of what is carried,
    and 1 % beyond the limit moves it 25 mm within the time of the load."""
    masses_kg: tuple[float, float] = (0.05, 2.0)
    """Least and greatest mass of that cube [kg]."""
    ramp_s: float = 0.125
    """The load grows from zero within this time [s]: a sudden one would overshoot."""
    hold_s: float = 0.5
    """Time for which the full load stands [s]."""
    held_m: float = 1e-3
    """A cube that moved less is held [m]."""
    held_deg: float = 2.0
    """It must have turned less than this, too [deg]."""
    creep_share: float = 0.8
    """Load of the long hold, in units of the limit."""
    curved_share: float = 0.5
    """The same for the cylinder, in units of 2 mu F."""
    creep_s: float = 5.0
    """Length of the long hold [s]."""
    creep_m: float = 5e-5
    """Greatest motion in the long hold [m]."""
    creep_deg: float = 0.5
    """Greatest turn in the long hold [deg]; that of the symmetric box in a stage."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StageConfig:
    """Grasps that go through the whole slip test and whose outcome is known."""

    box_masses_kg: tuple[float, ...] = (0.125, 0.013)
    """Masses of the 5 cm cube [kg]: wood, and a light one that needs more of the solver."""
    box_slip_m: float = 2e-4
    """Greatest slip of that cube in a stage [m]."""
    box_turn_deg: float = 0.5
    """Greatest turn of that cube in a stage [deg]."""
    capacity_mass_kg: float = 0.125
    fails: tuple[tuple[float, float], ...] = ((5.0, 0.05), (1.0, 0.25))
    """Force [N] and friction that carry 0.5 N of the cube's 1.23 N."""
    holds: tuple[tuple[float, float], ...] = ((20.0, 0.05), (70.0, 0.05), (4.0, 0.25))
    """Force [N] and friction that carry 2 N and more."""
    settings_tolerance: float = 1e-6
    """Greatest relative difference of a setting read back from the engine."""
    force_pct: float = 2.0
    """Greatest error of the fingers' measured force [%]."""
    stiffness_pct: float = 10.0
    """Greatest error of the pads' measured stiffness [%]."""
    pair_slip_m: float = 5e-5
    """Greatest difference of a held grasp's slip when it shares the world [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelConfig:
    """Grasps on the edge, whose labels must not depend on the solver's settings."""

    seed: int = 7
    """Seed of the grasps' places."""
    masses_kg: tuple[float, ...] = (0.01, 0.013, 0.1, 0.5, 2.0)
    """What the Robot School meets: from a paper cup to a full bottle."""
    shapes: tuple[str, ...] = ("box", "l_shape", "cylinder", "wedge")
    grasps: int = 5
    """Grasps of each shape and mass."""
    friction: float = 0.3
    capacity_ratio: float = 6.0
    """The hand's force is such that friction carries this many times the weight, but at most the
    hand's: an off-centre load then drops a part of the objects."""
    finer: tuple[tuple[int, int], ...] = ((2, 1), (4, 1), (1, 2))
    """(divisor of the time step, factor of the iterations) of each comparison."""
    agreement: float = 0.97
    """Least share of equal labels between the settings and finer ones."""
    replay_agreement: float = 0.96
    """Least share of equal labels between fast and true replay."""
    jitter_m: float = 5e-5
    """For comparison the grasps are also tried this far beside [m]: what no engine can decide."""
    arm_cases: tuple[tuple[float, float, float, float], ...] = (
        (0.05, 70.0, 1.0, 0.0),
        (0.125, 5.0, 0.05, 0.0),
        (0.125, 10.0, 0.3, 0.015),
        (1.0, 70.0, 0.2, 0.01),
        (1.0, 70.0, 0.2, 0.03),
    )
    """Cubes that the whole arm carries: mass [kg], force of a finger [N], friction, and how far
    beside the centre they are grasped [m]. The second is too slippery, the last one turns."""
    arm_slip_m: float = 2e-3
    """Greatest difference of slip between the carrying arm and the hand alone [m]: a moving hand's
    contacts drift by a millimetre in a swing, at any mass."""
    arm_turn_deg: float = 1.0
    """The same of the turn [deg]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ReferenceConfig:
    """Grasps on the edge that the independent contact model tries as well."""

    force_n: float = 20.0
    friction: float = 0.5
    """With that force, friction carries 20 N."""
    masses_kg: tuple[tuple[str, tuple[float, ...]], ...] = (
        ("box", (0.4, 1.3)),
        ("l_shape", (0.4, 0.8)),
        ("disc", (0.8, 1.6)),
        ("cylinder", (0.6, 1.5)),
        ("cone", (0.3, 1.5)),
        ("ball", (0.6, 1.6)),
        ("bottle", (0.3, 1.2)),
    )
    """Shapes and their masses: about half of the lighter ones turn by more than 10 deg, and half of
    the heavier ones are dropped."""
    seed: int = 7
    """Seed of the grasps' places."""
    grasps: int = 1
    """Grasps of each shape and mass; they take the contact model about a second each."""
    lean_deg: float = 20.0
    """How far the surfaces under the fingers may lean over [deg]: friction holds 26 deg."""
    agreement: float = 0.78
    """Least share of equal labels: of 14 grasps three may differ, which is one in 250 where 95 %
    agree."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ValidationConfig:
    """Everything the validation suite can be told."""

    hand: Hand = field(default_factory=find_hand)
    slip: SlipConfig = field(default_factory=lambda: SlipConfig(sure=None))
    """Physics, closing and stages of the slip test, all of them simulated; its engine's settings
    are not used."""
    checks: tuple[str, ...] = CHECKS
    """Which parts of the suite run."""
    limits: LimitConfig = field(default_factory=LimitConfig)
    stages: StageConfig = field(default_factory=StageConfig)
    labels: LabelConfig = field(default_factory=LabelConfig)
    reference: ReferenceConfig = field(default_factory=ReferenceConfig)

    @classmethod
    def of(cls, hand: Hand) -> "ValidationConfig":
        """Return the suite for a hand, with its pads; forces and frictions are the suite's own."""
        pads = PadModel.of(hand)
        slip = SlipConfig(physics=SlipPhysics(pads=pads), closing=Closing.of(hand), sure=None)
        return cls(hand=hand, slip=slip)

    def quick(self) -> "ValidationConfig":
        """Return the suite's short form: every part, with fewer samples; less than a minute."""
        return replace(
            self,
            limits=LimitConfig(
                cases=((2.0, 0.25), (20.0, 0.25), (70.0, 1.0)),
                directions_deg=(0.0, 45.0, 90.0, 270.0),
                coulomb_shares=(0.9, 0.97, 0.99, 1.01, 1.03, 1.1),
                torque_shares=(0.8, 0.9, 0.97, 1.03, 1.1, 1.2),
            ),
            labels=LabelConfig(
                # 40 grasps: with fewer than 34, one differing label is already less than 97 %.
                masses_kg=(0.01, 0.5),
                finer=((2, 1),),
                arm_cases=((0.125, 5.0, 0.05, 0.0), (0.125, 10.0, 0.3, 0.015)),
            ),
        )
