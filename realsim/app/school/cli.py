"""`realsim school`: try grasps by physics, check the physics, check a scene, export, sum up."""

from pathlib import Path
from typing import Any

import click

from realsim.app.command import Group
from realsim.app.console import Console
from realsim.app.meanings import one_of
from realsim.app.option_values import FOLDER
from realsim.app.options import SOURCE, Has, command, json_file, many, options, rare
from realsim.app.outputs import GOES_ON, OutputFile, OutputFolder

ENGINES = ("pybullet", "mujoco")
PICTURE = OutputFolder(("settle.png",), own=("settle.png", ("realsim settle",)))
VALIDATION = OutputFolder(
    tuple(f"validation_{name}.{end}" for name in ENGINES for end in ("json", "png")),
    own=("validation_*.json", ('"checks"', '"ratios"')),
)
REALITY = OutputFolder(
    ("reality.json", "reliability.png"), own=("reality.json", ('"predictors"', '"reliability"'))
)
CALIBRATION = OutputFile({".json": ('"held_share"', '"slope"')}, "calibration")
JUDGED = {
    "draws": 16, "cell_error": Has(None, "  [8 3 10 3]"),
    "p_hold_calibration": Has(None, "  [the shipped one]"), "weighed": (),
}  # fmt: skip
"""Options of what p_hold stands for."""


@click.group(
    "school",
    cls=Group,
    by_default="run",
    examples=(
        "realsim school demo/session --restart",
        "realsim school validate --quick --engine pybullet",
    ),
)
def school_command() -> None:
    """Try grasps by physics: reach, close, lift, shake, swing.

    \b
      realsim school SESSION              try grasps on the registered objects of a session
      realsim school SCENE --out FOLDER   of a BOP scene, GraspNet scene or scene.yaml
      realsim school validate             is the physics right on this machine?
      realsim school reality TRIALS       do labels tell what a real robot did?
      realsim school settle SCENE         do the objects stand, or jump and fall?
      realsim school export SESSION --to acronym --out FOLDER
      realsim school summary SESSION ...  the paper's statistics over many sessions

    `realsim school run --help` lists what a run can be told. What the labels mean: the guide
    docs/how-to/grasps-tried-by-physics.md.
    """  # noqa: D301 - click's own mark for lines that stay as they are


@command(
    "run",
    "realsim school demo/session --grasps 8 --restart",
    "realsim school demo/session --arm ur5 --hand parallel --grasps 4 --restart",
    "realsim school run demo/session --grasps 4 --force 20 --restart --json",
    group=school_command,
)
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SOURCE...")
@options(
    out=Has(None, ", if SOURCE is no session", GOES_ON), arm="panda", hand="franka_hand", grasps=60,
    engine="pybullet", cross_check=False, sweep=False, force=Has(None, "  [the hand's]"),
    friction=Has(None, "  [the hand's]"), restart=False,
)  # fmt: skip
@many()
@rare(
    stiffness=Has(None, "  [the hand's]"), **JUDGED, density=Has(None, "  [the models' own]"),
    base_pose=Has(None, "  [above the table]"), points=Has(None, "  [1000]"), rotations=None,
    models=None, quaternions=None, seed=0, json_file=json_file("reasons", "agreement", "settings"),
)  # fmt: skip
def run_command(
    console: Console, sources: tuple[Path, ...], out: Path | None, json_file: Path | None,
    **options: Any,
) -> bool:  # fmt: skip
    """Try grasps on every object of each SOURCE.

    SOURCE is a registered session, or a BOP scene, a GraspNet scene or a scene.yaml with --out.
    A run that was interrupted goes on where it stopped.

    Writes grasps/ (every set as npz and JSON, grasps.h5) and reports/school.html.

    Exit codes: 0 done, 1 no grasp could be tried, 2 bad input.
    """
    from realsim.app.annotate.current import other_grasps_shown
    from realsim.app.many_sessions import one_session
    from realsim.app.school.files import PAGE
    from realsim.app.school.inputs import SchoolRequest
    from realsim.app.school.run import run
    from realsim.app.school.tables import as_json, show_school
    from realsim.store import atomic

    source = one_session(sources, options["where"])
    outcome = run(source, out, SchoolRequest(**options), console)
    folder = outcome.inputs.folder
    show_school(outcome.sets, outcome.models, console)
    for instance, gave_up in outcome.unfinished.items():
        console.warn(f"instance {instance}: given up: {'; '.join(gave_up)}. Run it again.")
    console.say(f"page      {folder / PAGE}")
    store = outcome.inputs.store
    if store is not None and (shown := other_grasps_shown(store)):
        console.warn(f"the frames {shown}; `realsim annotate {folder}` writes these into them.")
    document = as_json(outcome.sets, outcome.models)
    if json_file is not None:
        atomic.write_json(json_file, document)
    console.result(document | {"folder": folder, "page": folder / PAGE})
    if not any(s.reachable.any() for s in outcome.sets):
        console.warn("no grasp could be tried; the table above and the page say why.")
        return False
    return True


