"""Arm and camera by two clocks: their offset is found, told, and the arm's poses follow it.

Only streams are looked at: many stamped poses a second of an arm that moved. Views taken at stops
need no offset.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.app.console import Console
from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError, InputError
from realsim.records import CameraIntrinsics, Target
from realsim_calibration import BoardView, ClockOffset, estimate_board_pose, estimate_clock_offset
from realsim_calibration.clock.offset import checked_stream, in_gap, interpolated
from realsim_calibration.inputs.raw_poses import RawPoses
from realsim_calibration.inputs.readings import PoseReading
from realsim_calibration.results import Clock, Mode

STREAM_PERIOD_S = 0.5
"""Poses further apart are views at stops, not a stream."""
STREAM_POSES = 30
"""Fewer poses are no stream either."""
MIN_POINTS = 6
"""Fewest points of a board pose that may speak for a clock."""
LONGER = 1.5
"""A way that is so much longer in the order of time than in the file's is that of two recordings
whose times overlap; lines that are merely not sorted make it shorter."""


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


def why_no_stream(poses: RawPoses, least: int = STREAM_POSES) -> str:
    """Return why stamped poses are no stream of at least so many; empty where they are one."""
    assert poses.times is not None
    known = np.unique(poses.times[np.isfinite(poses.times)])
    if len(known) < 2:
        return f"{poses.path}: all time stamps are equal."
    apart = float(np.median(np.diff(known)))
    if apart > STREAM_PERIOD_S:
        unit = "milliseconds? Divide by 1000" if apart < 1e4 else "nanoseconds? Divide by 1e9"
        return (
            f"{poses.path}: the time stamps are {apart:.6g} apart (median); a stream in seconds "
            f"has at most {STREAM_PERIOD_S:g} s between poses. Are they {unit}."
        )
    if len(known) < least:
        return (
            f"{poses.path}: {len(known)} poses have a time stamp of their own; {least} are needed "
            "to find the offset of the clocks. Record longer, or give it (--clock-offset SECONDS)."
        )
    return ""


def own_times(poses: RawPoses, Ts: Array, console: Console) -> Mask:
    """Return which poses (n, 4, 4) have a time stamp that is theirs alone; say which have not.

    Raises:
        InputError: the clock goes back to a time that was recorded already.
    """
    assert poses.times is not None
    t, finite = poses.times, np.isfinite(poses.times)
    known = np.flatnonzero(finite)
    by_time = known[np.argsort(t[known], kind="stable")]
    way, way_by_time = (
        float(np.linalg.norm(np.diff(Ts[rows], axis=0), axis=(1, 2)).sum())
        for rows in (known, by_time)
    )
    if way_by_time > LONGER * way:
        k = int(np.argmin(np.diff(t[known])))
        raise InputError(
            f"{poses.path}: {poses.where[known[k + 1]]}: the time goes back by "
            f"{t[known[k]] - t[known[k + 1]]:.4g} s: two recordings in one file? Give each its own."
        )
    own = np.zeros(len(t), dtype=bool)
    own[known[np.unique(t[known], return_index=True)[1]]] = True
    for lost, what in (
        (~finite, "without a time stamp"),
        (finite & ~own, "with the time stamp of a pose before"),
    ):
        if lost.any():
            console.warn(
                f"{poses.path}: {lost.sum()} of {len(t)} poses are left out: {what} (the first is "
                f"{poses.where[int(np.argmax(lost))]})."
            )
    return own


def arm_at(
    times: Array, Ts: Array, joints: Array | None, frames: Array, offset_s: float
) -> Stamped:
    """Return the arm at frames stamped by a clock that is ahead of its own by an offset."""
    known = np.isfinite(times) & np.isfinite(Ts).all(axis=(1, 2))
    order = np.flatnonzero(known)[np.unique(times[known], return_index=True)[1]]
    t, at = times[order], frames - offset_s
    Ts_at, inside = interpolated(*checked_stream(t, Ts[order], "the arm's stream"), at)
    columns = () if joints is None else np.unwrap(joints[order], axis=0).T
    q = np.stack([np.interp(at, t, column) for column in columns], -1) if len(columns) else None
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
        InputError: no offset explains both, they have no time in common, or time stamps by which
            alone they could be paired are no stream.
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
    named = all(label or stem for label, stem in zip(board.labels, board.stems, strict=True))
    if len(robot) != len(board) and not named:
        # An offset that is given needs many poses of neither, and no stream of the board.
        auto = why_no_stream(robot) or why_no_stream(board)
        why = auto if given is None else why_no_stream(robot, 2)
        if why:
            raise InputError(
                f"{why} (Poses at stops are paired by the image's name beside each pose of both "
                "files.)"
            )
    if given is None and not (is_stream(times) and is_stream(frames)):
        return None
    Ts, boards = robot.poses(readings[0]), board.poses(readings[1])
    own_times(robot, Ts, console)
    own = own_times(board, boards, console)
    if given is None:
        # The frames lie between the arm's poses: they follow even an offset that hardly matters.
        found = estimate_clock_offset(times, Ts, frames, boards, mode=mode)
        clock = replace(tell(found, console), applied=True)
    else:
        clock = as_given(given)
    offset = clock.offset_s
    arm = arm_at(times, Ts, robot.joints, frames, offset)
    gap = own & in_gap(np.unique(times[np.isfinite(times)]), frames - offset)
    if gap.any():
        rows = np.flatnonzero(gap)
        console.warn(
            f"{len(rows)} poses of {board.path} lie in gaps of {robot.path} and are not used: "
            f"{', '.join(board.where[k] for k in rows[:8])}{', ...' * (len(rows) > 8)}."
        )
    keep = np.flatnonzero(arm.inside & own & ~gap)
    if not len(keep):
        raise InputError(
            f"with the clocks {offset:+.3f} s apart no frame of {board.path} "
            f"({np.nanmin(frames):.10g} to {np.nanmax(frames):.10g}) lies in the time of "
            f"{robot.path} ({np.nanmin(times):.10g} to {np.nanmax(times):.10g}): they have no time "
            "in common. Are both in seconds? Else give another --clock-offset."
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
