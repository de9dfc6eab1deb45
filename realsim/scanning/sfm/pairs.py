"""Which images to match: all pairs, or those that may see the same where poses are known."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from realsim.scanning.sfm.config import FeatureConfig

Array = NDArray[np.float64]


def pairs_to_match(
    count: int, Ts_world_cam: Array | None, config: FeatureConfig
) -> list[tuple[int, int]]:
    """Return pairs of image numbers (i < j), in order.

    Without poses all pairs; with poses those whose optical axes differ by at most
    `max_angle_deg`, and, where there are many views, of each view the `neighbours` nearest by the
    angle plus the distance of the centres over the spread of all. Each view keeps its nearest two
    whatever the angle, so that none is left out by a wrong pose.

    Args:
        count: images.
        Ts_world_cam: (count, 4, 4) camera poses [m], rough ones do; None where not known.
        config: angles and numbers.
    """
    every = list(combinations(range(count), 2))
    if Ts_world_cam is None:
        return every
    axes, centres = Ts_world_cam[:, :3, 2], Ts_world_cam[:, :3, 3]
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)))
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    spread = max(float(np.median(distance)), 1e-9)
    # One spread of the centres counts as much as 30 deg: on a hemisphere they go together.
    cost = angle + 30.0 * distance / spread
    np.fill_diagonal(cost, np.inf)
    order = np.argsort(cost, axis=1, kind="stable")
    near = np.zeros((count, count), dtype=bool)
    most = count if count <= config.exhaustive_up_to else config.neighbours
    for i in range(count):
        chosen = [j for j in order[i, :most] if angle[i, j] <= config.max_angle_deg and j != i]
        near[i, chosen] = True
        near[i, order[i, : min(2, count - 1)]] = True
    near |= near.T
    return [(i, j) for i, j in every if near[i, j]]
