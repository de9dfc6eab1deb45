"""A calibration told: as tables on the console, and as values for `--json`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from realsim.app.console import Console
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim.records import Check, HandEye, RobotErrorMap, View
from realsim.records.calibration import worst_first
from realsim_calibration import HandEyeReport

NEXT_VIEWS = 3
"""Further views that are proposed."""
GAIN = 0.95
"""The proposed views are told of if together they bring a sigma below this part of what it is."""
MAP_REACH = 2.0
"""Gaps between the calibrated poses up to which a robot map holds (`RobotErrorMap.beyond`)."""
FAR_NAMED = 6
"""Views outside that are named."""


def report_document(
    report: HandEyeReport, checks: Sequence[Check], files: Sequence[Path]
) -> dict[str, object]:
    """Return what a program wants to know of a calibrated folder, for `--json`."""
    from realsim.untrusted.own_json import to_json

    in_hand = report.mode == "eye_in_hand"
    return {
        "passed": not any(c.verdict == "bad" for c in checks),
        "mode": report.mode,
        "T_ee_cam" if in_hand else "T_base_cam": report.X,
        "T_base_board" if in_hand else "T_ee_board": report.Z,
        "here_sigma_mm": report.here_mm,
        "here_sigma_deg": report.here_deg,
        "here_covariance": report.X_here_covariance,
        "clock": None if report.clock is None else to_json(report.clock),
        "sigma_mm": report.sigma_mm,
        "sigma_deg": report.sigma_deg,
        "covariance": report.X_covariance,
        "T_alone": report.X_alone,
        "alone_from": report.plain_name,
        "held_out_px": report.held_out_px,
        "held_out_mm": report.held_out_mm,
        "held_out_deg": report.held_out_deg,
        "intrinsics": to_json(report.intrinsics),
        "view_indices": [v.index for v in report.used],
        "rejected": report.rejected,
        "checks": [to_json(c) for c in checks],
        "files": files,
    }


def show_hand_eye(hand_eye: HandEye, console: Console) -> None:
    """Print the hand-eye of a session and what speaks for it."""
    t, w = hand_eye.T_ee_cam[:3, 3] * 1e3, np.degrees(se3.log_so3(hand_eye.T_ee_cam[:3, :3]))
    mm, deg = hand_eye.here_sigmas
    rows = [
        ["camera in tool, translation [mm]", " ".join(f"{v:.2f}" for v in t)],
        ["camera in tool, rotation vector [deg]", " ".join(f"{v:.3f}" for v in w)],
        ["1 sigma (worst axis) for this arm as it moves here", f"{mm:.3f} mm / {deg:.4f} deg"],
        [
            "the same for another arm, a new mount, a drawing",
            f"{hand_eye.sigma_mm:.3f} mm / {hand_eye.sigma_deg:.4f} deg",
        ],
        ["reprojection of held-out views", f"{hand_eye.held_out_px:.3f} px"],
        ["views used / rejected", f"{len(hand_eye.view_indices)} / {len(hand_eye.rejected)}"],
    ]
    console.table("Hand-eye calibration", ["", "value"], rows)
    for index, reason in hand_eye.rejected:
        console.warn(f"board view {index} was not used: {reason}")
    show_checks([c for c in hand_eye.checks if c.verdict != "good"], console)


def warn_of_far_views(hand_eye: HandEye, views: Sequence[View], console: Console) -> None:
    """Warn of views whose robot pose is outside of the poses that the robot's map was fitted on."""
    known = hand_eye.robot_map
    posed = [v for v in views if v.T_base_ee is not None]
    if not isinstance(known, RobotErrorMap) or not posed:
        return
    beyond = known.beyond(np.array([v.T_base_ee for v in posed]))
    far = [f"{v.index} ({b:.1f})" for v, b in zip(posed, beyond, strict=True) if b > MAP_REACH]
    if far:
        console.warn(
            f"{len(far)} of {len(posed)} views are outside of the calibrated poses, where the "
            f"robot's error map is a guess: {', '.join(far[:FAR_NAMED])}"
            f"{', ...' if len(far) > FAR_NAMED else ''} (in gaps between calibrated poses, "
            f"up to {MAP_REACH:g} is inside). Calibrate with board views where these were taken."
        )


def show_report(report: HandEyeReport, checks: Sequence[Check], console: Console) -> None:
    """Print a calibration: figures, every check, every dropped view."""
    from realsim_calibration.report.summary import PLACES_HEADER, places_rows, summary_rows

    console.table("Where the camera is", PLACES_HEADER, places_rows(report))
    console.table("Calibration", ["", "value"], summary_rows(report))
    show_checks(checks, console)
    for view in report.views:
        if not view.used:
            console.warn(f"{view.label} was not used: {view.reason}")


def show_next_views(report: HandEyeReport, console: Console) -> None:
    """Print the views that would lower the uncertainty most."""
    from realsim_calibration import choose_next_views
    from realsim_calibration.planning.view_proposals import propose_views

    try:
        views = choose_next_views(report, propose_views(report), NEXT_VIEWS)
    except RealsimError:
        return  # a calibration that is this poor has said so in its checks
    if not views:
        return
    last = views[-1]
    if last.sigma_mm > GAIN * report.here_mm and last.sigma_deg > GAIN * report.here_deg:
        joints = any(v.joints is None for v in report.used)
        console.say(
            f"further views like these gain nothing: sigma stays at {report.here_mm:.2f} mm and "
            f"{report.here_deg:.3f} deg for this arm. The arm's own errors are left"
            + ("; joint angles with the poses let them be modelled." if joints else ".")
        )
        return
    rows = [
        [
            f"{k + 1}", f"{100 * v.distance_m:.0f} cm", f"{v.tilt_deg:.0f} deg",
            f"{v.roll_deg:+.0f} deg", f"{v.sigma_mm:.2f} mm / {v.sigma_deg:.3f} deg",
        ]
        for k, v in enumerate(views)
    ]  # fmt: skip
    header = ["view", "distance", "tilt", "roll in the image", "sigma for this arm then"]
    console.table("Further views that would help most, in this order", header, rows)


def show_checks(checks: Sequence[Check], console: Console) -> None:
    """Print checks, the worst first."""
    if not checks:
        return
    rows = [[c.name, c.verdict, c.words] for c in worst_first(checks)]
    console.table("Checks", ["check", "verdict", "what was found"], rows)
