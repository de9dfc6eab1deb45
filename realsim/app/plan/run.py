"""`realsim plan`, `plan-show` and `plan-convert`: make, look at and exchange capture plans."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from realsim.app.console import Console, shortened
from realsim.app.outputs import require_free_file, require_free_folder
from realsim.app.plan.request import Place, PlanRequest
from realsim.errors import InputError
from realsim.robots.arm import find_arm, known_chains
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Mount
from realsim.store.atomic import only_run_in
from realsim.untrusted.json_text import read_json
from realsim_capture_plans.plan_files.evidence import JointUnit
from realsim_capture_plans.planning.advise import better_place
from realsim_capture_plans.planning.metrics import METRIC_MEANINGS, goal_of, plan_metrics
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig

if TYPE_CHECKING:
    from realsim_capture_plans.pictures.replay import PlanReplay

PICTURES = "_pictures"
"""Added to a plan's name: the folder of its pictures beside it."""
GRASPNET_FILES = ("plan.json", "camera_poses.npy", "cam0_wrt_table.npy")
GRASPNET_MARK = ("camera_poses.npy", ("NUMPY", ", 4, 4)"))
PLAN_MARKS = {
    ".json": ('"realsim capture plan"',),
    ".csv": ("view,via,q1_rad",),
    ".script": ("def realsim_plan():",),
}
"""What every plan file of ours holds, by its suffix."""
ODD_ROW_M = 0.010
"""A tool pose that is farther than this from its joints' is named [m]; arms leave 1 to 3 mm."""
ODD_ROW_TIMES = 5.0
"""Least ratio of a named pose's distance to the median distance."""
LOOKING_BACK = -0.2
"""Cosine between optical axis and tool z below which a camera looks back."""
NO_PLAN_DEG = 180.0
"""The advice's hole where a place has fewer reachable views than were asked for [deg]."""
LEAST_SHARE = 0.75
"""A plan that reaches less of the directions is told where it would reach more."""
NAMED_LEGS = 12
"""Colliding pieces of moves that are printed one by one."""


def run_plan(request: PlanRequest, console: Console, *, advise: bool) -> bool:
    """Make a plan and write it with its pictures; return whether all its moves are free.

    Raises:
        InputError: something given cannot be used, or the plan is there already.
        DegenerateError: fewer views are reachable than asked for.
    """
    place, config = request.place, request.config()
    chain, mount = place.chain() or find_arm("ur5").chain, place.camera_mount()
    if advise:
        show_advice(request, chain, mount, config, console)
        return True
    out = request.out
    _check_free_name(out, request.overwrite)
    plan = make_plan(request, chain, mount, config, console)
    plan = replace(plan, metrics=plan.metrics | plan_metrics(plan))
    from realsim_capture_plans.plan_files.plan_json import save_plan

    show_plan(plan, plan.metrics, console)
    free = show_colliding(plan, console)
    if plan.kind == "hemisphere" and plan.metrics["reachable_share"] < LEAST_SHARE:
        above = float(plan.center_world[2]) - config.table_height_m
        console.warn(
            f"only {100 * plan.metrics['reachable_share']:.0f} % of the directions are reachable "
            f"from here: the views leave one side out. {better_place(chain, mount, config, above)}"
        )
    files: list[Path] = []
    with ExitStack() as stack:
        if not request.no_pictures:
            picture_folder(out).mkdir(exist_ok=True)
            stack.enter_context(only_run_in(picture_folder(out)))
        _check_free_name(out, request.overwrite)  # another run may have made it meanwhile
        if not request.no_pictures:
            files = _write_pictures(plan, plan.metrics, picture_folder(out), console)
        save_plan(plan, out)  # last: what was interrupted before can be run again
    console.say(f"plan: {out}")
    console.result(_document(plan, plan.metrics) | {"plan": out, "pictures": files})
    return free


