"""`realsim school`: try grasps by physics, check the physics, check a scene, export, sum up."""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command, Group
from realsim.app.options import FOLDER, JSON, QUIET, arm, json_file, many, seed
from realsim.app.outputs import GOES_ON, OutputFile, OutputFolder

ENGINES = ("pybullet", "mujoco")
FORMATS = ("acronym", "graspgen", "isaac", "hdf5", "parquet")
PICTURE = OutputFolder(("settle.png",), own=("settle.png", ("realsim settle",)))
VALIDATION = OutputFolder(
    tuple(f"validation_{name}.{end}" for name in ENGINES for end in ("json", "png")),
    own=("validation_*.json", ('"checks"', '"ratios"')),
)

REALITY = OutputFolder(
    ("reality.json", "reliability.png"), own=("reality.json", ('"predictors"', '"reliability"'))
)
CALIBRATION = OutputFile({".json": ('"held_share"', '"slope"')}, "calibration")
DRAWS = click.option("--draws", default=16, show_default=True, type=int,
                     help="Draws of each grasp behind p_hold.")  # fmt: skip
CELL = click.option("--cell-error", nargs=4, type=float, default=None, metavar="MM MM DEG DEG",
                    help="Of the cell: across, height, yaw, tilt.  [8 3 10 3]")  # fmt: skip
FITTED = click.option("--calibration", type=FOLDER, default=None, metavar="FILE",
                      help="Of p_hold, by `school reality --fit`.  [the shipped one]")  # fmt: skip
HAND = click.option("--hand", default="franka_hand", show_default=True, metavar="NAME",
                    help="Hand, by its name (`realsim robots`) or its folder.")  # fmt: skip


class RunByDefault(Group):
    """A group whose command `run` needs no name: `realsim school SESSION` runs the school."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put `run` before arguments that begin with no command and do not ask for help."""
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = ["run", *args]
        return super().parse_args(ctx, args)


@click.group(
    "school",
    cls=RunByDefault,
    examples=(
        "realsim school demo/session --restart",
        "realsim school validate --quick --engine pybullet",
    ),
)
def SCHOOL() -> None:
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


@SCHOOL.command(
    "run",
    cls=Command,
    examples=(
        "realsim school demo/session --grasps 8 --restart",
        "realsim school demo/session --arm ur5 --hand parallel --grasps 4 --restart",
        "realsim school run demo/session --grasps 4 --force 20 --restart --json",
    ),
)
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SOURCE...")
@click.option(
    "--out",
    type=GOES_ON,
    default=None,
    help="Folder, where SOURCE is no session.",
)
@arm("Arm that grasps, or its folder.", default="panda")
@HAND
@click.option("--grasps", default=60, show_default=True, type=click.IntRange(1, 2000),
              help="Candidates to try on each object, at most.")  # fmt: skip
@click.option("--engine", default="pybullet", show_default=True, type=click.Choice(ENGINES),
              help="Which physics.")  # fmt: skip
@click.option("--cross-check", is_flag=True, help="The other engine tries them, too.")
@click.option(
    "--sweep", is_flag=True, help="Least friction and force, and stiffness, that each survives."
)
@click.option(
    "--force", "force_n", type=float, default=None, help="Of each finger [N].  [the hand's]"
)
@click.option("--friction", type=float, default=None, help="Coulomb coefficient.  [the hand's]")
@click.option("--stiffness", "stiffness_n_per_m", type=float, default=None,
              help="Of one pad [N/m].  [the hand's]")  # fmt: skip
@DRAWS
@CELL
@FITTED
@click.option("--density", type=float, default=None,
              help="Of objects that are not weighed [kg/m^3].  [the models' own]")  # fmt: skip
@click.option(
    "--mass", "masses", multiple=True, metavar="NAME=KG", help="A weighed object; repeat."
)
@click.option("--base-pose", type=FOLDER, default=None,
              help="JSON with T_world_base or T_table_base.  [above the table]")  # fmt: skip
@click.option("--points", type=click.IntRange(1, 1_000_000), default=None,
              help="Surface points that candidates start from.  [1000]")  # fmt: skip
@click.option("--rotations", type=click.IntRange(1, 360), default=None,
              help="Approaches tried for each pair of contacts.")  # fmt: skip
