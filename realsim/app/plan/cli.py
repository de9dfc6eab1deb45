"""`realsim plan`, `plan-show` and `plan-convert`: their options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.console import Console
from realsim.app.option_values import PlanName, port_in_use
from realsim.app.options import Has, command, options, rare
from realsim.app.outputs import GOES_ON, OutputFile

REPLAY = OutputFile({".html": ("viser",), ".viser": ("viser",)}, "replay")
CELL = {
    "mount": Has(None, "  [a D405 on a bracket]"), "center": Has("", "  [0.40,0, 0.05 up]"),
    "table_height": Has(None, "  [0]"), "keep_out": Has("", "  [0.3,0.3,0.12]"), "obstacles": None,
    "arm_calibration": None,
}  # fmt: skip
"""Options of what stands round the arm."""


@command(
    "plan",
    "realsim plan --views 24 --out plan.json",
    "realsim plan --board-views --out board_plan.json --no-pictures",
    "realsim plan --arm panda --advise --views 64",
)
@options(
    views=Has(None, "  [256; 24 of a board]", click.IntRange(1, 4096)), arm="ur5",
    out=Has(Path("plan.json"), kind=GOES_ON), board_views=False, advise=False, overwrite=False,
    no_pictures=False,
)  # fmt: skip
@options(**CELL)
@rare(radius="", elevation="", seed=0)
def plan_command(console: Console, advise: bool, **options: Any) -> bool:
    """Plan the views of a scene, or of a board: where the arm goes, in which order.

    Writes the plan file and pictures beside it.

    Exit codes: 0 done, 1 a move of it collides, 2 bad input.
    """
    from realsim.app.plan.request import PlanRequest
    from realsim.app.plan.run import run_plan

    return run_plan(PlanRequest.of(options), console, advise=advise)


@command(
    "plan-show",
    "realsim plan-show plan.json --no-pictures",
    "realsim plan-show shipped:ur5_d405_hemisphere_256 --no-pictures --json",
    "realsim plan-show plan.json --no-pictures --replay-file replay.viser",
)
@click.argument("source", metavar="PLAN", type=PlanName())
@options(
    arm=Has(None, "  [the plan's]"), replay=False, replay_file=Has(kind=REPLAY), port=8080,
    host="127.0.0.1", overwrite=False, no_pictures=False,
)  # fmt: skip
def plan_show_command(
    console: Console, source: str, replay_file: Path | None, overwrite: bool, no_pictures: bool,
    **replay: Any,
) -> bool:  # fmt: skip
    """Show how good a plan is, with pictures and a replay.

    PLAN is a plan file, or shipped:ur5_d405_hemisphere_256.

    Exit codes: 0 done, 1 a move of it collides, 2 bad input.
    """
    from realsim.app.plan.run import run_show
    from realsim.errors import InputError

    if replay_file is not None and replay_file.exists() and not overwrite:
        raise InputError(
            f"{replay_file} is there already. Name another file, or replace it with --overwrite."
        )
    port: int = replay["port"]
    if replay["replay"] and port and port_in_use(replay["host"], port):
        click.echo(f"note: port {port} is in use; another one will be taken.", err=True)
    return run_show(source, console, pictures=not no_pictures, replay_file=replay_file, **replay)


@command(
    "plan-convert",
    "realsim plan-convert plan.json plan.csv",
    "realsim plan-convert shipped:ur5_d405_hemisphere_256 hemisphere.script",
)
@click.argument("source", type=PlanName())
@click.argument("dest", type=GOES_ON)
@options(arm=Has(None, ", of a path without tool poses"), joints_unit=None, overwrite=False)
@options(**CELL | {"center": Has("", "  [where the cameras look]"), "keep_out": ""})
def plan_convert_command(
    console: Console, source: str, dest: Path, joints_unit: Any, overwrite: bool, **place: Any
) -> bool:
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
    from realsim.app.plan.request import Place
    from realsim.app.plan.run import run_convert

    where = Place(**place)
    return run_convert(source, dest, where, console, joints_unit=joints_unit, overwrite=overwrite)
