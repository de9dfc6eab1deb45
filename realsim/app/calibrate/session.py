"""The hand-eye of a session, also of one with board views only: before the board is taken away."""

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np

from realsim.app.calibrate import board_views
from realsim.app.calibrate.clock import mend_views
from realsim.app.console import Console, Tick
from realsim.app.stages import BOARD_VIEWS, content_key, note, require_sound
from realsim.errors import InputError
from realsim.records import HandEye
from realsim.store import SessionStore
from realsim.store.atomic import write_json
from realsim.store.provenance import is_current
from realsim.store.results import BOARD_FILE, HAND_EYE_FILE, hand_eye_to_json
from realsim.store.session_check import is_session


def calibrate_session(
    store: SessionStore, console: Console, arm: str = "", clock: str = "auto"
) -> HandEye:
    """Calibrate the hand-eye from the board views and place every camera of the session.

    Args:
        store: the session.
        console: told how far the work is.
        arm: name or folder of the arm; empty = the one that the session names or the poses prove.
        clock: offset of the camera's clock: auto, off, or seconds.

    Raises:
        InputError: there are no board views, or no calibration/board.json.
        DegenerateError: the views do not determine the hand-eye.
    """
    from realsim.store import load_hand_eye, save_hand_eye

    folder = store.folder / BOARD_VIEWS
    if not (folder / "session.json").is_file():
        raise InputError(
            f"session '{store.folder}' has no board views: {folder} is missing. Capture them first "
            "(`realsim plan --board-views --out board_plan.json`, then `realsim capture "
            f"{shlex.quote(str(store.folder))} --plan board_plan.json --board TARGET ...`), or "
            "place the cameras by importing a calibration."
        )
    views_store = SessionStore.open(folder)
    require_sound(views_store)
    made_of = (folder / "robot.jsonl", store.folder / BOARD_FILE, folder / "session.json")
    key = arm + ("" if clock == "auto" else clock) + content_key(*made_of)
    with console.stage("calibrate", f"{len(views_store.session.views)} board views") as tick:
        if is_current(store, "calibrate", key):
            hand_eye = load_hand_eye(store)
        else:
            hand_eye = _fitted(store, views_store, arm, clock, console, tick)
            save_hand_eye(store, hand_eye)
        place_cameras(store, hand_eye)
        read = (BOARD_FILE, f"{BOARD_VIEWS}/robot.jsonl", f"{BOARD_VIEWS}/rgb/*")
        asked = {"arm": arm, "clock": clock}
        note(store, "calibrate", console, request=asked, inputs=read, key=key)
    return hand_eye


def place_cameras(store: SessionStore, hand_eye: HandEye) -> None:
    """Write T_world_cam for every view that has a robot pose, robot errors corrected.

    Cameras that a registration has refined stay refined where the calibration says the same again.
    """
    from realsim.app.register.results import keep_refined

    cameras = {
        v.index: hand_eye.camera_poses(v.T_base_ee, v.joints)
        for v in store.session.views
        if v.T_base_ee is not None
    }
    store.set_cameras(hand_eye.intrinsics, keep_refined(store, cameras))


def keep_board(folder: Path, board: str) -> None:
    """Write the target of board views that came without one, such as those of a recording.

    Raises:
        InputError: no target is meant.
    """
    from realsim.app.calibrate.folder import target_of
    from realsim_calibration.targets.target_file import target_to_json

    write_json(folder / BOARD_FILE, target_to_json(target_of(board)))


def has_board_views_only(folder: Path) -> bool:
    """Return whether board views were captured there, and no view of objects yet."""
    return not is_session(folder) and (folder / BOARD_VIEWS / "session.json").is_file()


def calibrate_board_only(folder: Path, console: Console, arm: str, clock: str) -> HandEye:
    """Calibrate the hand-eye from the board views; no camera of a session is placed yet.

    Nothing is noted as done: once there is a session, `realsim calibrate` does it anew, lists the
    files with their checksums and places the cameras.

    Raises:
        InputError: no calibration/board.json, or a view is not as it was captured.
        DegenerateError: the views do not determine the hand-eye.
    """
    files = board_views.CalibrationFolder(folder=folder)
    views_store = SessionStore.open(folder / BOARD_VIEWS)
    require_sound(views_store)
    with console.stage("calibrate", f"{len(views_store.session.views)} board views") as tick:
        hand_eye = _fitted(files, views_store, arm, clock, console, tick)
        files.write_json(HAND_EYE_FILE, hand_eye_to_json(hand_eye))
    return hand_eye


def _fitted(
    files: board_views.SessionFiles, views_store: SessionStore, arm: str, clock: str,
    console: Console, tick: Tick,
) -> HandEye:  # fmt: skip
    """Calibrate from the board views, and write the report."""
    from realsim_calibration import calibrate_hand_eye_report

    seen, target, known = board_views.read_board_views(files, views_store, arm, tick)
    camera = views_store.session.intrinsics
    times = np.array([v.time_s for v in views_store.session.views])
    seen, at = mend_views(seen, times, target, camera, clock, console)
    report = replace(calibrate_hand_eye_report(seen, target, camera, arm=known), clock=at)
    board_views.write_results(report, seen, files, views_store, console)
    return report.hand_eye
