"""Sessions of the school that several modules try, each its own."""

import shutil
from pathlib import Path

import pytest
from click.testing import Result

from school_sessions import QUICK, registered, run


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A registered session."""
    return registered(tmp_path_factory.mktemp("pristine") / "s")


@pytest.fixture(scope="module")
def tried(pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The same session after a school, and what the command said."""
    folder = tmp_path_factory.mktemp("tried") / "s"
    shutil.copytree(pristine, folder)
    return folder, run(folder, *QUICK, "--json-file", folder.parent / "counts.json")
