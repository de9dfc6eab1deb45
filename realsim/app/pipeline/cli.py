"""`realsim pipeline`: its options."""

from pathlib import Path

import click

from realsim.app.command import Group
from realsim.app.console import Console
from realsim.app.option_values import FOLDER
from realsim.app.options import Has, Where, command, many, options


@command(
    "pipeline",
    "realsim pipeline campaign.toml --workers 2",
    "realsim pipeline campaign.toml --json",
)
@click.argument("campaign", type=FOLDER)
@many(note="; scenes at a time")
@options(list=Has(False, ": print what would run"), without_failed=False)
@click.pass_context
def pipeline_command(
    ctx: click.Context, console: Console, campaign: Path, where: Where, list_only: bool,
    without_failed: bool,
) -> bool:  # fmt: skip
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
    from realsim.app.pipeline.campaign import read_campaign
    from realsim.app.pipeline.run import run_pipeline, show_pipeline, show_plan

    root = ctx.find_root().command
    assert isinstance(root, Group)
    asked = read_campaign(campaign, root)
    if list_only:
        show_plan(asked, console)
        return True
    result = run_pipeline(asked, where, console, without_failed=without_failed)
    show_pipeline(asked, result, console)
    console.result(result.told)
    return not result.failed
