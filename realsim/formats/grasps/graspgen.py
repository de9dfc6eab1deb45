"""Grasps of one object as a GraspGen JSON file.

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

from importlib.metadata import version
from pathlib import Path

import numpy as np

from realsim.formats.grasps.hand_frames import HandFrame, hand_of_set, hand_poses, known_frame
from realsim.formats.grasps.scene_grasps import check_values, executed, held, measures_json
from realsim.records import GraspSet
from realsim.store import atomic
from realsim.untrusted.own_json import to_json


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
