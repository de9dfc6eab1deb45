"""Poses from which the target can be seen, where nobody has planned any; and moves in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Target
from realsim_calibration.faults.motion_check import range_deg
from realsim_calibration.planning.next_view import BoardGeometry, board_geometry
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import BoardView, target_middle

SMALL_MOVE_DEG = 10.0
"""Angles that are not worth a word to the operator [deg]."""
SMALL_MOVE_M = 0.03
"""Distances that are not worth a word to the operator [m]."""
ROWS = ("upper", "middle", "lower")
COLUMNS = ("left", "middle", "right")


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
    X, Z = report.X, report.Z_points
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


# --- what is missing in the views ----------------------------------------------------------------
#
# What a set of target views lacks before any calibration: roll, tilt, distance, coverage.


ROLL_DEG = 60.0
"""Range of roll about the optical axis [deg]: without it errors were 2 to 6 times larger."""
TILT_DEG = 7.0
"""Least spread (RMS over all views) of the tilt along either axis of the board [deg]: one view
in ten at 25 deg."""
HAND_TURN_DEG = 10.0
"""Least spread (RMS) of the hand's turns about its second axis [deg]: turns about one axis
leave the camera's place along it open."""
FILL = 0.35
"""Least share of the image's width or height that the target fills in the best view."""
DISTANCE_RATIO = 1.25
"""Least ratio of the farthest to the nearest view: size and distance are told apart by it."""
CELLS = 7
"""Least number of the image's 3 x 3 cells with points: the lens is measured where they are."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Need:
    """Something that the views so far lack."""

    about: Literal["target", "roll", "tilt", "turn", "distance", "image"]
    sentence: str
    """What to do in further views."""

    @property
    def hidden(self) -> bool:
        """Whether sigma cannot speak for it.

        Without a turn about an axis errors of arm and lens look like another place of the camera,
        and no residual shows them.
        """
        return self.about in ("roll", "tilt", "turn")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SeenBoard:
    """A view with the pose of its target."""

    view: BoardView
    T_cam_board: Array
    """(4, 4) [m]."""


def second_turn_deg(Ts_base_ee: Array) -> float:
    """Return the RMS turn of the hand about the second axis of all its relative turns [deg].

    From the scatter of the rotation vectors of all pairs (n, 4, 4), in the hand's own axes.
    """
    i, j = np.triu_indices(len(Ts_base_ee), 1)
    if not len(i):
        return 0.0
    turns = se3.log_so3(np.swapaxes(Ts_base_ee[i, :3, :3], 1, 2) @ Ts_base_ee[j, :3, :3])
    values = np.linalg.eigvalsh(turns.T @ turns / len(turns))
    # A pair differs by two views' turns.
    return float(np.degrees(np.sqrt(max(values[1], 0.0) / 2)))


def missing(
    seen: Sequence[SeenBoard], target: Target, camera: CameraIntrinsics
) -> tuple[Need, ...]:
    """Return what to do in further views, the most useful first; empty where nothing lacks."""
    if not seen:
        return (Need(about="target", sentence="show the target to the camera"),)
    places = [board_geometry(s.T_cam_board, target) for s in seen]
    needs: list[Need] = []
    roll = range_deg([p.roll_deg for p in places])
    if roll < ROLL_DEG:
        told = f"{ROLL_DEG:.0f} deg about the optical axis (so far {roll:.0f})"
        needs.append(Need(about="roll", sentence=f"roll the hand by {told}"))
    needs += _tilts(np.array([[p.tilt_deg, p.azimuth_deg] for p in places]))
    turn = second_turn_deg(np.stack([s.view.T_base_ee for s in seen]))
    if turn < HAND_TURN_DEG and not needs:
        told = f"turn the hand about a second axis (so far {turn:.0f} deg)"
        needs.append(Need(about="turn", sentence=told))
    fill = max(_fill(s.view, camera) for s in seen)
    distances = [p.distance_m for p in places]
    if fill < FILL:
        told = f"move closer: the board fills {fill:.0%} of the image"
        needs.append(Need(about="distance", sentence=told))
    elif max(distances) < DISTANCE_RATIO * min(distances):
        told = (
            f"change the distance ({min(distances):.2f} to {max(distances):.2f} m so far), by a "
            "quarter at least"
        )
        needs.append(Need(about="distance", sentence=told))
    return (*needs, *_corners(seen, camera))


def _tilts(places: Array) -> list[Need]:
    """Return what tilts (n, 2) of angle and azimuth [deg] lack."""
    angle, azimuth = np.radians(places[:, 0]), np.radians(places[:, 1])
    slants = np.degrees(angle[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], -1))
    values = np.linalg.eigvalsh(slants.T @ slants / len(slants))
    second, first = np.sqrt(np.maximum(values, 0.0))
    if first < TILT_DEG:
        told = f"tilt the camera by 20 to 45 deg (so far {first:.0f})"
        return [Need(about="tilt", sentence=told)]
    if second < TILT_DEG:
        told = f"tilt about a second axis by 20 to 45 deg (so far {second:.0f})"
        return [Need(about="tilt", sentence=told)]
    return []


def _fill(view: BoardView, camera: CameraIntrinsics) -> float:
    """Return the share of the image's width or height that the target fills, the greater."""
    extent = np.ptp(view.detection.uv, axis=0)
    return float(np.max(extent / [camera.width, camera.height]))


def _corners(seen: Sequence[SeenBoard], camera: CameraIntrinsics) -> tuple[Need, ...]:
    """Return where in the image the target has not been, corners first."""
    uv = np.concatenate([s.view.detection.uv for s in seen])
    cell = np.clip((uv / [camera.width, camera.height] * 3).astype(int), 0, 2)
    filled = np.zeros((3, 3), bool)
    filled[cell[:, 1], cell[:, 0]] = True
    if filled.sum() >= CELLS:
        return ()
    order = [(0, 0), (2, 2), (0, 2), (2, 0), (0, 1), (2, 1), (1, 0), (1, 2), (1, 1)]
    r, c = next(rc for rc in order if not filled[rc])
    name = "middle" if r == c == 1 else f"{ROWS[r]} {COLUMNS[c]}"
    told = f"show the board in the {name} part of the image"
    return (Need(about="image", sentence=told),)
