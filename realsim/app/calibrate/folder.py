"""`realsim calibrate` on plain folders: images with a pose file, or pose files alone.

Nothing is guessed in silence: how images and poses were paired, and how the poses were read, is
said; where the file leaves several readings open, the images decide, or nothing is calibrated.
"""

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from realsim.app.calibrate.board_views import (
    find_in_images,
    known_arm,
    require_one_size,
    require_target,
    require_views,
    warn_of_pictures,
)
from realsim.app.console import Console
from realsim.app.outputs import require_free_folder
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry.dh import DhArm
from realsim.records import CameraIntrinsics, Target
from realsim.store.atomic import write_text
from realsim.untrusted.own_json import read_object
from realsim_calibration import (
    BoardView,
    Calibration,
    CalibrationConfig,
    TargetDetection,
    calibrate,
    calibrate_from_poses,
    calibrate_intrinsics,
    diagnose,
    estimate_board_pose,
    prove_reading,
)
from realsim_calibration.calibrate import require_given_camera
from realsim_calibration.fit.closed_forms import MIN_VIEWS
from realsim_calibration.inputs.pairing import MADE_OF
from realsim_calibration.results import Clock

if TYPE_CHECKING:
    from realsim_calibration.inputs.folder import FolderInput
    from realsim_calibration.inputs.raw_poses import RawPoses
    from realsim_calibration.inputs.readings import PoseReading

MIN_POSE_POINTS = 6
"""Fewest points of a board pose that may speak for a reading."""
MIN_DIAGNOSED = 6
"""Fewer views do not tell a fault of the pairing from a wrong reading."""
USUAL_READINGS = 2
"""Readings under which faults are looked for where none fits; the commonest come first."""
NAMED_FAULTS = ("shifted_pairing", "robot_unit", "board_size", "board_unit", "tool_change",
                "board_moved", "camera_moved", "mirrored_axis")  # fmt: skip
"""Faults of a whole set that explain why no reading fits."""
PROOF_VIEWS = 40
"""Views that decide on a reading: more do not change the verdict."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FolderRequest:
    """What `realsim calibrate` was asked for."""

    images: Path
    out: Path
    board: str = ""
    """One-line target, or the path of a target file."""
    poses: Path | None = None
    """Pose file or folder; the images' folder where None."""
    board_poses: Path | None = None
    """Camera poses of the board instead of images."""
    reading: str = ""
    """How the pose file is to be read; empty = what the file states, or what the images prove."""
    key: str = ""
    """Which entry of the pose file holds the poses."""
    intrinsics: Path | None = None
    """File with known intrinsics."""
    mode: Literal["eye_in_hand", "eye_to_hand"] = "eye_in_hand"
    arm: str = ""
    """Name or folder of the arm; empty = the one that joints and poses prove, if any."""
    clock: str = "auto"
    """Offset of the camera's clock: auto, off, or seconds."""


def made_of(images: Path) -> str:
    """Return the text of the file that says what a folder of results was made of."""
    return json.dumps({"images": str(images.resolve())})


def require_free_results(out: Path, source: Path, console: Console) -> None:
    """Raise unless results can go to a folder: a new or empty one, or one made of this source."""
    if out.resolve() == source.resolve():
        raise InputError(
            f"--out '{out}' is the data set itself: pictures of the report would replace images of "
            f"the same name. Give a folder of its own, such as {out / 'calibration'}."
        )
    note, here = out / MADE_OF, str(source.resolve())
    if note.is_file() and (stands := read_object(note).get("images")) != here:
        own = shlex.quote(str(out.parent / f"calibration-{Path(here).name}"))
        raise InputError(f"'{out}' holds the calibration of '{stands}'; give --out {own}")
    require_free_folder(out, "--out", None, (MADE_OF, (made_of(source),)))
    if any(out.glob("*_report.html")):
        console.say(f"replacing the calibration of {source} in {out}; --out FOLDER keeps both")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FolderViews:
    """What a folder holds, read and proven."""

    images: tuple[Path, ...]
    views: list[BoardView]
    """One for each image."""
    target: Target
    camera: CameraIntrinsics | None
    """The camera that was given."""
    arm: DhArm | None
    """The arm that was named, or that joints and poses prove."""


