"""A stored session for every test: a copy of the whole one that all tests of a run share."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def session(small_session: Path, tmp_path: Path) -> Path:
    # Nothing is linked: these tests damage images where they stand.
    return Path(shutil.copytree(small_session, tmp_path / "s"))
