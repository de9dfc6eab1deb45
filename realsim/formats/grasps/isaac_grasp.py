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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.grasps.hand_frames import HandFrame, grasp_poses, hand_of_set, hand_poses
from realsim.formats.grasps.scene_grasps import (
    check_values,
    labelled,
    measures_json,
    measures_of_json,
    untried_set,
)
from realsim.geometry import se3
from realsim.records import GraspSet
from realsim.robots.hand import Hand
from realsim.store import atomic
from realsim.untrusted.own_json import to_json
from realsim.untrusted.values import mapping, number, numbers
from realsim.untrusted.yaml_text import read_yaml

FORMAT_VERSION = 1.0
FINGER = "panda_finger_joint1"
WIDEST_M = 1.0
"""A finger that has moved farther is in millimetres [m]."""
CONFIDENCES = {
    "p_hold": "p_hold, the probability that a robot lifts the object and holds it",
    "score": "score of one nominal attempt, no probability",
}
"""What the confidence is, by the set's label."""
UNIT_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1: files written by hand have five decimals."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class IsaacGrasps:
    """What an isaac_grasp file says."""

    names: tuple[str, ...]
    Ts_obj_grasp: Array
    """(N, 4, 4) [m], frame `grasp`."""
    confidences: Array
    """(N,) in [0, 1]."""
    widths_m: Array
    """(N,) distance of the fingers [m]; NaN = the file names no such joint."""
    openings_m: Array
    """(N,) distance of the fingers before closing [m]; NaN likewise."""
    scores: Array
    """(N,) our score, where realsim wrote the file; else NaN."""
    base_scores: Array
    """(N,) likewise."""
    measures: dict[str, Array] = field(default_factory=dict[str, Array])
    """(N,) or (N, 4) by the names of MEASURES, likewise."""

    def as_set(self, obj_id: int, instance: int = 0) -> GraspSet:
        """Return the grasps as a set that our physics has not tried."""
        return untried_set(
            self.Ts_obj_grasp, obj_id=obj_id, instance=instance, widths_m=self.widths_m,
            parameters={"source": {"from": "isaac_grasp"}}, measures=self.measures,
        )  # fmt: skip


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
    widths, openings = grasps.widths_m[rows], _openings(grasps, hand)[rows]
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


def _openings(grasps: GraspSet, hand: Hand) -> Array:
    """Return the distance of the fingers (N,) before they close [m]."""
    stored = grasps.parameters.get("openings_m")
    if isinstance(stored, list) and np.shape(stored) == (len(grasps),):  # pyright: ignore[reportUnknownArgumentType]
        return np.array(stored, dtype=np.float64)
    return np.full(len(grasps), hand.max_opening_m)


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


def read_isaac_grasp(path: Path | str, frame: HandFrame = "panda_hand") -> IsaacGrasps:
    """Return the grasps of an isaac_grasp file, in the order of the file.

    Args:
        path: the YAML file.
        frame: of its gripper; the file's own entry is for human readers, as its specification says.

    Raises:
        InputError: it is none, of another version, or a grasp of it is not one.
    """
    path = Path(path)
    data = read_yaml(path)
    if not isinstance(data, dict) or data.get("format") != "isaac_grasp":
        raise InputError(f"{path} is no isaac_grasp file: it must begin with format: isaac_grasp.")
    try:
        found = float(data.get("format_version", "nan"))
    except (TypeError, ValueError, OverflowError):
        found = float("nan")
    if found != FORMAT_VERSION:
        raise InputError(
            f"{path} has the format_version {data.get('format_version')!r}; "
            f"{FORMAT_VERSION} is read."
        )
    listed: Any = data.get("grasps")
    if not isinstance(listed, dict):
        raise InputError(f"{path} has no grasps: names with a grasp each are expected.")
    rows: list[Array] = []
    for name, entry in listed.items():
        try:
            rows.append(_row(entry))
        except InputError as error:
            raise InputError(
                f"{path}: {name} is no grasp ({error}); confidence in 0 to 1, position [x, y, z] "
                "and orientation {w, xyz: [x, y, z]} of unit length are expected."
            ) from error
    table = np.stack(rows) if rows else np.zeros((0, 10))
    told = [mapping(entry.get("realsim", {}), f"{path}: realsim") for entry in listed.values()]
    scores, base_scores = (
        np.array(
            [np.nan if t.get(key) is None else number(t[key], f"{path}: {key}", 0, 1) for t in told]
        )
        for key in ("score", "base_score")
    )
    others = {key for t in told for key in t} - {"score", "base_score"}
    columns = {key: [t.get(key) for t in told] for key in others}
    R = interop.R_from_quaternion_xyzw(table[:, 3:7]) if rows else np.zeros((0, 3, 3))
    Ts = grasp_poses(se3.from_rt(R, table[:, :3]), frame)
    return IsaacGrasps(
        names=tuple(str(name) for name in listed),
        Ts_obj_grasp=Ts,
        confidences=table[:, 7],
        widths_m=table[:, 8],
        openings_m=table[:, 9],
        scores=scores,
        base_scores=base_scores,
        measures=measures_of_json(columns, len(rows), str(path)),
    )


def _row(entry: Any) -> Array:
    """Return position, quaternion x y z w, confidence, width and opening of one grasp (10,)."""
    grasp = mapping(entry, "the grasp")
    turn = mapping(grasp.get("orientation"), "'orientation'")
    xyzw = [*numbers(turn.get("xyz"), 3, "'xyz'"), number(turn.get("w"), "'w'")]
    length = float(np.linalg.norm(xyzw))
    if abs(length - 1) > UNIT_TOLERANCE:
        raise InputError(f"the quaternion has the length {length:.4f}")
    return np.array(
        [
            *numbers(grasp.get("position"), 3, "'position'"), *xyzw,
            number(grasp.get("confidence"), "'confidence'", 0, 1),
            _fingers_m(grasp.get("cspace_position")),
            _fingers_m(grasp.get("pregrasp_cspace_position")),
        ]
    )  # fmt: skip


def _fingers_m(joints: Any) -> float:
    """Return the distance of the fingers [m], NaN if the file does not say it."""
    if not isinstance(joints, dict) or FINGER not in joints:
        return np.nan
    return 2 * number(joints[FINGER], f"'{FINGER}'", 0, WIDEST_M)
