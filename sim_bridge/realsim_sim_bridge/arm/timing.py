"""Time along a path in joint space, within an arm's limits.

A straight move from rest to rest under limits on each joint's speed and acceleration has a closed
answer: the position along it follows a trapezoid of speed whose limits are those of the joint that
needs longest. It is the optimum that TOPP-RA (Pham & Pham 2018) finds on a grid, a thousand times
faster. Paths with corners are rounded by a spline, if that is free too, and timed by TOPP-RA;
otherwise the arm stops at the corners.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.robots.limits import JointLimits

FreePath = Callable[[Array], bool]
"""(M, n) joint angles -> whether the straight moves between them are free."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TimingConfig:
    """How fast the arm moves and how often its joints are written down."""

    velocity_share: float = 0.5
    """Share of the joints' greatest speeds used on the way to the grasp: half, as labs do with
    things on the table. Lift, oscillation and swing have the slip test's own speeds."""
    acceleration_share: float = 0.3
    """Share of the joints' greatest accelerations, likewise."""
    approach_speed: float = 0.15
    """Greatest speed of the straight approach [m/s]: slow beside an object; a choice."""
    close_speed: float = 0.1
    """Speed of each finger [m/s]: the Franka Hand's top speed."""
    close_settle_s: float = 0.2
    """Time at full force after both fingers have arrived [s]."""
    sample_hz: float = 50.0
    """Samples of a trajectory per second; an attempt of 9 s has 450, 36 kB."""
    grid_points: int = 31
    """TOPP-RA's grid between two corners' worth of path; the samples are checked afterwards."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: a share is not in (0, 1], or a speed or rate is not positive.
        """
        shares = (self.velocity_share, self.acceleration_share)
        if not all(0 < share <= 1 for share in shares):
            raise InputError(f"the shares of the arm's limits are {shares}; 0 < share <= 1.")
        rates = (self.approach_speed, self.close_speed, self.sample_hz)
        if not (min(rates) > 0 and self.close_settle_s >= 0 and self.grid_points >= 5):
            raise InputError(
                f"approach_speed, close_speed and sample_hz are {rates}, close_settle_s "
                f"{self.close_settle_s}, grid_points {self.grid_points}: speeds and rates must be "
                "positive, times not negative, and 5 grid points or more."
            )

    def limits(self, arm: JointLimits) -> tuple[Array, Array]:
        """Return speeds [rad/s] and accelerations [rad/s^2] (n,) of the way to the grasp."""
        return self.velocity_share * arm.speed, self.acceleration_share * arm.acceleration


def trapezoid(length: Array, speed: Array, acceleration: Array) -> tuple[Array, Array]:
    """Return how long moves of `length` (N,) accelerate, and how long they take in all [s].

    From rest to rest; a move too short for the top speed accelerates half the time.

    Args:
        length: (N,) any unit, 0 or more.
        speed: (N,) greatest speed, in units per second.
        acceleration: (N,) greatest acceleration.
    """
    ramp = np.minimum(speed / acceleration, np.sqrt(length / acceleration))
    top = acceleration * ramp
    rest = np.where(top > 0, length / np.where(top > 0, top, 1.0) - ramp, 0.0)
    return ramp, 2 * ramp + np.maximum(rest, 0.0)


def trapezoid_share(t: Array, ramp: Array | float, duration: Array | float) -> Array:
    """Return the share of a trapezoid's length that is done at times t [s]."""
    t = np.clip(t, 0.0, duration)
    whole = (np.asarray(duration) - ramp) * ramp
    start, end = t**2 / 2, whole - (duration - t) ** 2 / 2
    middle = ramp * (t - np.asarray(ramp) / 2)
    done = np.where(t < ramp, start, np.where(t > duration - ramp, end, middle))
    return done / np.where(whole > 0, whole, 1.0)


def straight_times(moves: Array, limits: JointLimits, config: TimingConfig) -> tuple[Array, Array]:
    """Return ramp and duration (N,) [s] of straight joint moves (N, n) [rad], rest to rest."""
    velocity, acceleration = config.limits(limits)
    size = np.abs(moves)
    # Each joint does its share of a common trapezoid from 0 to 1.
    with np.errstate(divide="ignore"):
        speed = np.min(velocity / size, axis=-1)
        rate = np.min(acceleration / size, axis=-1)
    rests = np.all(size == 0, axis=-1)
    speed, rate = np.where(rests, 1.0, speed), np.where(rests, 1.0, rate)
    return trapezoid(np.where(rests, 0.0, 1.0), speed, rate)


