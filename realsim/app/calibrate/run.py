"""`realsim calibrate`: a session, a folder, pose files, or a capture that is still going on."""

from importlib import import_module
from pathlib import Path
from typing import Any

from realsim.app.calibrate import show
from realsim.app.console import Console
from realsim.errors import InputError

OUT = Path("calibration")
"""Where the calibration of a plain folder goes, if nobody says."""


BAG_ENDINGS = (".bag", ".mcap", ".db3")
"""Endings of recordings."""
TOLERANCE_MM = 1.0
"""What `--check` allows, if nobody says [mm at the objects]."""


def require_used(check: bool, live: bool, tolerance: float, options: dict[str, Any]) -> None:
    """Raise if an option was given that this way of calibrating does not look at.

    Raises:
        InputError: names the option and what it belongs to.
    """
    clock = options["clock_offset"] != "auto"
    given = [f"--{name.replace('_', '-')}" for name, value in options.items()
             if value and name not in ("out", "clock_offset")]  # fmt: skip
    given += ["--clock-offset"] * clock + ["--live"] * live + ["--out"] * (options["out"] != OUT)
    if check and given:
        raise InputError(f"{given[0]} has no meaning with --check, which calibrates nothing.")
    if not check and tolerance != TOLERANCE_MM:
        raise InputError("--tolerance belongs to --check: give both, or leave it out.")
    if options["cameras"] and (clock or live):
        name = "--live" if live else "--clock-offset"
        raise InputError(
            f"{name} is for one camera alone: calibrate it without --cameras, or leave {name} out."
        )


def run_calibrate(source: Path, console: Console, *, live: bool, **options: Any) -> bool:
    """Calibrate what `source` holds; return whether no check is bad.

    BLAS gets one thread: on matrices of 30 rows several wait for each other, which costs twice the
    processor time and more.

    Raises:
        InputError: source or options cannot be used.
    """
    from threadpoolctl import threadpool_limits

    import_module("scipy.linalg")  # it has a BLAS of its own, which must be there to be limited
    with threadpool_limits(1, user_api="blas"):
        return _run(source, console, live=live, **options)


def _run(source: Path, console: Console, *, live: bool, **options: Any) -> bool:
    """Calibrate what `source` holds; return whether no check is bad."""
    from realsim.app.calibrate.session import has_board_views_only, keep_board
    from realsim.app.stages import hint_of
    from realsim.store.opening import require_header
    from realsim.store.results import BOARD_FILE

    if options.get("cameras") is not None:
        from realsim.app.calibrate.cameras import run_cameras

        return run_cameras(source, console, options)
    alone = [f"--{o.replace('_', '-')}" for o in ("held_board", "moved_board") if options.get(o)]
    if alone:
        raise InputError(f"{alone[0]} is for several cameras: name them with --cameras.")
    require_header(source)
    if (source / "session.json").is_file() or has_board_views_only(source):
        lacks = has_board_views_only(source) and not (source / BOARD_FILE).exists()
        _refuse_folder_options({**options, "board": ""} if lacks else options)
        if lacks and options["board"]:
            keep_board(source, options["board"])
        return _run_session(source, console, options["arm"] or "", options["clock_offset"])
    require_no_bag(source, options["board"])
    if not source.is_dir():
        raise InputError(
            f"'{source}' is not a folder; a session (it holds session.json) or a folder of images "
            "with robot poses is expected."
        )
    if not options["board"] and options["board_poses"] is None:
        raise InputError(
            f"'{source}' holds no session.json, so it is not a session.{hint_of(source)} For a "
            "folder of images with robot poses say which target they show: --board "
            "charuco:5x7,square=33mm,marker=20mm,dict=6X6_100, or a file of `realsim board`."
        )
    request = _request(source, options, console)
    if live:
        from realsim.app.calibrate.live import run_live

        return run_live(request, console)
    from realsim.app.calibrate.folder import calibrate_folder

    result, files = calibrate_folder(request, console)
    show.show_report(result.hand_eye, result.checks, console)
    show.show_next_views(result.hand_eye, console)
    console.say(f"report: {files[0]}")
    console.say(f"for ROS, URDF, OpenCV and NumPy: {request.out / 'exports'}")
    console.result(show.report_document(result.hand_eye, result.checks, files))
    return not any(c.verdict == "bad" for c in result.checks)


def require_no_bag(source: Path, board: str) -> None:
    """Raise if the source is a recording.

    Raises:
        InputError: it is one; names the two commands that calibrate it.
    """
    inside = source.iterdir() if (source / "metadata.yaml").is_file() else (source,)
    if not any(p.suffix.lower() in BAG_ENDINGS for p in inside):
        return
    lab = source.stem or "lab"
    raise InputError(
        f"'{source}' is a recording. Make board views of it, then calibrate these:\n"
        f"  realsim import {source} {lab}/calibration/capture\n"
        f"  realsim calibrate {lab} --board "
        f"{board or 'charuco:5x7,square=33mm,marker=20mm,dict=6X6_100'}"
    )


def _run_session(source: Path, console: Console, arm: str, clock: str) -> bool:
    """Calibrate a session, also one that has board views only; return whether no check is bad."""
    from realsim.app.calibrate import session
    from realsim.app.stages import open_session
    from realsim.store.results import hand_eye_to_json

    board_only = session.has_board_views_only(source)
    if board_only:
        hand_eye = session.calibrate_board_only(source, console, arm, clock)
    else:
        store = open_session(source)
        hand_eye = session.calibrate_session(store, console, arm, clock)
        show.warn_of_far_views(hand_eye, store.session.views, console)
    show.show_hand_eye(hand_eye, console)
    console.say(f"report and pictures: {source / 'calibration' / 'report'}")
    if board_only:
        console.say(
            "There are no views of objects yet: their cameras are placed by the same command, once "
            "they are captured."
        )
    passed = not any(c.verdict == "bad" for c in hand_eye.checks)
    console.result({"passed": passed, **hand_eye_to_json(hand_eye)})
    return passed


def _refuse_folder_options(options: dict[str, Any]) -> None:
    """Raise if an option was given that a session answers itself."""
    mine = ("board", "poses", "reading", "key", "board_poses", "intrinsics", "eye_to_hand")
    given = [f"--{name.replace('_', '-')}" for name in mine if options.get(name)]
    if options.get("out", OUT) != OUT:
        raise InputError(
            f"--out {options['out']}: a session keeps its calibration itself, in calibration/. "
            "Leave --out away, or copy that folder afterwards."
        )
    if given:
        raise InputError(
            f"{', '.join(given)}: a session says these itself (calibration/board.json, robot.jsonl "
            "and session.json). Leave them out, or give a plain folder of images."
        )


def _request(source: Path, options: dict[str, Any], console: Console) -> Any:
    """Return the request for a plain folder; relative pose files may lie inside it."""
    from realsim.app.calibrate.folder import FolderRequest, require_free_results

    def inside(path: Path | None) -> Path | None:
        if path is None or path.exists() or path.is_absolute():
            return path
        return source / path if (source / path).exists() else path

    require_free_results(options["out"], source, console)
    return FolderRequest(
        images=source,
        out=options["out"],
        board=options["board"],
        poses=inside(options["poses"]),
        board_poses=inside(options["board_poses"]),
        reading=options["reading"],
        key=options["key"],
        intrinsics=inside(options["intrinsics"]),
        mode="eye_to_hand" if options["eye_to_hand"] else "eye_in_hand",
        arm=options["arm"] or "",
        clock=options["clock_offset"],
    )
