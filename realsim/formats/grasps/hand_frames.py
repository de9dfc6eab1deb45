"""The frames in which others say where the Panda's hand is, and the way to and from `grasp`.

| frame      | origin              | approach | closing axis | used by                          |
|------------|---------------------|----------|--------------|----------------------------------|
| grasp      | tool centre point   | z        | y            | realsim                          |
| panda_hand | hand's mounting face| z        | y            | franka_description, isaac_grasp  |
| acronym    | hand's mounting face| z        | x            | ACRONYM, GraspGen's convention   |

ACRONYM's frame is panda_hand turned by +90 degrees about z, so that its x axis is our y axis. The
fingertips are at z = 0.1122 m in both, the tool centre point is at 0.1034 m.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import find_hand

Array = NDArray[np.float64]
HandFrame = Literal["grasp", "panda_hand", "acronym"]
_FRANKA = find_hand()

TCP_Z_M = -_FRANKA.mount_z_m
"""z of the tool centre point in panda_hand [m]: Franka's own setting of the hand."""
FINGERTIP_Z_M = round(TCP_Z_M + _FRANKA.tip_beyond_tcp_m, 6)
"""z of the fingertips in panda_hand [m] (franka_description; ACRONYM's gripper marker)."""
FINGER_OPEN_M = _FRANKA.max_opening_m / 2.0
"""Position of each finger's joint when the hand is fully open [m]."""

_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# Signed permutations and one shift: nothing but the shift is ever rounded.
T_GRASP_HAND: dict[HandFrame, Array] = {
    "grasp": np.eye(4),
    "panda_hand": se3.from_translation([0.0, 0.0, -TCP_Z_M]),
    "acronym": se3.from_rt(_QUARTER_TURN, [0.0, 0.0, -TCP_Z_M]),
}
"""Pose (4, 4) of each frame in `grasp` [m]."""


def hand_poses(Ts_a_grasp: ArrayLike, frame: HandFrame) -> Array:
    """Return T_a_hand (..., 4, 4) [m] of grasps T_a_grasp (..., 4, 4) [m]."""
    return np.asarray(Ts_a_grasp, dtype=np.float64) @ T_GRASP_HAND[known_frame(frame)]


def grasp_poses(Ts_a_hand: ArrayLike, frame: HandFrame) -> Array:
    """Return T_a_grasp (..., 4, 4) [m] of hands T_a_hand (..., 4, 4) [m]; undoes `hand_poses`."""
    return np.asarray(Ts_a_hand, dtype=np.float64) @ se3.invert(T_GRASP_HAND[known_frame(frame)])


def known_frame(frame: str) -> HandFrame:
    """Return the frame's name.

    Raises:
        InputError: there is no such frame.
    """
    for name in T_GRASP_HAND:
        if name == frame:
            return name
    raise InputError(f"'{frame}' is no frame of the hand; there are: {', '.join(T_GRASP_HAND)}.")
