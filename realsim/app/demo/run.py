"""The whole loop in the simulated lab: plan, capture, calibrate, register, school, annotate.

The pipeline sees only what a real lab would give it: images, joint angles, the controller's poses,
the camera's factory values, the operator's rough poses. The truth goes to a folder of its own,
which only the report opens.

`realsim demo --site`: the pages of a session as a folder that any file server hosts.
"""

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.annotate.current import annotate_session
from realsim.app.calibrate.session import calibrate_session
from realsim.app.console import Console, StageTime
from realsim.app.register.run import register_session
from realsim.app.school.inputs import SchoolRequest
from realsim.app.school.run import run_in_session
from realsim.app.stages import BOARD_VIEWS, save_starts
from realsim.app.truth import LoopErrors
from realsim.errors import InputError
from realsim.pages import Cell, Page
from realsim.records import CaptureSession, GraspSet, HandEye, Scene
from realsim.robots.arm import find_arm
from realsim.store import SessionStore, atomic
from realsim.store.atomic import only_run_in

if TYPE_CHECKING:
    from realsim.app.truth import LoopErrors
    from realsim_capture_plans import CapturePlan
    from realsim_capture_plans.lab import SimulatedLab


BOARD_VIEW_SHARE = 24
"""Most board views of a demo; a smaller demo takes as many as scene views, 10 at least."""
QUICK: dict[str, Any] = {"views": 8, "objects": 2, "grasps_per_object": 12, "width": 640}
"""What `--quick` captures and tries."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DemoConfig:
    """What the demo captures."""

    arm: str = "ur5"
    """Name or folder of the arm."""
    views: int = 24
    """Views of the scene."""
    objects: int = 5
    """Objects on the table."""
    seed: int = 0
    """Seed of everything random: scene, noise, sampling."""
    grasps_per_object: int = 60
    """Grasp candidates tried on each object, at most."""
    width: int = 1280
    """Width of the images, which are 16:9 [px]."""
    workers: int = 2
    """Processes in the Robot School."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DemoResult:
    """What the demo made and how far it is from the truth."""

    store: SessionStore
    grasps: list[GraspSet]
    errors: "LoopErrors"
    report: Path
    times: list[StageTime]


def run_demo(config: DemoConfig, out: Path, console: Console) -> DemoResult:
    """Run the loop in `out`, going on where an earlier run stopped.

    Raises:
        InputError: the folder holds a demo of another setup, or something else.
    """
    from threadpoolctl import threadpool_limits

    from realsim.app.report.session import report_of, write_report
    from realsim.app.truth import loop_errors

    _claim(out, config)
    # One BLAS thread: on small matrices the spinning of more costs more than the work.
    with only_run_in(out), threadpool_limits(limits=1):
        store, _, _ = capture_and_register(config, out, console)
        asked = SchoolRequest(
            grasps=config.grasps_per_object, seed=config.seed, where=config.workers,
            restart="finished",
        )  # fmt: skip
        grasps = run_in_session(store, asked, console).sets
        annotate_session(store, console)
        with console.stage("report"):
            errors = loop_errors(store, out / "truth")
            report = write_report(store, report_of(store, errors, "kept", times=console.times))
    return DemoResult(store=store, grasps=grasps, errors=errors, report=report, times=console.times)


def capture_and_register(
    config: DemoConfig, out: Path, console: Console
) -> tuple[SessionStore, HandEye, Scene]:
    """Run the first half of the loop in `out`: plan, capture, calibrate, register.

    Returns:
        The session, the hand-eye calibration and the registered scene; the truth lies in
        `out/truth`.
    """
    from realsim_capture_plans.lab import LabConfig, SimulatedLab

    setup = LabConfig(
        seed=config.seed, arm=config.arm, n_objects=config.objects, width=config.width,
        height=config.width * 9 // 16,
    )  # fmt: skip
    lab = SimulatedLab(setup)
    store = _capture_all(lab, config, out, console)
    joints = {v.index: v.joints for v in store.session.views if v.joints is not None}
    lab.write_truth(out / "truth", joints)
    hand_eye = calibrate_session(store, console, config.arm)
    return store, hand_eye, register_session(store, console)


def _claim(out: Path, config: DemoConfig) -> None:
    """Take the folder for this demo, or say why it cannot be had."""
    from realsim.store.atomic import write_json

    note = out / "demo.json"
    wanted = {k: v for k, v in asdict(config).items() if k != "workers"}
    if out.exists() and not out.is_dir():
        raise InputError(f"'{out}' is a file; give --out a folder that may be made or filled.")
    if note.is_file():
        older = {"arm": "ur5", "width": 1280}  # what folders of before do not name
        found = older | json.loads(note.read_text())
        if found != wanted:
            told = ", ".join(f"{k}={v}" for k, v in found.items())
            raise InputError(
                f"'{out}' holds a demo of another setup ({told}). Choose another --out, or delete "
                "the folder to begin anew; the same setup would go on where it stopped."
            )
        return
    if out.is_dir() and any(out.iterdir()):
        raise InputError(
            f"'{out}' is not empty and holds no demo. Choose another --out: nothing of yours is "
            "overwritten."
        )
    out.mkdir(parents=True, exist_ok=True)
    write_json(note, wanted)