def calibrate_folder(request: FolderRequest, console: Console) -> tuple[Calibration, list[Path]]:
    """Return the calibration of a folder and the files that were written.

    Raises:
        InputError: something cannot be read, paired or proven; says what to give.
        UnitError: a length is in another unit.
        DegenerateError: the views do not determine the calibration.
    """
    config = CalibrationConfig()
    config = replace(config, hand_eye=replace(config.hand_eye, mode=request.mode))
    if request.board_poses is not None:
        return _from_pose_files(request, config, console)
    found = read_views(request, console)
    with console.stage("calibrate", f"{len(found.views)} views"):
        result = calibrate(
            found.views, found.target, intrinsics0=found.camera, arm=found.arm, config=config
        )
    return result, write_calibration(result, request, found.images, console)


def read_views(request: FolderRequest, console: Console) -> FolderViews:
    """Return the views of a folder of images: paired, found, their poses read.

    Raises:
        InputError: something cannot be read, paired or proven; says what to give.
    """
    from realsim_calibration.inputs.folder import read_image_folder
    from realsim_calibration.inputs.readings import reading_from_text

    target = target_of(request.board)
    reading = reading_from_text(request.reading) if request.reading else None
    folder = read_image_folder(
        request.images, request.poses or request.images, reading=reading, key=request.key or None
    )
    console.say(f"Images with poses: {len(folder)}. {folder.pairing}")
    console.warn(*folder.warnings, *folder.poses.notes)
    for name, reason in (*folder.unpaired_images, *folder.unpaired_poses):
        console.warn(f"{name} was left out: {reason}")
    write_text(request.out / MADE_OF, made_of(request.images))
    detections = find_in_images(folder.images, target, request.out, console)
    require_target(folder, detections, target)
    require_views(folder, detections, MIN_VIEWS)
    warn_of_pictures(folder, detections, target, console)
    camera = _camera_of(request.intrinsics)
    require_one_size(folder.labels, detections, camera, request.intrinsics)
    reading = reading or _stated_or_proven(folder, detections, target, camera, request, console)
    Ts, joints = folder.Ts_base_ee(reading), folder.joints
    views = [
        BoardView(
            index=k, T_base_ee=Ts[k], detection=found, name=folder.labels[k],
            joints=None if joints is None else joints[k],
        )
        for k, found in enumerate(detections)
    ]  # fmt: skip
    return FolderViews(
        images=folder.images, views=views, target=target, camera=camera,
        arm=known_arm(
            request.arm, [v.T_base_ee for v in views], [v.joints for v in views], console
        ),
    )  # fmt: skip


def target_of(text: str) -> Target:
    """Return the target of a one-line description or of a file.

    Raises:
        InputError: neither; says what is accepted.
    """
    from realsim_calibration.targets.target_file import read_target
    from realsim_calibration.targets.target_text import parse_target, target_usage

    if not text:
        raise InputError(
            "which target is in the images was not said: give --board, a file that `realsim board` "
            f"wrote, or one line:\n{target_usage()}"
        )
    path = Path(text)
    return read_target(path) if path.is_file() else parse_target(text)


def _camera_of(path: Path | None) -> CameraIntrinsics | None:
    from realsim_calibration.lens.camera_files import read_camera

    return None if path is None else read_camera(path)


