"""GraspNet's collision labels of a scene: collision_label/scene_NNNN/collision_labels.npz.

arr_0, arr_1, ... are (P, 300, 12, 4) booleans, one array an object, in the order of the scene's
object_id_list.txt: whether the gripper of that label of grasp_label/NNN_labels.npz is in another
object or the table. The arrays have no names, so that the order is all that says whose they are;
the number of points P is the one thing that can be compared with the object's label file.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Mask
from realsim.errors import InputError
from realsim.formats.graspnet.grasp_labels import BLOCK, GRID, GraspLabels
from realsim.formats.graspnet.npz_blocks import write_blocks


def write_collision_labels(path: Path | str, objects: Sequence[tuple[GraspLabels, Mask]]) -> Path:
    """Write the collision labels of a scene, whole or not at all.

    Args:
        path: the npz file.
        objects: in the order of object_id_list.txt, the labels and whether each candidate collides
            (N,). Candidates that are not among the labels get True: nobody looked at them.

    Raises:
        InputError: the numbers of candidates and collisions differ.
    """
    arrays: dict[str, tuple[tuple[int, ...], Any, Iterator[NDArray[Any]]]] = {}
    for k, (labels, collides) in enumerate(objects):
        if np.shape(collides) != (len(labels),):
            raise InputError(
                f"object {k}: {len(labels)} candidates and collisions of the shape "
                f"{np.shape(collides)}; one each is needed."
            )
        shape = (len(labels.points), *GRID)
        arrays[f"arr_{k}"] = (shape, np.bool_, _blocks(labels, np.asarray(collides)))
    return write_blocks(path, arrays)


def _blocks(labels: GraspLabels, collides: Mask) -> Iterator[Mask]:
    """Yield a dense array (B, 300, 12, 4) for every few points."""
    count = len(labels.points)
    for first in range(0, count, BLOCK):
        block = np.ones((min(BLOCK, count - first), *GRID), dtype=np.bool_)
        low, high = np.searchsorted(labels.index[:, 0], [first, first + BLOCK])
        index = labels.index[low:high].T
        block[index[0] - first, index[1], index[2], index[3]] = collides[low:high]
        yield block
