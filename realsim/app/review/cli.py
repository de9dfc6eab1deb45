"""`realsim review`: its options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET
from realsim.app.outputs import OutputFile

MARK = ("Made with realsim", "The viewer in this file is Viser")
PAGE = OutputFile({".html": MARK, ".htm": MARK}, "page")


@click.command(
    "review",
    cls=Command,
    examples=(
        "realsim review demo/session",
        "realsim review demo/session --static scene.html",
    ),
)
@click.argument("sessions", type=FOLDER, nargs=-1, required=True, metavar="SESSION...")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--port", default=8080, show_default=True, type=click.IntRange(0, 65535),
              help="The next free one is taken if it is in use; 0 = any.")  # fmt: skip
@click.option("--token-file", type=FOLDER, default=None, metavar="FILE",
              help="Ask for the secret in this file, in place of one that is made.")  # fmt: skip
@click.option("--reviewer", default="", metavar="NAME", help="Your name; decisions are signed.")
@click.option("--static", type=PAGE, default=None, metavar="FILE",
              help="Write the reviewed scene as one HTML file, and end.")  # fmt: skip
@click.option("--no-browser", is_flag=True, help="Do not open a browser.")
@QUIET
@JSON
def review_command(
    sessions: tuple[Path, ...], static: Path | None, quiet: bool, as_json: bool, **options: Any
) -> None:
    """Look at sessions in the browser: accept, reject or correct each object, worst first.

    SESSION is a registered session, or a folder of sessions such as the output of `realsim
    upgrade`: all below it are opened. Decisions are appended to SESSION/review/journal.jsonl,
    signed; nothing is overwritten. `realsim register SESSION --from-review` goes on from them.

    Only this machine can open the page. From another one, forward the port with ssh; or give a
    --host of this machine: whoever opens the page then needs the token that is printed, and nothing
    is encrypted.

    Ctrl-C ends. Exit codes: 0 ended, 2 bad input.
    """
    from realsim.app.console import Console
    from realsim.app.review.run import ReviewRequest, run_review, write_page

    console = Console(quiet=quiet, as_json=as_json)
    request = ReviewRequest(
        folders=sessions,
        host=options["host"],
        port=options["port"],
        token_file=options["token_file"],
        reviewer=options["reviewer"],
        opens_browser=not options["no_browser"],
    )
    if static is not None:
        write_page(request, static, console)
    else:
        run_review(request, console)
