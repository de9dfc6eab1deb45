"""The tour as the arm drives it: where every joint is at which time, stop to stop.

Every leg is a straight line in joint space. Its leading joint follows a trapezoid of the plan's
speed and acceleration (a triangle where the speed is never reached); the other joints keep step.
The arm waits `config.settle_s` at every view; at via points it stops but does not wait.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim_capture_plans.planning.ordering import move_seconds
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig

Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TourSamples:
    """Configurations along all legs, ends included."""

    joints: Array
    """(M, 6) [rad]."""
    time_s: Array
    """(M,) since the tour began [s]."""
    leg: Ints
    """(M,) number of the leg."""
    move: Ints
    """(M,) number of the move, which is that of the view it ends at."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TourTime:
    """The legs of a plan with the times at which they begin and end."""

    config: PlanConfig
    """Speed, acceleration and settling time."""
    start: Array
    """(L, 6) joints where each leg begins [rad]."""
    goal: Array
    """(L, 6) joints where each leg ends [rad]."""
    move: Ints
    """(L,) move that each leg belongs to."""
    begin_s: Array
    """(L,) when each leg begins [s]."""
    end_s: Array
    """(L,) when each leg ends [s]."""

    @classmethod
    def of(cls, plan: CapturePlan) -> "TourTime":
        """Return the times of a plan's legs, from home to its last view."""
        corners = [plan.move(k) for k in range(len(plan))]
        start = np.concatenate([c[:-1] for c in corners])
        goal = np.concatenate([c[1:] for c in corners])
        move = np.repeat(np.arange(len(plan)), [len(c) - 1 for c in corners])
        c = plan.config
        seconds = move_seconds(np.abs(goal - start).max(-1), c.speed, c.acceleration)
        last = np.append(np.diff(move) > 0, True)
        pause = np.where(last, c.settle_s, 0.0)
        end = np.cumsum(seconds + pause) - pause
        return cls(config=c, start=start, goal=goal, move=move, begin_s=end - seconds, end_s=end)

    @property
    def leading_rad(self) -> Array:
        """How far the leading joint of each leg turns (L,) [rad]."""
        return np.abs(self.goal - self.start).max(-1)

    @property
    def view_s(self) -> Array:
        """When the arm arrives at each view (N,) [s]; it then waits."""
        last = np.append(np.diff(self.move) > 0, True)
        return self.end_s[last]

    @property
    def total_s(self) -> float:
        """The whole tour, the last wait included [s]."""
        return float(self.end_s[-1] + self.config.settle_s)

    def leg_at(self, time_s: ArrayLike) -> Ints:
        """Return the leg (...) under way at times (...) [s], or the one just ended."""
        last = np.searchsorted(self.begin_s, np.asarray(time_s, dtype=np.float64), side="right") - 1
        return np.clip(last, 0, len(self.begin_s) - 1)

    def joints_at(self, time_s: ArrayLike) -> Array:
        """Return the joints (..., 6) [rad] at times (...) [s]; outside the tour, its ends."""
        t = np.asarray(time_s, dtype=np.float64)
        leg = self.leg_at(t)
        turned, _ = self._along(leg, t)
        way = self.leading_rad[leg]
        part = np.divide(turned, way, out=np.ones_like(turned), where=way > 0)[..., None]
        return self.start[leg] + part * (self.goal[leg] - self.start[leg])

    def speeds_at(self, time_s: ArrayLike) -> Array:
        """Return the joint speeds (..., 6) [rad/s] at times (...) [s]."""
        t = np.asarray(time_s, dtype=np.float64)
        leg = self.leg_at(t)
        _, speed = self._along(leg, t)
        way = self.leading_rad[leg]
        rate = np.divide(speed, way, out=np.zeros_like(speed), where=way > 0)[..., None]
        return rate * (self.goal[leg] - self.start[leg])

    def samples(self, step_rad: float) -> TourSamples:
        """Return configurations at most step_rad apart in every joint, as moves are checked."""
        counts = np.ceil(self.leading_rad / step_rad).astype(np.intp) + 1
        leg = np.repeat(np.arange(len(counts)), counts + 1)
        first = np.repeat(np.cumsum(counts + 1) - (counts + 1), counts + 1)
        part = (np.arange(len(leg)) - first) / counts[leg]
        joints = self.start[leg] + part[:, None] * (self.goal - self.start)[leg]
        time = self.begin_s[leg] + self._seconds_to(leg, part * self.leading_rad[leg])
        return TourSamples(
            joints=joints.reshape(-1, joints.shape[-1]), time_s=time, leg=leg, move=self.move[leg]
        )

    def _ramp_s(self, leg: Ints) -> Array:
        """Return how long each leg speeds up, and as long slows down [s]."""
        c = self.config
        way = self.leading_rad[leg]
        return np.minimum(c.speed / c.acceleration, np.sqrt(way / c.acceleration))

    def _along(self, leg: Ints, time_s: Array) -> tuple[Array, Array]:
        """Return how far [rad] and how fast [rad/s] the leading joint is at a time on its leg."""
        a = self.config.acceleration
        whole = self.end_s[leg] - self.begin_s[leg]
        t = np.clip(time_s - self.begin_s[leg], 0.0, whole)
        ramp = self._ramp_s(leg)
        speed = a * np.minimum(ramp, np.minimum(t, whole - t))
        early = np.minimum(t, ramp)
        late = np.maximum(t - (whole - ramp), 0.0)
        cruise = t - early - late
        top = a * ramp
        turned = 0.5 * a * early**2 + top * cruise + top * late - 0.5 * a * late**2
        return np.clip(turned, 0.0, self.leading_rad[leg]), speed

    def _seconds_to(self, leg: Ints, turned_rad: Array) -> Array:
        """Return the time since the leg's begin [s] at which its leading joint has turned so far.

        The inverse of `_along`.
        """
        a = self.config.acceleration
        whole, way = self.end_s[leg] - self.begin_s[leg], self.leading_rad[leg]
        ramp = self._ramp_s(leg)
        ramp_rad = 0.5 * a * ramp**2
        rising = np.sqrt(2.0 * turned_rad / a)
        falling = whole - np.sqrt(2.0 * np.maximum(way - turned_rad, 0.0) / a)
        top = np.where(ramp > 0, a * ramp, 1.0)
        cruising = ramp + (turned_rad - ramp_rad) / top
        late = turned_rad > way - ramp_rad
        return np.where(turned_rad <= ramp_rad, rising, np.where(late, falling, cruising))
