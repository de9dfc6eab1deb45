"""Grasps of one view as a GraspGroup npy file: what graspnetAPI, its baseline and AnyGrasp write.

    (N, 17) float32: score, width, height, depth, rotation (9, by rows), translation (3), object id

Metres, in the frame of the view's camera. The rotation's columns and the translation are
GraspNet's gripper frame (see `gripper_frame`), width is the opening of the gripper before it
closes. The score is higher for better grasps: a network's confidence of any range, or
1.1 - friction where the grasps come from labels (loadGrasp). Objects count from 0, realsim's ids
are one more; -1, which networks write, is an object that is not known: id 0 here.

What the format has no place for: which of several instances of an object, contact widths, stages,
how sure a score is. `write_grasp_group` puts what is known of that beside it, 000000.labels.npz:
instance, row of its set, score, base_score, width_m and all measures (p_hold, its error, safety by
stage), one entry a grasp in the same order.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.formats.graspnet.cameras import npy_bytes
from realsim.formats.graspnet.gripper_frame import HEIGHT_M, grasp_poses, graspnet_poses
from realsim.formats.grasps.scene_grasps import (
    executed,
    measures_of_json,
    stored_values,
    untried_set,
)
from realsim.geometry import se3
from realsim.records import GraspSet
from realsim.records.checked_arrays import freeze, frozen
from realsim.records.grasps import MEASURES, joined_measure
from realsim.store import atomic
from realsim.untrusted.arrays import read_npy, read_npz

COLUMNS = 17
MOST_BYTES = 300e6
"""Largest file that is read [bytes]: 4 million grasps."""
DEPTH_M = 0.02
"""Depth of grasps that bring none [m]; graspnetAPI's own for rectangles."""
MOST_FRICTION = 1.1
"""Score and friction of a label add up to this."""
GREATEST_LEVEL = 1.0
"""Greatest friction of GraspNet's labels."""
LONGEST_M = 0.5
"""Wider, higher or deeper grippers are in millimetres."""
FARTHEST_M = 20.0
"""Grasps farther from the camera are in millimetres."""
ROTATION_TOLERANCE = 1e-3
"""How far R^T R may be from the identity: single precision, of networks' own products."""
Scores = Literal["school", "friction", "tried"]
OWN = ("instance", "row", "score", "base_score", "width_m")
"""Columns of the file beside a group, besides those of MEASURES."""


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
    obj_ids: Int64
    """(N,) realsim's ids: GraspNet's number + 1; 0 = not known."""
    known: dict[str, Array] = field(default_factory=dict[str, Array])
    """(N,) or (N, 4) what else is known, by the names of OWN and MEASURES; empty of others'."""

    def __post_init__(self) -> None:
        """Check that all arrays speak of the same grasps and freeze them."""
        n = len(self.scores)
        Ts = np.asarray(self.Ts_a_grasp, dtype=np.float64).reshape(-1, 4, 4)
        Ts = se3.check_rigid(Ts, "grasps") if len(Ts) else Ts
        object.__setattr__(self, "Ts_a_grasp", frozen(Ts, np.float64, (n, 4, 4), "Ts_a_grasp"))
        freeze(self, scores=(n,), openings_m=(n,), heights_m=(n,), depths_m=(n,))
        freeze(self, np.int64, obj_ids=(n,))
        known = {k: np.asarray(v, dtype=np.float64) for k, v in self.known.items()}
        measures = {k: v.tolist() for k, v in known.items() if k not in OWN}
        own = {k: frozen(known[k], np.float64, (n,), k) for k in OWN if k in known}
        checked = own | measures_of_json(measures, n, "a group of grasps")
        object.__setattr__(self, "known", checked)

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.scores)

    def of_object(self, obj_id: int, T_a_obj: Array, instance: int = 0) -> GraspSet:
        """Return the grasps of one object as a set that our physics has not tried.

        Args:
            obj_id: realsim's id.
            T_a_obj: (4, 4) where the object is in the group's frame [m].
            instance: of the object.
        """
        of = self.obj_ids == obj_id
        if "instance" in self.known:
            of &= self.known["instance"] == instance
        rows = np.flatnonzero(of)
        T_obj_a = se3.invert(se3.check_rigid(T_a_obj, "the object's pose"))
        return untried_set(
            T_obj_a @ self.Ts_a_grasp[rows],
            obj_id=obj_id,
            instance=instance,
            parameters={
                "source": {"from": "GraspGroup", "scores": self.scores[rows].tolist()},
                "openings_m": self.openings_m[rows].tolist(),
                "depths_m": self.depths_m[rows].tolist(),
            },
            measures={name: self.known[name][rows] for name in MEASURES if name in self.known},
            widths_m=self.known["width_m"][rows] if "width_m" in self.known else None,
        )


