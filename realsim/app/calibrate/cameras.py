"""`realsim calibrate --cameras`: several cameras at once, from a folder of each or a session.

Images of the same instant have the same name, or the same number in it, in every camera's folder;
one file of poses says where the arm was. In a session the camera in the hand is the board views
themselves, every other one `cameras/NAME` inside them (or just its images, `rgb_NAME/`), with the
numbers of the views. The session's own `cameras/NAME` are then placed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.calibrate import camera_frames
from realsim.app.calibrate.board_views import (
    BOARD_FILE,
    find_in_images,
    known_arm,
    note_depth_bias,
    why_not_found,
)
from realsim.app.calibrate.folder import MADE_OF, made_of, require_free_results
from realsim.app.calibrate.show import show_checks
from realsim.app.console import Console
from realsim.app.register.results import keep_refined
from realsim.app.stages import BOARD_VIEWS
from realsim.errors import InputError, RealsimError
from realsim.store import SessionStore
from realsim.store.atomic import write_bytes, write_text
from realsim.store.cameras import camera_folder, camera_folders, open_cameras
from realsim_calibration import (
    DepthBoardView,
    calibrate_intrinsics,
    estimate_board_pose,
    prove_reading,
)
from realsim_calibration.cameras import page
from realsim_calibration.cameras.calibrate import calibrate_cameras
from realsim_calibration.cameras.faults import FEW_VIEWS
from realsim_calibration.cameras.files import document, write_cameras
from realsim_calibration.cameras.results import CamerasReport
from realsim_calibration.cameras.rig import Instant, Rig, RigBoard, RigCamera, Sighting
from realsim_calibration.faults.diagnosis import ReadingProof
from realsim_calibration.inputs.image_files import list_images
from realsim_calibration.inputs.pose_file import read_pose_file
from realsim_calibration.inputs.raw_poses import RawPoses
from realsim_calibration.inputs.readings import PoseReading, reading_from_text

CAMERAS_FILE = "cameras.json"
PROOF_VIEWS = 40
"""Views that decide on a reading: more do not change the verdict."""


def run_cameras(source: Path, console: Console, options: dict[str, Any]) -> bool:
    """Calibrate several cameras; return whether no check is bad.

    Raises:
        InputError: source or options cannot be used; says what is accepted.
        DegenerateError: the views do not determine the cameras.
    """
    cameras = camera_frames.cameras_of(options["cameras"])
    for name in ("board_poses", "eye_to_hand"):
        if options.get(name):
            raise InputError(
                f"--{name.replace('_', '-')} is of one camera alone; with --cameras say NAME=hand "
                "or NAME=fixed, and give images."
            )
    if (source / BOARD_VIEWS / "session.json").is_file():
        return _run_session(source, cameras, console, options)
    if not source.is_dir():
        raise InputError(f"'{source}' is not a folder; one with a folder per camera is expected.")
    out: Path = options["out"]
    require_free_results(out, source, console)
    boards = camera_frames.boards_of(options)
    poses = camera_frames.pose_file_of(source, options["poses"], [c.name for c in cameras])
    raw = None if poses is None else read_pose_file(poses, key=options["key"] or None)
    frames = camera_frames.frames_of(source, cameras, raw)
    console.warn(*frames.left_out)
    cameras = camera_frames.with_intrinsics(cameras, options["intrinsics"])
    write_text(out / MADE_OF, made_of(source))
    sightings = tuple(_sightings(frames, cameras, boards, out, console))
    rig = Rig(
        cameras=cameras, boards=boards, sightings=sightings,
        instants=tuple(Instant(name=name) for name in frames.instants),
    )  # fmt: skip
    _require_seen(rig, frames)
    rig = _with_poses(rig, frames, raw, options["reading"], console)
    report = _calibrated(rig, options["arm"], console)
    return _told(report, write_files(report, out, console), console)


def _run_session(
    source: Path, cameras: tuple[RigCamera, ...], console: Console, options: dict[str, Any]
) -> bool:
    """Calibrate the cameras of a session's board views, and note the one in the hand there."""
    from realsim.untrusted.own_json import read_values
    from realsim_calibration.targets.target_file import target_from_json

    store = SessionStore.open(source / BOARD_VIEWS)
    folder = source / "calibration"
    boards = camera_frames.boards_of(options, needed=False)
    if not any(b.place == "table" for b in boards) and (source / BOARD_FILE).is_file():
        target = target_from_json(read_values(source / BOARD_FILE))
        boards = (RigBoard(name="table", target=target, place="table"), *boards)
    if not boards:
        raise InputError(f"'{source}' has no {BOARD_FILE}: give --board or --held-board.")
    views = store.session.views
    images: dict[str, dict[int, Path]] = {}
    inner = open_cameras(store)
    for camera in cameras:
        place = store.folder / ("rgb" if camera.mount == "hand" else f"rgb_{camera.name}")
        if camera.mount == "fixed" and camera.name in inner:
            place = inner[camera.name].folder / "rgb"
        elif not place.is_dir():
            own = camera_folder(store.folder, camera.name)
            raise InputError(
                f"there are no images of the camera '{camera.name}': neither the session {own} "
                f"(`realsim capture --fixed-cameras` makes it) nor the folder {place} is there."
            )
        found = {p.stem: p for p in list_images(place).images}
        images[camera.name] = {
            i: found[f"{v.index:06d}"] for i, v in enumerate(views) if f"{v.index:06d}" in found
        }
    frames = camera_frames.Frames(
        instants=tuple(f"{v.index:06d}" for v in views), images=images, rows={}
    )
    lenses = {name: s.session.intrinsics for name, s in inner.items()}
    lenses |= {c.name: store.session.intrinsics for c in cameras if c.mount == "hand"}
    known = tuple(
        replace(c, intrinsics0=lenses[c.name]) if c.name in lenses else c for c in cameras
    )
    known = camera_frames.with_intrinsics(known, options["intrinsics"])
    rig = Rig(
        cameras=known, boards=boards,
        sightings=tuple(_sightings(frames, known, boards, folder, console)),
        instants=tuple(
            Instant(name=f"{v.index:06d}", T_base_ee=v.T_base_ee, joints=v.joints) for v in views
        ),
    )  # fmt: skip
    _require_seen(rig, frames)
    report = _calibrated(rig, options["arm"], console)
    files = write_files(report, folder / "cameras", console)
    place_fixed(source, store, report, console)
    return _told(report, files, console)


