"""A command that was ended in the middle, run again, ends like one left alone."""

import importlib
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
kills: Any = importlib.import_module("reliability_kills")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kills")
    kills.make_inputs(root / "work")
    return root


@pytest.fixture(scope="module", params=["annotate", "export", "stats"])
def command(request: pytest.FixtureRequest, root: Path) -> Any:
    return kills.Command(root, kills.LONG[request.param])


@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_a_killed_command_ends_like_one_left_alone(command: Any, how: int) -> None:
    caught, much = False, command.seconds
    while not caught:  # the machine may be faster now than when the time was taken
        much /= 2
        caught, differs = command.ended(how, much)
        assert differs == []


@pytest.mark.parametrize("room", [2_000, pytest.param(9_000, marks=pytest.mark.slow)])
def test_a_full_disk_is_told_and_the_same_command_goes_on(command: Any, room: int) -> None:
    caught, differs = command.ended(kills.FULL, room)
    assert caught and differs == []
