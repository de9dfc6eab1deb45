"""Sphinx builds the pages without a warning, from what is here alone."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from documents import ROOT

NO_NETWORK = """
import socket, sys
def refuse(*args, **kwargs):
    raise OSError("the documentation is built without a network")
socket.socket.connect = socket.create_connection = refuse
from sphinx.cmd.build import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_the_pages_are_built_with_warnings_as_errors(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            sys.executable, "-c", NO_NETWORK, "-q", "-W", "--keep-going", "-b", "html",
            "-d", str(tmp_path / "read"), str(ROOT / "docs"), str(tmp_path / "site"),
        ],
        capture_output=True, text=True, timeout=1200,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-6000:]
    site = tmp_path / "site"
    for page in ("index", "tour/05-school", "api/store", "how-to/import-bop"):
        assert (site / f"{page}.html").is_file()
    assert "SessionStore.open" in (site / "api/store.html").read_text(encoding="utf-8")
    assert not (ROOT / "docs/_build").exists()
