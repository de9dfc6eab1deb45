"""`realsim capture`: drive a plan with a robot, or in the simulated lab, into a session."""

import signal
import sys
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.calibrate.board_views import BOARD_FILE
from realsim.app.capture.devices import open_devices
from realsim.app.capture.fixed import FixedStores, fixed_stores, open_fixed
from realsim.app.console import Console, shortened
from realsim.app.stages import BOARD_VIEWS, save_starts
from realsim.arrays import UInt8
from realsim.errors import InputError
from realsim.records import CaptureSession, Target
from realsim.store import SessionStore
from realsim.store.atomic import only_run_in
from realsim_capture_plans.capturing import contact_sheet
from realsim_capture_plans.capturing.capture import (
    CaptureConfig,
    CaptureJob,
    CaptureSummary,
    capture,
    check_views,
    dry_run,
)
from realsim_capture_plans.capturing.operator import LineOperator, Operator
from realsim_capture_plans.devices.interfaces import Arm, DepthCamera, DeviceError
from realsim_capture_plans.planning.record import CapturePlan

if TYPE_CHECKING:
    from realsim_capture_plans.lab import SimulatedLab

DRY_RUN_SPEED = 0.25
"""Share of the plan's speed, in a dry run: slow enough to reach the stop button."""
BOARD_POINTS = 12
"""Points of the target that a view must show, three tags: fewer hardly turn the fit."""
BOARD_SHRINK = 0.5
"""The target is first looked for in an image of half the size: three times as quick."""
NAMED = 6
"""Views whose reasons are printed."""
TERMINATED = 143
"""Exit code of a process that was asked to end (128 + SIGTERM), as shells count."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureRequest:
    """What the command line asks for."""

    out: Path
    """The session's folder."""
    plan: str
    """Plan file, or shipped:NAME."""
    arm: str | None = None
    """Name or folder of the arm; None is the plan's."""
    robot_host: str = ""
    """Address of the robot's controller; empty with `simulated`."""
    simulated: bool = False
    """The simulated lab instead of devices."""
    camera: str | None = None
    """Serial number of the RealSense; None where one is connected."""
    fixed_cameras: str = ""
    """Cameras that stand still: left=SERIAL,right=SERIAL."""
    board: str = ""
    """Calibration target: its file or one line. The views are then the session's board views."""
    dry_run: bool = False
    """Drive slowly, look, store nothing."""
    speed: float | None = None
    """Share of the plan's speed; None is 1, in a dry run `DRY_RUN_SPEED`."""
    settle_s: float | None = None
    """Waited after a move [s]; None is the plan's, in the simulated lab 0."""
    no_input: bool = False
    """Nobody is asked: trouble ends the run."""
    views: tuple[int, ...] = ()
    """Only these views; empty = all."""
    retake: tuple[int, ...] = ()
    """Views to take again although they are stored."""
    seed: int = 0
    """Seed of the simulated lab."""
    objects: int = 5
    """In the simulated lab."""


def run_capture(request: CaptureRequest, console: Console) -> bool:
    """Capture into the session, or go on with it; return whether everything asked for is there.

    Raises:
        InputError: plan, target, robot or session do not belong together.
    """
    from threadpoolctl import threadpool_limits

    from realsim_capture_plans.plan_files.plan_json import resolve_plan

    plan = resolve_plan(request.plan)
    target = _target(request, plan)
    check_views(plan, [*request.views, *request.retake])
    config = _config(request, plan)
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(limits=1))
        stack.enter_context(_ends_on_request())
        try:
            arm, camera, lab = stack.enter_context(open_devices(request, plan, target))
            if request.dry_run:
                return _rehearse(request, plan, (arm, camera), (config, target), console)
            assert camera is not None  # only a rehearsal does without
            named = open_fixed(request.fixed_cameras, request.simulated, stack)
            store = _session(request, plan, (arm, camera), target)
            stack.enter_context(only_run_in(store.folder))
            fixed = fixed_stores(store, named)
            work = (config, store, target, lab, fixed)
            return _carry_out(request, plan, (arm, camera), work, console)
        except DeviceError as error:
            sys.stderr.write(f"trouble: {error}\n")
            console.say(_how_it_stands(request, target))
            return False


