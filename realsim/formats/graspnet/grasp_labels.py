"""GraspNet's analytic labels of one object: grasp_label/NNN_labels.npz.

    points    (P, 3)               on the object's surface [m], object frame
    offsets   (P, 300, 12, 4, 3)   angle [rad], depth [m], width = opening of the gripper [m]
    scores    (P, 300, 12, 4)      smallest friction that closes; LOWER is better, -1 = none does
    collision (P, 300, 12, 4)      whether the gripper is in the object itself

Unpacked, one object has hundreds of MB, of which few candidates close. So files are read and
written a few points at a time, and only the candidates that close are kept. `view_tried` (300,), an
array of realsim's own, says which views were computed, if not all were; graspnetAPI ignores it.

Collision labels of a scene, collision_label/scene_NNNN/collision_labels.npz, are arr_0, arr_1, ...
of (P, 300, 12, 4) booleans, one array an object, in the order of the scene's object_id_list.txt:
whether the gripper of that label is in another object or the table. The arrays have no names, so
that the order is all that says whose they are; the number of points P is the one thing that can be
compared with the object's label file.

Poses: see `gripper_frame`. Source: graspnetAPI's loadGrasp; its documentation, "Grasp Format".
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.errors import InputError
from realsim.formats.graspnet.gripper_frame import (
    ANGLES,
    DEPTHS,
    DEPTHS_M,
    VIEWS,
    angles_rad,
    label_poses,
)
from realsim.formats.graspnet.npz_blocks import NpzArray, opened, write_blocks
from realsim.records.checked_arrays import freeze

GRID = (VIEWS, ANGLES, DEPTHS)
BLOCK = 16
"""Points read or written at a time: 4 MB."""
MOST_POINTS = 5_000
"""Most points of one object: 1.2 GB unpacked, 4 s; GraspNet has some hundred to a thousand."""
MOST_GRASPS = 5_000_000
"""Kept of one file: 170 MB."""
LARGEST_M = 2.0
"""Farther points are in millimetres: no object of a hand is so large."""
WIDEST_M, DEEPEST_M = 0.25, 0.15
"""Wider openings (GraspNet's gripper: 0.1 m) and greater depths (0.04 m) are in millimetres."""
MOST_FRICTION = 2.0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspLabels:
    """The candidates of one object that close."""

    points: Array
    """(P, 3) all points that grasps were looked for at [m]."""
    index: Int32
    """(N, 4) number of point, view, angle and depth of each candidate; increasing."""
    angles_rad: Array32
    """(N,) turn about the approach axis."""
    depths_m: Array32
    """(N,) how far the fingertips are beyond the point."""
    openings_m: Array32
    """(N,) distance of the fingers before closing."""
    friction: Array32
    """(N,) smallest friction that closes; lower is better."""
    collision: Mask
    """(N,) whether the gripper is in the object."""
    view_tried: Mask = field(default_factory=lambda: np.ones(VIEWS, dtype=np.bool_))
    """(300,) which views were looked at; nothing is known of the others."""

    def __post_init__(self) -> None:
        """Check that all arrays speak of the same candidates and freeze them.

        Raises:
            InputError: they do not, or an index is out of range or there twice.
        """
        n = len(self.friction)
        freeze(self, points=(None, 3))
        freeze(self, np.int32, index=(n, 4))
        freeze(self, np.float32, angles_rad=(n,), depths_m=(n,), openings_m=(n,), friction=(n,))
        freeze(self, np.bool_, collision=(n,), view_tried=(VIEWS,))
        most = np.array([len(self.points), *GRID])
        if n and (self.index.min() < 0 or np.any(self.index.max(axis=0) >= most)):
            raise InputError(f"labels: an index is outside {tuple(most.tolist())}.")
        if np.any(np.diff(self.numbers) <= 0):
            raise InputError("labels: the candidates must be sorted by index, each there once.")

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.friction)

    @property
    def numbers(self) -> Int64:
        """(N,) one number for point, view, angle and depth of each candidate; increasing."""
        return self.index.astype(np.int64) @ np.array(
            [VIEWS * ANGLES * DEPTHS, ANGLES * DEPTHS, DEPTHS, 1], dtype=np.int64
        )

    def rows(self, rows: NDArray[Any]) -> "GraspLabels":
        """Return some of the candidates, by increasing numbers or a mask (N,)."""
        names = ("index", "angles_rad", "depths_m", "openings_m", "friction", "collision")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def Ts_obj_grasp(self) -> Array:
        """Return the grasps (N, 4, 4) [m], frame `grasp`."""
        point, view = self.index[:, 0], self.index[:, 1]
        return label_poses(self.points[point], view, self.angles_rad, self.depths_m)


