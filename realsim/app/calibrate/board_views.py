"""The board views of a session: read them for the calibration, leave its results beside them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.console import Console, Tick
from realsim.arrays import Array
from realsim.errors import InputError, RealsimError
from realsim.geometry.dh import DhArm
from realsim.records import Target
from realsim.robots.arm import find_arm, known_chains
from realsim.robots.robot_files import same_name
from realsim.store import SessionStore, atomic
from realsim.untrusted.own_json import read_values, to_json
from realsim_calibration import (
    BoardView,
    DepthBoardView,
    HandEyeReport,
    estimate_depth_bias,
    find_target,
)
from realsim_calibration.depth.bias import DepthBiasReport
from realsim_calibration.fit.robot_error import matching_arm

BOARD_FILE = "calibration/board.json"
DEPTH_FILE = "calibration/depth_bias.json"
"""What is known of the depth camera's scale and offset."""
RESULTS = "calibration"
"""Folder of the session that takes report, pictures and exports."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationFolder:
    """The folder of a session that is not begun: its files have no list of checksums yet."""

    folder: Path
    """What will be the session's folder."""

    def write_json(self, relative: str, value: Any) -> None:
        """Write plain JSON values, whole or not at all."""
        atomic.write_json(self.folder / relative, value)


SessionFiles = SessionStore | CalibrationFolder
"""Files of a session by their paths inside it."""


def read_board_views(
    store: SessionFiles, views_store: SessionStore, arm: str, tick: Tick
) -> tuple[list[BoardView], Target, DhArm | None]:
    """Return the board views with the points found, the target, and the arm if it can be told.

    Args:
        store: what holds the target's file.
        views_store: the board views.
        arm: name or folder of the arm; empty = the one that the session names or the poses prove.
        tick: told how far the work is.

    Raises:
        InputError: no target file, a view without a robot pose, or views of another arm.
    """
    from realsim_calibration.targets.target_file import target_from_json

    if not (store.folder / BOARD_FILE).is_file():
        raise InputError(
            f"session '{store.folder}' has no {BOARD_FILE}, so the printed target is not known. "
            "`realsim board` writes one beside every sheet: copy it there."
        )
    target = target_from_json(read_values(store.folder / BOARD_FILE))
    views, camera = views_store.session.views, views_store.session.intrinsics
    taken_with = str(views_store.extra.get("arm", ""))
    named = find_arm(arm).chain if arm else None
    if named is not None and taken_with and not same_name(taken_with, named.name):
        raise InputError(
            f"the views of '{views_store.folder}' were captured with a {taken_with}, and --arm "
            f"{arm} is a {named.name}: its joints and links say nothing of these views. Leave "
            f"--arm out, or give --arm {taken_with}."
        )
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
    if named is None:
        return seen, target, arm_of(seen, taken_with)
    if any(view.joints is None for view in seen):
        raise InputError(
            f"--arm {arm} needs joint angles with every view; those of '{views_store.folder}' have "
            "none. Leave --arm out."
        )
    return seen, target, named.bare()


def arm_of(views: Sequence[BoardView], name: str = "") -> DhArm | None:
    """Return the arm that the joints and poses of all views prove, None where they do not.

    Of several with the same numbers the one of this name is taken, or else the first.
    """
    joints = [v.joints for v in views if v.joints is not None]
    if len(joints) < len(views) or len({len(q) for q in joints}) != 1:
        return None
    return arm_of_poses(np.array([v.T_base_ee for v in views]), np.array(joints), name)


def known_arm(
    name: str, Ts_base_ee: Sequence[Array], joints: Sequence[Array | None], console: Console
) -> DhArm | None:
    """Return the arm that was named, or that poses (4, 4) and joints [rad] prove, and tell it.

    Raises:
        InputError: an arm that is not known, or one without joints.
    """
    given = [q for q in joints if q is not None]
    complete = bool(given) and len(given) == len(Ts_base_ee) and len({len(q) for q in given}) == 1
    if name:
        arm = find_arm(name).chain.bare()
        if not complete:
            raise InputError(f"--arm {name} needs joint angles with every pose; there are none.")
        return arm
    if not complete:
        return None
    arm = arm_of_poses(np.array(Ts_base_ee), np.array(given))
    if arm is not None:
        console.say(f"joints and poses are those of a {arm.name}: its own errors are modelled.")
    else:
        console.warn(
            "the joints beside the poses are those of no arm that is known: they are not used. "
            "Name the arm: --arm ur5e, or its folder."
        )
    return arm


def arm_of_poses(Ts_base_ee: Array, joints: Array, name: str = "") -> DhArm | None:
    """Return the arm that poses (N, 4, 4) and joints (N, J) [rad] prove, None where they do not."""
    known = known_chains(joints.shape[1])
    arms = [known[key].bare() for key in sorted(known, key=lambda k: not same_name(k, name))]
    return matching_arm(joints, Ts_base_ee, arms)


def write_results(
    report: HandEyeReport, seen: Sequence[BoardView], store: SessionFiles,
    views_store: SessionStore, console: Console,
) -> None:  # fmt: skip
    """Write report, pictures, depth bias and the files for other tools into the session."""
    from realsim_calibration.exports.frames import FrameNames
    from realsim_calibration.exports.write import write_exports
    from realsim_calibration.report.page import PAGE_NAME, write_calibration_report

    folder = store.folder / RESULTS
    (folder / "report" / PAGE_NAME).unlink(missing_ok=True)  # written last: not whole without it
    used = {v.index for v in report.used}
    views = [
        DepthBoardView(
            index=v.index, depth_m=views_store.depth_m(v.index), detection=v.detection, name=v.label
        )
        for v in seen
        if v.index in used
    ]
    depth = note_depth_bias(store, views, report)
    write_exports(report, folder / "exports", frames=FrameNames(), tell=console.warn)
    write_calibration_report(report, folder / "report", images=views_store.rgb, depth_report=depth)


def note_depth_bias(
    store: SessionFiles, views: Sequence[DepthBoardView], report: HandEyeReport
) -> DepthBiasReport | None:
    """Return the depth camera's bias and note it in the session; None where it cannot be told."""
    try:
        found = estimate_depth_bias(
            views, report.target, report.intrinsics, shape=report.board,
            intrinsics_covariance=report.intrinsics_covariance,
        )  # fmt: skip
    except RealsimError as error:
        store.write_json(DEPTH_FILE, {"known": False, "why": str(error)})
        return None
    store.write_json(DEPTH_FILE, {"known": True, **depth_bias_to_json(found)})
    return found


def depth_bias_to_json(found: DepthBiasReport) -> dict[str, Any]:
    """Return a depth bias as JSON values: a prior for the registration, and its checks."""
    bias = found.bias
    return {
        "model": "1 / z_true = scale / z_measured + offset_per_m",
        "scale": bias.scale,
        "offset_per_m": bias.offset_per_m,
        "covariance": bias.covariance.tolist(),
        "noise_per_m": to_json(bias.noise_per_m),
        "range_m": [to_json(v) for v in bias.range_m],
        "separable": bias.separable,
        "checks": [to_json(check) for check in found.checks],
    }
