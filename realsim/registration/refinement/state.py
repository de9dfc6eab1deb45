"""Where everything stands during a refinement."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.registration.body import Body
from realsim.registration.refinement.equations import BIAS, HAND_EYE, TABLE, TABLE_ROWS, object_at

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class State:
    """Objects, table, cameras' errors and the depth's bias."""

    poses: Array
    """(K, 4, 4) T_world_obj."""
    T_world_table: Array | None
    """(4, 4)."""
    hand_eye: Array
    """(6,) twist of every camera [rad, m]."""
    views: Array
    """(V, 6) further twist of each."""
    bias: Array
    """(2,) scale and offset [1/m] of the inverse depth."""

    def cameras(self, claimed: Array) -> Array:
        """Return the cameras (V, 4, 4) as they stand now, from what is said of them."""
        return claimed @ se3.exp(self.hand_eye + self.views)

    def corrected(self, points: Array) -> Array:
        """Return points (N, 3) in camera axes without the depth's bias."""
        scale, offset = self.bias
        return points / (scale + offset * points[:, 2:])


def centred(body: Body, T_world_obj: Array) -> Array:
    """Return the pose (4, 4) of the body's frame moved to the centre of its box."""
    return T_world_obj @ se3.from_translation(body.center_obj)


def moved(state: State, bodies: list[Body], shared: Array, views: Array) -> State:
    """Return the state after one step.

    Args:
        state: before.
        bodies: the objects.
        shared: (11 + 6 K,) see `equations`.
        views: (V, 6).
    """
    poses = [
        centred(b, T) @ se3.exp(shared[object_at(k)])
        @ se3.from_translation(-b.center_obj)
        for k, (b, T) in enumerate(zip(bodies, state.poses, strict=True))
    ]  # fmt: skip
    table = state.T_world_table
    if table is not None:
        xi = np.zeros(6)
        xi[list(TABLE_ROWS)] = shared[TABLE]
        table = table @ se3.exp(xi)
    return replace(
        state,
        poses=np.stack(poses) if poses else state.poses,
        T_world_table=table,
        hand_eye=state.hand_eye + shared[HAND_EYE],
        views=state.views + views,
        bias=state.bias + shared[BIAS],
    )
