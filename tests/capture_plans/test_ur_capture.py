"""A whole capture with the UR driver: real ur_rtde, loopback controller, the lab's own camera."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from begun_sessions import begun
from given_plans import joints_looking_at, plan_through
from realsim.store import SessionStore
from realsim_capture_plans.capturing.capture import CaptureJob, capture
from realsim_capture_plans.capturing.operator import Command, NoOperator
from realsim_capture_plans.devices.interfaces import ArmStoppedError
from realsim_capture_plans.devices.ur import UrArm
from realsim_capture_plans.devices.ur_loopback import LoopbackController
from realsim_capture_plans.lab.lab import LabConfig, SimulatedDepthCamera, SimulatedLab
from realsim_capture_plans.planning.record import CapturePlan

VIEWS = 4
TCP = [0.0, 0.0, 0.12, 0.0, 0.0, 0.5]
HOME = np.radians([180.0, -90.0, 90.0, -90.0, -90.0, 0.0])


def small_plan(center: np.ndarray) -> CapturePlan:
    """Views on a narrow ring that look down at a point of the table."""
    turns = np.linspace(0.0, 2 * np.pi, VIEWS, endpoint=False)
    eyes = [center + 0.32 * np.array([0.25 * np.cos(a), 0.25 * np.sin(a), 1.0]) for a in turns]
    joints = joints_looking_at(center, eyes, HOME)
    return plan_through(np.stack(joints), HOME, center, "calibration")


class PersonAtThePendant(NoOperator):
    """Clears whatever stopped the arm, then says go."""

    def __init__(self, controller: LoopbackController) -> None:
        self.controller = controller
        self.told: list[str] = []
        self.asked = 0

    def tell(self, text: str, *, trouble: bool = False) -> None:
        self.told.append(text)

    def ask(self, text: str, choices: Sequence[Command]) -> Command | None:
        self.asked += 1
        self.controller.clear()
        return "go"


@pytest.mark.slow
def test_a_capture_with_a_protective_stop_on_its_way_stores_every_view(tmp_path: Path) -> None:
    lab = SimulatedLab(LabConfig(width=128, height=72, n_objects=1))
    lab.place_board()
    plan = small_plan(lab.scene_center)
    words = {"tcp": ",".join(map(str, TCP)), "joints": ",".join(map(str, HOME))}
    with LoopbackController.start(robot="UR5", speedup=10, **words) as controller:
        with UrArm(controller.host, model="UR5") as arm:
            camera = SimulatedDepthCamera(lab.config, lab.truth, arm, lambda: lab._on_table)
            store = begun(tmp_path / "session", camera.intrinsics, {"plan_hash": plan.content_hash})
            controller.inject("protective_stop", at_progress=0.4)
            with pytest.raises(ArmStoppedError, match="protective stop"):
                capture(plan, arm, camera, store)  # nobody can be asked
            controller.clear()
            arm.recover()
            person = PersonAtThePendant(controller)
            controller.inject("emergency_stop", at_progress=0.7)
            summary = capture(plan, arm, camera, store, job=CaptureJob(operator=person))
    assert summary.complete and person.asked == 1
    assert any("emergency stop" in text and "red button" in text for text in person.told)
    store = SessionStore.open(tmp_path / "session")
    assert store.completed == set(range(VIEWS))
    for view in store.session.views:
        np.testing.assert_allclose(view.joints, plan.joints[view.index], atol=1e-9)
        np.testing.assert_allclose(view.T_base_ee, plan.Ts_base_ee[view.index], atol=1e-9)
        assert np.mean(store.depth_m(view.index) > 0) > 0.5
