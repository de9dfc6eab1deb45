"""The hand-eye of a session that has board views only: known before the board is taken away."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim.app.calibrate.board_views import read_board_views, write_results
from realsim.app.console import Console
from realsim.app.stages import BOARD_VIEWS, require_sound
from realsim.records import HandEye
from realsim.store import SessionStore
from realsim.store.atomic import json_bytes, write_bytes
from realsim.store.results import HAND_EYE_FILE, hand_eye_to_json
from realsim.store.session_check import is_session
from realsim.untrusted.own_json import read_values


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationFolder:
    """The folder of a session that is not begun: its files have no list of checksums yet."""

    folder: Path
    """What will be the session's folder."""

    def has(self, relative: str) -> bool:
        """Return whether there is this file."""
        return (self.folder / relative).is_file()

    def read_json(self, relative: str) -> Any:
        """Return the values of a JSON file.

        Raises:
            InputError: it is missing or not JSON.
        """
        return read_values(self.folder / relative)

    def write_json(self, relative: str, value: Any) -> None:
        """Write plain JSON values, whole or not at all."""
        write_bytes(self.folder / relative, json_bytes(value))


def has_board_views_only(folder: Path) -> bool:
    """Return whether board views were captured there, and no view of objects yet."""
    return not is_session(folder) and (folder / BOARD_VIEWS / "session.json").is_file()


def calibrate_board_only(folder: Path, console: Console) -> HandEye:
    """Calibrate the hand-eye from the board views; no camera of a session is placed yet.

    Nothing is noted as done: once there is a session, `realsim calibrate` does it anew, lists the
    files with their checksums and places the cameras.

    Raises:
        InputError: no calibration/board.json, or a view is not as it was captured.
        DegenerateError: the views do not determine the hand-eye.
    """
    from realsim_calibration import calibrate_hand_eye_report

    files = CalibrationFolder(folder=folder)
    views_store = SessionStore.open(folder / BOARD_VIEWS)
    require_sound(views_store)
    with console.stage("calibrate", f"{len(views_store.session.views)} board views") as tick:
        seen, target, arm = read_board_views(files, views_store, tick)
        report = calibrate_hand_eye_report(seen, target, views_store.session.intrinsics, arm=arm)
        write_results(report, seen, files, views_store)
        files.write_json(HAND_EYE_FILE, hand_eye_to_json(report.hand_eye))
    return report.hand_eye
