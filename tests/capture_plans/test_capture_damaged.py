"""A capture does not go on in silence in a session that is not what was written.

The wait for a standing arm, and the checks' own numbers.
"""

from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from begun_sessions import begun
from given_plans import QUICK, UR5_HOME, stopped
from realsim.robots.arm import UR5
from realsim.store import SessionStore
from realsim.store.opening import BEGUN_FILE
from realsim.store.session_repair import repair_session
from realsim_capture_plans.capturing.capture import CaptureJob, capture
from realsim_capture_plans.capturing.checks import SHARPNESS_OF_MEDIAN, sharpness
from realsim_capture_plans.capturing.look import SettleConfig, until_still
from realsim_capture_plans.capturing.run import CaptureSummary
from realsim_capture_plans.devices.interfaces import ArmState
from realsim_capture_plans.lab import LabConfig, SimulatedLab
from realsim_capture_plans.lab.lab import SimulatedArm
from realsim_capture_plans.plan_files.plan_json import resolve_plan
from realsim_capture_plans.planning.record import CapturePlan
from refusals import refused

LAB = {"seed": 3, "objects": 2}


@lru_cache(maxsize=1)
def plan() -> CapturePlan:
    return resolve_plan("shipped:ur5_d405_hemisphere_256")


def lab() -> SimulatedLab:
    """A lab as it is at the beginning of every run: its camera counts the time from 0."""
    made = SimulatedLab(LabConfig(seed=3, n_objects=2, width=160, height=90))
    made.place_objects()
    return made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    camera = lab().camera
    extra = {"plan_hash": plan().content_hash, "camera": camera.name, "arm": "UR5", "lab": LAB}
    begun(tmp_path / "s", camera.intrinsics, extra, unit_m=camera.depth_unit_m)
    run(tmp_path / "s", views=(0, 1, 2, 3))
    return tmp_path / "s"


def run(folder: Path, **job: Any) -> CaptureSummary:
    here, store = lab(), SessionStore.open(folder)
    return capture(plan(), here.arm, here.camera, store, config=QUICK, job=CaptureJob(**job))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def test_stored_images_that_changed_are_named_and_not_counted(folder: Path) -> None:
    cut(folder / "rgb/000001.png")
    (folder / "depth/000003.png").unlink()
    log = (folder / "capture_log.jsonl").read_bytes()
    for _ in range(2):  # opening it again does not make it sound
        refused(r"rgb/000001\.png: .*depth/000003.*s --repair", run, folder, views=(0, 1, 2, 3, 4))
    assert (folder / "capture_log.jsonl").read_bytes() == log
    repair_session(folder)
    summary = run(folder, views=(0, 1, 2, 3, 4))
    assert summary.complete and (summary.skipped, summary.captured) == (2, 3)
    store = SessionStore.open(folder)
    assert store.verify() == [] and store.check().sound


def test_a_session_without_its_manifest_is_not_gone_on_with(folder: Path) -> None:
    (folder / "manifest.jsonl").unlink()
    cut(folder / "rgb/000002.png")
    refused(r"manifest\.jsonl is lost.*--repair", run, folder, views=(0, 1, 2, 3, 4))
    assert not (folder / "manifest.jsonl").exists()
    assert repair_session(folder).dropped_views == (2,)
    assert run(folder, views=(0, 1, 2, 3, 4)).captured == 2


def test_a_session_whose_beginning_is_lost_gets_no_more_views(folder: Path) -> None:
    (folder / BEGUN_FILE).unlink()
    (folder / "session.json").write_text('{"broken')
    repair_session(folder)
    refused(r"made anew by a repair.*arm_description.*new folder", run, folder, views=(4,))
    store = SessionStore.open(folder)
    assert store.completed == {0, 1, 2, 3} and store.check().sound
    # The way that the message tells.
    header = (folder / "session.json").read_text()
    assert '"recovered": true,' in header
    (folder / "session.json").write_text(header.replace('"recovered": true,', ""))
    repair_session(folder)
    assert run(folder, views=(4,)).complete


class RingingArm(SimulatedArm):
    """Swings at 8 Hz with an amplitude that dies away; its clock only goes on by waiting."""

    def __init__(self, amplitude_rad: float, decay_s: float) -> None:
        super().__init__()
        self.amplitude_rad, self.decay_s, self.now_s = amplitude_rad, decay_s, 0.0

    def state(self) -> ArmState:
        swing = np.exp(-self.now_s / self.decay_s) * np.cos(2 * np.pi * 8.0 * self.now_s)
        q = UR5_HOME + self.amplitude_rad * swing * np.eye(6)[1]
        return ArmState(joints=q, T_base_ee=UR5.forward(q), time_s=self.now_s)

    def wait(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.mark.parametrize("amplitude", [0.0, 1e-3, 5e-3])
def test_the_wait_ends_when_the_swing_is_below_the_tolerance(amplitude: float) -> None:
    arm, config = RingingArm(amplitude, 0.1), SettleConfig()
    state, waited = until_still(arm, config, clock=lambda: arm.now_s, sleep=arm.wait)
    assert amplitude * np.exp(-arm.now_s / 0.1) <= config.tolerance_rad
    assert np.abs(state.joints - UR5_HOME).max() <= config.tolerance_rad
    # Not much later than needed either: the tolerance plus two windows.
    needed = 0.1 * np.log(max(amplitude / (config.tolerance_rad / 2), 1.0))
    assert config.window_s <= waited <= needed + 3 * config.window_s


def test_an_arm_that_never_stands_is_named() -> None:
    arm = RingingArm(5e-3, 1e9)
    timed = {"clock": lambda: arm.now_s, "sleep": arm.wait}
    stopped("not ready", "does not come to rest", until_still, arm, SettleConfig(), **timed)


def scene(rng: np.random.Generator, contrast: float = 1.0) -> np.ndarray:
    """Discs of all sizes on a textured ground."""
    image = np.full((360, 640, 3), 120, np.uint8)
    for _ in range(60):
        x, y, r = (int(rng.integers(0, n)) for n in (640, 360, 40))
        grey = int(120 + contrast * rng.integers(-100, 100))
        cv2.circle(image, (x, y), r + 3, (grey, grey, grey), -1, cv2.LINE_AA)
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def test_sharpness_falls_with_every_blur_and_not_with_contrast() -> None:
    rng = np.random.default_rng(0)
    image = scene(rng)
    values = [sharpness(image)]
    for sigma in (1.0, 1.5, 2.0, 3.0):
        soft = cv2.GaussianBlur(image, (0, 0), sigma).astype(float)
        noisy = np.clip(soft + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        values.append(sharpness(noisy))
    assert np.all(np.diff(values) < 0)
    assert values[2] < SHARPNESS_OF_MEDIAN * values[0]
    faint = np.clip(120 + 0.5 * (image.astype(float) - 120), 0, 255).astype(np.uint8)
    assert sharpness(faint) == pytest.approx(values[0], rel=0.1)
    turned = np.ascontiguousarray(image.transpose(1, 0, 2))
    assert sharpness(turned) == pytest.approx(values[0], rel=0.05)
    moved = cv2.filter2D(image, -1, np.full((1, 11), 1 / 11, np.float32))
    assert sharpness(moved) < SHARPNESS_OF_MEDIAN * values[0]