def _how_it_stands(request: CaptureRequest, target: Target | None) -> str:
    """Return what a run that a device ended leaves behind."""
    folder = request.out if target is None else request.out / BOARD_VIEWS
    if request.dry_run:
        return "stopped; a dry run stores nothing."
    if not (folder / "session.json").is_file():
        return "nothing was begun, and nothing is stored."
    return "stopped; what is stored is safe, and the same command goes on from here."


def _carry_out(
    request: CaptureRequest,
    plan: CapturePlan,
    devices: tuple[Arm, DepthCamera],
    work: tuple[CaptureConfig, SessionStore, Target | None, "SimulatedLab | None", FixedStores],
    console: Console,
) -> bool:
    """Capture, and show what was captured however it ended."""
    arm, camera = devices
    config, store, target, lab, fixed = work
    intrinsics = camera.intrinsics
    size = (intrinsics.width, intrinsics.height)
    taken, is_due = contact_sheet.Thumbnails(contact_sheet.cell_size(len(plan), size)[1:]), False
    try:
        with _operator(request, f"{request.out}   {arm.name}, {camera.name}", console) as operator:
            job = CaptureJob(
                operator=operator, views=request.views or None, retake=request.retake,
                on_view=taken.add, board_check=_board_check(target), fixed=fixed,
            )  # fmt: skip
            summary = capture(plan, arm, camera, store, config=config, job=job)
        # An earlier run may have been killed before it wrote it.
        is_due = not store.has(contact_sheet.SHEET_FILE)
        if lab is not None and target is None:
            _give_models(lab, store)
        show_summary(summary, console)
        console.result(_document(store.folder, summary, len(store.completed), len(plan)))
    finally:
        if taken.images or is_due:  # a run that was refused changes nothing
            title = f"{request.out.resolve().name}, {arm.name}, {camera.name}"
            sheet = contact_sheet.write_contact_sheet(store, len(plan), title, taken)
            console.say(f"contact sheet  {store.folder / sheet}")
            console.say(
                f"stored         {len(store.completed)} of {len(plan)} views, {store.folder}"
            )
    return summary.complete


def _rehearse(
    request: CaptureRequest,
    plan: CapturePlan,
    devices: tuple[Arm, DepthCamera | None],
    work: tuple[CaptureConfig, Target | None],
    console: Console,
) -> bool:
    """Drive slowly and look, where there is a camera; nothing is stored."""
    config, target = work
    arm, camera = devices
    if camera is None:
        console.say("no RealSense camera is connected: the moves are driven, nothing is looked at.")
    name = "no camera" if camera is None else camera.name
    with _operator(request, f"{arm.name}, {name}", console) as operator:
        job = CaptureJob(
            operator=operator, views=request.views or None, board_check=_board_check(target)
        )
        summary = dry_run(plan, arm, camera, config=config, job=job)
    show_summary(summary, console, dry=True)
    console.result(_document(None, summary, 0, len(plan)))
    return summary.complete


def _config(request: CaptureRequest, plan: CapturePlan) -> CaptureConfig:
    """Return speed and settle time as asked for, else those of plan and devices."""
    usual = DRY_RUN_SPEED if request.dry_run else 1.0
    settle = 0.0 if request.simulated else plan.config.settle_s
    return CaptureConfig(
        settle_s=settle if request.settle_s is None else request.settle_s,
        speed_scale=usual if request.speed is None else request.speed,
    )


def _target(request: CaptureRequest, plan: CapturePlan) -> Target | None:
    """Return the calibration target that the plan is made for, if it is.

    Raises:
        InputError: a board plan without a target, or the other way round.
    """
    from realsim.app.calibrate.folder import target_of

    if not request.board:
        if plan.kind == "calibration":
            raise InputError(
                f"{request.plan} goes round a calibration target, and --board does not say which: "
                "give the file that `realsim board` wrote beside the sheet."
            )
        return None
    if plan.kind == "hemisphere":
        raise InputError(
            f"{request.plan} goes round a scene of objects; --board belongs to a plan of board "
            "views (`realsim plan --board-views`). Leave --board out, or give that plan."
        )
    return target_of(request.board)


