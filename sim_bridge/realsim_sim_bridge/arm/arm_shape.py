"""The shape of arm and hand: spheres that contain their surfaces.

The arm's were fitted to Franka's meshes (franka_description; collision and visual ones): per link
the samples of the surface are split into a few groups, each with its least enclosing sphere, grown
by 1.5 mm (the foot by 4) for what lies between the samples. They stand out of the link's convex
hull by 7 to 10 mm on average (the foot's by 23). The hand's follow from its boxes.
"""

import numpy as np
from numpy.typing import NDArray

from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.grasping.hand import HandGeometry

Array = NDArray[np.float64]

HAND = 8
"""Link number of the hand's palm: its frame is the grasp frame. 0 = base, 1 to 7 = the joints."""
FINGER_SIDE = (9, 10)
"""Link numbers of the fingers at +y and -y, in the grasp frame of a closed hand."""
PALM_CELL_M, FINGER_CELL_M, BEHIND_CELL_M = 0.036, 0.018, 0.036
"""Largest edge of the pieces of a box that one sphere contains [m]."""

_ARM = (
    (0, -0.0076, 0.0569, 0.0278, 0.0720),
    (0, -0.1128, -0.0396, 0.0146, 0.0613),
    (0, 0.0069, -0.0203, 0.1078, 0.0677),
    (0, 0.0413, -0.0218, 0.0179, 0.0716),
    (0, -0.1014, 0.0340, 0.0064, 0.0659),
    (0, -0.0637, 0.0018, 0.0817, 0.0714),
    (0, -0.0279, -0.0493, 0.0389, 0.0720),
    (0, 0.0064, 0.0288, 0.1008, 0.0692),
    (1, -0.0011, -0.0004, -0.1478, 0.0731),
    (1, 0.0021, -0.0262, -0.0008, 0.0647),
    (1, -0.0028, -0.0690, -0.0040, 0.0658),
    (1, 0.0029, -0.0303, -0.0680, 0.0696),
    (2, 0.0020, -0.0090, 0.0697, 0.0688),
    (2, 0.0002, -0.1518, 0.0002, 0.0713),
    (2, -0.0007, -0.0735, 0.0223, 0.0704),
    (2, -0.0008, 0.0000, 0.0259, 0.0635),
    (3, 0.0765, 0.0180, 0.0018, 0.0661),
    (3, -0.0004, 0.0002, -0.0824, 0.0693),
    (3, 0.0721, 0.0622, -0.0028, 0.0662),
    (3, 0.0114, -0.0043, -0.0721, 0.0688),
    (4, -0.0711, 0.0530, 0.0036, 0.0608),
    (4, -0.0064, 0.0054, 0.0599, 0.0653),
    (4, -0.0826, 0.0912, 0.0001, 0.0662),
    (4, -0.0037, -0.0003, 0.0114, 0.0649),
    (5, 0.0002, 0.0870, 0.0002, 0.0554),
    (5, 0.0004, -0.0003, -0.2263, 0.0658),
    (5, 0.0061, 0.0625, -0.1577, 0.0628),
    (5, -0.0001, 0.0393, 0.0003, 0.0552),
    (5, -0.0072, 0.0169, -0.2282, 0.0637),
    (5, -0.0034, 0.0990, -0.0701, 0.0576),
    (6, 0.0329, 0.0128, 0.0158, 0.0572),
    (6, 0.0863, -0.0201, 0.0004, 0.0573),
    (6, 0.0825, 0.0386, -0.0018, 0.0568),
    (6, 0.0028, -0.0015, 0.0077, 0.0576),
    (7, 0.0076, -0.0200, 0.0750, 0.0390),
    (7, -0.0236, -0.0207, 0.0777, 0.0351),
    (7, -0.0199, 0.0067, 0.0779, 0.0383),
    (7, -0.0011, 0.0356, 0.0762, 0.0387),
    (7, 0.0446, 0.0447, 0.0808, 0.0400),
    (7, 0.0308, 0.0012, 0.0824, 0.0393),
)
"""Link, centre in the link's frame [m], radius [m]."""


_MOUNT = -panda.TCP_M
_BEHIND = (
    ((-0.029, -0.104, _MOUNT - 0.0105), (0.029, 0.089, _MOUNT)),
    ((-0.006, -0.104, _MOUNT - 0.026), (0.006, -0.045, _MOUNT)),
)
"""Boxes (2, 3) around what the hand has beside and behind the flange, grasp frame [m]: the rim of
its body and its plug."""


def arm_spheres() -> Array:
    """Return the spheres (S, 5) of links 0 to 7: link, centre in its frame [m], radius [m].

    With them goes what Franka's hand has behind its mounting face, which is no part of its boxes.
    """
    behind = [_cover(HAND, np.array(box), BEHIND_CELL_M) for box in _BEHIND]
    return np.concatenate([np.array(_ARM, dtype=np.float64), *behind])


def hand_spheres(geometry: HandGeometry) -> Array:
    """Return the spheres (S, 5) that contain the hand's boxes: as `arm_spheres`, grasp frame.

    The fingers are those of the closed hand; an open one's are moved along y by half the opening.
    """
    palm, right, left = geometry.boxes(0.0)[0]
    pieces = ((HAND, palm, PALM_CELL_M), (FINGER_SIDE[0], left, FINGER_CELL_M),
              (FINGER_SIDE[1], right, FINGER_CELL_M))  # fmt: skip
    return np.concatenate([_cover(link, box, cell_m) for link, box, cell_m in pieces])


def _cover(link: int, box: Array, cell_m: float) -> Array:
    """Return spheres (S, 5) that contain the box (2, 3): one around each of its equal pieces."""
    size = box[1] - box[0]
    counts = np.maximum(np.ceil(size / cell_m - 1e-9), 1).astype(np.int64)
    pieces = size / counts
    grid = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in counts), indexing="ij"), axis=-1)
    centers = box[0] + grid.reshape(-1, 3) * pieces
    rest = np.broadcast_to([np.linalg.norm(pieces) / 2], (len(centers), 1))
    return np.concatenate([np.full((len(centers), 1), float(link)), centers, rest], axis=1)
