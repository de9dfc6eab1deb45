"""`realsim demo`: its options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.options import JSON, QUIET, arm, seed, workers
from realsim.app.outputs import GOES_ON


@click.command(
    "demo", cls=Command,
    examples=(
        "realsim demo", "realsim demo --arm panda --out small --views 12 --objects 2 --grasps 20"
    ),
)  # fmt: skip
@click.option(
    "--out",
    type=GOES_ON,
    default=Path("demo"),
    show_default=True,
    help="Folder to fill.",
)
@arm("The arm that captures, or its folder.", default="ur5")
@click.option("--views", default=24, show_default=True, type=click.IntRange(4, 1024),
              help="Of the scene.")  # fmt: skip
@click.option("--objects", default=5, show_default=True, type=click.IntRange(1, 40),
              help="On the table.")  # fmt: skip
@seed("Another seed, another scene.")
@click.option("--grasps", default=60, show_default=True, type=click.IntRange(1, 2000),
              help="Candidates to try on each object, at most.")  # fmt: skip
@workers(help="Processes of the Robot School.")
@JSON
@QUIET
def demo_command(out: Path, as_json: bool, quiet: bool, grasps: int, **setup: Any) -> None:
    """Run the whole loop in a simulated lab and compare it with the truth."""
    from realsim.app.console import Console
    from realsim.app.demo.run import DemoConfig, demo_document, run_demo, show_demo

    config = DemoConfig(grasps_per_object=grasps, **setup)
    console = Console(quiet=quiet, as_json=as_json)
    result = run_demo(config, out, console)
    show_demo(result, console)
    console.result(demo_document(result))