# --- what is seen ---------------------------------------------------------------------------------


def _sightings(
    frames: camera_frames.Frames, cameras: Sequence[RigCamera], boards: Sequence[RigBoard],
    out: Path, console: Console,
) -> Iterator[Sighting]:  # fmt: skip
    """Return what every camera sees of every board, images without a board among them."""
    for c, camera in enumerate(cameras):
        own = sorted(frames.images[camera.name].items())
        for b, board in enumerate(boards):
            seen = find_in_images([p for _, p in own], board.target, out, console)
            _require_one_size(camera.name, [p.name for _, p in own], [d.image_size for d in seen])
            yield from [
                Sighting(camera=c, board=b, instant=i, detection=d, name=f"{camera.name}/{p.name}")
                for (i, p), d in zip(own, seen, strict=True)
                if len(d) or len(boards) == 1
            ]


def _require_one_size(camera: str, names: list[str], sizes: list[tuple[int, int]]) -> None:
    """Raise if an image, with a board or without, has another size than most of a camera's."""
    usual = max(set(sizes), key=sizes.count, default=(0, 0))
    odd = [f"{n} ({w}x{h})" for n, (w, h) in zip(names, sizes, strict=True) if (w, h) != usual]
    if odd:
        raise InputError(
            f"camera '{camera}' has images of several sizes: most have {usual[0]}x{usual[1]} px, "
            f"not {', '.join(odd[:5])}. One camera at one resolution is calibrated: take these "
            "out, and put images of another camera into a folder of its own."
        )


