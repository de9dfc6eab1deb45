"""The guides are true: their commands run in order and print what the text says."""

import json
import shutil
from pathlib import Path

import pytest
from documents import ROOT
from played import play

PLAYED = ("calibrate-a-new-lab", "your-own-gripper")
"""A lab of its own, board views first: plan, capture, calibrate, and the figures of all three; a
gripper that is not in the package: described, proven and simulated."""


@pytest.mark.slow
@pytest.mark.parametrize("guide", PLAYED)
def test_a_guide_prints_what_it_says(guide: str, tmp_path: Path) -> None:
    wrong = play(ROOT / f"docs/how-to/{guide}.md", tmp_path)
    assert not wrong, "\n\n".join(wrong)


@pytest.mark.slow
def test_an_arm_that_is_not_in_the_package_is_proven_planned_for_and_captured_with(
    tmp_path: Path,
) -> None:
    robots = Path("examples/robots")
    shutil.copytree(ROOT / robots, tmp_path / robots)
    wrong = play(ROOT / "docs/how-to/your-own-arm.md", tmp_path)
    assert not wrong, "\n\n".join(wrong)
    header = json.loads((tmp_path / "own/session.json").read_text())
    assert header["extra"]["arm"] == "SixJoint"
    plan = json.loads((tmp_path / "own.json").read_text())["content"]
    assert plan["robot"] == "SixJoint" and plan["metrics"]["colliding_legs"] == 0
