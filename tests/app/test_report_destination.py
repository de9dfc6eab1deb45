"""Where `--out` may write: on a new name or on a page of reports, never on anything else."""

import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from realsim.app.report.cli import report_command
from realsim.app.report.session import write_report
from realsim.errors import InputError
from realsim.store import SessionStore
from registered_sessions import table_session


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a session; its report.json lies beside it."""
    store: SessionStore = table_session(tmp_path_factory.mktemp("out") / "s", views=2)
    return write_report(store, None)


def refused(arguments: list[str | Path], named: str) -> None:
    done = CliRunner().invoke(report_command, [str(a) for a in arguments])
    assert isinstance(done.exception, InputError), done.output
    assert named in str(done.exception)


@pytest.mark.parametrize("linked", [False, True])
def test_an_input_is_never_overwritten(page: Path, tmp_path: Path, linked: bool) -> None:
    stored = tmp_path / "a.html"
    stored.write_bytes((page.parent / "report.json").read_bytes())
    before = stored.read_bytes()
    out = stored
    if linked:
        out = tmp_path / "b.html"
        os.link(stored, out)
    refused([stored, stored, "--out", out], "not replaced")
    assert stored.read_bytes() == out.read_bytes() == before


def test_a_device_a_folder_and_a_link_to_nothing_are_refused(tmp_path: Path) -> None:
    pipe, link = tmp_path / "pipe.html", tmp_path / "link.html"
    os.mkfifo(pipe)
    link.symlink_to(tmp_path / "nowhere.html")
    for out, named in (
        (Path("/dev/full"), "device"), (pipe, "device"), (link, "link to nothing"),
        (tmp_path, "folder"),
    ):  # fmt: skip
        refused([tmp_path, tmp_path, "--out", out], named)
    assert Path("/dev/full").is_char_device() and pipe.is_fifo() and link.is_symlink()


def test_the_folder_and_the_suffix_are_looked_at_before_anything_is_computed(
    tmp_path: Path,
) -> None:
    nothing = tmp_path / "no session"
    refused([nothing, nothing, "--out", tmp_path / "not" / "there.html"], "make it first")
    refused([nothing, nothing, "--out", tmp_path / "page.json"], ".html")
    assert list(tmp_path.iterdir()) == []


def test_a_page_of_reports_is_replaced_and_another_one_is_not(page: Path, tmp_path: Path) -> None:
    stored = page.parent / "report.json"
    out = tmp_path / "page.htm"
    for _ in range(2):
        done = CliRunner().invoke(report_command, [*[str(stored)] * 2, "--out", str(out)])
        assert done.exit_code == 0, done.output
    out.write_text("<!DOCTYPE html><title>my thesis</title>")
    refused([stored, stored, "--out", out], "not replaced")
    assert "thesis" in out.read_text()
