"""What is seen of pairs while MuJoCo rolls them out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim_sim_bridge.slip import mujoco_state
from realsim_sim_bridge.slip.world import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Samples:
    """State rows and forces of K pairs at S times; NaN until they are filled in."""

    rows: Array
    """(K, S, 20), see `mujoco_state`."""
    finger_n: Array
    """(K, S, 2) sum of the normal forces of each finger's contacts [N]."""
    times_s: Array
    """(S,) [s]."""

    @classmethod
    def empty(cls, pairs: int, times_s: Array) -> "Samples":
        """Return samples of K pairs at times (S,) [s] of which nothing has been seen."""
        shape = (pairs, len(times_s))
        return cls(
            rows=np.full((*shape, mujoco_state.WIDTH), np.nan),
            finger_n=np.full((*shape, 2), np.nan),
            times_s=times_s,
        )

    def held(self, last: NDArray[np.int64], pairs: NDArray[np.bool_]) -> "Samples":
        """Return them up to the last sample of any pair, some pairs standing still after theirs.

        Args:
            last: (K,) number of the last sample of each pair.
            pairs: (K,) those that stand still; the others stay NaN.
        """
        count = int(last.max()) + 1 if len(last) else 0
        times = np.arange(count)
        at = np.where(pairs[:, None], np.minimum(times, last[:, None]), times)[..., None]
        return Samples(
            rows=np.take_along_axis(self.rows, at, axis=1),
            finger_n=np.take_along_axis(self.finger_n, at, axis=1),
            times_s=self.times_s[:count],
        )

    def motion(self, Rs_world_hand: Array) -> Motion:
        """Return them in the pairs' worlds, whose axes are turned against the hand's (K, 3, 3)."""
        return Motion(
            Ts_world_body=mujoco_state.poses(self.rows, Rs_world_hand[:, None]),
            finger_n=self.finger_n,
            times_s=self.times_s,
        )
