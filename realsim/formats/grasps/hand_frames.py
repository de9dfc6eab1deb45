"""The frames in which others say where a hand is, and the way to and from `grasp`.

| frame      | origin              | approach | closing axis | used by                          |
|------------|---------------------|----------|--------------|----------------------------------|
| grasp      | tool centre point   | z        | y            | realsim                          |
| panda_hand | hand's mounting face| z        | y            | franka_description, isaac_grasp  |
| acronym    | hand's mounting face| z        | x            | ACRONYM, GraspGen's convention   |

ACRONYM's frame is panda_hand turned by +90 degrees about z, so that its x axis is our y axis. How
far the mounting face is behind `grasp` the hand's description says: 0.1034 m of the Panda's, whose
fingertips are at z = 0.1122 m. The frames of other hands are named after the Panda's, too.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import GraspSet
from realsim.robots.hand import FRANKA, Hand, find_hand, hand_of_json

HandFrame = Literal["grasp", "panda_hand", "acronym"]

_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# Signed permutations and one shift: nothing but the shift is ever rounded.
_R_GRASP_HAND: dict[HandFrame, Array] = {
    "grasp": np.eye(3), "panda_hand": np.eye(3), "acronym": _QUARTER_TURN,
}  # fmt: skip
HAND_FRAMES = tuple(_R_GRASP_HAND)


def T_grasp_hand(frame: HandFrame, hand: Hand | None = None) -> Array:
    """Return the pose (4, 4) of a frame in `grasp` [m]; of the Panda's hand where none is given."""
    mount_z = 0.0 if frame == "grasp" else (hand or find_hand()).mount_z_m
    return se3.from_rt(_R_GRASP_HAND[known_frame(frame)], [0.0, 0.0, mount_z])


def hand_poses(Ts_a_grasp: ArrayLike, frame: HandFrame, hand: Hand | None = None) -> Array:
    """Return T_a_hand (..., 4, 4) [m] of grasps T_a_grasp (..., 4, 4) [m]."""
    return np.asarray(Ts_a_grasp, dtype=np.float64) @ T_grasp_hand(known_frame(frame), hand)


def grasp_poses(Ts_a_hand: ArrayLike, frame: HandFrame, hand: Hand | None = None) -> Array:
    """Return T_a_grasp (..., 4, 4) [m] of hands T_a_hand (..., 4, 4) [m]; undoes `hand_poses`."""
    T = T_grasp_hand(known_frame(frame), hand)
    return np.asarray(Ts_a_hand, dtype=np.float64) @ se3.invert(T)


def known_frame(frame: str) -> HandFrame:
    """Return the frame's name.

    Raises:
        InputError: there is no such frame.
    """
    for name in HAND_FRAMES:
        if name == frame:
            return name
    raise InputError(f"'{frame}' is no frame of the hand; there are: {', '.join(HAND_FRAMES)}.")


def hand_of_set(grasps: GraspSet) -> Hand:
    """Return the hand that a set's grasps are of; of sets that name none the Panda's.

    Raises:
        InputError: the set's parameters hold what is no hand.
    """
    config = grasps.parameters.get("config")
    told = config.get("hand") if isinstance(config, dict) else None
    if not told:
        return find_hand()
    return hand_of_json(told, f"the grasps of instance {grasps.instance}: hand")


def require_panda(grasps: GraspSet, what: str) -> None:
    """Check that grasps are of the Panda's hand.

    Raises:
        InputError: they are of another one.
    """
    name = grasps.hand[0]
    if name != FRANKA:
        raise InputError(
            f"the grasps of instance {grasps.instance} are of the hand '{name}'; {what} is of the "
            "Panda's hand alone. Export them with --to graspgen, isaac, hdf5 or parquet, which "
            "take any hand."
        )