def grasp_group(
    sets: Sequence[GraspSet], Ts_a_obj: Mapping[int, Array], *, scores: Scores = "school"
) -> GraspGroup:
    """Return the grasps of a scene in one frame; those without a label are left out.

    Args:
        sets: grasps of the objects.
        Ts_a_obj: (4, 4) of each object by instance [m]: in the view's camera, as a rule.
        scores: "school": p_hold, of sets without it the score, 0 to 1; "friction": 1.1 -
            closure_friction, as graspnetAPI makes it of labels, of grasps that close below 1.1;
            "tried": 1.1 - `held_friction`, of grasps that held.

    Raises:
        InputError: a set's object has no pose, or its grasps have no width.
    """
    groups = [_group_of(s, Ts_a_obj, scores) for s in sets]
    kept = np.concatenate([np.zeros(0, np.bool_), *(~np.isnan(_value(s, scores)) for s in sets)])
    known = {k: np.concatenate([np.zeros(0), *(g.known[k] for g in groups)]) for k in OWN}
    measured = [k for k in MEASURES if any(k in s.measures for s in sets)]

    def column(name: str) -> Array:
        return np.concatenate([np.zeros(0), *(getattr(g, name) for g in groups)])

    return GraspGroup(
        Ts_a_grasp=np.concatenate([np.zeros((0, 4, 4)), *(g.Ts_a_grasp for g in groups)]),
        scores=column("scores"),
        openings_m=column("openings_m"),
        heights_m=column("heights_m"),
        depths_m=column("depths_m"),
        obj_ids=column("obj_ids").astype(np.int64),
        known=known | {k: joined_measure(sets, k)[kept] for k in measured},
    )


def held_friction(grasps: GraspSet) -> Array:
    """Return the friction (N,) of the grasps that held, as GraspNet's labels have one; NaN = none.

    The least at which a sweep held, where there was one; else the least at which the contacts
    close; else GraspNet's greatest level, for physics held what no pair of points closes.
    """
    friction = np.full(len(grasps), GREATEST_LEVEL)
    for name in ("closure_friction", "least_friction"):
        known = grasps.measures.get(name, np.full(len(grasps), np.nan))
        friction = np.where((known > 0) & (known <= GREATEST_LEVEL), known, friction)
    return np.where(grasps.good & executed(grasps), friction, np.nan)


def _value(grasps: GraspSet, scores: Scores) -> Array:
    """Return what a group's score is made of (N,); NaN = left out."""
    if scores == "school":
        return grasps.labels
    if scores == "tried":
        return MOST_FRICTION - held_friction(grasps)
    friction = grasps.measures.get("closure_friction", np.full(len(grasps), np.nan))
    return np.where(friction < MOST_FRICTION, MOST_FRICTION - friction, np.nan)


def _group_of(grasps: GraspSet, Ts_a_obj: Mapping[int, Array], scores: Scores) -> GraspGroup:
    if grasps.instance not in Ts_a_obj:
        raise InputError(
            f"the object of instance {grasps.instance} has no pose; there are poses of: "
            f"{', '.join(map(str, sorted(Ts_a_obj))) or 'none'}."
        )
    value = _value(grasps, scores)
    rows = np.flatnonzero(~np.isnan(value))
    openings = stored_values(grasps, "openings_m", grasps.widths_m)[rows]
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
        depths_m=stored_values(grasps, "depths_m", np.full(len(grasps), DEPTH_M))[rows],
        obj_ids=np.full(len(rows), grasps.obj_id, dtype=np.int64),
        known={
            "instance": np.full(len(rows), float(grasps.instance)), "row": rows.astype(np.float64),
            "score": grasps.scores[rows], "base_score": grasps.base_scores[rows],
            "width_m": grasps.widths_m[rows],
        },
    )  # fmt: skip


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
    return npy_bytes(rows)


def grasp_group_files(name: str, group: GraspGroup) -> dict[str, bytes]:
    """Return file names and contents of a group: the npy and, where more is known, the npz."""
    files = {name: grasp_group_bytes(group)}
    if group.known:
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **group.known)
        files = {str(_beside(Path(name))): buffer.getvalue()} | files
    return files


def _beside(path: Path) -> Path:
    """Return the file beside a group of what its columns do not say."""
    return path.with_suffix(".labels.npz")


def write_grasp_group(path: Path | str, group: GraspGroup) -> Path:
    """Write grasps as graspnetAPI's save_npy does, in single precision, and what else is known.

    Each file is whole or not there.
    """
    path = Path(path)
    _beside(path).unlink(missing_ok=True)  # of other grasps
    for name, data in grasp_group_files(path.name, group).items():
        atomic.write_bytes(path.with_name(name), data)
    return path


def read_grasp_group(path: Path | str) -> GraspGroup:
    """Return the grasps of a GraspGroup npy file, in its order, and what stands beside it.

    Raises:
        InputError: it is none, a number is not finite, a rotation is none, it is not in metres, or
            the file beside it is of other grasps.
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
        known=read_npz(_beside(path)) if _beside(path).is_file() else {},
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