# --- who is told ------------------------------------------------------------------------------


@contextmanager
def _ends_on_request() -> Generator[None]:
    """Turn a request to end (SIGTERM) into an orderly one: terminal and devices are given back."""

    def end(signum: int, frame: Any) -> None:
        sys.exit(TERMINATED)

    try:
        before = signal.signal(signal.SIGTERM, end)
    except ValueError:  # not the main thread: whoever runs that handles signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _operator(request: CaptureRequest, title: str, console: Console) -> Generator[Operator]:
    """Open the terminal view where a person sits at it, else write lines."""
    from realsim_capture_plans.capturing.operator import TerminalOperator, is_terminal

    if not request.no_input and not console.quiet and is_terminal():
        with TerminalOperator(title) as operator:
            yield operator
    else:
        yield LineOperator(_line_writer(console))


def _line_writer(console: Console) -> Callable[[str], None]:
    """Return a function that writes a line to stderr; a quiet console only gets trouble."""

    def write(text: str) -> None:
        if not console.quiet or text.startswith("trouble"):
            with suppress(BrokenPipeError):
                sys.stderr.write(text + "\n")
                sys.stderr.flush()

    return write


def _board_check(target: Target | None) -> Callable[[UInt8], str] | None:
    """Return what says whether the target can be seen; None without a target."""
    if target is None:
        return None
    from realsim_calibration import find_target

    total = len(target.points_board)
    needed = min(BOARD_POINTS, total)

    def check(rgb: UInt8) -> str:
        import cv2

        half = cv2.resize(rgb, None, fx=BOARD_SHRINK, fy=BOARD_SHRINK, interpolation=cv2.INTER_AREA)
        if len(find_target(np.asarray(half, dtype=np.uint8), target).point_ids) >= needed:
            return ""
        found = find_target(rgb, target)
        if len(found.point_ids) >= needed:
            return ""
        why = f" ({found.rejected[0]})" if found.rejected else ""
        return f"board: {len(found.point_ids)} of its {total} points are found{why}"

    return check


# --- the session ------------------------------------------------------------------------------


def _session(
    request: CaptureRequest,
    plan: CapturePlan,
    devices: tuple[Arm, DepthCamera],
    target: Target | None,
) -> SessionStore:
    """Open the session that an earlier run began, or begin it; board views have one of their own.

    Raises:
        InputError: the folder is something else, or its board is another one.
    """
    out, (arm, camera) = request.out, devices
    if out.exists() and not out.is_dir():
        raise InputError(f"'{out}' is a file; OUT is the folder of a session, made or filled.")
    folder = out if target is None else out / BOARD_VIEWS
    header = {
        "plan_hash": plan.content_hash,
        "arm": arm.name,
        "camera": camera.name,
        "arm_description": arm.description,
        "camera_description": camera.description,
        # The plans are made for an arm that stands upright on the table.
        "gravity_up_world": [0.0, 0.0, 1.0],
    }
    if (folder / "session.json").is_file():
        store = SessionStore.open(folder)
        _check_same_lab(request, store)
    else:
        _check_free(out)
        if request.simulated:
            header["lab"] = {"seed": request.seed, "objects": request.objects}
        session = CaptureSession(
            name=out.resolve().name, intrinsics=camera.intrinsics, depth_unit_m=camera.depth_unit_m
        )
        store = SessionStore.create(folder, session, header)
    _keep_board(out, target)
    return store


