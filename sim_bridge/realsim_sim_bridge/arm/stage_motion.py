"""The arm's joints over time in one attempt at a grasp: the way there, and the slip test's stages.

From home to the pre-grasp and straight on, timed within a share of the arm's limits; then the
fingers close, and the hand is lifted, shaken and swung with the slip test's own profiles
(`slip.motion`), as joint motions that follow the straight lines. The stages' speeds are the test's,
not the arm's: where a joint would have to be faster than it can, that is noted.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int64, Mask, Rows
from realsim.records.grasps import PHASES, GraspTrajectories
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.arm.timing import (
    TimingConfig,
    sample_times,
    straight_times,
    trapezoid,
    trapezoid_share,
)
from realsim_sim_bridge.slip.motion import SlipMotion, min_jerk

# --- Joint paths as cubics between followed poses (Hermite): value and slope are exact at the nodes
# With nodes 2 cm apart the hand leaves the straight line by h^4 / 384 times a fourth derivative,
# less than a tenth of a millimetre. Because all lines of a kind share their nodes and times, a path
# at many times is one matrix product.


def basis(at: Array, nodes: Array) -> tuple[Array, Array]:
    """Return weights (S, W) of the nodes' values and (S, W) of their slopes at distances (S,).

    Args:
        at: where the path is wanted; cut at the first and last node.
        nodes: (W,) increasing.
    """
    left, u, h = _segment(at, nodes)
    values, slopes = np.zeros((len(at), len(nodes))), np.zeros((len(at), len(nodes)))
    row = np.arange(len(at))
    values[row, left] = (1 + 2 * u) * (1 - u) ** 2
    values[row, left + 1] = u**2 * (3 - 2 * u)
    slopes[row, left] = h * u * (1 - u) ** 2
    slopes[row, left + 1] = h * u**2 * (u - 1)
    return values, slopes


def basis_slope(at: Array, nodes: Array) -> tuple[Array, Array]:
    """Return the derivatives of `basis` by the distance."""
    left, u, h = _segment(at, nodes)
    values, slopes = np.zeros((len(at), len(nodes))), np.zeros((len(at), len(nodes)))
    row = np.arange(len(at))
    values[row, left] = 6 * u * (u - 1) / h
    values[row, left + 1] = 6 * u * (1 - u) / h
    slopes[row, left] = (1 - u) * (1 - 3 * u)
    slopes[row, left + 1] = u * (3 * u - 2)
    return values, slopes


def greatest_slopes(values: Array, slopes: Array, nodes: Array) -> tuple[Array, Array]:
    """Return bounds (..., J) of the first and second derivative over the whole path.

    The derivatives of a cubic are inside the hull of their Bezier points.

    Args:
        values: (..., W, J).
        slopes: (..., W, J).
        nodes: (W,) increasing.
    """
    h = np.diff(nodes)[:, None]
    a, b = slopes[..., :-1, :], slopes[..., 1:, :]
    middle = 3 * np.diff(values, axis=-2) / h - a - b
    first = np.maximum(np.maximum(np.abs(a), np.abs(b)), np.abs(middle))
    second = 2 * np.maximum(np.abs(middle - a), np.abs(b - middle)) / h
    return first.max(axis=-2), second.max(axis=-2)


def _segment(at: Array, nodes: Array) -> tuple[Int64, Array, Array]:
    """Return left node, share of the segment from 0 to 1, and segment length."""
    left = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    h = np.diff(nodes)[left]
    return left, np.clip((at - nodes[left]) / h, 0.0, 1.0), h


REACH, APPROACH, CLOSE, LIFT, OSCILLATE, PENDULUM = range(len(PHASES))
MOVED_STAGES = ("lift", "oscillate", "pendulum")
"""The stages in which the arm moves."""
_SPEED_CHECKS = 65
"""Times at which a stage's joint speeds are looked at: the largest is missed by 0.1 %."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Line:
    """A straight line of the hand that A arms follow."""

    nodes: Array
    """(W,) distances along it [m], increasing from 0."""
    joints: Array
    """(A, W, n) [rad]."""
    slopes: Array
    """(A, W, n) derivative of the joints by the distance [rad/m]."""
    possible: Mask
    """(A,) whether it is followed within the joint limits; only then the joints mean anything."""

    def at(self, distances: Array) -> Array:
        """Return joints (A, S, n) at distances (S,) [m]."""
        values, slopes = basis(distances, self.nodes)
        return values @ self.joints + slopes @ self.slopes

    def speeds(self, distances: Array, speeds: Array) -> Array:
        """Return the greatest speed (A, n) [rad/s] of each joint at distances and speeds (S,)."""
        values, slopes = basis_slope(distances, self.nodes)
        rates = values @ self.joints + slopes @ self.slopes
        return np.max(np.abs(rates) * np.abs(speeds)[:, None], axis=1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Attempts:
    """What A attempts consist of."""

    arm: GraspingArm
    rows: Rows
    """(A,) row of the candidates, increasing."""
    home: Array
    """(n,) [rad]."""
    bent: dict[int, tuple[Array, float]]
    """Samples (S, n) and duration [s] of the way to the pre-grasp where it is not straight, by
    attempt."""
    approach: Line
    """From the grasp backwards."""
    lift: Line
    along_x: Line
    along_y: Line
    """From the lifted hand along the table's axes."""
    openings_m: Array
    """(A,) distance of the finger faces on the way [m]."""
    widths_m: Array
    """(A,) at which they meet the object [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StageMotions:
    """The attempts over time, and what the arm cannot do of them."""

    trajectories: GraspTrajectories
    possible: Mask
    """(A, 3) whether lift, oscillation and swing stay within joint limits and speeds."""
    notes: tuple[str, ...]
    """(A,) why not; '' = all is possible."""


def stage_motions(attempts: Attempts, motion: SlipMotion, config: TimingConfig) -> StageMotions:
    """Return all attempts sampled over time."""
    possible, notes = _possible(attempts, motion)
    parts = [
        _reach(attempts, config),
        _approach(attempts, config),
        _close(attempts, config),
        _lift(attempts, motion, config),
        _oscillate(attempts, motion, config),
        _swing(attempts, motion, config),
    ]
    return StageMotions(
        trajectories=_joined(attempts, parts, config), possible=possible, notes=notes
    )


# --- parts --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, slots=True)
class _Part:
    """One phase of all attempts, samples one attempt after the other."""

    durations: Array
    """(A,) [s]."""
    counts: Rows
    """(A,) samples of each attempt."""
    joints: Array
    """(S, n) [rad]."""
    openings: Array
    """(S,) [m]."""


def _ragged(durations: Array, config: TimingConfig) -> tuple[Rows, Rows, Array]:
    """Return counts (A,) and, for each sample, its attempt (S,) and its time (S,) [s]."""
    counts = np.ceil(durations * config.sample_hz - 1e-9).astype(np.int64)
    row = np.repeat(np.arange(len(counts)), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    return counts, row, (np.arange(len(row)) - first) / config.sample_hz


def _reach(attempts: Attempts, config: TimingConfig) -> _Part:
    """From home to the pre-grasp."""
    moves = attempts.approach.joints[:, -1] - attempts.home
    ramps, durations = straight_times(moves, attempts.arm.limits, config)
    for a, (_, duration) in attempts.bent.items():
        durations[a] = duration
    counts, row, t = _ragged(durations, config)
    share = trapezoid_share(t, ramps[row], durations[row])
    joints = attempts.home + share[:, None] * moves[row]
    starts = np.cumsum(counts) - counts
    for a, (samples, _) in attempts.bent.items():
        joints[starts[a] : starts[a] + counts[a]] = samples
    return _Part(durations, counts, joints, attempts.openings_m[row])


def _approach(attempts: Attempts, config: TimingConfig) -> _Part:
    """Straight on to the grasp, with a trapezoid of speed that all joints can follow."""
    line = attempts.approach
    velocity, acceleration = config.limits(attempts.arm.limits)
    first, second = greatest_slopes(line.joints, line.slopes, line.nodes)
    tiny = 1e-12
    # |q''| v^2 may take half of the acceleration, |q'| a the rest.
    speed = np.minimum(
        np.min(velocity / np.maximum(first, tiny), axis=1),
        np.min(np.sqrt(0.5 * acceleration / np.maximum(second, tiny)), axis=1),
    )
    speed = np.minimum(speed, config.approach_speed)
    left = acceleration - second * speed[:, None] ** 2
    rate = np.min(left / np.maximum(first, tiny), axis=1)
    length = float(line.nodes[-1])
    ramps, durations = trapezoid(np.full(len(speed), length), speed, rate)
    counts, row, t = _ragged(durations, config)
    back = length * (1.0 - trapezoid_share(t, ramps[row], durations[row]))
    left_node = np.clip(np.searchsorted(line.nodes, back, side="right") - 1, 0, len(line.nodes) - 2)
    values, slopes = basis(back, line.nodes)
    joints = np.zeros((len(row), attempts.arm.joints))
    for node in (left_node, left_node + 1):
        at = np.arange(len(row)), node
        joints += values[at][:, None] * line.joints[row, node]
        joints += slopes[at][:, None] * line.slopes[row, node]
    return _Part(durations, counts, joints, attempts.openings_m[row])


def _close(attempts: Attempts, config: TimingConfig) -> _Part:
    """The fingers close to the object's width, then press."""
    arrive = np.maximum(attempts.openings_m - attempts.widths_m, 0.0) / (2 * config.close_speed)
    durations = arrive + config.close_settle_s
    counts, row, t = _ragged(durations, config)
    closing = attempts.openings_m[row] - 2 * config.close_speed * t
    openings = np.maximum(closing, np.minimum(attempts.widths_m, attempts.openings_m)[row])
    return _Part(durations, counts, attempts.approach.joints[row, 0], openings)


def _stage(attempts: Attempts, possible: Mask, duration: float, joints: Array) -> _Part:
    """Return a stage that lasts equally long for all, or not at all: joints (A, S, n)."""
    count = joints.shape[1]
    return _Part(
        np.where(possible, duration, 0.0),
        np.where(possible, count, 0),
        joints[possible].reshape(-1, attempts.arm.joints),
        np.repeat(np.minimum(attempts.widths_m, attempts.openings_m)[possible], count),
    )


def _lift(attempts: Attempts, motion: SlipMotion, config: TimingConfig) -> _Part:
    """Straight up."""
    duration = motion.lift_s + motion.lift_hold_s
    height = min_jerk(
        motion.lift_height_m, motion.lift_s, sample_times(duration, config.sample_hz)
    )[0]
    return _stage(attempts, attempts.lift.possible, duration, attempts.lift.at(height))


def _oscillate(attempts: Attempts, motion: SlipMotion, config: TimingConfig) -> _Part:
    """To and fro along the table's x, then y."""
    duration = motion.oscillation_cycles / motion.oscillation_hz
    t = sample_times(2 * duration, config.sample_hz)
    along = _wave(motion, np.where(t < duration, t, t - duration))
    x, y = attempts.along_x.at(along[t < duration]), attempts.along_y.at(along[t >= duration])
    possible = attempts.along_x.possible & attempts.along_y.possible
    return _stage(attempts, possible, 2 * duration, np.concatenate([x, y], axis=1))


def _wave(motion: SlipMotion, t: Array) -> Array:
    """Return how far the hand is from where it rested [m]: from 0 to twice the amplitude."""
    return motion.oscillation_m * (1 - np.cos(2 * np.pi * motion.oscillation_hz * t))


def swing_range(arm: GraspingArm, lifted: Array, motion: SlipMotion) -> tuple[Array, Array]:
    """Return how far (A,) the hand swings down and up from the lifted joints (A, n) [rad]."""
    sweep, j = np.radians(motion.pendulum_deg), arm.swing_joint
    low = np.clip(arm.limits.lower[j] - lifted[:, j], -sweep, 0.0)
    return low, np.clip(arm.limits.upper[j] - lifted[:, j], 0.0, sweep)


def _swing(attempts: Attempts, motion: SlipMotion, config: TimingConfig) -> _Part:
    """The joint that swings the hand up, down and back (`slip.motion.pendulum_angle`)."""
    lifted = attempts.lift.joints[:, -1]
    low, high = swing_range(attempts.arm, lifted, motion)
    t, quarter = sample_times(motion.pendulum_s, config.sample_hz), motion.pendulum_s / 4
    up = min_jerk(1.0, quarter, t)[0]
    down = min_jerk(1.0, 2 * quarter, t - quarter)[0]
    back = min_jerk(1.0, quarter, t - 3 * quarter)[0]
    joints = np.repeat(lifted[:, None], len(t), axis=1)
    joints[..., attempts.arm.swing_joint] += high[:, None] * (up - down) + low[:, None] * (
        down - back
    )
    return _stage(attempts, attempts.lift.possible, motion.pendulum_s, joints)


# --- what the arm can do ------------------------------------------------------------------------


def _possible(attempts: Attempts, motion: SlipMotion) -> tuple[Mask, tuple[str, ...]]:
    """Return which stages (A, 3) stay within the arm's limits, and notes (A,) on the others."""
    count = len(attempts.rows)
    possible = np.zeros((count, len(MOVED_STAGES)), dtype=np.bool_)
    notes: list[list[str]] = [[] for _ in range(count)]
    t = np.linspace(0.0, motion.lift_s, _SPEED_CHECKS)
    height, speed, _ = min_jerk(motion.lift_height_m, motion.lift_s, t)
    lift = attempts.lift.speeds(height, speed)
    t = np.linspace(0.0, 0.5 / motion.oscillation_hz, _SPEED_CHECKS)
    omega = 2 * np.pi * motion.oscillation_hz
    speed = motion.oscillation_m * omega * np.sin(omega * t)
    shake = np.maximum(
        attempts.along_x.speeds(_wave(motion, t), speed),
        attempts.along_y.speeds(_wave(motion, t), speed),
    )
    arm = attempts.arm
    low, high = swing_range(arm, attempts.lift.joints[:, -1], motion)
    quarter = motion.pendulum_s / 4
    swing = np.zeros((count, arm.joints))
    # A minimum-jerk move's peak speed is 15/8 of its mean.
    swing[:, arm.swing_joint] = 1.875 * np.max([high, (high - low) / 2, -low], axis=0) / quarter
    reached = (
        attempts.lift.possible,
        attempts.along_x.possible & attempts.along_y.possible,
        attempts.lift.possible,
    )
    for stage, (name, speeds, within) in enumerate(
        zip(MOVED_STAGES, (lift, shake, swing), reached, strict=True)
    ):
        slow = np.all(speeds <= arm.limits.speed, axis=1)
        possible[:, stage] = within & slow
        for a in np.nonzero(~possible[:, stage])[0].tolist():
            notes[a].append(_why(name, bool(within[a]), speeds[a], arm.limits.speed))
    full = np.radians(motion.pendulum_deg) - 1e-9
    for a in np.nonzero((high < full) | (-low < full))[0].tolist():
        notes[a].append(
            f"pendulum: joint {arm.swing_joint + 1}'s limits leave {np.degrees(low[a]):.0f} to "
            f"{np.degrees(high[a]):+.0f} deg"
        )
    return possible, tuple("; ".join(said) for said in notes)


def _why(stage: str, within: bool, speeds: Array, limits: Array) -> str:
    """Return why the arm cannot do a stage."""
    if not within:
        return f"{stage}: the motion leaves the joint limits or the arm's reach"
    joint = int(np.argmax(speeds / limits))
    return (
        f"{stage}: joint {joint + 1} would need {speeds[joint]:.2f} rad/s, its limit is "
        f"{limits[joint]:g}"
    )


# --- together -----------------------------------------------------------------------------------


def _joined(attempts: Attempts, parts: list[_Part], config: TimingConfig) -> GraspTrajectories:
    """Return the phases of each attempt one after the other, and where it ends."""
    counts = np.stack([part.counts for part in parts])
    totals = counts.sum(axis=0) + 1
    starts = np.concatenate([[0], np.cumsum(totals)])
    joints, openings = np.empty((starts[-1], attempts.arm.joints)), np.empty(starts[-1])
    time_s, phase = np.empty(starts[-1]), np.empty(starts[-1], dtype=np.int64)
    at, clock = starts[:-1].copy(), np.zeros(len(totals))
    for number, part in enumerate(parts):
        first = np.cumsum(part.counts) - part.counts
        k = np.arange(len(part.openings)) - np.repeat(first, part.counts)
        to = np.repeat(at, part.counts) + k
        joints[to], openings[to], phase[to] = part.joints, part.openings, number
        time_s[to] = np.repeat(clock, part.counts) + k / config.sample_hz
        at, clock = at + part.counts, clock + part.durations
    # Every attempt ends where the lifted hand rests.
    last = np.zeros(len(totals), dtype=np.int64)
    for number, row in enumerate(counts):
        last[row > 0] = number
    joints[at], time_s[at], phase[at] = attempts.lift.joints[:, -1], clock, last
    openings[at] = np.minimum(attempts.widths_m, attempts.openings_m)
    return GraspTrajectories(
        rows=attempts.rows,
        starts=starts,
        time_s=time_s,
        joints_rad=joints,
        opening_m=openings,
        phase=phase,
    )
