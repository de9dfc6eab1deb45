"""What the arm did in each attempt at a grasp: joint angles over time."""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.records.checked_arrays import freeze

PHASES = ("reach", "approach", "close", "lift", "oscillate", "pendulum")
"""The parts of an attempt, in order: from home to the pre-grasp, straight on, and the stages."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspTrajectories:
    """The attempts of one grasp set; samples of attempt a are starts[a] to starts[a + 1]."""

    rows: Int64
    """(A,) row of the grasp set that each attempt belongs to, increasing."""
    starts: Int64
    """(A + 1,) first sample of each attempt; the last is the number of samples."""
    time_s: Array
    """(S,) since the attempt's start [s], not decreasing within an attempt."""
    joints_rad: Array
    """(S, J) angles of the arm's joints [rad]."""
    opening_m: Array
    """(S,) commanded distance of the finger faces [m]."""
    phase: Int64
    """(S,) number in PHASES."""

    def __post_init__(self) -> None:
        """Check that everything fits together and freeze it."""
        joints = np.asarray(self.joints_rad, dtype=np.float64)
        if joints.ndim != 2:
            raise InputError(
                f"joints_rad has the shape {joints.shape}; (samples, joints) is expected."
            )
        n, s = len(self.rows), len(joints)
        freeze(self, np.int64, rows=(n,), starts=(n + 1,), phase=(s,))
        freeze(self, joints_rad=joints.shape, time_s=(s,), opening_m=(s,))
        for name in ("time_s", "opening_m", "joints_rad"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"{name} of the attempts has NaN or infinite numbers.")
        if np.any(np.diff(self.rows) <= 0):
            raise InputError("the rows of attempts do not increase; each grasp has one attempt.")
        counts = np.diff(self.starts)
        if self.starts[0] != 0 or self.starts[-1] != s or np.any(counts < 0):
            raise InputError(
                f"the starts of {n} attempts do not cover their {s} samples from 0 to the end."
            )
        if s and not (self.phase.min() >= 0 and self.phase.max() < len(PHASES)):
            raise InputError(f"a phase is not one of 0 to {len(PHASES) - 1}: {', '.join(PHASES)}.")

    def __len__(self) -> int:
        """Return the number of attempts."""
        return len(self.rows)

    def attempt(self, row: int) -> slice | None:
        """Return the samples of a grasp set's row, or None if it was not attempted."""
        at = int(np.searchsorted(self.rows, row))
        if at == len(self.rows) or self.rows[at] != row:
            return None
        return slice(int(self.starts[at]), int(self.starts[at + 1]))
