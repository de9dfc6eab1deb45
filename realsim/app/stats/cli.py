"""`realsim stats` on the command line."""

from pathlib import Path

import click

FOLDER = click.Path(path_type=Path)


@click.command("stats")
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SOURCE...")
@click.option("--out", type=FOLDER, default=None, help="Folder for CSV, JSON and an HTML page.")
@click.option("--json", "json_file", type=FOLDER, default=None, help="File for the JSON alone.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
def stats_command(
    sources: tuple[Path, ...], out: Path | None, json_file: Path | None, quiet: bool
) -> None:
    """Count what sessions hold, row by row as in the paper: scenes, frames, grasps, scores.

    SOURCE is a session or a folder of sessions (of `realsim generate` or `upgrade`).

    \b
      realsim stats demo/session --out statistics
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.console import Console
    from realsim.app.stats.run import run_stats

    run_stats(sources, out, json_file, Console(quiet=quiet))
