"""Commands whose output nobody wants (`>&-`, `2>&-`) do their work all the same."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from typed_commands import realsim, started

MAIN = "from realsim.app.cli import main; main()"
CLOSED = "<&- >&- 2>&-"


def run(script: str, arguments: str, closed: str) -> subprocess.CompletedProcess[str]:
    """Run a script of Python by a shell that closes streams first."""
    line = f"exec '{sys.executable}' -c '{script}' {arguments} {closed}"
    return subprocess.run(
        ["sh", "-c", line], capture_output=True, text=True, timeout=120, check=False
    )


def test_the_result_is_that_of_a_run_whose_streams_are_open(
    small_session: Path, tmp_path: Path
) -> None:
    files = [tmp_path / "open.json", tmp_path / "closed.json"]
    assert realsim("stats", small_session, "--json-file", files[0]).returncode == 0
    done = run(MAIN, f"stats '{small_session}' --json-file '{files[1]}'", CLOSED)
    assert done.returncode == 0
    assert files[0].read_bytes() == files[1].read_bytes()


def test_what_a_library_prints_never_lands_in_a_file(tmp_path: Path) -> None:
    script = (
        "import os, sys; from realsim.app.console import open_missing_streams; "
        "open_missing_streams(); file = open(sys.argv[1], \"w\"); "
        "os.write(1, b\"noise\"); os.write(2, b\"noise\"); os.system(\"echo noise\"); "
        "print(\"noise\"); file.write(\"kept\"); file.close()"
    )  # fmt: skip
    path = tmp_path / "file"
    assert run(script, f"'{path}'", CLOSED).returncode == 0
    assert path.read_text() == "kept"


@pytest.mark.parametrize("words", [["--help"], ["check", "S"], ["check", "S", "--json"], ["no"]])
@pytest.mark.parametrize("also_errors", [False, True])
def test_a_reader_that_has_gone_is_no_failed_check(
    words: list[str], also_errors: bool, small_session: Path
) -> None:
    typed = [str(small_session) if w == "S" else w for w in words]
    reading, writing = os.pipe()
    os.close(reading)
    errors = writing if also_errors else subprocess.PIPE
    process = started(*typed, stdout=writing, stderr=errors)
    said = process.communicate(timeout=120)[1]
    os.close(writing)
    writes = also_errors or words != ["no"]
    assert process.returncode == (128 + signal.SIGPIPE if writes else 2)
    assert not said or "Traceback" not in said


def test_pycolmap_leaves_the_answer_to_sigterm_alone() -> None:
    script = """if True:
        import os, signal, sys, time
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        from realsim.interop import import_pycolmap
        import_pycolmap()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
    """
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode == 143 and b"stack trace" not in done.stderr


@pytest.mark.parametrize(
    ("cause", "code"), [("cli.Terminated()", 143), ("KeyboardInterrupt()", 130), ("None", 1)]
)
def test_sigterm_in_a_compiled_call_while_a_module_is_loaded_is_no_bug(
    cause: str, code: int
) -> None:
    script = f"""if True:
        import sys
        from realsim.app import cli
        def work():
            try:
                raise SystemError("returned a result with an exception set") from {cause}
            except SystemError as error:
                raise ImportError("initialization failed") from error
        cli.commands.command("work")(work)
        sys.argv = ["realsim", "work"]
        cli.main()
    """
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode == code and (b"goes on from here" in done.stderr) == (code != 1)


def test_a_second_sigterm_does_not_break_into_the_ending() -> None:
    script = """if True:
        import sys, time
        from realsim.app import cli
        from realsim.many import open_pool
        def work():
            with open_pool(2) as pool:
                pool.submit(time.sleep, 0.0).result()
                print("ready", flush=True)
                time.sleep(60)
        if __name__ == "__main__":
            cli.commands.command("work")(work)
            sys.argv = ["realsim", "work"]
            cli.main()
    """
    run = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE,
                           stderr=subprocess.PIPE, text=True)  # fmt: skip
    assert run.stdout is not None and run.stdout.readline() == "ready\n"
    while run.poll() is None:
        run.terminate()
        time.sleep(0.01)
    told = run.communicate()[1].strip()
    assert (run.returncode, told) == (143, "interrupted; the same command goes on from here.")