def make_plan(
    request: PlanRequest, chain: DhChain, mount: Mount, config: PlanConfig, console: Console
) -> CapturePlan:
    """Return the plan, with a progress bar for each of the planner's steps."""
    from realsim_capture_plans.planning.make import calibration_plan, hemisphere_plan

    boxes = request.place.boxes()
    maker = calibration_plan if request.board else hemisphere_plan
    rng = np.random.default_rng(request.seed)
    with console.steps("plan") as tell:
        return maker(
            request.count, request.center(config), mount, config, rng, chain=chain,
            obstacles=boxes, progress=tell,
        )  # fmt: skip


def show_advice(
    request: PlanRequest, chain: DhChain, mount: Mount, config: PlanConfig, console: Console
) -> None:
    """Print where the scene's centre is best put."""
    from realsim_capture_plans.planning.advise import advice, advise

    center = request.center(config)
    z = center[2]
    n = request.count
    with console.stage("advise", "places for the scene") as tick:
        places = advise(chain, mount, config, n, z - config.table_height_m, tick=tick)
    rows = [
        (
            ",".join(f"{v:.3f}" for v in p.center),
            f"{p.table_height_m:.2f}",
            f"{100 * p.reachable_share:.1f} %",
            *(
                f"{hole:.1f} deg" if hole < NO_PLAN_DEG else f"fewer than {n} views"
                for hole in (p.hole_deg, p.one_elbow_hole_deg)
            ),
        )
        for p in places
    ]
    header = ("--center (in base, m)", "--table-height", "reachable", "largest hole", "one elbow")
    console.table(f"Places for {n} views with a {chain.name}, best first", header, rows)
    said = advice(places, center, config.table_height_m)
    console.say(said)
    console.result({"robot": chain.name, "views": n, "places": places, "advice": said})
    console.say(
        "The base turns the arm to any side alike: only the distance from its axis and the heights "
        "matter here. Obstacles and the table's edges are looked at by the plan itself."
    )


def run_show(
    text: str, console: Console, *, arm: str | None = None, pictures: bool, replay: bool,
    replay_file: Path | None, host: str, port: int,
) -> bool:  # fmt: skip
    """Show a plan: its metrics, its pictures, its replay; return whether all moves are free.

    Raises:
        InputError: no such plan.
    """
    from realsim_capture_plans.plan_files.plan_json import PREFIX, resolve_plan

    plan = _of_arm(resolve_plan(text), arm)
    metrics = plan.metrics | plan_metrics(plan)
    show_plan(plan, metrics, console)
    free = show_colliding(plan, console)
    files: list[Path] = []
    if pictures:
        folder = picture_folder(Path(text.removeprefix(PREFIX)))
        files = _write_pictures(plan, metrics, folder, console)
    if replay_file is not None:
        from realsim_capture_plans.pictures.replay import write_replay

        write_replay(plan, replay_file)
        console.say(f"replay: {replay_file}")
    document = {"plan": text, "pictures": files, "replay": replay_file}
    console.result(_document(plan, metrics) | document)
    if replay:
        from realsim_capture_plans.pictures.replay import PlanReplay

        _serve(PlanReplay(plan, host=host, port=port), console)
    return free


def _of_arm(plan: CapturePlan, arm: str | None) -> CapturePlan:
    """Return a plan, if its arm is the one that was named: a name or a folder of one's own.

    Raises:
        InputError: it is another arm's.
    """
    if arm is not None and find_arm(arm).name != plan.robot:
        raise InputError(
            f"the plan is for a {plan.robot}, --arm {arm} is a {find_arm(arm).name}. Leave --arm "
            "out, or give the folder of the plan's arm."
        )
    return plan


def _serve(replay: "PlanReplay", console: Console) -> None:
    """Keep the replay running until the user ends it."""
    console.say(f"replay at {replay.url} (Ctrl-C ends)")
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        pass
    finally:
        replay.stop()