@click.option("--models", type=FOLDER, default=None, help="Models of a SOURCE that is no session.")
@click.option("--quaternions", type=click.Choice(("wxyz", "xyzw")), default=None,
              help="Their order in a scene.yaml that does not tell it.")  # fmt: skip
@many()
@click.option("--restart", is_flag=True, help="Throw away results of other parameters.")
@seed()
@json_file("Write the counts there, too.", "reasons", "agreement", "settings")
@JSON
@QUIET
def run_command(
    sources: tuple[Path, ...], out: Path | None, json_file: Path | None, as_json: bool, quiet: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Try grasps on every object of each SOURCE.

    SOURCE is a registered session, or a BOP scene, a GraspNet scene or a scene.yaml with --out.
    A run that was interrupted goes on where it stopped.

    Writes grasps/ (every set as npz and JSON, grasps.h5, grasps.parquet) and
    reports/school.html.

    Exit codes: 0 done, 1 no grasp could be tried, 2 bad input.
    """
    from realsim.app.console import Console
    from realsim.app.many_sessions import one_session
    from realsim.app.school.files import PAGE
    from realsim.app.school.inputs import SchoolRequest
    from realsim.app.school.run import run
    from realsim.app.school.tables import as_json as json_of
    from realsim.app.school.tables import show_school
    from realsim.store import atomic

    source = one_session(sources, options["where"])
    request = SchoolRequest(**options)
    console = Console(quiet=quiet, as_json=as_json)
    outcome = run(source, out, request, console)
    show_school(outcome.sets, outcome.models, console)
    for instance, gave_up in outcome.unfinished.items():
        console.warn(f"instance {instance}: given up: {'; '.join(gave_up)}. Run it again.")
    console.say(f"page      {outcome.inputs.folder / PAGE}")
    if (outcome.inputs.folder / "grasps/views").is_dir():
        console.warn(
            "the frames still show the grasps of before; write them anew with "
            f"`realsim annotate {outcome.inputs.folder}`."
        )
    document = json_of(outcome.sets, outcome.models)
    if json_file is not None:
        atomic.write_json(json_file, document)
    page = outcome.inputs.folder / PAGE
    console.result(document | {"folder": outcome.inputs.folder, "page": page})
    if not any(s.reachable.any() for s in outcome.sets):
        console.warn("no grasp could be tried; the table above and the page say why.")
        sys.exit(1)


@SCHOOL.command(
    "validate",
    cls=Command,
    examples=("realsim school validate --quick --engine pybullet",
              "realsim school validate --quick --out physics"),
)  # fmt: skip
@click.option("--engine", default="both", show_default=True,
              type=click.Choice([*ENGINES, "both"]), help="Which physics.")  # fmt: skip
@HAND
@click.option("--quick", is_flag=True, help="Every part with fewer samples: about a minute.")
@json_file("Write the reports there, too.", "checks", "ratios", "cpu_s")
@click.option("--out", type=VALIDATION, default=None, help="Folder for reports and pictures.")
@JSON
@QUIET
def validate_command(
    engine: str, hand: str, quick: bool, json_file: Path | None, out: Path | None, as_json: bool,
    quiet: bool,
) -> None:  # fmt: skip
    """Check that the physics obeys Coulomb's law and does not depend on its solver's settings.

    Exit codes: 0 all checks are green, 1 one is red, 2 an engine is not installed.
    """
    from realsim.app.console import Console
    from realsim.app.school.validate import validate_engines

    names = ENGINES if engine == "both" else (engine,)
    console = Console(quiet=quiet, as_json=as_json)
    if not validate_engines(names, hand, quick, json_file, out, console):
        sys.exit(1)


@SCHOOL.command(
    "reality", cls=Command,
    examples=("realsim school reality ../shared/data/school/graspa_open --out reality",
              "realsim school reality trials --engine mujoco --fit calibration.json"),
)  # fmt: skip
@click.argument("trials", type=FOLDER)
@click.option("--engine", default="pybullet", show_default=True, type=click.Choice(ENGINES),
              help="Of the simulated attempt.")  # fmt: skip
@DRAWS
@CELL
@FITTED
@click.option(
    "--mass", "masses", multiple=True, metavar="NAME=KG", help="A weighed object; repeat."
)
@click.option("--cache", type=GOES_ON, default=None, help="Folder where convex parts are kept.")
@click.option("--out", type=REALITY, default=None, help="Folder for report and picture.")
@click.option("--fit", type=CALIBRATION, default=None,
              help="Fit p_hold to these trials and write the calibration there.")  # fmt: skip
@JSON
@QUIET
def reality_command(
    trials: Path, out: Path | None, fit: Path | None, as_json: bool, quiet: bool, **options: Any
) -> None:
    """Judge labels by TRIALS of a real robot, in GRASPA's layout.

    Tells for p_hold, the scores and the analytic measures how well each predicts which grasps held
    (AUC, intervals by object), and whether p_hold means what it says.
    """
    from realsim.app.console import Console
    from realsim.app.school.reality import judge

    judge(trials, options, out, fit, Console(quiet=quiet, as_json=as_json))


@SCHOOL.command(
    "settle", cls=Command,
    examples=("realsim school settle demo/session", "realsim school settle demo/session --json"),
)  # fmt: skip
@click.argument("source", type=FOLDER)
@click.option("--models", type=FOLDER, default=None, help="Models of a SOURCE that is no session.")
@click.option("--quaternions", type=click.Choice(("wxyz", "xyzw")), default=None,
              help="Their order in a scene.yaml that does not tell it.")  # fmt: skip
@click.option(
    "--mass", "masses", multiple=True, metavar="NAME=KG", help="A weighed object; repeat."
)
@click.option("--density", type=float, default=None, help="Of the others [kg/m^3].")
@click.option("--support", "supports", multiple=True, type=FOLDER, metavar="URDF",
              help="A bin or shelf, in the table's frame; repeat.")  # fmt: skip
@click.option("--out", type=PICTURE, default=None, help="Folder for the picture.")
@json_file("Write the table there, too.", "stable", "simulated_s")
@JSON
@QUIET
def settle_command(
    source: Path, out: Path | None, json_file: Path | None, as_json: bool, quiet: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Let physics act on SOURCE and name the objects that jump or fall.

    Poses that are millimetres off put objects into one another or into the air; grasps tried on
    such a scene mean little.

    Exit codes: 0 everything stands, 1 an object does not, 2 bad input.
    """
    from realsim.app.console import Console
    from realsim.app.school.inputs import SchoolRequest
    from realsim.app.school.settle import settle

    request = SchoolRequest(**options)
    if not settle(source, request, out, json_file, Console(quiet=quiet, as_json=as_json)):
        sys.exit(1)


@SCHOOL.command(
    "export",
    cls=Command,
    examples=(
        "realsim school export demo/session --to acronym --out acronym",
        "realsim school export demo/session --to isaac --out isaac --least-score 0.5",
    ),
)
@click.argument("source", type=FOLDER)
@click.option("--to", "target", required=True, type=click.Choice(FORMATS), help="Format.")
@click.option("--out", type=OutputFolder(), required=True, help="Folder to write into.")
@click.option("--least-score", default=0.0, show_default=True, type=click.FloatRange(0, 1),
              help="Leave out grasps of less p_hold, else score (isaac).")  # fmt: skip
@JSON
@QUIET
def export_command(
    source: Path, target: str, out: Path, least_score: float, as_json: bool, quiet: bool
) -> None:
    """Write the grasps of SOURCE (a session, or a folder of results) for other programs."""
    from realsim.app.console import Console
    from realsim.app.school.export import export

    console = Console(quiet=quiet, as_json=as_json)
    files = export(source, target, out, least_score)
    for path in files:
        console.say(str(path))
    console.result({"format": target, "files": files})


@SCHOOL.command(
    "summary", cls=Command,
    examples=("realsim school summary demo/session", "realsim school summary demo/session --json"),
)  # fmt: skip
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SESSION...")
@json_file("Write the counts there, too.", "with_trajectory", "closures", top=True)
@JSON
@QUIET
def summary_command(
    sources: tuple[Path, ...], json_file: Path | None, as_json: bool, quiet: bool
) -> None:
    """Sum up the results of many sessions, row by row as in the paper's table."""
    from realsim.app.console import Console
    from realsim.app.school.export import summarise

    summarise(sources, json_file, Console(quiet=quiet, as_json=as_json))
