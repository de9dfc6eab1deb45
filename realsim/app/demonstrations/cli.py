"""`realsim demonstrations` on the command line."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, many
from realsim.app.outputs import GOES_ON

if TYPE_CHECKING:
    from realsim.many import PoolConfig


@click.command(
    "demonstrations",
    cls=Command,
    examples=(
        "realsim demonstrations demo/session --out demonstrations --limit 2",
        "realsim demonstrations demo/session --out good --outcome success --fps 10 --limit 1",
    ),
)
@click.argument("source", type=FOLDER)
@click.option(
    "--out",
    type=GOES_ON,
    required=True,
    help="Folder to fill; new, or to go on in.",
)
@click.option("--task", default="grasp", show_default=True, type=click.Choice(("grasp", "place")),
              help="Grasp and shake, or put it somewhere.")  # fmt: skip
@click.option("--fps", default=20, show_default=True, type=click.IntRange(1, 240),
              help="Steps per second.")  # fmt: skip
@click.option("--outcome", default="all", show_default=True,
              type=click.Choice(("all", "success", "failure")),
              help="Of the attempts.")  # fmt: skip
@click.option("--grasp", "grasps", multiple=True, metavar="INSTANCE:GRASP",
              help="Only this attempt; repeat.")  # fmt: skip
@click.option("--limit", type=click.IntRange(1), default=None,
              help="So many attempts, spread over all.")  # fmt: skip
@click.option("--width", default=320, show_default=True, type=click.IntRange(16, 4096),
              help="Of the pictures [px].")  # fmt: skip
@click.option("--height", default=240, show_default=True, type=click.IntRange(16, 4096),
              help="Of the pictures [px].")  # fmt: skip
@click.option("--view", type=click.IntRange(0), default=None,
              help="View of the session for the fixed camera.  [beside the table]")  # fmt: skip
@click.option("--hand-eye", is_flag=True,
              help="Mount the hand's camera as the session's calibration says.")  # fmt: skip
@click.option("--depth", is_flag=True, help="Depth beside the pictures.")
@click.option("--mass", "masses", multiple=True, metavar="NAME=KG", help="As the school was told.")
@click.option("--episodes-per-file", default=50, show_default=True, type=click.IntRange(1, 10_000),
              help="Attempts in one file of data/ and videos/.")  # fmt: skip
@click.option("--name", default="", help="Of the data set, on its card.")
@click.option("--licence", default="", help="Of the pictures, on the card.")
@click.option("--models-licence", default="", help="Of the object models, on the card.")
@click.option("--attribution", default="", help="Whom to name, on the card.")
@many(1, "Processes; all give the same bytes.")
@JSON
@QUIET
def demonstrations_command(
    source: Path, out: Path, as_json: bool, quiet: bool, where: "PoolConfig", **options: Any
) -> None:
    """Replay the school's attempts on SOURCE and write them as a LeRobot v3.0 data set.

    SOURCE is a session, or a folder of results of `realsim school`. Every attempt that the arm
    made is replayed, successful or failed, with its physics: joints, actions, the object, and
    pictures from a fixed camera and one in the hand, and where the cameras are. Interrupted, the
    same command goes on.

    Writes meta/, data/ and videos/ (LeRobot), realsim/episodes.jsonl, demonstrations.html.
    """
    from realsim.app.console import Console
    from realsim.app.demonstrations.run import (
        DemonstrationRequest,
        export_demonstrations,
        show_demonstrations,
    )

    console = Console(quiet=quiet, as_json=as_json)
    result = export_demonstrations(source, out, DemonstrationRequest(**options), console, where)
    show_demonstrations(result, console)
    console.result(result)
