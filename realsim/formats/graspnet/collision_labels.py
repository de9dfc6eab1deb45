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
from realsim.formats.graspnet.grasp_labels import BLOCK, GRID, MOST_POINTS, GraspLabels
from realsim.formats.graspnet.npz_blocks import NpzArray, opened, write_blocks


def collision_points(path: Path | str) -> tuple[int, ...]:
    """Return the number of points of every object, in the order of object_id_list.txt.

    Raises:
        InputError: it is no file of collision labels.
    """
    path = Path(path)
    with opened(path) as archive:
        count = sum(name.startswith("arr_") for name in archive.namelist())
        if count == 0:
            raise InputError(f"{path} has no array arr_0; it is no file of collision labels.")
        return tuple(_array(path, archive, k).shape[0] for k in range(count))


def read_collision_labels(path: Path | str, number: int, labels: GraspLabels) -> Mask:
    """Return whether the candidates (N,) of an object collide in a scene.

    Args:
        path: the npz file.
        number: place of the object in object_id_list.txt, from 0.
        labels: of that object.

    Raises:
        InputError: it is none, damaged, or of another number of points than the labels.
    """
    path = Path(path)
    found: list[Mask] = [np.zeros(0, dtype=np.bool_)]
    with opened(path) as archive:
        array = _array(path, archive, number)
        count = array.shape[0]
        if count != len(labels.points):
            raise InputError(
                f"{path}: arr_{number} is of {count} points, the object's labels have "
                f"{len(labels.points)}; it belongs to another object, or to other labels."
            )
        for first in range(0, count, BLOCK):
            block = array.rows(min(BLOCK, count - first))
            low, high = np.searchsorted(labels.index[:, 0], [first, first + BLOCK])
            index = labels.index[low:high].T
            found.append(block[index[0] - first, index[1], index[2], index[3]] != 0)
        array.finish()
    return np.concatenate(found)


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


def _array(path: Path, archive: Any, number: int) -> NpzArray:
    array = NpzArray(path, archive, f"arr_{number}", "bu")
    array.require((None, *GRID))
    if array.shape[0] > MOST_POINTS:
        raise InputError(f"{path} has {array.shape[0]} points; at most {MOST_POINTS} are read.")
    return array


def _blocks(labels: GraspLabels, collides: Mask) -> Iterator[Mask]:
    """Yield a dense array (B, 300, 12, 4) for every few points."""
    count = len(labels.points)
    for first in range(0, count, BLOCK):
        block = np.ones((min(BLOCK, count - first), *GRID), dtype=np.bool_)
        low, high = np.searchsorted(labels.index[:, 0], [first, first + BLOCK])
        index = labels.index[low:high].T
        block[index[0] - first, index[1], index[2], index[3]] = collides[low:high]
        yield block