def _require_seen(rig: Rig, frames: camera_frames.Frames) -> None:
    """Raise if a camera never sees a board, saying what is wrong with its images."""
    for c, camera in enumerate(rig.cameras):
        own = [frames.images[camera.name][i] for i in sorted(frames.images[camera.name])]
        if not own:
            raise InputError(
                f"camera '{camera.name}' has no image that belongs to a pose. Are its images named "
                "as the other cameras'?"
            )
        if not any(len(s.detection) for s in rig.of_camera(c)):
            raise InputError(
                f"camera '{camera.name}' never sees a board: none was found in its {len(own)} "
                f"images. {why_not_found(own[0], own[0].name)} Or point it at the board, or leave "
                "the camera out of --cameras."
            )


def _with_poses(
    rig: Rig, frames: camera_frames.Frames, raw: RawPoses | None, reading: str, console: Console
) -> Rig:
    """Return the rig with the arm's poses, read as is said, stated or proven by the images."""
    moving = any(rig.moves(s.camera, s.board) for s in rig.sightings if len(s.detection))
    if raw is None:
        if moving or any(c.mount == "hand" for c in rig.cameras):
            raise InputError(
                "a camera or a board is in the hand, and there are no poses of the arm: put one "
                "file of poses beside the cameras' folders, or give --poses."
            )
        return rig
    rows = [frames.rows[i] for i in range(len(frames.instants))]
    poses = raw.subset(rows)
    chosen = reading_from_text(reading) if reading else poses.stated
    if chosen is None:
        chosen = _proven(rig, poses)
        console.say(f"poses read as the images prove: {chosen}.")
    Ts, joints = poses.poses(chosen), poses.joints
    instants = tuple(
        replace(t, T_base_ee=Ts[i], joints=None if joints is None else joints[i])
        for i, t in enumerate(rig.instants)
    )
    return replace(rig, instants=instants)


def _proven(rig: Rig, poses: RawPoses) -> PoseReading:
    """Return the reading that the images of a camera prove.

    Where a camera and a board that are said to move together prove one, they do not: the reading is
    taken, and the check of who is where names them.

    Raises:
        InputError: no camera moves against a board, or the images do not decide.
    """
    said, denied = "no camera moves against a board.", None
    for c, camera in enumerate(rig.cameras):
        for b, board in enumerate(rig.boards):
            moves = rig.moves(c, b)
            if board.place == "free" or (denied is not None and not moves):
                continue
            try:
                proof = _proof(rig, c, b, poses)
            except RealsimError:
                if moves:
                    raise
                continue  # as it is said, the board stands still in the image
            if proof is None:
                continue
            mode = "eye_in_hand" if camera.mount == "hand" else "eye_to_hand"
            if proof.decisive and (proof.best_mode == mode or not moves):
                if moves:
                    return reading_from_text(proof.best)
                denied = reading_from_text(proof.best)
            elif moves:
                said = proof.sentence
    if denied is not None:
        return denied
    raise InputError(
        f"how the poses are to be read is not clear from the file, and the images do not decide: "
        f"{said} Is every camera and every board where it is said to be (--cameras NAME=hand or "
        "fixed; --board on the table, --held-board in the hand)? Else give --reading, such as "
        "--reading rotvec,m."
    )


def _proof(rig: Rig, c: int, b: int, poses: RawPoses) -> ReadingProof | None:
    """Return what the views of a board by a camera say of the readings, None if they are too few.

    A board that stands still in the image tells no lens, and nothing of the poses.
    """
    camera, target = rig.cameras[c], rig.boards[b].target
    own = [s for s in rig.of_camera(c) if s.board == b and len(s.detection)]
    if len(own) < FEW_VIEWS:
        return None
    lens = camera.intrinsics0
    if lens is None:
        try:
            names = [s.name for s in own]
            lens = calibrate_intrinsics([s.detection for s in own], target, names=names).intrinsics
        except RealsimError:
            return None
    pairs = [
        (s.instant, pose.T_cam_board)
        for s in own[:PROOF_VIEWS]
        if (pose := estimate_board_pose(s.detection.points(target), s.detection.uv, lens))
        is not None
    ]
    rows = poses.subset([i for i, _ in pairs])
    candidates = [(str(r), rows.poses(r)) for r in rows.possible]
    return prove_reading(candidates, np.array([T for _, T in pairs]), target=target)


# --- the calibration ------------------------------------------------------------------------------