def _stated_or_proven(
    folder: "FolderInput", detections: Sequence[TargetDetection], target: Target,
    camera: CameraIntrinsics | None, request: FolderRequest, console: Console,
) -> "PoseReading":  # fmt: skip
    """Return how the poses are to be read: as the file states, or as the images prove."""
    if folder.poses.stated is not None:
        console.say(f"poses read as the file states: {folder.poses.stated}")
        return folder.poses.stated
    names = list(folder.labels)
    lens = camera or calibrate_intrinsics(list(detections), target, names=names).intrinsics
    rows: list[int] = []
    boards: list[Array] = []
    for k, found in enumerate(detections):
        if len(found) < MIN_POSE_POINTS or len(rows) == PROOF_VIEWS:
            continue
        pose = estimate_board_pose(found.points(target), found.uv, lens)
        if pose is not None:
            rows.append(k)
            boards.append(pose.T_cam_board)
    try:
        return _proven(folder.poses.subset(rows), np.array(boards), target, request, console)
    except InputError:
        if camera is not None:
            require_given_camera(camera, detections, target, names, CalibrationConfig())
        raise


def _proven(
    poses: "RawPoses", boards: Array, target: Target | None, request: FolderRequest,
    console: Console,
) -> "PoseReading":  # fmt: skip
    """Return the reading that the board poses prove.

    Raises:
        InputError: none fits, or several do.
    """
    from realsim_calibration.inputs.readings import reading_from_text

    if not len(boards):
        raise InputError(
            "no image shows enough of the target to decide how the poses are to be read: give "
            "--reading, such as --reading rotvec,m."
        )
    candidates = [(str(r), poses.poses(r)) for r in poses.possible]
    proof = prove_reading(candidates, boards, target=target)
    if not proof.decisive:
        usual = _fault_under_usual_readings(poses, boards, target, request)
        if usual is not None:
            console.warn(
                f"no reading fits all views, and as {usual} only single views are at fault: the "
                "poses are read so; give --reading to be sure."
            )
            return usual
        raise InputError(
            "how the poses are to be read is not clear from the file, and the images do not "
            f"decide: {proof.sentence} Do images and poses belong together, and are all images "
            "the right way up, and are angles and lengths in the units that their names state? If "
            "so, say how the poses are written, such as --reading rotvec,deg,mm."
        )
    best = reading_from_text(proof.best)
    if proof.best_mode != request.mode:
        # The same equation with the poses the other way round: the user must say that they are.
        other = replace(best, inverted=not best.inverted)
        remedy = "Leave --eye-to-hand out" if request.mode == "eye_to_hand" else "Say --eye-to-hand"
        raise InputError(
            f"the poses fit as {proof.best} with the camera {_place(proof.best_mode)}, not "
            f"{_place(request.mode)}. {proof.sentence} {remedy}; or, if the file really holds the "
            f"poses the other way round, say --reading {other}."
        )
    console.say(f"poses read as the images prove: {best}. {proof.sentence}")
    return best


def _fault_under_usual_readings(
    poses: "RawPoses", boards: Array, target: Target | None, request: FolderRequest
) -> "PoseReading | None":
    """Return a usual reading under which only single views are at fault, None where none is.

    Raises:
        InputError: under a usual reading the whole set has a fault that explains everything, such
            as a shifted pairing.
    """
    from realsim_calibration.faults.consequences import SINGLE_VIEWS, told

    if len(boards) < MIN_DIAGNOSED:
        return None
    for reading in [r for r in poses.possible if not r.inverted][:USUAL_READINGS]:
        Ts = poses.poses(reading)
        found = diagnose(Ts, boards, labels=poses.where, target=target, mode=request.mode)
        if found.fault in SINGLE_VIEWS:
            return reading
        if found.fault in NAMED_FAULTS:
            raise InputError(f"with the poses read as {reading}: {told(found)}")
    return None


def _place(mode: str) -> str:
    return "in the hand" if mode == "eye_in_hand" else "standing still"