# --- reading ----------------------------------------------------------------------------------


def read_grasp_labels(
    path: Path | str, *, friction_at_most: float = 1.0, with_collision: bool = False
) -> GraspLabels:
    """Return the candidates of a label file that close.

    Args:
        path: the npz file.
        friction_at_most: candidates that need more are left out.
        with_collision: keep the candidates whose gripper is in the object, too.

    Raises:
        InputError: it is none, damaged, of another layout or unit, or has more candidates than
            memory should hold.
    """
    path, kept = Path(path), _Kept()
    points: list[Array] = []
    with opened(path) as archive:
        arrays = {name: NpzArray(path, archive, name, kinds) for name, kinds in _ARRAYS.items()}
        arrays["points"].require((None, 3))
        count = arrays["points"].shape[0]
        if count > MOST_POINTS:
            raise InputError(f"{path} has {count} points; at most {MOST_POINTS} are read.")
        arrays["offsets"].require((count, *GRID, 3))
        for name in ("scores", "collision"):
            arrays[name].require((count, *GRID))
        for first in range(0, count, BLOCK):
            block = {name: a.rows(min(BLOCK, count - first)) for name, a in arrays.items()}
            points.append(_checked_points(block["points"], path))
            kept.add(first, block, friction_at_most, with_collision, path)
        for array in arrays.values():
            array.finish()
        tried = np.ones(VIEWS, dtype=np.bool_)
        if "view_tried.npy" in archive.namelist():
            array = NpzArray(path, archive, "view_tried", "b")
            array.require((VIEWS,))
            tried = array.rows(VIEWS)
    return kept.labels(np.concatenate([np.zeros((0, 3)), *points]), tried)


_ARRAYS = {"points": "f", "offsets": "f", "scores": "f", "collision": "bu"}
"""Name -> kinds of numbers."""


class _Kept:
    """The candidates of a file that were worth keeping."""

    def __init__(self) -> None:
        self._index: list[Int32] = [np.zeros((0, 4), dtype=np.int32)]
        self._offsets: list[Array32] = [np.zeros((0, 3), dtype=np.float32)]
        self._friction: list[Array32] = [np.zeros(0, dtype=np.float32)]
        self._collision: list[Mask] = [np.zeros(0, dtype=np.bool_)]
        self._count = 0

    def add(
        self,
        first: int,
        block: dict[str, NDArray[Any]],
        friction_at_most: float,
        with_collision: bool,
        path: Path,
    ) -> None:
        friction, collision = block["scores"], block["collision"] != 0
        if np.any(friction > MOST_FRICTION):
            raise InputError(
                f"{path}: scores reach {np.max(friction):g}; frictions of 0 to {MOST_FRICTION:g}, "
                "or -1, are expected."
            )
        # In single precision 0.1f > 0.1: a level that was asked for belongs to it.
        keep = (friction > 0) & (friction <= friction_at_most + 1e-6)
        if not with_collision:
            keep &= ~collision
        rows = np.nonzero(keep)
        self._count += len(rows[0])
        if self._count > MOST_GRASPS:
            raise InputError(
                f"{path} has more than {MOST_GRASPS} candidates of a friction of at most "
                f"{friction_at_most:g}; ask for a lower one."
            )
        with np.errstate(over="ignore"):
            offsets = block["offsets"][rows].astype(np.float32)
        _require_metres(offsets, path)
        index = np.stack(rows, axis=1).astype(np.int32)
        index[:, 0] += first
        self._index.append(index)
        self._offsets.append(offsets)
        self._friction.append(friction[rows].astype(np.float32))
        self._collision.append(collision[rows])

    def labels(self, points: Array, view_tried: Mask) -> GraspLabels:
        offsets = np.concatenate(self._offsets)
        return GraspLabels(
            points=points,
            index=np.concatenate(self._index),
            angles_rad=offsets[:, 0],
            depths_m=offsets[:, 1],
            openings_m=offsets[:, 2],
            friction=np.concatenate(self._friction),
            collision=np.concatenate(self._collision),
            view_tried=view_tried,
        )


