"""Poses from which the target can be seen, where nobody has planned any; and moves in words."""

from dataclasses import dataclass

import numpy as np

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import Target
from realsim_calibration.planning.next_view import BoardGeometry, board_geometry, target_middle
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import Array

SMALL_MOVE_DEG = 10.0
"""Angles that are not worth a word to the operator [deg]."""
SMALL_MOVE_M = 0.03
"""Distances that are not worth a word to the operator [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewLimits:
    """Where the camera, or the target before a fixed camera, may go."""

    tilts_deg: tuple[float, ...] = (0.0, 25.0, 45.0)
    """Angles between line of sight and board normal [deg]; beyond 45 corners blur."""
    azimuths: int = 8
    """Sides from which a tilted board is looked at."""
    rolls: int = 6
    """Rolls about the optical axis, evenly over a turn: they improve the result most."""
    distances_m: tuple[float, ...] = (0.3, 0.4, 0.5)
    """Distances to the target's middle [m]: the working range."""
    aim: float = 0.2
    """How far from the image's middle the target is shown, in half images: the lens is seen there;
    the middle and four sides take turns."""
    reach_m: tuple[float, float] | None = None
    """Least and greatest distance of the hand from the base's origin [m]; None = not limited."""
    height_m: tuple[float, float] | None = None
    """Least and greatest height of hand and, where it is in the hand, camera over the base [m]."""
    max_turn_deg: float = 180.0
    """Largest turn of the hand away from the mean of the captured ones [deg]: joint limits."""

    def __post_init__(self) -> None:
        """Check that there is something to choose from."""
        if not self.tilts_deg or not self.distances_m or self.azimuths < 1 or self.rolls < 1:
            raise InputError("view limits need at least one tilt, azimuth, roll and distance.")
        if min(self.distances_m) <= 0.01 or max(self.distances_m) > 10:
            raise InputError(
                f"view distances {self.distances_m} m: metres between 0.01 and 10 are accepted. "
                "Were millimetres given?"
            )


def propose_views(report: HandEyeReport, limits: ViewLimits | None = None) -> Array:
    """Return candidate tool poses T_base_ee (n, 4, 4) around the target [m], within the limits.

    They are not checked for collision or against the joints' limits: the arm's planner does that.

    Raises:
        DegenerateError: no candidate is within the limits.
    """
    limits = limits or ViewLimits()
    boards = candidate_boards(report, limits)
    X, Z = report.X, report.Z
    if report.mode == "eye_in_hand":
        Ts = Z @ se3.invert(boards) @ se3.invert(X)
    else:
        Ts = X @ boards @ se3.invert(Z)
    keep = np.ones(len(Ts), bool)
    if limits.reach_m is not None:
        reach = np.linalg.norm(Ts[:, :3, 3], axis=-1)
        keep &= (reach >= limits.reach_m[0]) & (reach <= limits.reach_m[1])
    if limits.height_m is not None:
        low, high = limits.height_m
        places = [Ts[:, 2, 3]]
        if report.mode == "eye_in_hand":
            places.append((Ts @ X)[:, 2, 3])
        for z in places:
            keep &= (z >= low) & (z <= high)
    if report.used and limits.max_turn_deg < 180.0:
        mean = se3.mean_rotation(np.stack([v.T_base_ee[:3, :3] for v in report.used]))
        keep &= np.degrees(se3.angle(mean.T @ Ts[:, :3, :3])) <= limits.max_turn_deg
    if not keep.any():
        raise DegenerateError(
            f"none of {len(Ts)} candidate views is within the limits (reach {limits.reach_m} m, "
            f"height {limits.height_m} m, turn {limits.max_turn_deg:g} deg). Widen them, or move "
            "the target nearer to the middle of the arm's reach."
        )
    return Ts[keep]


def candidate_boards(report: HandEyeReport, limits: ViewLimits) -> Array:
    """Return T_cam_board (n, 4, 4) of a grid of tilt, azimuth, roll and distance [m]."""
    middle, i = target_middle(report.target), report.intrinsics
    half = np.array([i.width / (2 * i.fx), i.height / (2 * i.fy)]) * limits.aim
    aims = np.array([[0, 0], [-1, -1], [1, 1], [1, -1], [-1, 1]]) * half
    boards: list[Array] = []
    for distance in limits.distances_m:
        for tilt in np.radians(limits.tilts_deg):
            count = limits.azimuths if tilt > 0 else 1
            for azimuth in np.arange(count) * (2 * np.pi / count):
                away = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth),
                        -np.cos(tilt)]  # fmt: skip
                for roll in np.arange(limits.rolls) * (2 * np.pi / limits.rolls):
                    T = se3.look_at(middle + distance * np.array(away), middle, float(roll))
                    x, y = aims[len(boards) % len(aims)]
                    turn = se3.from_rt(se3.exp_so3([-y, x, 0.0]), [0.0, 0.0, 0.0])
                    boards.append(turn @ se3.invert(T))
    return np.stack(boards)


def describe_move(T_from: Array, T_to: Array, target: Target) -> str:
    """Return in words how the target's pose in the camera changes from one to another.

    Args:
        T_from: (4, 4) T_cam_board now [m].
        T_to: (4, 4) T_cam_board wanted [m].
        target: the target.
    """
    a, b = board_geometry(T_from, target), board_geometry(T_to, target)
    words: list[str] = []
    roll = (b.roll_deg - a.roll_deg + 180.0) % 360.0 - 180.0
    if abs(roll) > SMALL_MOVE_DEG:
        words.append(f"roll by {abs(roll):.0f} deg about the optical axis")
    turn = float(np.degrees(np.linalg.norm(_slant(a) - _slant(b))))
    if turn > SMALL_MOVE_DEG:
        words.append(f"look at the board {_side(b)}")
    step = b.distance_m - a.distance_m
    if abs(step) > SMALL_MOVE_M:
        way = "closer" if step < 0 else "farther away"
        words.append(f"move {100 * abs(step):.0f} cm {way}")
    return ", ".join(words) or "shift the board in the image"


def _slant(g: BoardGeometry) -> Array:
    """Return tilt as a vector in the board's plane [rad]."""
    a = np.radians(g.azimuth_deg)
    return np.radians(g.tilt_deg) * np.array([np.cos(a), np.sin(a)])


def _side(g: BoardGeometry) -> str:
    """Return from where the camera looks, in words; the board's y runs down the page."""
    if g.tilt_deg < SMALL_MOVE_DEG:
        return "square on"
    names = ("right", "lower right", "bottom", "lower left", "left", "upper left", "top",
             "upper right")  # fmt: skip
    side = names[round(g.azimuth_deg / 45.0) % 8]
    return f"from its {side} side, tilted by {g.tilt_deg:.0f} deg"
