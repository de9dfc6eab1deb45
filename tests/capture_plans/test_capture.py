"""A capture goes on after a kill, stores what the plan says, and refuses what it should.

Run as a script, this file captures slowly into a folder until it is killed.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics, CaptureSession
from realsim.store import SessionStore
from realsim_capture_plans.arms.kinematics import UR5, JointLimits
from realsim_capture_plans.capturing.capture import PLAN_FILE, capture
from realsim_capture_plans.collision.model import interpolate
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.devices.interfaces import ArmState, DeviceError, Frame
from realsim_capture_plans.plan_files.plan_json import load_plan, save_plan
from realsim_capture_plans.planning.make import calibration_plan
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig

VIEWS = 10
CAMERA = CameraIntrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)


@dataclass
class KinematicArm:
    """A UR5 that is where it was sent, at once; remembers the path of its joints."""

    joints: NDArray[np.float64]
    path: list[NDArray[np.float64]] = field(default_factory=list)
    drift_rad: list[float] = field(default_factory=list)
    clock_s: float = 0.0
    name: str = "UR5 of the test"
    limits: JointLimits = UR5.limits

    def move(self, joints: ArrayLike) -> None:
        goal = np.array(joints, dtype=np.float64)
        if not self.limits.contains(goal):
            raise InputError(f"{goal.tolist()} is outside the limits.")
        self.path.append(goal)
        self.joints = goal

    def state(self) -> ArmState:
        self.clock_s += 0.008
        drift = self.drift_rad.pop(0) if self.drift_rad else 0.0
        q = self.joints + drift * np.eye(6)[5]
        return ArmState(joints=q, T_base_ee=UR5.forward(q), time_s=self.clock_s)


@dataclass
class TableCamera:
    """Sees the plane z = 0 with a colour that encodes the place looked at."""

    arm: KinematicArm
    seconds: float = 0.0
    dark: int = 0
    name: str = "camera of the test"
    intrinsics: CameraIntrinsics = CAMERA
    depth_unit_m: float = 1e-4

    def grab(self) -> Frame:
        time.sleep(self.seconds)
        T = UR5.forward(self.arm.joints) @ d405_mount().T_ee_cam
        rays = ray_table(CAMERA).reshape(-1, 3) @ T[:3, :3].T
        depth = np.where(rays[:, 2] < -1e-3, -T[2, 3] / np.minimum(rays[:, 2], -1e-3), 0.0)
        ground = T[:3, 3] + depth[:, None] * rays
        rgb = (np.mod(ground * 500.0, 200.0) + 50.0).astype(np.uint8).reshape(48, 64, 3)
        if self.dark > 0:
            self.dark -= 1
            rgb = np.zeros_like(rgb)
        return Frame(rgb=rgb, depth_m=depth.reshape(48, 64).astype(np.float32), time_s=time.time())


@lru_cache(maxsize=1)
def plan() -> CapturePlan:
    rng = np.random.default_rng(3)
    return calibration_plan(VIEWS, [0.375, 0.0, 0.0], d405_mount(), PlanConfig(), rng)


def new_store(folder: Path, plan_hash: str) -> SessionStore:
    session = CaptureSession(name="test", intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    return SessionStore.create(folder, session, extra={"plan_hash": plan_hash})


@pytest.fixture
def arm() -> KinematicArm:
    return KinematicArm(joints=plan().home.copy())


def test_every_view_of_the_plan_is_stored_once(tmp_path: Path, arm: KinematicArm) -> None:
    store = new_store(tmp_path / "session", plan().content_hash)
    calls: list[tuple[int, int]] = []
    summary = capture(
        plan(), arm, TableCamera(arm), store, progress=lambda d, n: calls.append((d, n))
    )
    assert (summary.captured, summary.skipped, summary.rejected) == (VIEWS, 0, ())
    assert calls == [(k, VIEWS) for k in range(VIEWS + 1)]
    store = SessionStore.open(tmp_path / "session")
    for view in store.session.views:
        assert np.array_equal(view.joints, plan().joints[view.index])
        assert view.T_base_ee == pytest.approx(plan().Ts_base_ee[view.index], abs=1e-9)
        expected = UR5.forward(plan().joints[view.index]) @ d405_mount().T_ee_cam
        middle = store.depth_m(view.index)[23:25, 31:33].mean()
        assert middle == pytest.approx(-expected[2, 3] / expected[2, 2], abs=2e-3)
    assert load_plan_of(store).content_hash == plan().content_hash


def load_plan_of(store: SessionStore) -> CapturePlan:
    return load_plan(store.path(PLAN_FILE))


def driven_clear(path: list[NDArray[np.float64]], start: NDArray[np.float64]) -> bool:
    corners = np.stack([start, *path])
    samples, _ = interpolate(corners[:-1], corners[1:], plan().config.edge_step_rad)
    return bool(np.all(plan().collision_model().free(samples)))


@pytest.mark.parametrize("already", [{0, 1, 2}, {1, 4, 5, 9}, set(range(VIEWS)) - {6}])
def test_going_on_takes_only_what_is_missing_and_stays_clear(
    tmp_path: Path, arm: KinematicArm, already: set[int]
) -> None:
    full = new_store(tmp_path / "full", plan().content_hash)
    capture(plan(), arm, TableCamera(arm), full)
    part = new_store(tmp_path / "part", plan().content_hash)
    for k in already:
        part.add_view(full.session.view(k), full.rgb(k), full.depth_m(k))
    arm.path.clear()
    start = arm.joints
    summary = capture(plan(), arm, TableCamera(arm), part)
    assert (summary.captured, summary.skipped) == (VIEWS - len(already), len(already))
    assert part.completed == set(range(VIEWS))
    assert driven_clear(arm.path, start)
    # What was taken later is what would have been taken in one go.
    for k in range(VIEWS):
        assert np.array_equal(part.rgb(k), full.rgb(k))


def test_an_arm_below_the_table_is_not_moved(tmp_path: Path) -> None:
    low = KinematicArm(joints=np.array([0.0, 0.6, 0.0, 0.0, 0.0, 0.0]))
    assert not plan().collision_model().free(low.joints[None])[0]
    store = new_store(tmp_path / "s", plan().content_hash)
    with pytest.raises(DeviceError, match="by hand"):
        capture(plan(), low, TableCamera(low), store)
    assert low.path == []


def test_another_plan_is_refused(tmp_path: Path, arm: KinematicArm) -> None:
    store = new_store(tmp_path / "s", "0" * 64)
    with pytest.raises(InputError, match="begun with the plan 000000000000"):
        capture(plan(), arm, TableCamera(arm), store)
    assert arm.path == []


def test_a_moving_arm_and_a_dark_frame_are_taken_again(tmp_path: Path, arm: KinematicArm) -> None:
    store = new_store(tmp_path / "s", plan().content_hash)
    # States are read once to find the way, then twice a frame: 0.1 deg of wrist turn in the first.
    arm.drift_rad = [0.0, 0.0, np.radians(0.1)]
    summary = capture(plan(), arm, TableCamera(arm, dark=1), store)
    assert summary.captured == VIEWS
    assert len(summary.rejected) == 1 and "moved" in summary.rejected[0][1]
    store = new_store(tmp_path / "dark", plan().content_hash)
    summary = capture(plan(), arm, TableCamera(arm, dark=2), store)
    assert [k for k, _ in summary.rejected] == [0, 0]
    assert "black" in summary.rejected[0][1]


def test_a_camera_that_stays_dark_stops_the_capture(tmp_path: Path, arm: KinematicArm) -> None:
    store = new_store(tmp_path / "s", plan().content_hash)
    with pytest.raises(DeviceError, match=r"no good frame in 3 attempts.*black"):
        capture(plan(), arm, TableCamera(arm, dark=99), store)
    assert store.completed == set()


def test_an_arm_that_was_stopped_short_is_noticed(tmp_path: Path, arm: KinematicArm) -> None:
    store = new_store(tmp_path / "s", plan().content_hash)
    arm.drift_rad = [0.0, 0.02, 0.02]
    with pytest.raises(DeviceError, match="off its goal"):
        capture(plan(), arm, TableCamera(arm), store)


def wait_for(condition: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the capture did not get there in time"
        time.sleep(0.01)


def test_killed_captures_go_on_without_losing_a_view(tmp_path: Path) -> None:
    save_plan(plan(), tmp_path / "plan.json")
    folder = tmp_path / "session"
    robot = folder / "robot.jsonl"

    def lines() -> int:
        return robot.read_bytes().count(b"\n") if robot.is_file() else 0

    for target in (2, 6):
        child = subprocess.Popen([sys.executable, __file__, str(tmp_path)])
        try:
            wait_for(lambda n=target: lines() >= n, 30.0)
        finally:
            os.kill(child.pid, signal.SIGKILL)
            child.wait()
        done = SessionStore.open(folder).completed
        assert target <= len(done) < VIEWS
    arm = KinematicArm(joints=plan().joints[max(done)].copy())
    store = SessionStore.open(folder)
    summary = capture(plan(), arm, TableCamera(arm), store)
    assert summary.skipped == len(done)
    assert store.completed == set(range(VIEWS))
    assert store.verify() == []
    for view in store.session.views:
        assert np.array_equal(view.joints, plan().joints[view.index])


def slow_capture(folder: Path) -> None:
    the_plan = load_plan(folder / "plan.json")
    session = folder / "session"
    begun = (session / "session.json").is_file()
    store = SessionStore.open(session) if begun else new_store(session, the_plan.content_hash)
    arm = KinematicArm(joints=the_plan.home.copy())
    capture(the_plan, arm, TableCamera(arm, seconds=0.15), store)


def test_the_table_camera_is_a_camera(arm: KinematicArm) -> None:
    # The generated images are consistent: a ground point has one colour from every view.
    frame = TableCamera(arm).grab()
    T = UR5.forward(arm.joints) @ d405_mount().T_ee_cam
    points = se3.transform(T, (ray_table(CAMERA) * frame.depth_m[..., None]).reshape(-1, 3))
    assert np.abs(points[:, 2]).max() < 1e-6


if __name__ == "__main__":
    slow_capture(Path(sys.argv[1]))