def _calibrated(rig: Rig, arm: str, console: Console) -> CamerasReport:
    given = [t for t in rig.instants if t.T_base_ee is not None]
    Ts = [t.T_base_ee for t in given if t.T_base_ee is not None]
    known = known_arm(arm, Ts, [t.joints for t in given], console)
    with console.stage("calibrate", f"{len(rig.cameras)} cameras, {len(rig.instants)} instants"):
        return calibrate_cameras(rig, arm=known)


def write_files(report: CamerasReport, out: Path, console: Console) -> list[Path]:
    """Write all files, and last the page, which tells that all are there; return it first."""
    from realsim_calibration.exports.frames import FrameNames
    from realsim_calibration.exports.write import write_exports

    (out / page.PAGE).unlink(missing_ok=True)
    files = [out / page.PAGE, write_cameras(report, out / CAMERAS_FILE)]
    for camera, own in zip(report.rig.cameras, report.cameras, strict=True):
        moved = any(
            rig_board.target is own.target and rig_board.place == "hand"
            for rig_board in report.rig.boards
        )
        names = FrameNames(name=camera.name, camera_optical=f"{camera.name}_optical_frame")
        if camera.mount == "fixed" and not moved:
            # The board does not hang on the hand: what the files call the hand is the base.
            names = replace(names, hand=names.robot_base)
        home = out / camera.name / "exports"
        files += write_exports(own, home, frames=names, tell=console.warn)
    write_bytes(out / page.PAGE, page.cameras_page(report).encode())
    return files


def _told(report: CamerasReport, files: list[Path], console: Console) -> bool:
    """Print a calibration; return whether no check is bad."""
    names = {c.name for c in report.rig.cameras}
    for old in sorted(files[0].parent.glob("*/exports")):
        if old.parent.name not in names:
            console.warn(
                f"'{old}' is of an earlier run: camera '{old.parent.name}' is not in this one."
            )
    console.table("Cameras", page.camera_header(report), page.camera_rows(report))
    if report.pairs:
        console.table("Pairs", page.PAIR_HEADER, page.pair_rows(report))
    odd = page.odd_rows(report)
    if odd:
        console.table("Views that disagree", page.ODD_HEADER, odd)
    show_checks(report.all_checks, console)
    console.say(f"report: {files[0]}")
    console.say(f"{len(files) - 1} files for programs beside it, a folder for each camera")
    passed = not any(c.verdict == "bad" for c in report.all_checks)
    console.result({"passed": passed, **document(report), "files": files})
    return passed


def place_fixed(
    source: Path, board_views: SessionStore, report: CamerasReport, console: Console
) -> None:
    """Give the session's own fixed cameras lens, place and depth bias, where these were found.

    Args:
        source: the session.
        board_views: what was calibrated; its instants are its views.
        report: the calibration.
        console: told what was done.
    """
    there, seen = camera_folders(source), open_cameras(board_views)
    for camera, own in zip(report.rig.cameras, report.cameras, strict=True):
        if camera.mount == "hand" or camera.name not in there:
            continue
        store = SessionStore.open(there[camera.name])
        claimed = {v.index: own.X for v in store.session.views}
        store.set_cameras(own.intrinsics, keep_refined(store, claimed))
        console.say(f"camera {camera.name} of the session is placed ({len(claimed)} views).")
        if camera.name in seen:
            numbers = [v.index for v in board_views.session.views]
            views = _with_depth(report, camera.name, seen[camera.name], numbers)
            if views:
                note_depth_bias(store, views, own)


def _with_depth(
    report: CamerasReport, name: str, images: SessionStore, numbers: list[int]
) -> list[DepthBoardView]:
    """Return the depth images of one camera's used views of the board that it was calibrated on."""
    target = report.camera(name).target
    boards = {b.name for b in report.rig.boards if b.target is target}
    return [
        DepthBoardView(
            index=numbers[v.instant], depth_m=images.depth_m(numbers[v.instant]),
            detection=v.detection, name=v.name,
        )
        for v in report.views
        if v.used and v.camera == name and v.board in boards
        and images.has_depth(numbers[v.instant])
    ]  # fmt: skip