def _from_pose_files(
    request: FolderRequest, config: CalibrationConfig, console: Console
) -> tuple[Calibration, list[Path]]:
    """Return the calibration of robot poses and board poses without images."""
    from realsim_calibration.inputs.folder import read_board_poses
    from realsim_calibration.inputs.readings import reading_from_text

    assert request.board_poses is not None
    stamped = _from_logs(request, console)
    if stamped is not None:
        return _of_pairs(request, config, console, stamped)
    given = read_board_poses(request.poses, request.board_poses, robot_key=request.key or None)
    console.say(f"{len(given.robot)} pose pairs: {given.pairing}")
    for name, reason in given.unpaired_robot:
        console.warn(f"{name} was left out: {reason}")
    board_reading = given.board.stated
    if board_reading is None:
        raise InputError(
            f"{request.board_poses}: how the board poses are to be read is not clear. Give 4x4 "
            "matrices or named columns (x, y, z, qx, qy, qz, qw)."
        )
    boards = given.board.poses(board_reading)
    reading = reading_from_text(request.reading) if request.reading else given.robot.stated
    if reading is None:
        reading = _proven(given.robot, boards, None, request, console)
    Ts, joints = given.robot.poses(reading), given.robot.joints
    labels = [where or str(k) for k, where in enumerate(given.robot.where)]
    console.say(f"robot poses read as {reading}, board poses as {board_reading}")
    return _of_pairs(request, config, console, (Ts, boards, joints, labels, None))


def _from_logs(
    request: FolderRequest, console: Console
) -> tuple[Array, Array, Array | None, list[str], Clock | None] | None:
    """Return the pairs of two logs with time stamps, None where they are paired otherwise."""
    from realsim.app.calibrate.clock import pair_pose_logs
    from realsim_calibration.inputs.pose_file import read_pose_file
    from realsim_calibration.inputs.readings import reading_from_text

    assert request.board_poses is not None
    if request.clock == "off" or request.poses is None:
        return None
    robot = read_pose_file(request.poses, key=request.key or None)
    board = read_pose_file(request.board_poses, board=True)
    reading = reading_from_text(request.reading) if request.reading else robot.stated
    if reading is None or board.stated is None:
        return None
    readings = (reading, board.stated)
    return pair_pose_logs(robot, board, readings, request.mode, request.clock, console)


def _of_pairs(
    request: FolderRequest, config: CalibrationConfig, console: Console,
    pairs: tuple[Array, Array, Array | None, list[str], Clock | None],
) -> tuple[Calibration, list[Path]]:  # fmt: skip
    """Return the calibration of (hand poses, board poses, joints, labels, clock)."""
    Ts, boards, joints, labels, clock = pairs
    camera = _camera_of(request.intrinsics)
    arm = known_arm(request.arm, list(Ts), [] if joints is None else list(joints), console)
    with console.stage("calibrate", f"{len(Ts)} pose pairs"):
        report = calibrate_from_poses(
            Ts, boards, labels=labels, joints=joints, config=config.hand_eye, arm=arm,
            camera=camera,
        )  # fmt: skip
    if camera is None:
        console.warn(
            "there are no images: figures in px are those of a nominal camera (f = 900 px) that "
            "looks at the measured poses, and no lens is exported. --intrinsics FILE exports the "
            "lens by which the target was measured."
        )
    result = Calibration(hand_eye=replace(report, clock=clock), lens=None)
    return result, write_calibration(result, request, (), console)


def write_calibration(
    result: Calibration, request: FolderRequest, images: Sequence[Path], console: Console
) -> list[Path]:
    """Write all files, and last the page, which tells that all are there; return it first."""
    from realsim_calibration.exports.frames import FrameNames
    from realsim_calibration.exports.write import write_exports
    from realsim_calibration.inputs.image_files import load_image
    from realsim_calibration.report.page import PAGE_NAME, write_calibration_report

    out = request.out
    with console.stage("report", str(out)):
        write_text(out / MADE_OF, made_of(request.images))
        (out / PAGE_NAME).unlink(missing_ok=True)
        exports = write_exports(
            result.hand_eye, out / "exports", frames=FrameNames(), tell=console.warn
        )
        pages = write_calibration_report(
            result.hand_eye, out,
            images=(lambda k: load_image(images[k])) if images else None,
            intrinsics_report=result.lens,
        )  # fmt: skip
    return [*pages, *exports]