def _check_free(out: Path) -> None:
    """Refuse a folder that holds something else: nothing of anybody is mixed with a session."""
    from realsim.store.opening import finish_beginning
    from realsim.store.session_check import is_session

    finish_beginning(out)
    if is_session(out) and not (out / "session.json").is_file():
        raise InputError(
            f"'{out}' holds a session whose session.json is gone. `realsim check {out} --repair` "
            "makes it anew from what is left; then the same command goes on."
        )
    known = {"session.json", "calibration", "plan.json", "reports"}
    other = sorted(p.name for p in out.iterdir() if p.name not in known) if out.is_dir() else []
    if other and not (out / "session.json").is_file():
        raise InputError(
            f"'{out}' is not empty and holds no session ({', '.join(other[:4])}). Choose a new "
            "folder, or the session that is to go on."
        )


def _check_same_lab(request: CaptureRequest, store: SessionStore) -> None:
    """Refuse to go on in another simulated lab than the one that was begun in."""
    lab = {"seed": request.seed, "objects": request.objects} if request.simulated else None
    if (then := store.extra.get("lab", lab)) != lab:
        raise InputError(
            f"'{store.folder}' was begun {_in_lab(then)}, not {_in_lab(lab)}: give the same "
            "--seed and --objects, or a new folder."
        )


def _in_lab(lab: dict[str, int] | None) -> str:
    if lab is None:
        return "with devices"
    return "in the simulated lab with " + ", ".join(f"--{k} {v}" for k, v in lab.items())


def _keep_board(out: Path, target: Target | None) -> None:
    """Put the target where `realsim calibrate` looks for it, listed once there is a session."""
    from realsim.store.atomic import json_bytes, write_bytes
    from realsim_calibration.targets.target_file import target_from_json, target_to_json

    path = out / BOARD_FILE
    main = SessionStore.open(out) if (out / "session.json").is_file() else None
    if target is not None:
        data = target_to_json(target)
        if path.is_file():
            from realsim.untrusted.own_json import read_values

            if target_to_json(target_from_json(read_values(path))) != data:
                raise InputError(
                    f"{path} describes another target than --board. Capture into a new folder; "
                    "views of two targets cannot be calibrated as one."
                )
        elif main is None:
            write_bytes(path, json_bytes(data))
    if path.is_file() and main is not None:
        main.write_bytes(BOARD_FILE, path.read_bytes())
    elif target is not None and main is not None:
        main.write_json(BOARD_FILE, target_to_json(target))


def _give_models(lab: "SimulatedLab", store: SessionStore) -> None:
    """Leave what a real lab has, too: the objects' models and a person's rough poses."""
    from realsim.formats.bop.models import save_models

    if not store.has("registration/starts.json"):
        save_models(store.folder / "models", lab.models)
        starts = lab.operator_starts(np.random.default_rng([lab.config.seed, 2]))
        save_starts(store, starts, "rough poses given by the simulated operator")


# --- what is shown ----------------------------------------------------------------------------


def _document(
    folder: Path | None, summary: CaptureSummary, stored: int, planned: int
) -> dict[str, object]:
    """Return what a program wants to know, for `--json`; no folder in a dry run."""
    return {"session": folder, "stored": stored, "planned": planned, "summary": summary}


def show_summary(summary: CaptureSummary, console: Console, *, dry: bool = False) -> None:
    """Print what was captured, what was taken again and why, and what is doubtful."""
    rows: list[list[object]] = [
        ["visited" if dry else "captured", summary.captured, ""],
        ["there already", summary.skipped, ""],
        ["frames taken again", len(summary.rejected), _reasons(summary.rejected)],
        ["stored with a note", len(summary.noted), _reasons(summary.noted)],
        ["skipped", len(summary.left_out), ", ".join(map(str, summary.left_out))],
        ["seconds", f"{summary.seconds:.1f}", ""],
    ]
    rows = [row for row in rows if row[1] or row[0] in ("visited", "captured")]
    console.table("Dry run" if dry else "Capture", ["what", "number", "which"], rows)
    if dry:
        console.say("nothing was stored.")
    console.warn(*summary.warnings)
    if summary.left_out:
        console.say("the same command offers the skipped views again.")


def _reasons(found: tuple[tuple[int, str], ...]) -> str:
    """Return 'view: reason' of the first few."""
    told = [f"{k}: {reason}" for k, reason in found]
    return "\n".join(shortened(told, NAMED, "and {} more"))
