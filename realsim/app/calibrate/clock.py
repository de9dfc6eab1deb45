"""Arm and camera by two clocks: their offset is found, told, and the arm's poses follow it.

Only streams are looked at: many stamped poses a second of an arm that moved. Views taken at stops
need no offset.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from realsim.app.console import Console
from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError, InputError
from realsim.records import CameraIntrinsics, Target
from realsim_calibration import BoardView, ClockOffset, estimate_board_pose, estimate_clock_offset
from realsim_calibration.clock.streams import checked_stream, interpolated
from realsim_calibration.inputs import PoseReading, RawPoses
from realsim_calibration.results import Clock, Mode

STREAM_PERIOD_S = 0.5
"""Poses further apart are views at stops, not a stream."""
STREAM_POSES = 30
"""Fewer poses are no stream either."""
MIN_POINTS = 6
"""Fewest points of a board pose that may speak for a clock."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Stamped:
    """The arm at the camera's frames."""

    Ts_base_ee: Array
    """(m, 4, 4) [m]."""
    joints: Array | None
    """(m, q) [rad]."""
    inside: Mask
    """(m,) frames in the time that the arm's stream covers."""


def clock_option(text: str) -> float | None:
    """Return the offset that was given [s]; 0 for "off", None for "auto".

    Raises:
        InputError: neither a number nor one of the words.
    """
    if text in ("auto", "off"):
        return None if text == "auto" else 0.0
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(
            f"--clock-offset {text}: auto, off, or seconds by which the camera's clock is ahead of "
            "the arm's (0.035) are accepted."
        )
    return value


def is_stream(times: Array | None) -> bool:
    """Return whether stamped poses are a stream."""
    if times is None:
        return False
    known = np.unique(times[np.isfinite(times)])
    return len(known) >= STREAM_POSES and float(np.median(np.diff(known))) <= STREAM_PERIOD_S


def arm_at(
    times: Array, Ts: Array, joints: Array | None, frames: Array, offset_s: float
) -> Stamped:
    """Return the arm at frames stamped by a clock that is ahead of its own by an offset."""
    known = np.isfinite(times) & np.isfinite(Ts).all(axis=(1, 2))
    order = np.flatnonzero(known)[np.unique(times[known], return_index=True)[1]]
    t, at = times[order], frames - offset_s
    Ts_at, inside = interpolated(*checked_stream(t, Ts[order], "the arm's stream"), at)
    if joints is None:
        return Stamped(Ts_base_ee=Ts_at, joints=None, inside=inside)
    q = np.stack([np.interp(at, t, column) for column in np.unwrap(joints[order], axis=0).T], -1)
    return Stamped(Ts_base_ee=Ts_at, joints=q, inside=inside)


def tell(found: ClockOffset, console: Console) -> Clock:
    """Say the offset; return it as the calibration's files hold it."""
    say = console.warn if found.matters else console.say
    say(f"clocks: {found.sentence}" + (" The arm's poses follow it." if found.matters else ""))
    return Clock(offset_s=found.offset_s, sigma_s=found.sigma_s, applied=found.matters)


def as_given(offset_s: float) -> Clock:
    """Return an offset that somebody gave."""
    return Clock(offset_s=offset_s, sigma_s=float("nan"), applied=True)


def pair_pose_logs(
    robot: RawPoses,
    board: RawPoses,
    readings: tuple[PoseReading, PoseReading],
    mode: Mode,
    option: str,
    console: Console,
) -> tuple[Array, Array, Array | None, list[str], Clock | None] | None:
    """Return hand poses, board poses, joints, labels and clock of two logs, None without stamps.

    Raises:
        InputError: no offset explains both, or they have no time in common.
    """
    given = clock_option(option)
    times, frames = robot.times, board.times
    if option == "off" or times is None or frames is None:
        if given:
            raise InputError(
                f"--clock-offset {option}: {robot.path} and {board.path} need a column of time "
                "stamps each (time, t, stamp)."
            )
        return None
    if given is None and not (is_stream(times) and is_stream(frames)):
        return None
    Ts, boards = robot.poses(readings[0]), board.poses(readings[1])
    if given is None:
        # The frames lie between the arm's poses: they follow even an offset that hardly matters.
        found = estimate_clock_offset(times, Ts, frames, boards, mode=mode)
        clock = replace(tell(found, console), applied=True)
    else:
        clock = as_given(given)
    offset = clock.offset_s
    arm = arm_at(times, Ts, robot.joints, frames, offset)
    keep = np.flatnonzero(arm.inside & board.measured)
    if not len(keep):
        raise InputError(
            f"with the clocks {offset:+.3f} s apart no frame of {board.path} lies in the time of "
            f"{robot.path}: they have no time in common. Give another --clock-offset."
        )
    labels = [board.where[k] or str(k) for k in keep]
    joints = None if arm.joints is None else arm.joints[keep]
    console.say(f"{len(keep)} of {len(frames)} board poses lie in the time of {len(times)} poses.")
    return arm.Ts_base_ee[keep], boards[keep], joints, labels, clock


def mend_views(
    views: Sequence[BoardView], times: Array, target: Target, camera: CameraIntrinsics,
    option: str, console: Console,
) -> tuple[list[BoardView], Clock | None]:  # fmt: skip
    """Return views of a moving camera with the arm's poses at the times of their images; the clock.

    Args:
        views: as they were recorded, in any order.
        times: (n,) their time stamps [s].
        target: the target.
        camera: a camera that is good enough for board poses.
        option: auto, off, or seconds.
        console: told the offset.
    """
    given = clock_option(option)
    if option == "off" or (given is None and not is_stream(times)):
        return list(views), None
    Ts = np.array([v.T_base_ee for v in views])
    if given is not None:
        clock = as_given(given)
    else:
        boards = np.full((len(views), 4, 4), np.nan)
        for k, view in enumerate(views):
            found = view.detection
            if len(found) >= MIN_POINTS:
                pose = estimate_board_pose(found.points(target), found.uv, camera)
                boards[k] = np.nan if pose is None else pose.T_cam_board
        try:
            found = estimate_clock_offset(times, Ts, times, boards)
        except (InputError, DegenerateError) as error:
            console.warn(f"the clocks of arm and camera were not compared: {error}")
            return list(views), None
        clock = tell(found, console)
        if not clock.applied:
            return list(views), clock
    joints = None if any(v.joints is None for v in views) else np.array([v.joints for v in views])
    arm = arm_at(times, Ts, joints, times, clock.offset_s)
    mended = [
        replace(
            view, T_base_ee=arm.Ts_base_ee[k],
            joints=None if arm.joints is None else arm.joints[k],
        )
        for k, view in enumerate(views)
        if arm.inside[k]
    ]  # fmt: skip
    return mended, clock


def read_logs(robot: Path, board: Path, key: str) -> tuple[RawPoses, RawPoses]:
    """Return two pose files."""
    from realsim_calibration.inputs import read_pose_file

    return read_pose_file(robot, key=key or None), read_pose_file(board, board=True)
