"""moveJ's motion: all joints on one straight line, the leading joint on a trapezoid of speed."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Motion:
    """A straight line in joint space, from standing to standing, that may be braked on its way."""

    def __init__(self, start: Array, goal: Array, speed: float, acceleration: float) -> None:
        """Plan from start to goal (6,) [rad] at the leading joint's limits [rad/s, rad/s^2]."""
        self._start = start
        self.length = float(np.abs(goal - start).max())
        self._direction = (goal - start) / self.length if self.length > 0 else np.zeros(6)
        self._acceleration = acceleration
        # A short way never reaches the speed.
        self._peak = min(speed, math.sqrt(acceleration * self.length))
        self._t = 0.0
        self._s = 0.0
        self._v = 0.0
        self._brake: float | None = None

    @property
    def joints(self) -> Array:
        """(6,) where the arm is [rad]."""
        return self._start + self._s * self._direction

    @property
    def speeds(self) -> Array:
        """(6,) how fast its joints turn [rad/s]."""
        return self._v * self._direction

    @property
    def progress(self) -> float:
        """Share of the way that is done."""
        return 1.0 if self.length == 0 else self._s / self.length

    @property
    def ended(self) -> bool:
        """Whether the arm stands."""
        if self._brake is not None:
            return self._v == 0
        return self._t >= self._duration

    def brake(self, deceleration: float) -> None:
        """Come to a stand on the line with this deceleration of the leading joint [rad/s^2]."""
        self._brake = deceleration

    def advance(self, seconds: float) -> None:
        """Let time pass [s]."""
        if self._brake is not None:
            step = min(seconds, self._v / self._brake)
            self._s += self._v * step - 0.5 * self._brake * step**2
            self._v = 0.0 if step < seconds else self._v - self._brake * step
            return
        self._t += seconds
        self._s, self._v = self._at(self._t)

    @property
    def _duration(self) -> float:
        if self.length == 0:
            return 0.0
        return self.length / self._peak + self._peak / self._acceleration

    def _at(self, t: float) -> tuple[float, float]:
        """Return the way [rad] and the speed [rad/s] after t seconds."""
        a, v, end = self._acceleration, self._peak, self._duration
        if t >= end:
            return self.length, 0.0
        ramp = v / a
        if t < ramp:
            return 0.5 * a * t**2, a * t
        if t <= end - ramp:
            return v * (t - 0.5 * ramp), v
        return self.length - 0.5 * a * (end - t) ** 2, a * (end - t)
