"""`realsim plan`, `plan-show` and `plan-convert`: their options."""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.option_values import port_in_use
from realsim.app.options import FOLDER, JSON, QUIET, PlanName, arm, overwrite, seed
from realsim.app.outputs import GOES_ON, OutputFile

REPLAY = OutputFile({".html": ("viser",), ".viser": ("viser",)}, "replay")


@click.command(
    "plan",
    cls=Command,
    examples=(
        "realsim plan --views 24 --out plan.json",
        "realsim plan --board --out board_plan.json --no-pictures",
        "realsim plan --arm panda --advise --views 64",
    ),
)
@click.option("--views", type=click.IntRange(1, 4096), default=None, help="[256; 24 of a board]")
@arm("The arm, or its folder.", default="ur5")
@click.option(
    "--calibration", type=FOLDER, default=None,
    help="The arm's own calibration: the controller's calibration.conf, or ROS's YAML.",
)  # fmt: skip
@click.option("--mount", type=FOLDER, default=None, help="Mount file.  [a D405 on a bracket]")
@click.option("--center", default="", help="Scene centre x,y,z in base [m].  [0.40,0, 0.05 up]")
@click.option("--table-height", type=float, default=None, help="z of the table's top [m].  [0]")
@click.option("--keep-out", default="", help="Box of the objects x,y,z [m].  [0.3,0.3,0.12]")
@click.option("--obstacles", type=FOLDER, default=None, help="TOML file of named boxes in base.")
@click.option("--radius", default="", help="Camera to centre, least,greatest [m].")
@click.option("--elevation", default="", help="Camera above the table, least,greatest [degrees].")
@seed("Another seed, another plan.")
@click.option("--board", is_flag=True, help="Views of a board, to calibrate with.")
@click.option("--advise", is_flag=True, help="Say where the centre is best put; plan nothing.")
@click.option(
    "--out",
    type=GOES_ON,
    default=Path("plan.json"),
    show_default=True,
    help="File.",
)
@overwrite("Replace a plan of the same name.")
@click.option("--no-pictures", is_flag=True, help="The plan file alone.")
@JSON
@QUIET
def plan_command(advise: bool, as_json: bool, quiet: bool, **options: Any) -> None:
    """Plan the views of a scene, or of a board: where the arm goes, in which order.

    Writes the plan file and pictures beside it.

    Exit codes: 0 done, 1 a move of it collides, 2 bad input.
    """
    from realsim.app.console import Console
    from realsim.app.plan.request import PlanRequest
    from realsim.app.plan.run import run_plan

    if not run_plan(PlanRequest.of(options), Console(quiet=quiet, as_json=as_json), advise=advise):
        sys.exit(1)


@click.command(
    "plan-show",
    cls=Command,
    examples=(
        "realsim plan-show plan.json --no-pictures",
        "realsim plan-show shipped:ur5_d405_hemisphere_256 --no-pictures --json",
        "realsim plan-show plan.json --no-pictures --replay-file replay.viser",
    ),
)
@click.argument("source", metavar="PLAN", type=PlanName())
@arm("Folder of the plan's arm, where it is not found by name.")
@click.option("--replay", is_flag=True, help="Drive it on the screen, in the browser.")
@click.option("--replay-file", type=REPLAY, default=None, help="Write the replay as a file.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address of the replay.")
@click.option(
    "--port", default=8080, show_default=True, type=click.IntRange(0, 65535),
    help="Port of the replay.",
)  # fmt: skip
@overwrite("Replace the file of the replay.")
@click.option("--no-pictures", is_flag=True, help="The table alone.")
@JSON
@QUIET
def plan_show_command(
    source: str, replay_file: Path | None, overwrite: bool, no_pictures: bool, as_json: bool,
    quiet: bool, **replay: Any,
) -> None:  # fmt: skip
    """Show how good a plan is, with pictures and a replay.

    PLAN is a plan file, or shipped:ur5_d405_hemisphere_256.

    Exit codes: 0 done, 1 a move of it collides, 2 bad input.
    """
    from realsim.app.console import Console
    from realsim.app.plan.run import run_show
    from realsim.errors import InputError

    if replay_file is not None and replay_file.exists() and not overwrite:
        raise InputError(
            f"{replay_file} is there already. Name another file, or replace it with --overwrite."
        )
    port: int = replay["port"]
    if replay["replay"] and port and port_in_use(replay["host"], port):
        click.echo(f"note: port {port} is in use; another one will be taken.", err=True)
    if not run_show(
        source, Console(quiet=quiet, as_json=as_json), pictures=not no_pictures,
        replay_file=replay_file, **replay,
    ):  # fmt: skip
        sys.exit(1)


@click.command(
    "plan-convert",
    cls=Command,
    examples=(
        "realsim plan-convert plan.json plan.csv",
        "realsim plan-convert shipped:ur5_d405_hemisphere_256 hemisphere.script",
    ),
)
@click.argument("source", type=PlanName())
@click.argument("dest", type=GOES_ON)
@arm("Arm of a path without tool poses.")
@click.option("--calibration", type=FOLDER, default=None, help="The arm's own calibration.")
@click.option("--mount", type=FOLDER, default=None, help="Mount file.  [a D405 on a bracket]")
@click.option("--center", default="", help="Scene centre x,y,z [m].  [where the cameras look]")
@click.option("--table-height", type=float, default=None, help="z of the table's top [m].  [0]")
@click.option("--keep-out", default="", help="Box of the objects x,y,z [m].")
@click.option("--obstacles", type=FOLDER, default=None, help="TOML file of named boxes in base.")
@click.option(
    "--joints-unit", type=click.Choice(["deg", "rad"]), default=None,
    help="Unit of joints that say none.",
)  # fmt: skip
@overwrite("Replace DEST.")
@JSON
@QUIET
def plan_convert_command(
    source: str, dest: Path, joints_unit: Any, overwrite: bool, as_json: bool,
    quiet: bool, **place: Any,
) -> None:  # fmt: skip
    """Read other people's joint paths, and write plans for other programs.

    \b
    SOURCE  a realsim plan (.json or shipped:NAME), a joint path with tool
            poses (.json), or a table (.csv with q1_rad ... or q1_deg ...,
            and via)
    DEST    .json    realsim plan
            .csv     table of joints and expected camera poses
            .script  URScript program, of a UR
            FOLDER   GraspNet's camera_poses.npy and cam0_wrt_table.npy

    Robot, units and tool offset of a path are proven from its tool poses.

    Exit codes: 0 done, 1 a move of an imported path collides, 2 bad input.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.console import Console
    from realsim.app.plan.request import Place
    from realsim.app.plan.run import run_convert

    where = Place(**place)
    console = Console(quiet=quiet, as_json=as_json)
    if not run_convert(source, dest, where, console, joints_unit=joints_unit, overwrite=overwrite):
        sys.exit(1)
