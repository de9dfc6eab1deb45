"""`realsim pipeline`: its options."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from realsim.app.command import Command, Group
from realsim.app.options import FOLDER, JSON, QUIET, many

if TYPE_CHECKING:
    from realsim.many import PoolConfig


@click.command(
    "pipeline",
    cls=Command,
    examples=(
        "realsim pipeline campaign.toml --workers 2",
        "realsim pipeline campaign.toml --json",
    ),
)
@click.argument("campaign", type=FOLDER)
@many(help="Scenes at a time.")
@click.option("--plan", "only_plan", is_flag=True, help="Print what would run, and run nothing.")
@click.option("--without-failed", is_flag=True,
              help="Export what is done, although scenes failed.")  # fmt: skip
@JSON
@QUIET
@click.pass_context
def pipeline_command(
    ctx: click.Context, campaign: Path, where: "PoolConfig", only_plan: bool, without_failed: bool,
    as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Run a campaign: the scenes and stages that the file CAMPAIGN names.

    \b
      [campaign]
      out = "tables"
      stages = ["school", "annotate", "export", "stats"]
      [generate]            or: sources = ["recordings/*.bag"], to import
      scenes = 20               sessions = ["captures/*"], that are there
      [school.run]
      grasps = 60
      [export]
      to = "bop"

    Tables hold the options of a command, as in realsim.toml; paths count from the file's folder. A
    scene that fails is listed, and the others go on; stages over all scenes wait for it. Run again,
    the same command does what is not done yet, and what failed.

    Writes OUT/campaign.html and campaign.json, renewed as scenes end; OUT/scenes; OUT/logs.

    Exit codes: 0 done, 1 a scene or a stage failed, 2 bad input, 130 interrupted.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.console import Console
    from realsim.app.pipeline.campaign import read_campaign
    from realsim.app.pipeline.run import run_pipeline, show_pipeline, show_plan

    root = ctx.find_root().command
    assert isinstance(root, Group)
    console = Console(quiet=quiet, as_json=as_json)
    asked = read_campaign(campaign, root)
    if only_plan:
        show_plan(asked, console)
        return
    result = run_pipeline(asked, where, console, without_failed=without_failed)
    show_pipeline(asked, result, console)
    console.result(result.told)
    if result.failed:
        sys.exit(1)
