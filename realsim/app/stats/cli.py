"""`realsim stats`: its options."""

from pathlib import Path

import click

from realsim.app.console import Console
from realsim.app.option_values import FOLDER
from realsim.app.options import Has, Where, command, json_file, many, options
from realsim.app.outputs import OutputFolder

KEYS = ("statistics", "landscape")
OUT = OutputFolder(
    ("statistics.csv", "sessions.csv", "objects.csv", "statistics.json", "statistics.html"),
    own=("statistics.json", KEYS),
)


@command(
    "stats", "realsim stats demo/session --out statistics", "realsim stats demo/session --json"
)
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SOURCE...")
@options(
    out=Has(None, ": a folder for CSV, JSON and a page", OUT), json_file=json_file(*KEYS),
    compare=None,
)  # fmt: skip
@many(1, "; sessions at a time")
def stats_command(
    console: Console, sources: tuple[Path, ...], out: Path | None, json_file: Path | None,
    compare: Path | None, where: Where,
) -> None:  # fmt: skip
    """Count what sessions hold, row by row as in the paper: scenes, frames, grasps, scores.

    SOURCE is a session or a folder of sessions (of `realsim generate` or `upgrade`).

    With --compare, SOURCE and OLD are two releases of one data set, BOP or GraspNet data sets too:
    scenes, frames, objects, poses that moved and by how much, labels of single frames, other
    cameras, images and masks, grasps that came, went or changed, and further files that differ.
    Scenes are matched by number and camera, objects by the names of their models.
    """
    from realsim.app.stats.run import run_stats

    if compare is None:
        run_stats(sources, out, json_file, console, where)
    elif out is not None or json_file is not None:
        raise click.UsageError("--compare shows or prints (--json): no --out, no --json-file.")
    else:
        from realsim.app.stats.compare import compare_releases

        console.result(compare_releases(sources, compare, console))
