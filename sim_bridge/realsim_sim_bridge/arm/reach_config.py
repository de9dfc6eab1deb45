"""Where the arm stands, and which moves it must be able to make."""

from dataclasses import dataclass, field
from functools import cache

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.arm import ArmFile, RobotArm, find_arm
from realsim.robots.hand import Hand
from realsim.robots.robot_files import names_of, robot_file
from realsim_sim_bridge.arm.arm_space import FREE, ArmSpace, ArmSpaceConfig
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.arm.joint_path import PlannerConfig
from realsim_sim_bridge.arm.obstacles import obstacles_of
from realsim_sim_bridge.arm.timing import TimingConfig

Pose = tuple[tuple[float, ...], ...]
PANDA = "panda"
"""The arm that is meant where none is named."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ChosenArm:
    """An arm as a run writes it down; `asdict` of it is plain JSON."""

    name: str
    """By which it is found."""
    digest: str
    """SHA-256 of its folder."""

    def found(self) -> RobotArm:
        """Return the arm.

        Raises:
            InputError: there is none of that name, or its folder is another than it was.
        """
        arm = find_arm(self.name)
        if arm.folder.digest != self.digest:
            raise InputError(
                f"the arm '{self.name}' in {arm.folder.path} is another than the one that was "
                f"chosen: its folder's SHA-256 is {arm.folder.digest[:12]}, not "
                f"{self.digest[:12]}. Bring the folder back as it was, or run the school again."
            )
        return arm


def chosen_arm(name: str = PANDA) -> ChosenArm:
    """Return an arm by its name or its folder.

    Raises:
        InputError: there is none, or its file is not as declared.
    """
    return _panda() if name == PANDA else _chosen(name)


@cache
def _panda() -> ChosenArm:
    return _chosen(PANDA)


def _chosen(name: str) -> ChosenArm:
    _, folder = robot_file(name, ArmFile)
    is_known = names_of("arm").get(folder.name) == folder.path
    return ChosenArm(
        name=folder.name if is_known else str(folder.path.resolve()), digest=folder.digest
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class ReachConfig:
    """Where the arm stands and which moves it must be able to make."""

    arm: ChosenArm = field(default_factory=chosen_arm)
    T_table_base: Pose | None = None
    """The base of a lab's arm (4, 4) as rows [m]; None = it hangs above the table, placed by the
    next two (the paper's "perfect reach")."""
    base_height_m: float | None = None
    """Height of the base over the table [m]; None = 0.70 m for a Panda (with the next among the
    best of a grid: 89 % of random grasps within 60 deg of straight down on 36 x 36 cm are reached
    and lifted), and of another arm as much more as it reaches farther."""
    base_back_m: float | None = None
    """Distance of the base from the middle of the scene, against its own tilted z axis [m]; None =
    0.60 m for a Panda (nearer than 0.4 m joint 5 cannot turn the hand straight down), and of
    another arm as much more as it reaches farther."""
    home_height_m: float = 0.30
    """Height of the hand over the table, above the middle of the scene, before each grasp [m]."""
    approach_m: float = 0.08
    """Length of the straight approach [m]: a finger and a half."""
    lift_m: float = 0.20
    """Height that the arm must be able to lift straight up [m]; the slip test's."""
    step_m: float = 0.02
    """Distance between followed poses of the straight moves [m]; between them the hand leaves the
    line by less than a tenth of a millimetre."""
    held_values: int = 12
    """Values of a seventh joint tried at each grasp."""
    branches: int = 6
    """Free solutions per grasp that are followed."""
    limit_margin_rad: float = 0.02
    """Distance kept from the joint limits [rad]."""
    space: ArmSpaceConfig = field(default_factory=ArmSpaceConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    timing: TimingConfig = field(default_factory=TimingConfig)
    with_trajectories: bool = True
    """Whether the joints over time are computed and kept."""
    hand_clearance_m: float = 0.001
    """Least distance of the hand's boxes from objects during approach and lift [m]; at the grasp
    the candidates' own, larger ones hold."""
    lifted_clearance_m: float = 0.004
    """Least sideways distance of the lifted object from its neighbours [m]: about the spacing of
    the points on them, or one would slip between the other's."""
    tolerance: float = 1e-6
    """Largest error of a followed pose [m, rad]."""

    def __post_init__(self) -> None:
        """Check the numbers and the base's pose.

        Raises:
            InputError: a length or count is not positive, or the pose is not rigid.
        """
        lengths = (self.approach_m, self.lift_m, self.step_m)
        if not (min(lengths) > 0 and self.held_values >= 1 and self.branches >= 1):
            raise InputError(
                f"approach_m, lift_m and step_m are {lengths}, held_values "
                f"{self.held_values}, branches {self.branches}: all must be positive."
            )
        if self.T_table_base is not None:
            T = se3.check_rigid(self.T_table_base, "T_table_base of the arm")
            if T.shape != (4, 4):
                raise InputError(f"T_table_base of the arm has shape {T.shape}; one (4, 4) is it.")
            # Plain numbers, so that the configuration can be compared and written as JSON.
            object.__setattr__(self, "T_table_base", tuple(tuple(row) for row in T.tolist()))


PANDA_SIZE_M, PANDA_SHOULDER_M = 0.887, 0.333
"""Size of a Panda as `_size_m` says it, and its shoulder's height over its base [m]."""
PANDA_HEIGHT_M, PANDA_BACK_M = 0.70, 0.60
"""Where a Panda hangs [m]."""
WRIST_OVER_TABLE_M, OVER_HOME_M = 0.25, 0.35
"""Height of the wrist over the table at a grasp from above, and least height of the base over the
hand at home [m], whatever the arm: a small one would have its wrist at its shoulder."""


def grasping_arm(config: ReachConfig, hand: Hand) -> GraspingArm:
    """Return the configuration's arm with a hand.

    Raises:
        InputError: the arm is not there.
    """
    return GraspingArm(config.arm.found(), hand)


def base_on_table(middle_xy: tuple[float, float], config: ReachConfig, arm: GraspingArm) -> Array:
    """Return T_table_base (4, 4): the given one, or z along the table's x, x straight down."""
    if config.T_table_base is not None:
        return np.array(config.T_table_base, dtype=np.float64)
    R = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    height, back = config.base_height_m, config.base_back_m
    scale = round(_size_m(arm) / PANDA_SIZE_M, 2)
    if height is None:
        height = WRIST_OVER_TABLE_M + scale * (PANDA_HEIGHT_M - WRIST_OVER_TABLE_M)
        height = max(height, config.home_height_m + OVER_HOME_M)
    if back is None:
        beside = PANDA_BACK_M - PANDA_SHOULDER_M
        back = round(arm.shoulder_m + scale * beside, 9)
    return se3.from_rt(R, [middle_xy[0] - back, middle_xy[1], height])


def _size_m(arm: GraspingArm) -> float:
    """Return how near and how far the wrist usually is from the shoulder, added up [m].

    An arm whose elbow does not fold must stand as far away as one that is longer.
    """
    low, high = arm.limits.lower, arm.limits.upper
    q = np.random.default_rng(0).uniform(low, high, (2000, arm.joints))
    return float(np.quantile(arm.wrist_distance(arm.forward(q)), (0.02, 0.98)).sum())


def home_joints(
    config: ReachConfig, arm: GraspingArm, middle_xy: tuple[float, float] = (0.0, 0.0)
) -> Array:
    """Return the joints (n,) [rad] with the hand pointing down above the middle of the scene.

    Of all that do and touch neither the table nor the arm itself, those nearest to where the arm
    waits.

    Raises:
        InputError: the arm's base is placed so that it cannot.
    """
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    T_table_base = base_on_table(middle_xy, config, arm)
    T_table_grasp = se3.from_rt(down, [*middle_xy, config.home_height_m])
    T_base_grasp = (se3.invert(T_table_base) @ T_table_grasp)[None]
    home, limits = arm.arm.home, arm.limits
    q = arm.inverse(T_base_grasp, config.held_values, config.limit_margin_rad, home)[1]
    if len(q) == 0:
        out = float(arm.wrist_distance(T_base_grasp)[0])
        at = ", ".join(f"{x:.2f}" for x in T_table_base[:3, 3])
        raise InputError(
            f"the arm cannot hold its hand {config.home_height_m} m over the table at "
            f"({middle_xy[0]:.2f}, {middle_xy[1]:.2f}) m from a base at ({at}) m: its wrist would "
            f"be {out:.2f} m from the shoulder and {arm.wrist_reach_m:.2f} m is its reach. "
            "Choose another base or home height."
        )
    q = q[np.argsort(np.linalg.norm((q - home) / (limits.upper - limits.lower), axis=1))]
    empty = obstacles_of(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.bool_))
    space = ArmSpace(T_table_base, empty, config.space, arm)
    codes = space.blame(q, np.full(len(q), arm.hand.max_opening_m), with_hand=True)
    return q[np.argmax(codes == FREE)]
