"""A placed scene, for all formats of such."""

import pytest

import placed_scenes


@pytest.fixture(scope="module")
def scene():
    return placed_scenes.placed_scene()