def run_convert(
    source: str, dest: Path, place: Place, console: Console, *, joints_unit: JointUnit | None,
    overwrite: bool,
) -> bool:  # fmt: skip
    """Write a plan or a joint path in another form; return whether all its moves are free.

    Raises:
        InputError: the source is neither, the target has no known form or is there already.
    """
    writer = _writer(dest)
    if not dest.suffix:
        require_free_folder(dest, "DEST", GRASPNET_FILES, GRASPNET_MARK)
    elif dest.exists():
        require_free_file(dest, "DEST", PLAN_MARKS, "plan")
    if dest.exists() and not overwrite:
        raise InputError(f"{dest} is there already; --overwrite replaces it, or name another.")
    plan = _source_plan(source, place, joints_unit, console)
    document = _document(plan, plan.metrics)  # asks for the arm, before anything is written
    files = writer(plan, dest)
    free = show_colliding(plan, console) if plan.kind == "imported" else True
    console.say(*map(str, files))
    console.result(document | {"files": files})
    return free


def _source_plan(
    source: str, place: Place, joints_unit: JointUnit | None, console: Console
) -> CapturePlan:
    """Return the plan that a file holds, or the one that a joint path makes."""
    from realsim_capture_plans.plan_files import plan_json
    from realsim_capture_plans.plan_files.foreign_plans import plan_of_path
    from realsim_capture_plans.plan_files.joint_paths import read_path

    path = Path(source)
    is_plan = source.startswith(plan_json.PREFIX)
    if path.suffix.lower() == ".json" and path.is_file():
        data = read_json(path, most_bytes=plan_json.LARGEST_BYTES)
        is_plan = isinstance(data, dict) and data.get("schema") == plan_json.SCHEMA
    if is_plan or not path.exists():
        if is_plan and (replace(place, arm=None) != Place() or joints_unit):
            raise InputError(
                f"{source} is a realsim plan: its robot, mount and scene are in it and cannot be "
                "changed by options. Make it anew with `realsim plan`."
            )
        return _of_arm(plan_json.resolve_plan(source), place.arm)
    chain = place.chain()
    found = read_path(path, chain, joints_unit)
    if found.reading is not None:
        tool = 1e3 * found.reading.T_ee_tcp[:3, 3]
        console.say(f"{source} fits {found.reading.text()} are left with one constant tool offset")
        console.say(f"tool offset: {', '.join(f'{v:.1f}' for v in tool)} mm in the flange")
        if found.reading.worst_m > max(ODD_ROW_M, ODD_ROW_TIMES * found.reading.gap_m):
            console.warn(
                f"the tool pose of row {found.reading.worst} (counted from 0) is "
                f"{1e3 * found.reading.worst_m:.0f} mm from where its joints put the tool, and the "
                "worst of all rows. Its joints are driven all the same: look which of the two is "
                "wrong before you drive it."
            )
        chain = chain or found.reading.chain
    if chain is None:
        raise InputError(
            f"{source} does not say which robot it is for; choose --arm "
            f"({', '.join(known_chains())})."
        )
    plan = plan_of_path(
        found,
        chain=chain,
        mount=place.camera_mount(),
        config=place.config(),
        center=place.given_center() if place.center else None,
        obstacles=place.boxes(),
    )
    return replace(plan, metrics=plan_metrics(plan) | plan.metrics)


def _writer(dest: Path) -> Callable[[CapturePlan, Path], list[Path]]:
    """Return what writes a file of this suffix."""
    from realsim_capture_plans.plan_files import foreign_plans
    from realsim_capture_plans.plan_files.plan_json import save_plan

    writers: dict[str, Callable[[CapturePlan, Path], None]] = {
        ".json": save_plan,
        ".csv": foreign_plans.export_csv,
        ".script": foreign_plans.export_urscript,
    }
    suffix = dest.suffix.lower()
    if suffix in writers:

        def one(plan: CapturePlan, path: Path) -> list[Path]:
            writers[suffix](plan, path)
            return [path]

        return one
    if not suffix and not dest.is_file():
        return foreign_plans.export_graspnet
    raise InputError(
        f"'{dest}' has no form that is written: .json (realsim plan), .csv (table), .script "
        "(URScript), or a folder without a suffix (GraspNet's camera_poses.npy)."
    )


