"""Grasps of one object as a GraspGen JSON file, and such files as grasps.

    {"object": {"file", "scale"}, "grasps": {"transforms": [4x4, ...], "object_in_gripper": [...]}}

GraspGen's convention is approach = +z and closing = x, which is the frame `acronym`. Its loader
multiplies every transform by the gripper's `transform_offset_from_asset_to_graspgen_convention`:
for a gripper whose offset is the identity write the default; for one that is described in the axes
of franka_description's hand (closing = y) write frame="panda_hand".

The label is true where the fingers still held the object after all four stages. Grasps that physics
has not tried have none and are left out. What has no counterpart (frame, rows, widths, scores,
base scores and all measures: p_hold, its error, safety by stage) is under the key `realsim`, which
GraspGen does not read. The hand's frame has its origin at the
mounting face that the hand's description says.

Source: NVlabs/GraspGen, docs/GRASP_DATASET_FORMAT.md and docs/GRIPPER_DESCRIPTION.md.
"""

from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.formats.grasps.hand_frames import (
    HandFrame,
    grasp_poses,
    hand_of_set,
    hand_poses,
    known_frame,
)
from realsim.formats.grasps.scene_grasps import (
    check_values,
    executed,
    held,
    measures_json,
    measures_of_json,
    untried_set,
)
from realsim.geometry import se3
from realsim.records import GraspSet
from realsim.robots.hand import find_hand
from realsim.store import atomic
from realsim.untrusted.own_json import array_from_json, read_object, to_json

MOST_BYTES = 1 << 30
"""Largest file that is read [bytes]: 3 million grasps."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspGenGrasps:
    """What a GraspGen file says."""

    file: str
    """File of the mesh."""
    scale: float
    """What the mesh is multiplied by to be in metres."""
    Ts_obj_grasp: Array
    """(N, 4, 4) [m], frame `grasp`."""
    object_in_gripper: Mask
    """(N,) whether the simulator of the file found the object held."""
    scores: Array | None = None
    """(N,) our score, where realsim wrote the file."""
    base_scores: Array | None = None
    """(N,) likewise."""
    widths_m: Array | None = None
    """(N,) [m], likewise."""
    measures: dict[str, Array] = field(default_factory=dict[str, Array])
    """(N,) or (N, 4) by the names of MEASURES, likewise."""

    def as_set(self, obj_id: int, instance: int = 0) -> GraspSet:
        """Return the grasps as a set that our physics has not tried; the label is not a score."""
        return untried_set(
            self.Ts_obj_grasp, obj_id=obj_id, instance=instance, widths_m=self.widths_m,
            parameters={"source": {"from": "GraspGen", "file": self.file}}, measures=self.measures,
        )  # fmt: skip


def write_graspgen(
    path: Path | str,
    grasps: GraspSet,
    *,
    file: str,
    scale: float = 1.0,
    frame: HandFrame = "acronym",
) -> Path:
    """Write the tried grasps of one object, whole or not at all.

    Args:
        path: the JSON file.
        grasps: the set.
        file: of the object's mesh, relative to the object data set.
        scale: what that mesh is multiplied by to be in metres.
        frame: of the hand.

    Raises:
        InputError: the set holds what no grasp has.
    """
    check_values(grasps)
    hand = hand_of_set(grasps)
    rows = np.flatnonzero(executed(grasps))
    value = {
        "object": {"file": file, "scale": float(scale)},
        "grasps": {
            "transforms": hand_poses(grasps.Ts_obj_grasp[rows], frame, hand).tolist(),
            "object_in_gripper": held(grasps)[rows].tolist(),
        },
        "realsim": {
            "version": version("realsim"),
            "frame": known_frame(frame),
            "hand": {"name": hand.name, "digest": hand.digest, "mount_z_m": hand.mount_z_m},
            "rows": rows.tolist(),
            "scores": to_json(grasps.scores[rows]),
            "base_scores": to_json(grasps.base_scores[rows]),
            "widths_m": to_json(grasps.widths_m[rows]),
            "measures": measures_json(grasps, rows),
            "left_out": len(grasps) - len(rows),
        },
    }
    path = Path(path)
    atomic.write_bytes(path, atomic.json_bytes(value, indent=None))
    return path


def read_graspgen(path: Path | str, frame: HandFrame | None = None) -> GraspGenGrasps:
    """Return the grasps of a GraspGen file.

    Args:
        path: the JSON file.
        frame: of its hand; None = what the file says, else GraspGen's convention.

    Raises:
        InputError: it is none, or its transforms are not rigid.
    """
    path = Path(path)
    if path.is_file() and path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path} has {path.stat().st_size / 1e9:.1f} GB; at most 1.1 GB are read.")
    value = read_object(path)
    try:
        obj, grasps, ours = value["object"], value["grasps"], value.get("realsim", {})
        label = np.array(grasps["object_in_gripper"])
        Ts = np.array(grasps["transforms"], dtype=np.float64).reshape(-1, 4, 4)
        scale = float(obj.get("scale", 1.0))
        mesh = str(obj["file"])
        used = known_frame(frame or ours.get("frame", "acronym"))
        mount_z = float(ours.get("hand", {}).get("mount_z_m", find_hand().mount_z_m))
        hand = replace(find_hand(), mount_z_m=mount_z)
        columns = {k: _ours(ours, k, len(Ts)) for k in ("scores", "base_scores", "widths_m")}
        measures = measures_of_json(ours.get("measures", {}), len(Ts), str(path))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{path} is no file of GraspGen's grasps ({error!r}): object.file, object.scale, "
            "grasps.transforms (4x4 each) and grasps.object_in_gripper are expected."
        ) from error
    if label.shape != (len(Ts),) or not (len(Ts) == 0 or np.all((label == 0) | (label == 1))):
        raise InputError(
            f"{path}: object_in_gripper must be one true or false for each of {len(Ts)} transforms."
        )
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"{path}: the scale is {scale}; a number above 0 is expected.")
    Ts = se3.check_rigid(grasp_poses(Ts, used, hand), f"{path}: transforms") if len(Ts) else Ts
    return GraspGenGrasps(
        file=mesh, scale=scale, Ts_obj_grasp=Ts, object_in_gripper=label.astype(np.bool_),
        measures=measures, **columns,
    )  # fmt: skip


def _ours(ours: Any, key: str, n: int) -> Array | None:
    return array_from_json(ours[key], (n,)) if key in ours else None
