"""Commands whose output nobody wants (`>&-`, `2>&-`) do their work all the same."""

import subprocess
import sys
from pathlib import Path

import pytest

from registered_sessions import table_session

MAIN = "from realsim.app.cli import main; main()"
CLOSED = (">&-", "2>&-", "<&- >&- 2>&-")


def run(script: str, arguments: str, closed: str) -> subprocess.CompletedProcess[str]:
    """Run a script of Python by a shell that closes streams first."""
    line = f"exec '{sys.executable}' -c '{script}' {arguments} {closed}"
    return subprocess.run(
        ["sh", "-c", line], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("closed") / "s"
    table_session(folder, views=1)
    return folder


@pytest.mark.parametrize("closed", CLOSED)
def test_the_result_is_that_of_a_run_whose_streams_are_open(
    session: Path, tmp_path: Path, closed: str
) -> None:
    files = [tmp_path / "open.json", tmp_path / "closed.json"]
    done = [
        run(MAIN, f"stats '{session}' --json-file '{file}'", how)
        for file, how in zip(files, ("", closed), strict=True)
    ]
    assert [d.returncode for d in done] == [0, 0], done[1].stderr
    assert files[0].read_bytes() == files[1].read_bytes()
    if closed == "2>&-":
        assert done[0].stdout == done[1].stdout


@pytest.mark.parametrize("closed", CLOSED)
def test_what_cannot_be_used_ends_with_2(tmp_path: Path, closed: str) -> None:
    done = run(MAIN, f"stats '{tmp_path}/nothing'", closed)
    assert done.returncode == 2 and "Traceback" not in done.stderr


def test_what_a_library_prints_never_lands_in_a_file(tmp_path: Path) -> None:
    script = (
        "import os, sys; from realsim.app.console import open_missing_streams; "
        "open_missing_streams(); file = open(sys.argv[1], \"w\"); "
        "os.write(1, b\"noise\"); os.write(2, b\"noise\"); os.system(\"echo noise\"); "
        "print(\"noise\"); file.write(\"kept\"); file.close()"
    )  # fmt: skip
    path = tmp_path / "file"
    assert run(script, f"'{path}'", "<&- >&- 2>&-").returncode == 0
    assert path.read_text() == "kept"
