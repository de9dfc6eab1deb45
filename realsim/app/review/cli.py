"""`realsim review`: its options."""

from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.options import SESSIONS, Has, command, options, rare
from realsim.app.outputs import OutputFile

MARK = ("Made with realsim", "The viewer in this file is Viser")
PAGE = OutputFile({".html": MARK, ".htm": MARK}, "page")


@command("review", "realsim review demo/session", "realsim review demo/session --static scene.html")
@SESSIONS
@options(port=8080, reviewer="", static=Has(kind=PAGE), no_browser=False)
@rare(host="127.0.0.1", token_file=None)
def review_command(
    console: Console, sessions: tuple[Path, ...], static: Path | None, no_browser: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Look at sessions in the browser: accept, reject or correct each object, worst first.

    SESSION is a registered session, or a folder of sessions such as the output of `realsim
    upgrade`: all below it are opened. Decisions are appended to SESSION/review/journal.jsonl,
    signed; nothing is overwritten. `realsim register SESSION --from-review` goes on from them.

    Only this machine can open the page. From another one, forward the port with ssh; or give a
    --host of this machine: whoever opens the page then needs the token that is printed, and nothing
    is encrypted.

    Ctrl-C ends. Exit codes: 0 ended, 2 bad input.
    """
    from realsim.app.review.run import ReviewRequest, run_review, write_page

    request = ReviewRequest(folders=sessions, opens_browser=not no_browser, **options)
    if static is not None:
        write_page(request, static, console)
    else:
        run_review(request, console)
