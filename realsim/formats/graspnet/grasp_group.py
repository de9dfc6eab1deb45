"""Grasps of one view as a GraspGroup npy file: what graspnetAPI, its baseline and AnyGrasp write.

    (N, 17) float32: score, width, height, depth, rotation (9, by rows), translation (3), object id

Metres, in the frame of the view's camera. The rotation's columns and the translation are
GraspNet's gripper frame (see `gripper_frame`), width is the opening of the gripper before it
closes. The score is higher for better grasps: a network's confidence of any range, or
1.1 - friction where the grasps come from labels (loadGrasp). Objects count from 0, realsim's ids
are one more; -1, which networks write, is an object that is not known: id 0 here.

What the format has no place for: which of several instances of an object, contact widths, stages.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.graspnet.gripper_frame import HEIGHT_M, grasp_poses, graspnet_poses
from realsim.formats.grasps.scene_grasps import untried_set
from realsim.geometry import se3
from realsim.records import GraspSet
from realsim.records.checked_arrays import Array, frozen
from realsim.store import atomic
from realsim.untrusted.arrays import read_npy

COLUMNS = 17
MOST_BYTES = 300e6
"""Largest file that is read [bytes]: 4 million grasps."""
DEPTH_M = 0.02
"""Depth of grasps that bring none [m]; graspnetAPI's own for rectangles."""
MOST_FRICTION = 1.1
"""Score and friction of a label add up to this."""
LONGEST_M = 0.5
"""Wider, higher or deeper grippers are in millimetres."""
FARTHEST_M = 20.0
"""Likewise grasps that are farther from the camera."""
ROTATION_TOLERANCE = 1e-3
"""How far R^T R may be from the identity: single precision, of networks' own products."""
Scores = Literal["school", "friction"]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspGroup:
    """Grasps in one frame, usually a camera's."""

    Ts_a_grasp: Array
    """(N, 4, 4) [m], frame `grasp`."""
    scores: Array
    """(N,) higher is better; of any range."""
    openings_m: Array
    """(N,) distance of the fingers before closing [m]."""
    heights_m: Array
    """(N,) extent of the gripper across the closing axis [m]."""
    depths_m: Array
    """(N,) how far the fingertips are beyond GraspNet's translation [m]."""
    obj_ids: NDArray[np.int64]
    """(N,) realsim's ids: GraspNet's number + 1; 0 = not known."""

    def __post_init__(self) -> None:
        """Check that all arrays speak of the same grasps and freeze them."""
        n = len(self.scores)
        Ts = np.asarray(self.Ts_a_grasp, dtype=np.float64).reshape(-1, 4, 4)
        Ts = se3.check_rigid(Ts, "grasps") if len(Ts) else Ts
        object.__setattr__(self, "Ts_a_grasp", frozen(Ts, np.float64, (n, 4, 4), "Ts_a_grasp"))
        for name in ("scores", "openings_m", "heights_m", "depths_m"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, (n,), name))
        object.__setattr__(self, "obj_ids", frozen(self.obj_ids, np.int64, (n,), "obj_ids"))

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.scores)

    def moved(self, T_b_a: Array) -> "GraspGroup":
        """Return the grasps in another frame."""
        return replace(self, Ts_a_grasp=se3.check_rigid(T_b_a, "T_b_a") @ self.Ts_a_grasp)

    def of_object(
        self, obj_id: int, T_a_obj: Array, instance: int = 0, *, from_labels: bool = False
    ) -> GraspSet:
        """Return the grasps of one object as a set that our physics has not tried.

        Args:
            obj_id: realsim's id.
            T_a_obj: (4, 4) where the object is in the group's frame [m].
            instance: of the object.
            from_labels: whether the scores are 1.1 - friction; else they are a network's.
        """
        rows = np.flatnonzero(self.obj_ids == obj_id)
        T_obj_a = se3.invert(se3.check_rigid(T_a_obj, "the object's pose"))
        grasps = untried_set(
            T_obj_a @ self.Ts_a_grasp[rows],
            obj_id=obj_id,
            instance=instance,
            parameters={
                "source": {"from": "GraspGroup", "scores": self.scores[rows].tolist()},
                "openings_m": self.openings_m[rows].tolist(),
                "depths_m": self.depths_m[rows].tolist(),
            },
        )
        if not from_labels:
            return grasps
        friction = MOST_FRICTION - self.scores[rows]
        return replace(grasps, measures={"closure_friction": friction})