def timed_path(
    corners: Array, is_free: FreePath, limits: JointLimits, config: TimingConfig
) -> tuple[Array, float]:
    """Return joint angles (S, n) at the sample rate along a path with corners (M, n), and its time.

    The samples are at k / sample_hz, from the start to before the end; limits hold everywhere.
    """
    rounded = _rounded(corners, is_free, limits, config)
    return rounded if rounded is not None else _stopping(corners, limits, config)


def _stopping(corners: Array, limits: JointLimits, config: TimingConfig) -> tuple[Array, float]:
    """Return samples and duration of straight moves with a stop at each corner."""
    ramps, durations = straight_times(np.diff(corners, axis=0), limits, config)
    ends = np.concatenate([[0.0], np.cumsum(durations)])
    t = sample_times(float(ends[-1]), config.sample_hz)
    leg = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, len(durations) - 1)
    share = trapezoid_share(t - ends[leg], ramps[leg], durations[leg])[:, None]
    return corners[leg] + share * (corners[leg + 1] - corners[leg]), float(ends[-1])


def sample_times(duration_s: float, rate_hz: float) -> Array:
    """Return k / rate_hz from 0 to before the duration [s]."""
    return np.arange(max(int(np.ceil(duration_s * rate_hz - 1e-9)), 0)) / rate_hz


_HUG = (0.3, 0.7)
"""Where on each leg the rounding spline is held to the path, so that it leaves it at corners
only."""
_DENSE = 12
"""Points per leg of the spline at which it is checked."""


def _rounded(
    corners: Array, is_free: FreePath, limits: JointLimits, config: TimingConfig
) -> tuple[Array, float] | None:
    """Return samples and duration of the rounded path by TOPP-RA, or None if it is not free."""
    import toppra
    import toppra.algorithm
    import toppra.constraint

    toppra.setup_logging("ERROR")
    held = [corners[0]]
    for a, b in pairwise(corners):
        held += [a + share * (b - a) for share in _HUG]
    knots = np.stack([*held, corners[-1]])
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    if np.any(np.diff(at) < 1e-6):
        return None
    path: Any = toppra.SplineInterpolator(at / at[-1], knots, "natural")
    dense = path(np.linspace(0.0, 1.0, _DENSE * (len(corners) - 1) + 1))
    dense[0], dense[-1] = corners[0], corners[-1]
    if not limits.contains(dense).all() or not is_free(dense):
        return None
    velocity, acceleration = config.limits(limits)
    constraints: list[Any] = [
        toppra.constraint.JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        toppra.constraint.JointAccelerationConstraint(
            np.stack([-acceleration, acceleration], axis=1)
        ),
    ]
    grid = np.linspace(0.0, 1.0, config.grid_points * (len(corners) - 1))
    solver: Any = toppra.algorithm.TOPPRA(
        constraints, path, gridpoints=grid, parametrizer="ParametrizeConstAccel"
    )
    timed: Any = solver.compute_trajectory()
    if timed is None:
        return None
    return _slowed(timed, corners[-1], limits, config)


def _slowed(
    timed: Any, end: Array, limits: JointLimits, config: TimingConfig
) -> tuple[Array, float]:
    """Return samples and duration, slowed until they keep the limits: TOPP-RA does on its grid."""
    velocity, acceleration = config.limits(limits)
    slower = 1.0
    while True:
        duration = float(timed.duration) * slower
        t = sample_times(duration, config.sample_hz)
        q = np.asarray(timed(t / slower), dtype=np.float64)
        fine = np.linspace(0.0, float(timed.duration), 8 * config.grid_points)
        speed = np.abs(timed(fine, 1)) / slower / velocity
        force = np.abs(timed(fine, 2)) / slower**2 / acceleration
        # The samples' own divided differences are what a controller makes of them.
        steps = np.diff(np.append(t, duration))[:, None]
        speeds = np.diff(np.concatenate([q, end[None]]), axis=0) / steps
        forces = np.diff(speeds, axis=0) / ((steps[1:] + steps[:-1]) / 2)
        most = max(
            float(speed.max()),
            float(np.max(np.abs(speeds) / velocity)),
            float(np.sqrt(force.max())),
            float(np.sqrt(np.max(np.abs(forces) / acceleration, initial=0.0))),
        )
        if most <= 1.0:
            return q, duration
        # Time k times as long divides speeds by k and accelerations by k^2.
        slower *= most * (1.0 + 1e-9)
