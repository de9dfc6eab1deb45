"""Examples stay short and run as they stand: the quick ones here, .ci/run runs all of them."""

import ast
import json
import runpy
import sys
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim_capture_plans import ArmState
from realsim_capture_plans.devices.ur import UrArm
from realsim_capture_plans.devices.ur_loopback import LoopbackController
from realsim_capture_plans.lab import LabConfig, SimulatedLab

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from device_checks import check_arm, check_camera

ROOT = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(ROOT.glob("[0-9]*.py"))
QUICK = ("01_frames_and_cameras", "10_data_sets_in_and_out", "11_review_journal")


def test_examples_are_short() -> None:
    assert EXAMPLES and all(p.read_text().count("\n") <= 60 for p in EXAMPLES)


@pytest.mark.parametrize("path", [p for p in EXAMPLES if p.stem in QUICK], ids=lambda p: p.stem)
def test_example_runs(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out.strip()


@pytest.mark.slow
def test_the_cells_of_the_notebook_run_in_order_and_draw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cells = json.loads((ROOT / "tour.ipynb").read_text())["cells"]
    texts = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    verbs: list[str] = []
    for text in texts:
        *lines, last = ast.parse(text).body
        assert isinstance(last, ast.Expr)
        target = ast.Name("shown", ast.Store())
        tree = ast.Module([*lines, ast.Assign([target], last.value)], [])
        exec(compile(ast.fix_missing_locations(tree), "cell", "exec"), names)  # noqa: S102 - the book
        shown = names["shown"]
        assert shown.passed and f"<b>{shown.verb} " in shown._repr_html_()
        verbs.append(shown.verb)
    assert len(set(verbs)) == 11 and (tmp_path / "scene.html").is_file()


# --- The checks for a new driver pass good drivers and name what is wrong with bad ones.

LONGER = np.float32(1.03)
LOOKING_DOWN = np.radians([180.0, -95.0, 115.0, -110.0, -90.0, 0.0])
"""(6,) over the table, in the range of the camera [rad]."""


@pytest.fixture
def lab() -> SimulatedLab:
    lab = SimulatedLab(LabConfig(seed=0, n_objects=1, width=320, height=180))
    lab.place_objects()
    lab.arm.move(LOOKING_DOWN)
    return lab


@pytest.fixture
def ur() -> Generator[UrArm]:
    with LoopbackController.start(robot="UR5", speedup=10) as controller:
        with UrArm(controller.host, model="UR5") as arm:
            yield arm


class Wrong:
    """A device with some of its members replaced."""

    def __init__(self, device: Any, **members: Any) -> None:
        self.device, self.members = device, members

    def __getattr__(self, name: str) -> Any:
        return self.members.get(name, getattr(self.device, name))


def test_the_lab_keeps_the_protocols(lab: SimulatedLab) -> None:
    before = lab.arm.state().joints
    assert check_arm(lab.arm) + check_camera(lab.camera) == []
    assert np.array_equal(lab.arm.state().joints, before)


def test_the_ur_driver_keeps_the_protocol(ur: UrArm) -> None:
    assert check_arm(ur) == []


def changed(device: Any, told_by: str = "state", **fields: Any) -> Any:
    """Return a device of whose records, the arm's states or the camera's frames, some are wrong."""

    def told() -> Any:
        record = getattr(device, told_by)()
        return replace(record, **{k: change(record) for k, change in fields.items()})

    return Wrong(device, **{told_by: told})


def millimetres(s: ArmState) -> Any:
    T = s.T_base_ee.copy()
    T[:3, 3] *= 1e3
    return T


def test_a_wrong_arm_is_named(lab: SimulatedLab) -> None:
    arm = lab.arm
    faults = {
        "degrees?": changed(arm, joints=lambda s: np.degrees(s.joints)),
        "mm from the UR5's chain": changed(arm, T_base_ee=millimetres),
        "time stamps": changed(arm, time_s=lambda s: 0.0),
        "deg before its goal": Wrong(arm, move=lambda *_, **__: None),
        "is not refused": Wrong(arm, move=lambda *_, **__: None),
        "not plain JSON": Wrong(arm, description={"limits": arm.limits}),
    }
    for words, wrong in faults.items():
        assert any(words in finding for finding in check_arm(wrong)), words
    assert check_arm(changed(arm, joints=lambda s: s.joints)) == []


def test_a_wrong_camera_is_named(lab: SimulatedLab) -> None:
    camera = lab.camera
    faults = {
        "is it in metres?": changed(camera, "grab", depth_m=lambda f: 1e3 * f.depth_m),
        "aligned by interpolation?": changed(camera, "grab", depth_m=lambda f: LONGER * f.depth_m),
        "exposed after the call": changed(camera, "grab", time_s=lambda f: 0.0),
        "images are": Wrong(camera, intrinsics=replace(camera.intrinsics, width=640)),
        "not plain JSON": Wrong(camera, description={"noise": float("nan")}),
    }
    for words, wrong in faults.items():
        assert any(words in f for f in check_camera(wrong)), words
