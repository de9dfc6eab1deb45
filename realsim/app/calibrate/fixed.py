"""What a calibration of several cameras leaves in the fixed cameras of a session."""

from pathlib import Path

from realsim.app.calibrate.board_views import note_depth_bias
from realsim.app.console import Console
from realsim.app.register.results import keep_refined
from realsim.store import SessionStore
from realsim.store.cameras import camera_folders, open_cameras
from realsim_calibration import DepthBoardView
from realsim_calibration.cameras.results import CamerasReport


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
