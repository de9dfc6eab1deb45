"""A placed scene, and the folder that a module's writer `WRITE` makes of it."""

from pathlib import Path

import pytest

import placed_scenes


@pytest.fixture(scope="module")
def scene():
    return placed_scenes.placed_scene()


@pytest.fixture(scope="module")
def folder(request: pytest.FixtureRequest, scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("written") / "scene"
    placed_scenes.written(request.module.WRITE, scene, path)
    return path