def _capture_all(
    lab: "SimulatedLab", config: DemoConfig, out: Path, console: Console
) -> SessionStore:
    """Plan and capture the board views and the scene views."""
    from realsim.formats.bop.models import save_models
    from realsim.store import save_board
    from realsim_capture_plans import (
        PlanConfig,
        calibration_plan,
        capture,
        hemisphere_plan,
        load_plan,
        save_plan,
    )

    board_views = max(10, min(BOARD_VIEW_SHARE, config.views))
    session = out / "session"
    with console.stage("plan", f"{config.views} + {board_views} views") as tick:
        plans: list[CapturePlan] = []
        for name, make, n in (
            ("plan.json", hemisphere_plan, config.views),
            ("board_plan.json", calibration_plan, board_views),
        ):
            if not (out / name).is_file():
                rng = np.random.default_rng([config.seed, 1, len(plans)])
                plan = make(
                    n, lab.scene_center, lab.nominal_T_ee_cam, PlanConfig(), rng,
                    chain=find_arm(config.arm).chain,
                )  # fmt: skip
                save_plan(plan, out / name)
            plans.append(load_plan(out / name))
            tick(len(plans), 2)
    store = _open_or_create(session, lab, config, {"plan_hash": plans[0].content_hash})
    board = _open_or_create(
        session / BOARD_VIEWS, lab, config, {"plan_hash": plans[1].content_hash}
    )
    save_board(store, lab.board)
    with console.stage("capture", f"tag board, {board_views} views") as tick:
        lab.place_board()
        capture(plans[1], lab.arm, lab.camera, board, progress=tick)
    with console.stage("capture", f"{config.objects} objects, {config.views} views") as tick:
        lab.place_objects()
        # As an operator would between two captures: from the last board view there may be no
        # free straight way to the first view of the scene.
        lab.arm.move(plans[0].home)
        capture(plans[0], lab.arm, lab.camera, store, progress=tick)
    save_models(store.folder / "models", lab.models)
    starts = lab.operator_starts(np.random.default_rng([config.seed, 2]))
    save_starts(store, starts, "rough poses given by the simulated operator")
    return store


def _open_or_create(
    folder: Path, lab: "SimulatedLab", config: DemoConfig, extra: dict[str, Any]
) -> SessionStore:
    """Open a session that an earlier run began, or begin it."""
    if (folder / "session.json").is_file():
        return SessionStore.open(folder)
    session = CaptureSession(
        name=f"simulated lab, seed {config.seed}",
        intrinsics=lab.camera.intrinsics,
        depth_unit_m=lab.camera.depth_unit_m,
    )
    about = {"arm": lab.arm.name, "camera": lab.camera.name, "gravity_up_world": [0.0, 0.0, 1.0]}
    return SessionStore.create(folder, session, about | extra)


def demo_document(result: DemoResult) -> dict[str, object]:
    """Return what a program wants to know, for `--json`: errors, places, times."""
    return {
        "session": result.store.folder,
        "report": result.report,
        "errors": result.errors,
        "figures": result.errors.figures(),
        "times": result.times,
    }


def show_demo(result: DemoResult, console: Console, site: Path | None = None) -> None:
    """Print what it took, the errors against the truth, and three things to do next."""
    times = [(t.name, t.cpu_s, t.wall_s) for t in result.times]
    times.append(("all", sum(t.cpu_s for t in result.times), sum(t.wall_s for t in result.times)))
    rows = [[name, f"{cpu:.1f}", f"{wall:.1f}"] for name, cpu, wall in times]
    console.table("Time", ["stage", "CPU [s]", "clock [s]"], rows)
    title = "Errors against the truth of the simulated lab"
    console.table(title, ["figure", "measured", "goal"], result.errors.rows())
    console.say("What to do next")
    console.say(f"  1. Open {site or result.report} in a browser.")
    console.say(f"  2. Judge the poses:  realsim review {result.store.folder}")
    console.say("  3. Take your own images, recording or data set:  realsim import SOURCE session")


PAGES = (
    ("scene.html", "Scene", "Turn the point cloud, the models, the cameras and the grasps in 3D."),
    ("report.html", "Report", "Calibration, poses, grasps and labels: figures, checks, pictures."),
    ("school.html", "School sheet", "Every grasp that was tried, and what it failed on."),
    ("statistics.html", "Statistics", "Counts, beside those of published data sets."),
)
"""File, title and content of every page."""


def write_site(store: SessionStore, errors: LoopErrors, folder: Path, console: Console) -> Path:
    """Write the pages of a session that went through the whole loop; return the first one.

    Nothing on them is loaded from elsewhere, and links are relative.
    """
    from realsim.app.verbs import review, run

    folder.mkdir(parents=True, exist_ok=True)
    with console.stage("site", str(folder)):
        for name in ("report.html", "school.html"):
            shutil.copyfile(store.path(f"reports/{name}"), folder / name)
        review(store.folder, static=folder / "scene.html", quiet=True)
        counts = run("stats", (store.folder,), {"out": folder, "quiet": True}).document
        title = "A capture session, from plan to grasp labels"
        page = Page(title=title, about=f"Made by realsim in a {store.session.name}.")
        drawn = store.path("registration/pictures/overlay.jpg").read_bytes()
        figures = [(value, name) for name, value, goal in errors.rows() if goal]
        figures.append((f"{counts['school']['candidates']:,}", "grasps tried by physics"))
        page.lead(drawn, "What registration found, drawn on photographs.", figures)
        page.section("Pages")
        rows = [[Cell(name, href=f"./{file}"), text] for file, name, text in PAGES]
        page.table(["page", "what it shows"], rows)
        page.section("Make it yourself", "This needs no robot and no camera:")
        page.code("realsim demo --site site")
        atomic.write_bytes(folder / "index.html", page.encode())
    return folder / "index.html"
