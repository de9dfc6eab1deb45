"""`realsim report` on the command line."""

import sys
from pathlib import Path

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET
from realsim.app.outputs import OutputFile

MARK = ('<script type="application/json" id="report">',)
PAGE = OutputFile({".html": MARK, ".htm": MARK}, "page")


@click.command(
    "report", cls=Command,
    examples=(
        "realsim report demo/session",
        "realsim report demo/session --json --fail-on 'registration.accepted<5'",
        "realsim report monday tuesday --out comparison.html --fail-if-worse",
    ),
)  # fmt: skip
@click.argument("sessions", type=FOLDER, nargs=-1, required=True, metavar="SESSION...")
@click.option("--truth", type=FOLDER, default=None, help="The simulated lab's truth folder.")
@click.option(
    "--out", type=PAGE, default=None, metavar="FILE",
    help="HTML file to write.  [one session: SESSION/reports/report.html; several: none]",
)  # fmt: skip
@click.option(
    "--limits", type=FOLDER, default=None, metavar="FILE",
    help="TOML file of limits: FIGURE = {min = .., max = ..}.",
)  # fmt: skip
@click.option(
    "--fail-on", multiple=True, metavar="RULE",
    help="NAME<VALUE or NAME>VALUE: fail if it is so. May be given again.",
)  # fmt: skip
@click.option("--fail-if-worse", is_flag=True, help="Fail if a figure is worse than the first's.")
@JSON
@QUIET
def report_command(
    sessions: tuple[Path, ...], truth: Path | None, out: Path | None, limits: Path | None,
    fail_on: tuple[str, ...], fail_if_worse: bool, as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Report one SESSION on a self-contained page, or compare several.

    One: writes SESSION/reports/report.html, and report.json with the same figures. Several: prints
    how each differs from the first, figure by figure and object by object; a stored report.json
    may stand for its session.

    Ends with exit code 1 when a check is bad, a limit is broken, or (with --fail-if-worse) a figure
    is worse by more than its noise. A limit that is exactly met is kept.
    """
    from realsim.app.report.run import ReportRequest, run_report

    request = ReportRequest(
        sources=sessions, truth=truth, out=out, limits=limits, fail_on=fail_on,
        fail_if_worse=fail_if_worse, as_json=as_json, quiet=quiet,
    )  # fmt: skip
    if not run_report(request):
        sys.exit(1)
