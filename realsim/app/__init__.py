"""The command line, the whole loop, and the reports: the one place that knows every stage."""

import os
import sys


def main() -> None:
    """Run the command line."""
    from realsim.app.front import help_text

    if sys.argv[1:] in (["--help"], ["-h"]):
        try:
            print(help_text(), end="", flush=True)
        except BrokenPipeError:
            os._exit(141)  # as `realsim.app.cli`, where the reader of the output has gone
        return
    try:
        from realsim.app.cli import main as run

        run()
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("realsim"):
            raise  # a bug: its place is wanted
        print(
            f"error: {error.name} is not installed. Install what realsim needs with `uv sync "
            "--inexact`, or `pip install realsim`; `realsim doctor` says what else is missing.",
            file=sys.stderr,
        )
        sys.exit(2)
