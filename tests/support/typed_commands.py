"""Commands as they are typed, run in this process: an interpreter that starts costs more than most.

The whole of `realsim.app.cli.main` runs, so that exit codes and messages are those of the program.
Laws about the process itself (kills, terminals, what is imported) start one.
"""

import contextlib
import io
import subprocess
import sys
import traceback


def realsim(*words: object) -> "subprocess.CompletedProcess[str]":
    """Return what `realsim WORDS...` ends with; there is no terminal and nothing is typed in."""
    from realsim.app.cli import main

    typed = ["realsim", *map(str, words)]
    said, complained = io.StringIO(), io.StringIO()
    argv, code = sys.argv, 0
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
        sys.argv = typed
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        except Exception:  # as the interpreter would: the tests look for its traceback
            traceback.print_exc()
            code = 1
        finally:
            sys.argv = argv
    return subprocess.CompletedProcess(typed, code, said.getvalue(), complained.getvalue())