def _document(plan: CapturePlan, metrics: dict[str, float]) -> dict[str, object]:
    """Return what a program wants to know of a plan, for `--json`."""
    from realsim_capture_plans.plan_files.foreign_plans import colliding_legs

    return {
        "kind": plan.kind,
        "robot": plan.robot,
        "mount": plan.mount.name,
        "views": len(plan),
        "center_world_m": plan.center_world,
        "sha256": plan.content_hash,
        "metrics": metrics,
        "colliding": list(colliding_legs(plan)),
    }


def show_plan(plan: CapturePlan, metrics: dict[str, float], console: Console) -> None:
    """Print what the plan is for, and its metrics beside what is good."""
    from realsim_capture_plans.plan_files.foreign_plans import IMPORT_MEANINGS

    meanings = METRIC_MEANINGS | IMPORT_MEANINGS
    x, y, z = plan.center_world.tolist()
    own = any(np.any(getattr(plan.chain, f"delta_{p}")) for p in ("a", "d", "alpha", "theta"))
    arm = f"{plan.robot}, {'with its own calibration' if own else 'nominal'}"
    console.say(
        f"{plan.kind} plan: {len(plan)} views of ({x:.3f}, {y:.3f}, {z:.3f}) m; {arm}; "
        f"{plan.mount.name}; sha256 {plan.content_hash[:12]}"
    )
    rows: list[tuple[str, str, str, str]] = []
    missed: list[str] = []
    for name in [*meanings, *sorted(set(metrics) - set(meanings))]:
        if name not in metrics:
            continue
        meaning, value = meanings.get(name), metrics[name]
        if meaning is None:
            rows.append((name, f"{value:.4g}", "", ""))
            continue
        goal = goal_of(name, meaning, value, plan)
        rows.append(
            (
                meaning.text,
                f"{value:.4g} {meaning.unit}".strip(),
                goal.text,
                {True: "", False: "MISSED", None: ""}[goal.met],
            )
        )
        if goal.met is False:
            missed.append(f"{meaning.text}: {rows[-1][1]}, good is {goal.text}")
    console.table("How good it is", ("metric", "value", "good", "met"), rows)
    console.warn(*missed)
    if plan.mount.T_ee_cam[2, 2] < LOOKING_BACK:
        console.warn(
            f"the camera of mount '{plan.mount.name}' looks back along the arm. If it looks away "
            "from the flange as usual, the mount's rotation is wrong."
        )


def show_colliding(plan: CapturePlan, console: Console) -> bool:
    """Name the moves that collide in the model; return whether there are none."""
    from realsim_capture_plans.plan_files.foreign_plans import colliding_legs

    legs = colliding_legs(plan)
    told = [f"not free: {line}" for line in legs]
    console.warn(*shortened(told, NAMED_LEGS, "not free: {} more"))
    if legs:
        console.warn(
            f"{len(legs)} straight pieces of moves do not keep {1e3 * plan.config.clearance_m:g} "
            "mm to everything. Check mount, table height and keep-out box; do not drive them "
            "before they are."
        )
    return not legs


def picture_folder(out: Path) -> Path:
    """Return the folder beside a plan that its pictures go to."""
    return out.with_name(out.stem + PICTURES)


def _check_free_name(out: Path, overwrite: bool) -> None:
    """Raise before the work is done if its result could not be written."""
    if out.suffix.lower() != ".json":
        raise InputError(f"--out '{out}': a plan is a .json file; plan-convert writes other forms.")
    if out.is_dir():
        raise InputError(f"--out '{out}' is a folder; name a .json file.")
    require_free_folder(picture_folder(out), "the pictures of the plan:", (), ("", ()))
    if out.exists() and not overwrite:
        raise InputError(
            f"{out} is there already, and a plan that was driven must not be lost. Name "
            "another with --out, or replace it with --overwrite."
        )
    if out.exists():
        require_free_file(out, "--out", PLAN_MARKS, "plan")


def _write_pictures(
    plan: CapturePlan, metrics: dict[str, float], folder: Path, console: Console
) -> list[Path]:
    from realsim_capture_plans.pictures.plan_pictures import plan_pictures

    with console.stage("pictures"):
        files = plan_pictures(plan, folder, metrics)
    console.say(f"{len(files)} pictures: {folder}")
    return list(files)