def grasp_group(
    sets: Sequence[GraspSet],
    Ts_a_obj: Mapping[int, Array],
    *,
    scores: Scores = "school",
    depth_m: float = DEPTH_M,
) -> GraspGroup:
    """Return the grasps of a scene in one frame; those without a score are left out.

    Args:
        sets: grasps of the objects.
        Ts_a_obj: (4, 4) of each object by instance [m]: in the view's camera, as a rule.
        scores: "school": the score of physics, 0 to 1; "friction": 1.1 - closure_friction, as
            graspnetAPI makes it of labels, of grasps that close below 1.1.
        depth_m: of all grasps whose set's parameters have no depths_m.

    Raises:
        InputError: a set's object has no pose, or its grasps have no width.
    """
    groups = [_group_of(s, Ts_a_obj, scores, depth_m) for s in sets]

    def column(name: str) -> NDArray[np.float64]:
        return np.concatenate([np.zeros(0), *(getattr(g, name) for g in groups)])

    return GraspGroup(
        Ts_a_grasp=np.concatenate([np.zeros((0, 4, 4)), *(g.Ts_a_grasp for g in groups)]),
        scores=column("scores"),
        openings_m=column("openings_m"),
        heights_m=column("heights_m"),
        depths_m=column("depths_m"),
        obj_ids=column("obj_ids").astype(np.int64),
    )


def _group_of(
    grasps: GraspSet, Ts_a_obj: Mapping[int, Array], scores: Scores, depth_m: float
) -> GraspGroup:
    if grasps.instance not in Ts_a_obj:
        raise InputError(
            f"the object of instance {grasps.instance} has no pose; there are poses of: "
            f"{', '.join(map(str, sorted(Ts_a_obj))) or 'none'}."
        )
    nothing = np.full(len(grasps), np.nan)
    if scores == "school":
        value = grasps.scores
    else:
        friction = grasps.measures.get("closure_friction", nothing)
        value = np.where(friction < MOST_FRICTION, MOST_FRICTION - friction, np.nan)
    rows = np.flatnonzero(~np.isnan(value))
    openings = _stored(grasps, "openings_m", grasps.widths_m)[rows]
    if np.any(np.isnan(openings)):
        raise InputError(
            f"grasps of instance {grasps.instance} have neither a width nor an opening; a "
            "GraspGroup says how far the gripper is open."
        )
    return GraspGroup(
        Ts_a_grasp=Ts_a_obj[grasps.instance] @ grasps.Ts_obj_pads[rows],
        scores=value[rows],
        openings_m=openings,
        heights_m=np.full(len(rows), HEIGHT_M),
        depths_m=_stored(grasps, "depths_m", nothing + depth_m, depth_m)[rows],
        obj_ids=np.full(len(rows), grasps.obj_id, dtype=np.int64),
    )


def _stored(grasps: GraspSet, name: str, other: Array, fill: float = np.nan) -> Array:
    """Return a number a grasp out of a set's parameters, else the other (N,)."""
    stored = grasps.parameters.get(name)
    if isinstance(stored, list) and np.shape(stored) == (len(grasps),):  # pyright: ignore[reportUnknownArgumentType]
        return np.array(stored, dtype=np.float64)
    return np.where(np.isnan(other), fill, other)


# --- files ------------------------------------------------------------------------------------


