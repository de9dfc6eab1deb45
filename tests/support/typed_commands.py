"""Commands as they are typed, run in this process: an interpreter that starts costs more than most.

- `realsim`: the whole of `realsim.app.cli.main`, so that exit codes and messages are those of the
  program. Laws about the process itself (kills, terminals, what is imported) start one.
- `started`: the program as a process of its own.
- `wait_until`: what such a process is to come to.
- `complained`: what the program said of bad input, which has to be in words.
- `invoked`, `finished`, `refused`: the command alone, which says what it raised.
"""

import contextlib
import io
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

from click.testing import CliRunner, Result

from realsim.errors import InputError


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


def started(*words: object, **options: Any) -> "subprocess.Popen[str]":
    """Start `realsim WORDS...` in an interpreter of its own; `options` are those of `Popen`."""
    code = "from realsim.app.cli import main; main()"
    line = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.Popen(line, text=True, **options)


def wait_until(reached: Callable[[], object], process: "subprocess.Popen[str]") -> None:
    """Wait until something is so; a process that ends before that is an error, as are minutes."""
    end = time.monotonic() + 900
    while not reached():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, process.args
        time.sleep(0.005)


def complained(*words: object) -> str:
    """Return what `realsim WORDS...` said of bad input: it has to end with 2 and no traceback."""
    done = realsim(*words)
    assert done.returncode == 2 and "Traceback" not in done.stderr, (done.stdout, done.stderr)
    return done.stderr


def invoked(*words: object) -> Result:
    """Return how the command `realsim WORDS...` ended; what it raised is its `exception`."""
    from realsim.app.cli import commands

    return CliRunner().invoke(commands, [str(w) for w in words])


def finished(*words: object) -> Result:
    """Return how a command ended that has to end with 0."""
    result = invoked(*words)
    assert result.exit_code == 0, (result.output, result.exception)
    return result


def refused(*words: object) -> str:
    """Return why a command was refused, which has to be the user's mistake."""
    result = invoked(*words)
    assert isinstance(result.exception, InputError), (result.output, result.exception)
    return str(result.exception)
