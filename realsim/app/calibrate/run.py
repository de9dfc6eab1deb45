"""`realsim calibrate`: a session, a folder, pose files, or a capture that is still going on."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.console import Console
from realsim.errors import InputError, RealsimError
from realsim.geometry import se3
from realsim.records import Check, HandEye
from realsim_calibration import HandEyeReport

NEXT_VIEWS = 3
"""Further views that are proposed."""
ORDER = ("bad", "warn", "unknown", "good")


def run_calibrate(source: Path, console: Console, *, live: bool, **options: Any) -> bool:
    """Calibrate what `source` holds; return whether no check is bad.

    Raises:
        InputError: source or options cannot be used.
    """
    from realsim.app.calibrate.board_only import has_board_views_only

    if (source / "session.json").is_file() or has_board_views_only(source):
        _refuse_folder_options(options)
        return _run_session(source, console)
    if not source.is_dir():
        raise InputError(
            f"'{source}' is not a folder; a session (it holds session.json) or a folder of images "
            "with robot poses is expected."
        )
    if not options["board"] and options["board_poses"] is None:
        inner = sorted(p.parent.name for p in source.glob("*/session.json"))
        hint = f" Did you mean {', '.join(str(source / n) for n in inner)}?" if inner else ""
        raise InputError(
            f"'{source}' holds no session.json, so it is not a session.{hint} For a folder of "
            "images with robot poses say which target they show: --board "
            "charuco:5x7,square=33mm,marker=20mm,dict=6X6_100, or a file of `realsim board`."
        )
    request = _request(source, options)
    if live:
        from realsim.app.calibrate.live import run_live

        return run_live(request, console)
    from realsim.app.calibrate.folder import calibrate_folder

    result, files = calibrate_folder(request, console)
    show_report(result.hand_eye, result.checks, console)
    show_next_views(result.hand_eye, console)
    console.say(f"report: {files[0]}")
    console.say(f"{len(files) - 1} pictures and files for other tools beside it, in {request.out}")
    console.result(report_document(result.hand_eye, result.checks, files))
    return not any(c.verdict == "bad" for c in result.checks)


def _run_session(source: Path, console: Console) -> bool:
    """Calibrate a session, also one that has board views only; return whether no check is bad."""
    from realsim.app.calibrate.board_only import calibrate_board_only, has_board_views_only
    from realsim.app.stages import calibrate_session, open_session
    from realsim.store.results import hand_eye_to_json

    board_only = has_board_views_only(source)
    if board_only:
        hand_eye = calibrate_board_only(source, console)
    else:
        hand_eye = calibrate_session(open_session(source), console)
    show_hand_eye(hand_eye, console)
    console.say(f"report and pictures: {source / 'calibration' / 'report'}")
    if board_only:
        console.say(
            "There are no views of objects yet: their cameras are placed by the same command, once "
            "they are captured."
        )
    passed = not any(c.verdict == "bad" for c in hand_eye.checks)
    console.result({"passed": passed, **hand_eye_to_json(hand_eye)})
    return passed


def report_document(
    report: HandEyeReport, checks: Sequence[Check], files: Sequence[Path]
) -> dict[str, object]:
    """Return what a program wants to know of a calibrated folder, for `--json`."""
    from realsim.store.records_json import check_to_json, intrinsics_to_json

    in_hand = report.mode == "eye_in_hand"
    return {
        "passed": not any(c.verdict == "bad" for c in checks),
        "mode": report.mode,
        "T_ee_cam" if in_hand else "T_base_cam": report.X,
        "T_base_board" if in_hand else "T_ee_board": report.Z,
        "sigma_mm": report.sigma_mm,
        "sigma_deg": report.sigma_deg,
        "covariance": report.X_covariance,
        "held_out_px": report.held_out_px,
        "held_out_mm": report.held_out_mm,
        "held_out_deg": report.held_out_deg,
        "intrinsics": intrinsics_to_json(report.intrinsics),
        "view_indices": [v.index for v in report.used],
        "rejected": report.rejected,
        "checks": [check_to_json(c) for c in checks],
        "files": files,
    }


def _refuse_folder_options(options: dict[str, Any]) -> None:
    """Raise if an option was given that a session answers itself."""
    mine = ("board", "poses", "reading", "key", "board_poses", "camera", "robot", "eye_to_hand")
    given = [f"--{name.replace('_', '-')}" for name in mine if options.get(name)]
    if given:
        raise InputError(
            f"{', '.join(given)}: a session says these itself (calibration/board.json, robot.jsonl "
            "and session.json). Leave them out, or give a plain folder of images."
        )


def _request(source: Path, options: dict[str, Any]) -> Any:
    """Return the request for a plain folder; relative pose files may lie inside it."""
    from realsim.app.calibrate.folder import CALIBRATED, MADE_OF, FolderRequest, made_of
    from realsim.app.outputs import require_free_folder

    def inside(path: Path | None) -> Path | None:
        if path is None or path.exists() or path.is_absolute():
            return path
        return source / path if (source / path).exists() else path

    require_free_folder(options["out"], "--out", CALIBRATED, (MADE_OF, (made_of(source),)))
    return FolderRequest(
        images=source,
        out=options["out"],
        board=options["board"],
        poses=inside(options["poses"]),
        board_poses=inside(options["board_poses"]),
        reading=options["reading"],
        key=options["key"],
        camera=inside(options["camera"]),
        mode="eye_to_hand" if options["eye_to_hand"] else "eye_in_hand",
        robot=options["robot"],
    )


def show_hand_eye(hand_eye: HandEye, console: Console) -> None:
    """Print the hand-eye of a session and what speaks for it."""
    t, w = hand_eye.T_ee_cam[:3, 3] * 1e3, np.degrees(se3.log_so3(hand_eye.T_ee_cam[:3, :3]))
    rows = [
        ["camera in tool, translation [mm]", " ".join(f"{v:.2f}" for v in t)],
        ["camera in tool, rotation vector [deg]", " ".join(f"{v:.3f}" for v in w)],
        ["1 sigma (worst axis)", f"{hand_eye.sigma_mm:.3f} mm / {hand_eye.sigma_deg:.4f} deg"],
        ["reprojection of held-out views", f"{hand_eye.held_out_px:.3f} px"],
        ["views used / rejected", f"{len(hand_eye.view_indices)} / {len(hand_eye.rejected)}"],
    ]
    console.table("Hand-eye calibration", ["", "value"], rows)
    for index, reason in hand_eye.rejected:
        console.warn(f"board view {index} was not used: {reason}")
    show_checks([c for c in hand_eye.checks if c.verdict != "good"], console)


def show_report(report: HandEyeReport, checks: Sequence[Check], console: Console) -> None:
    """Print a calibration: figures, every check, every dropped view."""
    from realsim_calibration.report import summary_rows

    console.table("Calibration", ["", "value"], [list(row) for row in summary_rows(report)])
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
    rows = [
        [
            f"{k + 1}", f"{100 * v.distance_m:.0f} cm", f"{v.tilt_deg:.0f} deg",
            f"{v.roll_deg:+.0f} deg", f"{v.sigma_mm:.2f} mm / {v.sigma_deg:.3f} deg",
        ]
        for k, v in enumerate(views)
    ]  # fmt: skip
    header = ["view", "distance", "tilt", "roll in the image", "sigma expected then"]
    console.table("Further views that would help most, in this order", header, rows)


def show_checks(checks: Sequence[Check], console: Console) -> None:
    """Print checks, the worst first."""
    if not checks:
        return
    ordered = sorted(checks, key=lambda c: ORDER.index(c.verdict))
    rows = [[c.name, c.verdict, f"{c.sentence} {c.advice}".strip()] for c in ordered]
    console.table("Checks", ["check", "verdict", "what was found"], rows)
