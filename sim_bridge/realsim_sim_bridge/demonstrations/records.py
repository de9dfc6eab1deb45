"""What a demonstration consists of: a goal, an outcome, and steps that are seen and acted in."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from realsim.arrays import Array, Rgb
from realsim.records import CameraIntrinsics
from realsim.records.checked_arrays import rigid
from realsim.records.grasps import PHASES
from realsim.rendering.moving_scene import MovingPicture
from realsim_sim_bridge.demonstrations.placing import PlaceGoal

ALL_PHASES = (*PHASES, "carry", "lower", "release", "withdraw")
"""The parts of a demonstration, in order: those of an attempt, and of putting the object down."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DemonstrationConfig:
    """How attempts are replayed."""

    rate_hz: int = 20
    """Steps per second: as often as the slip test looks at the object."""
    fall_s: float = 0.7
    """How long a lost object is watched [s]: from the lifted hand it falls for 0.2 s."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DemonstrationCamera:
    """A camera of the demonstrations: fixed above the table, or in the hand."""

    name: str
    intrinsics: CameraIntrinsics
    T_frame_cam: Array
    """(4, 4) the camera in the table's frame, or in the grasp frame of the hand [m]."""
    on_hand: bool = False

    def __post_init__(self) -> None:
        """Check that the pose is rigid."""
        object.__setattr__(
            self, "T_frame_cam", rigid(self.T_frame_cam, f"pose of the camera '{self.name}'")
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspGoal:
    """What is to be grasped, and how."""

    obj_id: int
    instance: int
    name: str
    """Name of the object."""
    grasp: int
    """Row of the instance's grasp set."""
    T_base_grasp: Array
    """(4, 4) the grasp in the arm's base [m]."""
    language: str
    """The task in words."""
    place: PlaceGoal | None = None
    """Where it is to be put; None = the grasp is all."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AttemptOutcome:
    """How an attempt ended."""

    success: bool
    """Whether all four stages were passed."""
    stages_passed: int
    """0 to 4: close, lift, oscillate, pendulum."""
    score: float
    """The school's, of this one nominal attempt."""
    failure: str
    """Where and why it stopped; '' = it passed all."""
    agrees: bool
    """Whether the replay ended in the stored stage with the stored score."""
    disagreement: str
    """How the replay differs from what is stored, in words; '' = in nothing that is seen."""
    labels: dict[str, Any] = field(default_factory=dict[str, Any])
    """p_hold, its error and draws, safety by stage, as plain JSON values; empty = not measured."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RobotAction:
    """What is to be done until the next step."""

    joints_rad: Array
    """(7,) absolute targets: the joints at the next step; at the last step its own [rad]."""
    opening_m: float
    """Commanded distance of the finger faces at the next step [m]; 0 = close and press."""
    T_ee_next: Array
    """(4, 4) the hand's pose at the next step in that of this one [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DemonstrationStep:
    """One step of a demonstration."""

    index: int
    time_s: float
    """Since the attempt's start [s]."""
    phase: str
    """One of ALL_PHASES."""
    joints_rad: Array
    """(7,) [rad]."""
    opening_m: float
    """Distance of the finger faces [m]: they stop where the object is."""
    held: bool
    """Whether both fingers hold the object."""
    T_base_ee: Array
    """(4, 4) the hand's grasp frame in the arm's base [m]."""
    Ts_base_obj: Mapping[int, Array]
    """(4, 4) every object in the arm's base [m], by instance."""
    action: RobotAction
    picture: Callable[[str], MovingPicture]
    """Camera's name -> its picture and depth; rendered when it is asked for."""
    T_table_cam: Callable[[str], Array]
    """Camera's name -> where it is (4, 4), table frame [m]."""

    def look(self, name: str) -> Rgb:
        """Return the picture (H, W, 3) of a camera."""
        return self.picture(name).rgb
