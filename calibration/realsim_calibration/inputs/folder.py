"""A folder of images and its poses, paired; what is doubtful about them is said.

Files that hold pairs: the robot's pose beside the board's pose in the camera, without images.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from realsim.arrays import Array
from realsim.errors import InputError
from realsim_calibration.inputs.columns import PoseTable, raw_from_table
from realsim_calibration.inputs.image_files import content_of, list_images
from realsim_calibration.inputs.pairing import Pairing, image_folder, pair, pose_folders, poses_of
from realsim_calibration.inputs.pose_file import file_text, file_tree, read_pose_file
from realsim_calibration.inputs.pose_text import table_from_text
from realsim_calibration.inputs.raw_poses import RawPoses, listed_readings
from realsim_calibration.inputs.readings import PoseReading

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


NOT_MEASURED = "its pose holds NaN or infinite numbers: it was not measured"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FolderInput:
    """Images with their poses, one row each."""

    images: tuple[Path, ...]
    labels: tuple[str, ...]
    """File names of the images."""
    depths: tuple[Path | None, ...]
    """16-bit depth image of each, or None; not necessarily aligned to it."""
    poses: RawPoses
    """The poses in the order of the images."""
    reading: PoseReading | None
    """How to read them, if it was said."""
    pairing: str
    """How images and poses were paired."""
    unpaired_images: tuple[tuple[str, str], ...]
    """(file name, reason)."""
    unpaired_poses: tuple[tuple[str, str], ...]
    """(where it stands, reason)."""
    warnings: tuple[str, ...]

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.images)

    @property
    def joints(self) -> Array | None:
        """(n, j) joint angles [rad], None where they are not known."""
        return self.poses.joints

    def Ts_base_ee(self, reading: PoseReading | None = None) -> Array:
        """Return the poses (n, 4, 4) [m] of a reading, by default of the one that was said.

        A reading that contradicts the names of the file is taken: `warnings` says so.

        Raises:
            InputError: no reading was said, or it does not fit the file.
        """
        chosen = self.reading if reading is None else reading
        if chosen is None:
            raise InputError(
                f"{self.poses.path}: it was not said how the poses are to be read. The numbers "
                f"admit {listed_readings(self.poses.possible)}. Give one of them, or let the "
                "images decide."
            )
        return self.poses.poses(chosen, despite_names=True)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardPosesInput:
    """Robot poses and poses of the board in the camera, row by row, without images."""

    robot: RawPoses
    board: RawPoses
    """T_cam_board, or its inverse where read as inverted."""
    pairing: str
    unpaired_robot: tuple[tuple[str, str], ...]


def read_image_folder(
    images: Path | str,
    poses: Path | str,
    *,
    reading: PoseReading | None = None,
    key: str | None = None,
) -> FolderInput:
    """Return the images of a folder, each with its pose; `layouts` says where they may lie.

    Pairs by the image names beside the poses, else by the names or numbers of the pose files, else
    by the lines' numbers or order if the counts agree.

    Args:
        images: the folder.
        poses: file or folder of the poses; may be the images' folder.
        reading: how the poses are to be read, if it is known.
        key: which key of the poses' file holds them, where there are several.

    Raises:
        InputError: unreadable, nothing to pair, counts that differ without names, or a reading
            that does not fit.
    """
    folder = Path(images)
    single = pose_folders(folder, key) if Path(poses) == folder else None
    if single is not None:
        listing, raw, names = single.listing, single.raw, list(single.names)
        sentence = f"One folder a pose: {names[0]} with {raw.where[0]}, and so on."
        found = Pairing(pairs=tuple((k, k) for k in range(len(raw))), sentence=sentence)
    else:
        listing = list_images(image_folder(folder))
        raw = read_pose_file(
            poses_of(folder, image_folder(folder)) if Path(poses) == folder else poses, key=key
        )
        names = [p.name for p in listing.images]
        try:
            found = pair(names, raw.labels, raw.stems, raw.where)
        except InputError as error:
            raise InputError(f"{images} and {raw.path}: {error}") from error
    measured = raw.measured
    kept = [(i, r) for i, r in found.pairs if measured[r]]
    lost = [(i, r) for i, r in found.pairs if not measured[r]]
    if not kept:
        raise InputError(f"{raw.path}: no pose that belongs to an image holds finite numbers.")
    rows = raw.subset([r for _, r in kept])
    against = ""
    if reading is not None:
        rows.poses(reading, despite_names=True)
        against = rows.contradiction(reading)
    chosen = [listing.images[i] for i, _ in kept]
    labels = tuple(names[i] for i, _ in kept)
    same_images = _equal_groups(labels, [content_of(p) for p in chosen])
    same_poses = _equal_groups(rows.where, [v.tobytes() for v in rows.values + 0.0])
    return FolderInput(
        images=tuple(chosen),
        labels=labels,
        depths=tuple(listing.depths[i] for i, _ in kept),
        poses=rows,
        reading=reading,
        pairing=found.sentence,
        unpaired_images=(
            *((names[i], why) for i, why in found.unpaired_images),
            *((names[i], NOT_MEASURED) for i, _ in lost),
            *listing.ignored,
        ),
        unpaired_poses=(
            *((raw.where[r], why) for r, why in found.unpaired_poses),
            *((raw.where[r], "NaN or infinite numbers") for _, r in lost),
        ),
        warnings=(
            *([f"{against} It is taken as you say."] if against else []),
            *found.warnings,
            *_warnings(same_images, same_poses, found, len(lost)),
        ),
    )


def read_board_poses(
    robot: Path | str | None,
    board: Path | str,
    *,
    robot_key: str | None = None,
    board_key: str | None = None,
) -> BoardPosesInput:
    """Return robot poses and board poses that were measured elsewhere, row by row.

    Args:
        robot: file or folder of T_base_ee; None where the board's file holds pairs of both.
        board: file or folder of T_cam_board, the same formats are read; or a file of pairs.
        robot_key: which key of the robot's file holds the poses.
        board_key: which key of the board's file holds them.

    Raises:
        InputError: unreadable, or counts that differ without names.
    """
    if robot is None:
        a, b = read_pose_pairs(board)
    else:
        a = read_pose_file(robot, key=robot_key)
        b = read_pose_file(board, key=board_key, board=True)
    names = [label or stem for label, stem in zip(b.labels, b.stems, strict=True)]
    try:
        if all(names):
            found = pair(names, a.labels, a.stems, a.where)
        elif len(a) != len(b):
            raise InputError(
                f"there are {len(a)} robot poses and {len(b)} board poses, and no names say which "
                "belong together. Write the image's name beside each pose of both files."
                + (a.times is not None and b.times is not None)
                * " Or pair them by their time stamps: without `--clock-offset off`, and with "
                "--reading where the format of the poses is open."
            )
        else:
            sentence = f"Paired by order, as the counts agree ({len(a)}). No names confirm it."
            found = Pairing(pairs=tuple((k, k) for k in range(len(a))), sentence=sentence)
    except InputError as error:
        raise InputError(f"{a.path} and {b.path}: {error}") from error
    fine = [(i, r) for i, r in found.pairs if a.measured[r] and b.measured[i]]
    lost = [(i, r) for i, r in found.pairs if (i, r) not in fine]
    reason = "NaN or infinite numbers in it or in its partner"
    return BoardPosesInput(
        robot=a.subset([r for _, r in fine]),
        board=b.subset([i for i, _ in fine]),
        pairing=found.sentence,
        unpaired_robot=(
            *((a.where[r], why) for r, why in found.unpaired_poses),
            *((a.where[r], reason) for _, r in lost),
        ),
    )


def _equal_groups(names: Sequence[str], contents: Sequence[bytes]) -> tuple[tuple[str, ...], ...]:
    """Return the names of what is equal, group by group."""
    groups: dict[bytes, list[str]] = {}
    for name, content in zip(names, contents, strict=True):
        groups.setdefault(content, []).append(name)
    return tuple(tuple(g) for g in groups.values() if len(g) > 1)


def _warnings(
    same_images: Sequence[Sequence[str]],
    same_poses: Sequence[Sequence[str]],
    found: Pairing,
    not_measured: int,
) -> Iterator[str]:
    """Yield the sentences for what is doubtful."""
    if same_images:
        groups = "; ".join(", ".join(g) for g in same_images[:6])
        yield (
            f"Images are there more than once, byte by byte ({groups}): at least one "
            "of each has the pose of another. Delete the copies with their poses."
        )
    if same_poses:
        groups = "; ".join(", ".join(g) for g in same_poses[:6])
        yield (
            f"Poses are there more than once, with the very same numbers ({groups}): a controller "
            "never repeats all digits. Was an old pose stored again?"
        )
    left = len(found.unpaired_images), len(found.unpaired_poses)
    if any(left):
        yield f"Images without a pose: {left[0]}, poses without an image: {left[1]}."
    if not_measured:
        yield f"Images left out for a pose of NaN or infinite numbers: {not_measured}."
