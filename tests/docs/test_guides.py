"""The guides are true: their commands run in order and print what the text says."""

import json
import shutil
from pathlib import Path

import pytest
from documents import ROOT
from played import play

GUIDE = ROOT / "docs/how-to/calibrate-a-new-lab.md"
"""A lab of its own, board views first: plan, capture, calibrate, and the figures of all three."""
GRIPPER = ROOT / "docs/how-to/your-own-gripper.md"


@pytest.mark.slow
def test_the_guide_to_a_new_lab_prints_what_it_says(tmp_path: Path) -> None:
    wrong = play(GUIDE, tmp_path)
    assert not wrong, "\n\n".join(wrong)


@pytest.mark.slow
def test_a_gripper_that_is_not_in_the_package_is_described_proven_and_simulated(
    tmp_path: Path,
) -> None:
    wrong = play(GRIPPER, tmp_path)
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
