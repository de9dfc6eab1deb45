"""`realsim report`: its options."""

from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.options import SESSIONS, Has, command, options
from realsim.app.outputs import OutputFile

MARK = ('<script type="application/json" id="report">',)
PAGE = OutputFile({".html": MARK, ".htm": MARK}, "page")


@command(
    "report",
    "realsim report demo/session",
    "realsim report demo/session --json --fail-on 'registration.accepted<5'",
    "realsim report monday tuesday --out comparison.html --fail-if-worse",
)
@SESSIONS
@options(
    out=Has(None, "  [one session: SESSION/reports/report.html; several: none]", PAGE), truth=None,
    limits=None, fail_on=(), fail_if_worse=False,
)  # fmt: skip
def report_command(console: Console, sessions: tuple[Path, ...], **options: Any) -> bool:
    """Report one SESSION on a self-contained page, or compare several.

    One: writes SESSION/reports/report.html, and report.json with the same figures. Several: prints
    how each differs from the first, figure by figure and object by object; a stored report.json
    may stand for its session.

    Ends with exit code 1 when a check is bad, a limit is broken, or (with --fail-if-worse) a figure
    is worse by more than its noise. A limit that is exactly met is kept.
    """
    from realsim.app.report.run import ReportRequest, run_report

    return run_report(ReportRequest(sources=sessions, **options), console)