def _checked_points(points: NDArray[Any], path: Path) -> Array:
    points = points.astype(np.float64)
    if not np.all(np.abs(points) <= LARGEST_M):  # NaN is not
        raise InputError(
            f"{path}: points reach {np.max(np.abs(points)):g}; metres, at most {LARGEST_M:g} from "
            "the object's origin, are expected. Are they in millimetres?"
        )
    return points


def _require_metres(offsets: Array32, path: Path) -> None:
    """Check angle, depth and width (N, 3) of candidates that close."""
    limits = (
        ("angles", -2 * np.pi, 2 * np.pi, "rad"),
        ("depths", -DEEPEST_M, DEEPEST_M, "m"),
        ("widths", 0.0, WIDEST_M, "m"),
    )
    for k, (what, low, high, unit) in enumerate(limits):
        values = offsets[:, k]
        wrong = ~((values >= low) & (values <= high))
        if np.any(wrong):
            raise InputError(
                f"{path}: {what} of grasps that close have the value {values[wrong][0]:g}; "
                f"{low:g} to {high:g} {unit} is expected, in the order angle, depth, width."
            )


# --- writing ----------------------------------------------------------------------------------


def write_grasp_labels(path: Path | str, labels: GraspLabels) -> Path:
    """Write a label file, whole or not at all; all other candidates get -1 and the width 0.

    Raises:
        InputError: a candidate has no friction that GraspNet's readers would take for one.
    """
    if len(labels) and not np.all((labels.friction > 0) & (labels.friction <= MOST_FRICTION)):
        raise InputError(
            f"labels: frictions of {labels.friction.min():g} to {labels.friction.max():g}; above 0 "
            f"and at most {MOST_FRICTION:g} is what a label file can hold."
        )
    count = len(labels.points)
    arrays: dict[str, tuple[tuple[int, ...], Any, Iterator[NDArray[Any]]]] = {
        "points": ((count, 3), np.float32, iter([labels.points])),
        "offsets": ((count, *GRID, 3), np.float32, _offset_blocks(labels)),
        "scores": ((count, *GRID), np.float32, _blocks(labels, labels.friction, -1.0)),
        "collision": ((count, *GRID), np.bool_, _blocks(labels, labels.collision, False)),
    }
    if not labels.view_tried.all():
        arrays["view_tried"] = ((VIEWS,), np.bool_, iter([labels.view_tried]))
    return write_blocks(path, arrays)


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
        arrays[f"arr_{k}"] = (shape, np.bool_, _blocks(labels, np.asarray(collides), True))
    return write_blocks(path, arrays)


def _blocks(labels: GraspLabels, values: NDArray[Any], other: float) -> Iterator[NDArray[Any]]:
    """Yield a dense array (B, 300, 12, 4) for every few points."""
    for first, rows in _block_rows(labels):
        block = np.full((min(BLOCK, len(labels.points) - first), *GRID), other, dtype=values.dtype)
        index = labels.index[rows].T
        block[index[0] - first, index[1], index[2], index[3]] = values[rows]
        yield block


def _offset_blocks(labels: GraspLabels) -> Iterator[NDArray[Any]]:
    """Yield angle, depth and width (B, 300, 12, 4, 3) for every few points."""
    for first, rows in _block_rows(labels):
        block = np.zeros((min(BLOCK, len(labels.points) - first), *GRID, 3), dtype=np.float32)
        block[..., 0] = angles_rad()[:, None]
        block[..., 1] = DEPTHS_M
        index = labels.index[rows].T
        columns = (labels.angles_rad[rows], labels.depths_m[rows], labels.openings_m[rows])
        block[index[0] - first, index[1], index[2], index[3]] = np.stack(columns, axis=1)
        yield block


def _block_rows(labels: GraspLabels) -> Iterator[tuple[int, slice]]:
    """Yield the first point of every few, and their candidates."""
    for first in range(0, len(labels.points), BLOCK):
        low, high = np.searchsorted(labels.index[:, 0], [first, first + BLOCK])
        yield first, slice(int(low), int(high))
