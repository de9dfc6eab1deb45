"""Stored sessions: one that is whole, and a copy of it for every test."""

import shutil
from pathlib import Path

import pytest

from stored_sessions import make_whole


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions") / "whole"
    make_whole(folder)
    return folder


@pytest.fixture
def session(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "s"))
