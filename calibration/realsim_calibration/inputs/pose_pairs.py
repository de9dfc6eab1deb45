"""Files that hold pairs: the robot's pose beside the board's pose in the camera, without images."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim_calibration.inputs.columns import PoseTable, raw_from_table
from realsim_calibration.inputs.pose_file import file_text, file_tree, read_pose_file
from realsim_calibration.inputs.pose_text import table_from_text
from realsim_calibration.inputs.raw_poses import RawPoses

BOARD = re.compile(
    r"board|target|marker|object|pattern|optical|sensor|tracking|tag(?![a-z])|cam(?!.*(base|world))",
    re.IGNORECASE,
)
"""What the pose of the board in the camera is called: T_cam_board, target2cam, object_wrt_sensor
(MoveIt), optical (easy_handeye)."""
ROBOT = re.compile(
    r"robot|base|world|effector|hand|gripper|tcp|flange|tool|(^|_)ee(f|$|_)|arm", re.IGNORECASE
)
"""What the pose of the robot's hand is called: T_base_ee, gripper2base, effector_wrt_world."""
ACCEPTED = (
    "Accepted: entries, lists or columns with the robot's pose under a name such as robot, "
    "T_base_ee, gripper2base or effector_wrt_world, and the board's under one such as board, "
    "T_cam_board, target2cam or object_wrt_sensor; in a csv file robot_x ... robot_qw, board_x ... "
    "board_qw"
)


def read_pose_pairs(path: Path | str) -> tuple[RawPoses, RawPoses]:
    """Return the robot's poses and the board's poses of one file, row by row.

    Raises:
        InputError: unreadable, or it is not clear which poses are whose.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; a file of pose pairs was expected. {ACCEPTED}.")
    if path.suffix.lower() not in (".json", ".yaml", ".yml"):
        return _of_columns(path)
    keys = _pair_keys(file_tree(path))
    if keys is None:
        raise InputError(
            f"{path} does not say which poses are the robot's and which the board's. {ACCEPTED}."
        )
    robot, board = (read_pose_file(path, key=key) for key in keys)
    return robot, board


def _pair_keys(node: Any) -> tuple[str, str] | None:
    """Return the keys of the robot's and of the board's poses, of the first place that has both."""
    if isinstance(node, list):
        return _pair_keys(node[0]) if node else None
    if not isinstance(node, dict):
        return None
    held = [k for k, v in node.items() if isinstance(v, (list, dict))]
    boards = [k for k in held if BOARD.search(k)]
    robots = [k for k in held if ROBOT.search(k) and k not in boards]
    if len(boards) == len(robots) == 1:
        return robots[0], boards[0]
    return next((keys for k in held if (keys := _pair_keys(node[k])) is not None), None)


def _of_columns(path: Path) -> tuple[RawPoses, RawPoses]:
    """Return the poses of a file of lines whose header tells the two apart."""
    table = table_from_text(path, file_text(path))
    whose = [
        ("board" if BOARD.search(n) else "robot" if ROBOT.search(n) else "") for n in table.names
    ]
    if "board" not in whose or "robot" not in whose:
        raise InputError(
            f"{path}: its header does not say which columns are the robot's pose and which the "
            f"board's. {ACCEPTED}."
        )
    return _part(table, whose, "robot"), _part(table, whose, "board")


def _part(table: PoseTable, whose: list[str], which: str) -> RawPoses:
    """Return the poses in the columns of one of the two, their prefix taken off."""
    columns = [k for k, w in enumerate(whose) if w == which]
    names = [table.names[k] for k in columns]
    words = [re.split(r"[_.\s]", n) for n in names]
    common = 0
    while all(len(w) > common + 1 for w in words) and len({w[common] for w in words}) == 1:
        common += 1
    return raw_from_table(
        replace(
            table,
            names=tuple("_".join(w[common:]) for w in words),
            values=table.values[:, columns],
            notes=list(table.notes),
        )
    )
