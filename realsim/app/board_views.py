"""The board views of a session: read them for the calibration, leave its results beside them."""

from collections.abc import Sequence

import numpy as np

from realsim.app.console import Tick
from realsim.errors import InputError
from realsim.geometry.dh import ARMS, DhArm
from realsim.records import Target
from realsim.store import SessionStore
from realsim_calibration import BoardView, HandEyeReport, find_target
from realsim_calibration.fit.robot_error import RobotErrorConfig, matching_arm

BOARD_FILE = "calibration/board.json"
RESULTS = "calibration"
"""Folder of the session that takes report, pictures and exports."""


def read_board_views(
    store: SessionStore, views_store: SessionStore, tick: Tick
) -> tuple[list[BoardView], Target, DhArm | None]:
    """Return the board views with the points found, the target, and the arm if it can be told.

    Raises:
        InputError: no target file, or a view without a robot pose.
    """
    from realsim_calibration.targets.target_file import target_from_json

    if not store.has(BOARD_FILE):
        raise InputError(
            f"session '{store.folder}' has no {BOARD_FILE}, so the printed target is not known. "
            "`realsim board` writes one beside every sheet: copy it there."
        )
    target = target_from_json(store.read_json(BOARD_FILE))
    views, camera = views_store.session.views, views_store.session.intrinsics
    seen: list[BoardView] = []
    for k, view in enumerate(views):
        if view.T_base_ee is None:
            raise InputError(f"board view {view.index} has no robot pose.")
        found = find_target(views_store.rgb(view.index), target, intrinsics=camera)
        seen.append(
            BoardView(
                index=view.index, T_base_ee=view.T_base_ee, detection=found, joints=view.joints
            )
        )
        tick(k + 1, len(views))
    return seen, target, arm_of(seen)


def arm_of(views: Sequence[BoardView]) -> DhArm | None:
    """Return the arm that the joints and poses of all views prove, None where they do not."""
    joints = [v.joints for v in views]
    if any(q is None for q in joints) or not views:
        return None
    Ts = np.array([v.T_base_ee for v in views])
    return matching_arm(np.array(joints), Ts, tuple(ARMS.values()), RobotErrorConfig())


def write_results(report: HandEyeReport, store: SessionStore, views_store: SessionStore) -> None:
    """Write report, pictures and the files for other tools into the session."""
    from realsim_calibration.exports import FrameNames, write_exports
    from realsim_calibration.report import write_calibration_report

    folder = store.folder / RESULTS
    write_exports(report, folder / "exports", frames=FrameNames())
    write_calibration_report(report, folder / "report", images=views_store.rgb)
