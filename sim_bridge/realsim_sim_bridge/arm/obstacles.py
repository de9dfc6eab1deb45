"""Points on the objects, made quick to ask: how far are they at least, and which is within reach.

A grid of cells holds for each cell a lower bound of the distance from anywhere in it to any point:
the distance from its box to the nearest box with a point in it. Where that is not enough the points
themselves are asked, which lie sorted by cell.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.robots.hand import Hand
from realsim_sim_bridge.arm import panda

Array = NDArray[np.float64]

CELL_M = 0.0125
"""Edge of a cell [m]: the bound is short of the distance by a cell or so."""
FAR_CELLS = 14
"""Distances are known up to so many cells (17 cm); the bound is no greater."""


class Obstacles(NamedTuple):
    """Points on objects in a grid; a tuple, so that compiled code takes it."""

    origin: Array
    """(3,) corner of the grid [m]."""
    bound_m: NDArray[np.float32]
    """(X, Y, Z) least distance from anywhere in the cell to a point [m]."""
    starts: NDArray[np.int64]
    """(X Y Z + 1,) first point of each cell."""
    points: Array
    """(P, 3) sorted by cell [m]."""
    instances: NDArray[np.int64]
    """(P,) instance number of each."""
    own: NDArray[np.bool_]
    """(P,) whether the point is on the object that is to be grasped."""
    box: Array
    """(2, 3) least and greatest corner of the points [m]."""


def obstacles_of(points: Array, instances: NDArray[np.int64], own: NDArray[np.bool_]) -> Obstacles:
    """Return the points (P, 3) [m] of instances (P,) in a grid."""
    if len(points) == 0:
        nowhere = np.full((1, 3), 1e6)
        return obstacles_of(nowhere, np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.bool_))
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    origin = box[0] - (FAR_CELLS + 0.5) * CELL_M
    shape = np.floor((box[1] - origin) / CELL_M).astype(np.int64) + FAR_CELLS + 1
    cells = np.floor((points - origin) / CELL_M).astype(np.int64)
    flat = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    counts = np.bincount(flat, minlength=int(shape.prod()))
    order = np.argsort(flat, kind="stable")
    return Obstacles(
        origin=origin,
        bound_m=_bounds(counts.reshape(shape) > 0),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        points=np.ascontiguousarray(points[order], dtype=np.float64),
        instances=np.ascontiguousarray(instances[order], dtype=np.int64),
        own=np.ascontiguousarray(own[order], dtype=np.bool_),
        box=box,
    )


@njit
def _bounds(occupied: Any) -> Any:
    """Return the distance (X, Y, Z) [m] from each cell's box to the nearest occupied one.

    Along an axis, boxes k cells apart have a gap of k - 1 cells; the squares add up over the axes,
    so that the least is found one axis after the other. Distances end at `FAR_CELLS`.
    """
    nx, ny, nz = occupied.shape
    squared = np.empty((nx, ny, nz), dtype=np.int32)
    for i in range(nx):
        for j in range(ny):
            gap = FAR_CELLS + 1
            for k in range(nz):
                gap = 0 if occupied[i, j, k] else gap + 1
                squared[i, j, k] = min(max(gap - 1, 0), FAR_CELLS) ** 2
            gap = FAR_CELLS + 1
            for k in range(nz - 1, -1, -1):
                gap = 0 if occupied[i, j, k] else gap + 1
                squared[i, j, k] = min(squared[i, j, k], min(max(gap - 1, 0), FAR_CELLS) ** 2)
    far = FAR_CELLS**2
    along_y = np.full((nx, ny, nz), far, dtype=np.int32)
    for i in range(nx):
        for j in range(ny):
            for other in range(max(j - FAR_CELLS, 0), min(j + FAR_CELLS + 1, ny)):
                gap = max(abs(other - j) - 1, 0) ** 2
                for k in range(nz):
                    along_y[i, j, k] = min(along_y[i, j, k], squared[i, other, k] + gap)
    squared[:] = far
    for i in range(nx):
        for other in range(max(i - FAR_CELLS, 0), min(i + FAR_CELLS + 1, nx)):
            gap = max(abs(other - i) - 1, 0) ** 2
            for j in range(ny):
                for k in range(nz):
                    squared[i, j, k] = min(squared[i, j, k], along_y[other, j, k] + gap)
    return (np.sqrt(squared) * CELL_M).astype(np.float32)


@njit
def least_distance(obstacles: Any, x: float, y: float, z: float) -> float:
    """Return a lower bound of the distance [m] from (x, y, z) to any point."""
    origin, bound, box = obstacles.origin, obstacles.bound_m, obstacles.box
    i = int(np.floor((x - origin[0]) / CELL_M))
    j = int(np.floor((y - origin[1]) / CELL_M))
    k = int(np.floor((z - origin[2]) / CELL_M))
    nx, ny, nz = bound.shape
    if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
        near = float(bound[i, j, k])
        if near < (FAR_CELLS - 1) * CELL_M:
            return near
    dx = max(box[0, 0] - x, 0.0, x - box[1, 0])
    dy = max(box[0, 1] - y, 0.0, y - box[1, 1])
    dz = max(box[0, 2] - z, 0.0, z - box[1, 2])
    outside = np.sqrt(dx * dx + dy * dy + dz * dz)
    if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
        return max(outside, (FAR_CELLS - 1) * CELL_M)
    return outside


@njit
def nearest_within(obstacles: Any, x: float, y: float, z: float, radius: float) -> Any:
    """Return the distance [m] to the nearest point within `radius` and its row, or (inf, -1)."""
    origin, starts, points = obstacles.origin, obstacles.starts, obstacles.points
    nx, ny, nz = obstacles.bound_m.shape
    i0 = max(int(np.floor((x - radius - origin[0]) / CELL_M)), 0)
    i1 = min(int(np.floor((x + radius - origin[0]) / CELL_M)), nx - 1)
    j0 = max(int(np.floor((y - radius - origin[1]) / CELL_M)), 0)
    j1 = min(int(np.floor((y + radius - origin[1]) / CELL_M)), ny - 1)
    k0 = max(int(np.floor((z - radius - origin[2]) / CELL_M)), 0)
    k1 = min(int(np.floor((z + radius - origin[2]) / CELL_M)), nz - 1)
    best, row = radius * radius, -1
    if k0 <= k1:
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                cell = (i * ny + j) * nz
                for p in range(starts[cell + k0], starts[cell + k1 + 1]):
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared < best:
                        best, row = squared, p
    return (np.sqrt(best) if row >= 0 else np.inf), row


# --- The shape of arm and hand: spheres that contain their surfaces ------------------------------
# The arm's were fitted to Franka's meshes (franka_description; collision and visual ones): per link
# the samples of the surface are split into a few groups, each with its least enclosing sphere,
# grown by 1.5 mm (the foot by 4) for what lies between the samples. They stand out of the link's
# convex hull by 7 to 10 mm on average (the foot's by 23). The hand's follow from its boxes.


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


def hand_spheres(geometry: Hand) -> Array:
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
