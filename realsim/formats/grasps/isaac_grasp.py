"""Grasps of one object as an isaac_grasp YAML file, and such files as grasps.

    format: isaac_grasp
    format_version: 1.0
    object_frame_link: mug
    gripper_frame_link: panda_hand
    grasps:
      "grasp_0":
        confidence: 0.83
        position: [x, y, z]                     # of the gripper's frame in the object's [m]
        orientation: {w: 1.0, xyz: [0.0, 0.0, 0.0]}
        cspace_position: {panda_finger_joint1: 0.012}
        pregrasp_cspace_position: {panda_finger_joint1: 0.04}
        realsim: {score: 1.0, base_score: 1.0, p_hold: 0.83, p_hold_error: 0.09, ...}

The gripper's frame is franka_description's panda_hand, of other hands that at the mounting face
with the same axes; frame and joint are called as the hand's description says. The confidence is
p_hold where the set has it, else the score; a comment in the file says which. Under `realsim`,
which other readers leave alone, stand both scores and all measures, one number or one a stage;
null = not measured. The number in the name is the grasp's row in its set. The joint is half the
distance of the fingers, joint 2 mimics it; of an arc it is the crank's angle. Grasps without
a label, those out of the arm's reach among them, are left out.

Source: Isaac Sim, Grasp Editor, "What is an Isaac Grasp File?"; Isaac ROS names the two frames
object_frame and gripper_frame, which are read, too.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.grasps.hand_frames import hand_of_set, hand_poses
from realsim.formats.grasps.scene_grasps import check_values, labelled, measures_json, stored_values
from realsim.records import GraspSet
from realsim.robots.hand import Hand
from realsim.store import atomic
from realsim.untrusted.own_json import to_json

FORMAT_VERSION = 1.0
CONFIDENCES = {
    "p_hold": "p_hold, the probability that a robot lifts the object and holds it",
    "score": "score of one nominal attempt, no probability",
}
"""What the confidence is, by the set's label."""


def write_isaac_grasp(
    path: Path | str, grasps: GraspSet, *, object_frame: str, least_score: float = 0.0
) -> Path:
    """Write the tried grasps of one object, whole or not at all.

    Args:
        path: the YAML file.
        grasps: the set; its parameters' openings_m are the fingers' distance before closing, where
            they are there, else the hand opens fully.
        object_frame: name of the object's frame.
        least_score: grasps of less confidence are left out.

    Raises:
        InputError: the set holds what no grasp has, or a width that the hand cannot take.
    """
    check_values(grasps)
    labels = grasps.labels
    rows = np.flatnonzero(labelled(grasps) & (labels >= least_score))
    ours = {"score": to_json(grasps.scores[rows]), "base_score": to_json(grasps.base_scores[rows])}
    ours |= measures_json(grasps, rows)
    hand = hand_of_set(grasps)
    Ts = hand_poses(grasps.Ts_obj_grasp[rows], "panda_hand", hand)
    widths = grasps.widths_m[rows]
    widest = np.full(len(grasps), hand.max_opening_m)
    openings = stored_values(grasps, "openings_m", widest)[rows]
    _require_fits(widths, hand)
    _require_fits(openings, hand)
    closed, opened = _joint(hand, widths), _joint(hand, openings)
    xyzw = interop.quaternion_xyzw_from_R(Ts) if len(rows) else np.zeros((0, 4))
    lines = [
        "format: isaac_grasp",
        f"format_version: {FORMAT_VERSION}",
        f"object_frame_link: {json.dumps(object_frame)}",
        f"gripper_frame_link: {json.dumps(hand.frame_link)}",
        f"# confidence: {CONFIDENCES[grasps.label]}",
        "grasps:" if len(rows) else "grasps: {}",
    ]
    for k, row in enumerate(rows.tolist()):
        x, y, z, w = (_number(q) for q in xyzw[k])
        lines += [
            f'  "grasp_{row}":',
            f"    confidence: {_number(labels[row])}",
            f"    position: [{', '.join(_number(t) for t in Ts[k, :3, 3])}]",
            f"    orientation: {{w: {w}, xyz: [{x}, {y}, {z}]}}",
            f"    cspace_position: {{{hand.joint}: {_number(closed[k])}}}",
            f"    pregrasp_cspace_position: {{{hand.joint}: {_number(opened[k])}}}",
            f"    realsim: {{{', '.join(f'{n}: {_flow(v[k])}' for n, v in ours.items())}}}",
        ]
    path = Path(path)
    atomic.write_text(path, "\n".join(lines) + "\n")
    return path


def _joint(hand: Hand, openings_m: Array) -> Array:
    """Return the positions (N,) of the hand's joint at openings (N,): [m], on an arc [rad].

    Raises:
        InputError: the hand's description does not name its joint.
    """
    if not hand.joint:
        raise InputError(
            f"the hand '{hand.name}' does not say what its joint is called, which an isaac_grasp "
            'file names. Add joint = "..." to its robot.toml and run `realsim school` again, or '
            "export with --to graspgen, hdf5 or parquet."
        )
    return hand.joint_position(openings_m)


def _require_fits(widths_m: Array, hand: Hand) -> None:
    """Check that the widths are known and fit between the hand's fingers.

    Raises:
        InputError: one is NaN or wider than the hand opens.
    """
    most_m = hand.max_opening_m
    wrong = ~((widths_m >= 0) & (widths_m <= most_m))
    if np.any(wrong):
        at = int(np.flatnonzero(wrong)[0])
        raise InputError(
            f"grasp {at} has the width {widths_m[at]:g} m; 0 to {most_m:g} m, what the "
            f"{hand.title} opens, is needed to say where its fingers are."
        )


def _flow(value: Any) -> str:
    """Return a number or a list of them, as `to_json` made them, in YAML's words."""
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    return _number(value) if isinstance(value, float) else json.dumps(value)


def _number(x: float) -> str:
    """Return a float that every YAML reader takes for one: 1e-05 is a text in YAML 1.1."""
    text = repr(float(x))
    return text if "." in text or "e" not in text else text.replace("e", ".0e")
