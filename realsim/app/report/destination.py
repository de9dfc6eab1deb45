"""Where a page may be written: nothing but a page of reports is ever replaced."""

import os
from collections.abc import Sequence
from pathlib import Path

from realsim.app.report.session import DOCUMENT_SCRIPT
from realsim.errors import InputError

SUFFIXES = (".html", ".htm")


def require_destination(out: Path, inputs: Sequence[Path]) -> None:
    """Raise unless a page can be written at `out` without loss of anything else.

    Args:
        out: the page.
        inputs: what the page is made of, or is checked against.

    Raises:
        InputError: `out` is a folder, one of the inputs, a device, another kind of file than a web
            page, a page that is no report, or in a folder that is missing or cannot be written.
    """
    if out.is_dir():
        raise InputError(f"--out '{out}' is a folder; give the HTML file to be written.")
    if any(_is_same(out, path) for path in inputs):
        raise InputError(
            f"--out '{out}' is one of the files that are read, and would be lost; give another "
            "name for the page."
        )
    if os.path.lexists(out) and not out.is_file():
        raise InputError(
            f"--out '{out}' is a device, or a link to nothing; give a name for the page, such as "
            "report.html. `--json` prints the figures."
        )
    if out.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"--out '{out}' is written as a web page; a name that ends in .html is expected. "
            "`--json` prints the figures for programs."
        )
    if not out.parent.is_dir():
        raise InputError(f"the folder '{out.parent}' for --out is not there; make it first.")
    if not os.access(out.parent, os.W_OK):
        raise InputError(f"the folder '{out.parent}' for --out may not be written by you.")
    if out.is_file() and not _is_report(out):
        raise InputError(
            f"--out '{out}' is there and is no page of `realsim report`; it is not replaced. Give "
            "another name, or delete it first."
        )


def _is_same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:  # one of them is not there
        return False


def _is_report(path: Path) -> bool:
    """Return whether a file is a page of reports: it holds its figures, for programs."""
    return DOCUMENT_SCRIPT.encode() in path.read_bytes()