@command(
    "validate",
    "realsim school validate --quick --engine pybullet",
    "realsim school validate --quick --out physics",
    group=school_command,
)
@options(
    engine=Has("both", kind=one_of("pybullet mujoco both")), hand="franka_hand", quick=False,
    json_file=json_file("checks", "ratios", "cpu_s"), out=Has(None, ": a folder", VALIDATION),
)  # fmt: skip
def validate_command(
    console: Console, engine: str, hand: str, quick: bool, json_file: Path | None, out: Path | None
) -> bool:
    """Check that the physics obeys Coulomb's law and does not depend on its solver's settings.

    Exit codes: 0 all checks are green, 1 one is red, 2 an engine is not installed.
    """
    from realsim.app.school.validate import validate_engines

    names = ENGINES if engine == "both" else (engine,)
    return validate_engines(names, hand, quick, json_file, out, console)


@command(
    "reality",
    "realsim school reality ../shared/data/school/graspa_open --out reality",
    "realsim school reality trials --engine mujoco --fit calibration.json",
    group=school_command,
)
@click.argument("trials", type=FOLDER)
@options(
    engine="pybullet", **JUDGED, cache=Has(kind=GOES_ON), out=Has(None, ": a folder", REALITY),
    fit=Has(kind=CALIBRATION),
)  # fmt: skip
def reality_command(
    console: Console, trials: Path, out: Path | None, fit: Path | None, **options: Any
) -> None:
    """Judge labels by TRIALS of a real robot, in GRASPA's layout.

    Tells for p_hold, the scores and the analytic measures how well each predicts which grasps held
    (AUC, intervals by object), and whether p_hold means what it says.
    """
    from realsim.app.school.reality import judge

    judge(trials, options, out, fit, console)


@command(
    "settle", "realsim school settle demo/session", "realsim school settle demo/session --json",
    group=school_command,
)  # fmt: skip
@SOURCE
@options(
    models=None, weighed=(), density=None, support=(), out=Has(None, ": a folder", PICTURE),
    json_file=json_file("stable", "simulated_s"), quaternions=None,
)  # fmt: skip
def settle_command(
    console: Console, source: Path, out: Path | None, json_file: Path | None, **options: Any
) -> bool:
    """Let physics act on SOURCE and name the objects that jump or fall.

    Poses that are millimetres off put objects into one another or into the air; grasps tried on
    such a scene mean little.

    Exit codes: 0 everything stands, 1 an object does not, 2 bad input.
    """
    from realsim.app.school.inputs import SchoolRequest
    from realsim.app.school.settle import settle

    return settle(source, SchoolRequest(**options), out, json_file, console)


@command(
    "export",
    "realsim school export demo/session --to acronym --out acronym",
    "realsim school export demo/session --to isaac --out isaac --least-score 0.5",
    group=school_command,
)
@SOURCE
@options(
    to=Has(kind=one_of("acronym graspgen isaac hdf5 parquet"), required=True),
    out=Has(kind=OutputFolder(), note=": a folder", required=True), least_score=0.0,
)  # fmt: skip
def export_command(
    console: Console, source: Path, target: str, out: Path, least_score: float
) -> None:
    """Write the grasps of SOURCE (a session, or a folder of results) for other programs."""
    from realsim.app.school.files import export

    files = export(source, target, out, least_score)
    console.say(*map(str, files))
    console.result({"format": target, "files": files})


@command(
    "summary", "realsim school summary demo/session", "realsim school summary demo/session --json",
    group=school_command,
)  # fmt: skip
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SESSION...")
@options(json_file=json_file("with_trajectory", "closures", top=True))
def summary_command(console: Console, sources: tuple[Path, ...], json_file: Path | None) -> None:
    """Sum up the results of many sessions, row by row as in the paper's table."""
    from realsim.app.school.files import summarise

    summarise(sources, json_file, console)
