"""Where the arm stands, and which moves it must be able to make."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.arm.arm_space import ArmSpaceConfig
from realsim_sim_bridge.arm.joint_path import PlannerConfig
from realsim_sim_bridge.arm.timing import TimingConfig

Array = NDArray[np.float64]
Pose = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class ReachConfig:
    """Where the arm stands and which moves it must be able to make."""

    T_table_base: Pose | None = None
    """The base of a lab's arm (4, 4) as rows [m]; None = it hangs above the table, placed by the
    next two (the paper's "perfect reach")."""
    base_height_m: float = 0.70
    """Height of the base over the table [m]. With the next among the best of a grid: 89 %
    of random grasps within 60 deg of straight down on 36 x 36 cm are reached and lifted."""
    base_back_m: float = 0.60
    """Distance of the base from the middle of the scene, against its own tilted z axis [m]; nearer
    than 0.4 m joint 5 cannot turn the hand straight down."""
    home_height_m: float = 0.30
    """Height of the hand over the table, above the middle of the scene, before each grasp [m]."""
    approach_m: float = 0.08
    """Length of the straight approach [m]: a finger and a half."""
    lift_m: float = 0.20
    """Height that the arm must be able to lift straight up [m]; the slip test's."""
    step_m: float = 0.02
    """Distance between followed poses of the straight moves [m]; between them the hand leaves the
    line by less than a tenth of a millimetre."""
    joint7_samples: int = 12
    """Values of joint 7 tried at each grasp."""
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
        if not (min(lengths) > 0 and self.joint7_samples >= 1 and self.branches >= 1):
            raise InputError(
                f"approach_m, lift_m and step_m are {lengths}, joint7_samples "
                f"{self.joint7_samples}, branches {self.branches}: all must be positive."
            )
        if self.T_table_base is not None:
            T = se3.check_rigid(self.T_table_base, "T_table_base of the arm")
            if T.shape != (4, 4):
                raise InputError(f"T_table_base of the arm has shape {T.shape}; one (4, 4) is it.")
            # Plain numbers, so that the configuration can be compared and written as JSON.
            object.__setattr__(self, "T_table_base", tuple(tuple(row) for row in T.tolist()))


def base_on_table(middle_xy: tuple[float, float], config: ReachConfig) -> Array:
    """Return T_table_base (4, 4): the given one, or z along the table's x, x straight down."""
    if config.T_table_base is not None:
        return np.array(config.T_table_base, dtype=np.float64)
    R = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    at = [middle_xy[0] - config.base_back_m, middle_xy[1], config.base_height_m]
    return se3.from_rt(R, at)


def home_joints(config: ReachConfig, middle_xy: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Return the joints (7,) [rad] with the hand pointing down above the middle of the scene.

    Raises:
        InputError: the arm's base is placed so that it cannot.
    """
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    T_table_base = base_on_table(middle_xy, config)
    T_table_grasp = se3.from_rt(down, [*middle_xy, config.home_height_m])
    T_base_grasp = se3.invert(T_table_base) @ T_table_grasp
    q = panda.inverse(T_base_grasp, config.joint7_samples, config.limit_margin_rad)
    if len(q) == 0:
        out = float(panda.wrist_distance(T_base_grasp[None])[0])
        at = ", ".join(f"{x:.2f}" for x in T_table_base[:3, 3])
        raise InputError(
            f"the arm cannot hold its hand {config.home_height_m} m over the table at "
            f"({middle_xy[0]:.2f}, {middle_xy[1]:.2f}) m from a base at ({at}) m: its wrist would "
            f"be {out:.2f} m from the shoulder and {panda.WRIST_REACH_M:.2f} m is its reach. "
            "Choose another base or home height."
        )
    middle = (panda.LOWER + panda.UPPER) / 2
    return q[np.argmin(np.linalg.norm((q - middle) / (panda.UPPER - panda.LOWER), axis=1))]