def grasp_group_bytes(group: GraspGroup) -> bytes:
    """Return grasps as graspnetAPI's save_npy writes them, in single precision."""
    rows = np.empty((len(group), COLUMNS), dtype=np.float32)
    Ts = graspnet_poses(group.Ts_a_grasp, group.depths_m)
    rows[:, 0], rows[:, 1] = group.scores, group.openings_m
    rows[:, 2], rows[:, 3] = group.heights_m, group.depths_m
    rows[:, 4:13] = Ts[:, :3, :3].reshape(-1, 9)
    rows[:, 13:16] = Ts[:, :3, 3]
    rows[:, 16] = group.obj_ids - 1
    buffer = io.BytesIO()
    np.save(buffer, rows, allow_pickle=False)
    return buffer.getvalue()


def write_grasp_group(path: Path | str, group: GraspGroup) -> Path:
    """Write grasps as graspnetAPI's save_npy does, in single precision, whole or not at all."""
    path = Path(path)
    atomic.write_bytes(path, grasp_group_bytes(group))
    return path


def read_grasp_group(path: Path | str) -> GraspGroup:
    """Return the grasps of a GraspGroup npy file, in its order.

    Raises:
        InputError: it is none, a number is not finite, a rotation is none, or it is not in metres.
    """
    path = Path(path)
    rows = read_npy(path, most_bytes=MOST_BYTES)
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind != "f":
        raise InputError(
            f"{path} has the shape {rows.shape} of {rows.dtype}; a GraspGroup is (N, {COLUMNS}) "
            "numbers: score, width, height, depth, rotation (9), translation (3), object id."
        )
    rows = rows.astype(np.float64)
    if not np.all(np.isfinite(rows)):
        at = np.argwhere(~np.isfinite(rows))[0]
        raise InputError(f"{path}: grasp {at[0]} has {rows[tuple(at)]} in column {at[1]}.")
    _require_metres(rows, path)
    ids = rows[:, 16]
    if np.any((ids != np.round(ids)) | (ids < -1) | (ids > 1e6)):
        wrong = ids[(ids != np.round(ids)) | (ids < -1) | (ids > 1e6)][0]
        raise InputError(
            f"{path}: {wrong:g} is no object id; whole numbers from 0, or -1 for not known, are "
            "expected in the last column."
        )
    Ts = se3.from_rt(_rotations(rows[:, 4:13].reshape(-1, 3, 3), path), rows[:, 13:16])
    return GraspGroup(
        Ts_a_grasp=grasp_poses(Ts, rows[:, 3]),
        scores=rows[:, 0],
        openings_m=rows[:, 1],
        heights_m=rows[:, 2],
        depths_m=rows[:, 3],
        obj_ids=ids.astype(np.int64) + 1,
    )


def _rotations(R: Array, path: Path) -> Array:
    """Return the rotations (N, 3, 3) nearest to matrices of single precision."""
    if len(R) == 0:
        return R
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    wrong = (off > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)
    if np.any(wrong):
        at = int(np.flatnonzero(wrong)[0])
        raise InputError(
            f"{path}: columns 4 to 12 of grasp {at} are no rotation: R^T R is off the identity by "
            f"{off[at]:.2g}, the determinant is {np.linalg.det(R[at]):.3f}."
        )
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt


def _require_metres(rows: Array, path: Path) -> None:
    """Check width, height, depth and translation."""
    sizes, places = np.abs(rows[:, 1:4]), np.abs(rows[:, 13:16])
    if len(rows) and (sizes.max() > LONGEST_M or places.max() > FARTHEST_M):
        raise InputError(
            f"{path}: widths, heights and depths reach {sizes.max():g}, translations "
            f"{places.max():g}; metres, at most {LONGEST_M:g} and {FARTHEST_M:g}, are expected."
        )
    if np.any(rows[:, 1:3] < 0):
        raise InputError(f"{path}: a width or a height is negative.")
