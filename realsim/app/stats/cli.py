"""`realsim stats` on the command line."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, json_file, many
from realsim.app.outputs import OutputFolder

if TYPE_CHECKING:
    from realsim.many import PoolConfig

KEYS = ("statistics", "landscape")
OUT = OutputFolder(
    ("statistics.csv", "sessions.csv", "objects.csv", "statistics.json", "statistics.html"),
    own=("statistics.json", KEYS),
)


@click.command(
    "stats", cls=Command,
    examples=("realsim stats demo/session --out statistics", "realsim stats demo/session --json"),
)  # fmt: skip
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SOURCE...")
@click.option("--out", type=OUT, default=None, help="Folder for CSV, JSON and an HTML page.")
@json_file("File for the JSON alone.", *KEYS)
@click.option("--compare", type=FOLDER, default=None, metavar="OLD",
              help="Say what differs from an older release instead.")  # fmt: skip
@many(1, "Sessions at a time.")
@JSON
@QUIET
def stats_command(
    sources: tuple[Path, ...], out: Path | None, json_file: Path | None, compare: Path | None,
    where: "PoolConfig", as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Count what sessions hold, row by row as in the paper: scenes, frames, grasps, scores.

    SOURCE is a session or a folder of sessions (of `realsim generate` or `upgrade`).

    With --compare, SOURCE and OLD are two releases of one data set, BOP or GraspNet data sets too:
    scenes, frames, objects, poses that moved and by how much, grasps that came, went or changed.
    """
    from realsim.app.console import Console
    from realsim.app.stats.run import run_stats

    if compare is not None:
        from realsim.app.stats.compare import compare_releases

        if out is not None or json_file is not None:
            raise click.UsageError("--compare shows or prints (--json): no --out, no --json-file.")
        console = Console(quiet=quiet, as_json=as_json)
        console.result(compare_releases(sources, compare, console))
        return
    run_stats(sources, out, json_file, Console(quiet=quiet, as_json=as_json), where)
