"""What a set of target views lacks before any calibration: roll, tilt, distance, coverage."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Target
from realsim_calibration.planning.next_view import board_geometry
from realsim_calibration.views import Array, BoardView

ROWS = ("upper", "middle", "lower")
COLUMNS = ("left", "middle", "right")


@dataclass(frozen=True, kw_only=True, slots=True)
class NeedsConfig:
    """What a good set of views has."""

    roll_deg: float = 60.0
    """Range of roll about the optical axis [deg]: without it errors were 2 to 6 times larger."""
    tilt_deg: float = 7.0
    """Least spread (RMS over all views) of the tilt along either axis of the board [deg]: one view
    in ten at 25 deg."""
    hand_turn_deg: float = 10.0
    """Least spread (RMS) of the hand's turns about its second axis [deg]: turns about one axis
    leave the camera's place along it open."""
    fill: float = 0.35
    """Least share of the image's width or height that the target fills in the best view."""
    distance_ratio: float = 1.25
    """Least ratio of the farthest to the nearest view: size and distance are told apart by it."""
    cells: int = 7
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


def roll_range_deg(rolls_deg: Sequence[float]) -> float:
    """Return the shortest arc that holds all rolls [deg]: a full turn less the largest gap."""
    if len(rolls_deg) < 2:
        return 0.0
    ordered = np.sort(np.mod(rolls_deg, 360.0))
    gaps = np.diff(np.append(ordered, ordered[0] + 360.0))
    return float(360.0 - gaps.max())


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
    seen: Sequence[SeenBoard], target: Target, camera: CameraIntrinsics, config: NeedsConfig
) -> tuple[Need, ...]:
    """Return what to do in further views, the most useful first; empty where nothing lacks."""
    if not seen:
        return (Need(about="target", sentence="show the target to the camera"),)
    places = [board_geometry(s.T_cam_board, target) for s in seen]
    needs: list[Need] = []
    roll = roll_range_deg([p.roll_deg for p in places])
    if roll < config.roll_deg:
        told = f"{config.roll_deg:.0f} deg about the optical axis (so far {roll:.0f})"
        needs.append(Need(about="roll", sentence=f"roll the hand by {told}"))
    needs += _tilts(np.array([[p.tilt_deg, p.azimuth_deg] for p in places]), config)
    turn = second_turn_deg(np.stack([s.view.T_base_ee for s in seen]))
    if turn < config.hand_turn_deg and not needs:
        told = f"turn the hand about a second axis (so far {turn:.0f} deg)"
        needs.append(Need(about="turn", sentence=told))
    fill = max(_fill(s.view, camera) for s in seen)
    distances = [p.distance_m for p in places]
    if fill < config.fill:
        told = f"move closer: the board fills {fill:.0%} of the image"
        needs.append(Need(about="distance", sentence=told))
    elif max(distances) < config.distance_ratio * min(distances):
        told = (
            f"change the distance ({min(distances):.2f} to {max(distances):.2f} m so far), by a "
            "quarter at least"
        )
        needs.append(Need(about="distance", sentence=told))
    return (*needs, *_corners(seen, camera, config))


def _tilts(places: Array, config: NeedsConfig) -> list[Need]:
    """Return what tilts (n, 2) of angle and azimuth [deg] lack."""
    angle, azimuth = np.radians(places[:, 0]), np.radians(places[:, 1])
    slants = np.degrees(angle[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], -1))
    values = np.linalg.eigvalsh(slants.T @ slants / len(slants))
    second, first = np.sqrt(np.maximum(values, 0.0))
    if first < config.tilt_deg:
        told = f"tilt the camera by 20 to 45 deg (so far {first:.0f})"
        return [Need(about="tilt", sentence=told)]
    if second < config.tilt_deg:
        told = f"tilt about a second axis by 20 to 45 deg (so far {second:.0f})"
        return [Need(about="tilt", sentence=told)]
    return []


def _fill(view: BoardView, camera: CameraIntrinsics) -> float:
    """Return the share of the image's width or height that the target fills, the greater."""
    extent = np.ptp(view.detection.uv, axis=0)
    return float(np.max(extent / [camera.width, camera.height]))


def _corners(
    seen: Sequence[SeenBoard], camera: CameraIntrinsics, config: NeedsConfig
) -> tuple[Need, ...]:
    """Return where in the image the target has not been, corners first."""
    uv = np.concatenate([s.view.detection.uv for s in seen])
    cell = np.clip((uv / [camera.width, camera.height] * 3).astype(int), 0, 2)
    filled = np.zeros((3, 3), bool)
    filled[cell[:, 1], cell[:, 0]] = True
    if filled.sum() >= config.cells:
        return ()
    order = [(0, 0), (2, 2), (0, 2), (2, 0), (0, 1), (2, 1), (1, 0), (1, 2), (1, 1)]
    r, c = next(rc for rc in order if not filled[rc])
    name = "middle" if r == c == 1 else f"{ROWS[r]} {COLUMNS[c]}"
    told = f"show the board in the {name} part of the image"
    return (Need(about="image", sentence=told),)
