"""A capture goes on after a kill, stores what the plan says, and refuses what it should."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from begun_sessions import begun
from given_plans import QUICK, TURNED_HOME, driven_clear, ring_plan, stopped
from killed_children import killed_growing
from realsim.app.capture.fixed import fixed_stores, open_fixed, serials_of
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics
from realsim.robots.arm import UR5, UR5E
from realsim.robots.limits import JointLimits
from realsim.store import SessionStore, atomic
from realsim.store.cameras import open_cameras
from realsim_capture_plans.capturing.capture import PLAN_FILE, capture, dry_run
from realsim_capture_plans.capturing.log import LOG_FILE, CaptureLog
from realsim_capture_plans.capturing.run import CaptureJob, CaptureSummary
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.devices.interfaces import ArmState, DeviceError, Frame
from realsim_capture_plans.plan_files.foreign_plans import colliding_legs
from realsim_capture_plans.plan_files.plan_json import load_plan
from realsim_capture_plans.planning.record import CapturePlan
from refusals import refused

VIEWS = 10
CAMERA = CameraIntrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)


@dataclass
class KinematicArm:
    """A UR5 that is where it was sent, at once; remembers the path of its joints."""

    joints: Array
    path: list[Array] = field(default_factory=list)
    speeds: list[tuple[float, float]] = field(default_factory=list)
    clock_s: float = 0.0
    name: str = "UR5 of the test"
    limits: JointLimits = UR5.limits
    description: dict[str, Any] = field(default_factory=dict)

    def move(self, joints: ArrayLike, speed: float = 1.05, acceleration: float = 1.4) -> None:
        goal = np.array(joints, dtype=np.float64)
        if not self.limits.contains(goal):
            raise InputError(f"{goal.tolist()} is outside the limits.")
        self.path.append(goal)
        self.speeds.append((speed, acceleration))
        self.joints = goal

    def turn_wrist(self, angle_rad: float) -> None:
        self.joints = self.joints + angle_rad * np.eye(6)[5]

    def state(self) -> ArmState:
        self.clock_s += 0.008
        return ArmState(joints=self.joints, T_base_ee=UR5.forward(self.joints), time_s=self.clock_s)

    def recover(self) -> None:
        pass


@dataclass
class TableCamera:
    """Sees the plane z = 0 with a colour that encodes the place looked at."""

    arm: KinematicArm
    seconds: float = 0.0
    dark: int = 0
    meanwhile: list[Callable[[], None]] = field(default_factory=list)
    name: str = "camera of the test"
    intrinsics: CameraIntrinsics = CAMERA
    depth_unit_m: float = 1e-4
    description: dict[str, Any] = field(default_factory=dict)

    def grab(self) -> Frame:
        time.sleep(self.seconds)
        T = UR5.forward(self.arm.joints) @ d405_mount().T_ee_cam
        if self.meanwhile:
            self.meanwhile.pop(0)()
        rays = ray_table(CAMERA).reshape(-1, 3) @ T[:3, :3].T
        depth = np.where(rays[:, 2] < -1e-3, -T[2, 3] / np.minimum(rays[:, 2], -1e-3), 0.0)
        ground = T[:3, 3] + depth[:, None] * rays
        rgb = (np.mod(ground * 500.0, 200.0) + 50.0).astype(np.uint8).reshape(48, 64, 3)
        if self.dark > 0:
            self.dark -= 1
            rgb = np.zeros_like(rgb)
        return Frame(rgb=rgb, depth_m=depth.reshape(48, 64).astype(np.float32), time_s=time.time())

    def recover(self) -> None:
        pass


@lru_cache(maxsize=1)
def plan() -> CapturePlan:
    """A ring of views that look down at the middle of the table, every third over a via point."""
    ring = ring_plan(np.array([0.40, 0.0, 0.0]), TURNED_HOME, VIEWS)
    q = ring.joints
    made = replace(ring, vias=tuple((k, (q[[k - 1]] + q[[k]]) / 2) for k in range(3, VIEWS, 3)))
    assert colliding_legs(made) == ()
    return made


def new_store(folder: Path, plan_hash: str) -> SessionStore:
    return begun(folder, CAMERA, {"plan_hash": plan_hash})


@pytest.fixture
def store(tmp_path: Path) -> SessionStore:
    return new_store(tmp_path / "s", plan().content_hash)


@pytest.fixture
def arm() -> KinematicArm:
    return KinematicArm(joints=plan().home.copy())


def test_every_view_of_the_plan_is_stored_once(tmp_path: Path, arm: KinematicArm) -> None:
    store = new_store(tmp_path / "session", plan().content_hash)
    calls: list[tuple[int, ...]] = []
    summary = capture(plan(), arm, TableCamera(arm), store, progress=lambda *n: calls.append(n))
    assert (summary.captured, summary.skipped, summary.rejected) == (VIEWS, 0, ())
    assert summary.noted == summary.warnings == () and summary.complete
    assert calls == [(k, VIEWS) for k in range(VIEWS + 1)]
    store = SessionStore.open(tmp_path / "session")
    for view in store.session.views:
        assert np.array_equal(view.joints, plan().joints[view.index])
        assert view.T_base_ee == pytest.approx(plan().Ts_base_ee[view.index], abs=1e-9)
        expected = UR5.forward(plan().joints[view.index]) @ d405_mount().T_ee_cam
        middle = store.depth_m(view.index)[23:25, 31:33].mean()
        assert middle == pytest.approx(-expected[2, 3] / expected[2, 2], abs=2e-3)
    assert load_plan(store.path(PLAN_FILE)).content_hash == plan().content_hash


def test_going_on_takes_only_what_is_missing_and_stays_clear(
    tmp_path: Path, arm: KinematicArm
) -> None:
    already = {1, 4, 5, 9}
    full = new_store(tmp_path / "full", plan().content_hash)
    capture(plan(), arm, TableCamera(arm), full, config=QUICK)
    part = new_store(tmp_path / "part", plan().content_hash)
    for k in already:
        part.add_view(full.session.view(k), full.rgb(k), full.depth_m(k))
    arm.path.clear()
    start = arm.joints
    summary = capture(plan(), arm, TableCamera(arm), part, config=QUICK)
    assert (summary.captured, summary.skipped) == (VIEWS - len(already), len(already))
    assert part.completed == set(range(VIEWS))
    assert driven_clear(plan(), [start, *arm.path])
    # What was taken later is what would have been taken in one go.
    for k in range(VIEWS):
        assert np.array_equal(part.rgb(k), full.rgb(k))


def test_an_arm_below_the_table_is_not_moved(store: SessionStore) -> None:
    low = KinematicArm(joints=np.array([0.0, 0.6, 0.0, 0.0, 0.0, 0.0]))
    assert not plan().collision_model().free(low.joints[None])[0]
    refused("by hand", capture, plan(), low, TableCamera(low), store, error=DeviceError)
    assert low.path == []


def test_another_plan_is_refused(tmp_path: Path, arm: KinematicArm) -> None:
    store = new_store(tmp_path / "s", "0" * 64)
    refused("begun with the plan 000000000000", capture, plan(), arm, TableCamera(arm), store)
    session = store.session
    other = SessionStore.create(tmp_path / "p", session, {"plan_hash": "0" * 64, "arm": "Panda"})
    with pytest.raises(InputError, match="begun with a Panda, and this plan is for a UR5"):
        capture(plan(), arm, TableCamera(arm), other)
    assert arm.path == []


def test_a_moving_arm_and_a_dark_frame_are_taken_again(tmp_path: Path, arm: KinematicArm) -> None:
    store = new_store(tmp_path / "s", plan().content_hash)
    camera = TableCamera(arm, meanwhile=[lambda: arm.turn_wrist(np.radians(0.1))])
    summary = capture(plan(), arm, camera, store)
    assert summary.captured == VIEWS
    assert len(summary.rejected) == 1 and "moved" in summary.rejected[0][1]
    store = new_store(tmp_path / "dark", plan().content_hash)
    summary = capture(plan(), arm, TableCamera(arm, dark=2), store)
    assert [k for k, _ in summary.rejected] == [0, 0]
    assert "black" in summary.rejected[0][1]


def test_an_arm_that_was_stopped_short_is_noticed(store: SessionStore, arm: KinematicArm) -> None:
    camera = TableCamera(arm, meanwhile=[lambda: arm.turn_wrist(0.02)])
    stopped("off goal", "off its goal", capture, plan(), arm, camera, store)
    assert store.completed == set()


def test_another_arm_is_told_by_its_name_or_by_where_its_flange_is(store: SessionStore) -> None:
    named = KinematicArm(joints=plan().home.copy(), name="UR5e")
    refused("made for a UR5, this arm is a UR5e", capture, plan(), named, TableCamera(named), store)

    class OtherArm(KinematicArm):
        def state(self) -> ArmState:
            return replace(super().state(), T_base_ee=UR5E.forward(self.joints))

    other = OtherArm(joints=plan().home.copy(), name="arm in the corner")
    refused("moves like a UR5e", capture, plan(), other, TableCamera(other), store)
    assert named.path == other.path == []


def test_a_calibration_left_out_is_warned_of_once_and_the_controllers_pose_kept(
    store: SessionStore,
) -> None:
    chain = replace(UR5, delta_d=np.array([1e-3, 0, 0, 2e-3, 0, 0]))

    class CalibratedArm(KinematicArm):
        def state(self) -> ArmState:
            return replace(super().state(), T_base_ee=chain.forward(self.joints))

    arm = CalibratedArm(joints=plan().home.copy())
    summary = capture(plan(), arm, TableCamera(arm), store)
    assert len(summary.warnings) == 1 and "calibration.conf" in summary.warnings[0]
    for view in store.session.views:
        assert np.allclose(view.T_base_ee, chain.forward(view.joints))
    gaps = [e["pose_mm"] for e in CaptureLog(store).entries if e["event"] == "stored"]
    expected = [1e3 * np.linalg.norm((UR5.forward(q) - chain.forward(q))[:3, 3])
                for q in plan().joints]  # fmt: skip
    assert gaps == pytest.approx(expected, abs=2e-3)


def test_a_dry_run_goes_everywhere_slowly_and_keeps_nothing(
    tmp_path: Path, arm: KinematicArm
) -> None:
    summary = dry_run(plan(), arm, TableCamera(arm), config=replace(QUICK, speed_scale=0.25))
    assert summary.captured == VIEWS and summary.complete
    visited = np.stack(arm.path)
    assert all(np.any(np.all(visited == q, axis=1)) for q in plan().joints)
    assert {s for s, _ in arm.speeds} == {0.25 * plan().config.speed}
    refused("at most 1 is accepted", replace, QUICK, speed_scale=1.5)
    assert list(tmp_path.iterdir()) == []


def test_views_asked_for_and_views_taken_again(store: SessionStore, arm: KinematicArm) -> None:
    camera = TableCamera(arm)
    first = capture(plan(), arm, camera, store, config=QUICK, job=CaptureJob(views=(2, 7)))
    assert store.completed == {2, 7} and first.complete
    before = {k: (store.path(f"rgb/{k:06d}.png").read_bytes(), store.rgb(k)) for k in (2, 7)}
    stamps = {v.index: v.time_s for v in store.session.views}
    # The same place gives the same image; the time stamp tells the two apart.
    job = CaptureJob(views=(2,), retake=(7,))
    again = capture(plan(), arm, camera, store, config=QUICK, job=job)
    assert (again.captured, again.skipped) == (1, 1)
    store = SessionStore.open(store.folder)
    assert store.completed == {2, 7} and store.verify() == []
    assert store.session.view(7).time_s > stamps[7]
    assert store.session.view(2).time_s == stamps[2]
    assert store.path("retaken/000007_1_rgb.png").read_bytes() == before[7][0]
    assert store.has("retaken/000007_1_depth.png")
    assert store.read_json("retaken/000007_1.json")["time_s"] == stamps[7]
    capture(plan(), arm, camera, store, config=QUICK, job=CaptureJob(retake=(7,), views=()))
    assert store.has("retaken/000007_2_rgb.png") and store.has("retaken/000007_1_rgb.png")
    with pytest.raises(InputError, match="views \\[99\\] are not in the plan"):
        capture(plan(), arm, camera, store, config=QUICK, job=CaptureJob(views=(99,)))


def test_a_kill_at_any_write_of_a_retake_loses_neither_view(
    tmp_path: Path, arm: KinematicArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = TableCamera(arm)
    original = atomic.append_line
    for fatal in range(12):
        store = new_store(tmp_path / str(fatal), plan().content_hash)
        capture(plan(), arm, camera, store, config=QUICK, job=CaptureJob(views=(0,)))
        earlier = store.path("rgb/000000.png").read_bytes()
        left = iter(range(fatal))

        def torn(path: Path, line: str, left: Iterator[int] = left) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt
            original(path, line)

        monkeypatch.setattr(atomic, "append_line", torn)
        try:
            capture(plan(), arm, camera, store, config=QUICK, job=CaptureJob(retake=(0,), views=()))
            ended = True
        except KeyboardInterrupt:
            ended = False
        monkeypatch.setattr(atomic, "append_line", original)
        store = SessionStore.open(store.folder)
        kept = [store.path("rgb/000000.png"), store.path("retaken/000000_1_rgb.png")]
        assert any(p.is_file() and p.read_bytes() == earlier for p in kept)
        capture(plan(), arm, camera, store, config=QUICK, job=CaptureJob(views=(0,)))
        assert store.completed == {0} and store.verify() == []
        if ended:
            return
    pytest.fail("the retake never came to its end")


def test_the_log_says_what_happened_and_is_listed(store: SessionStore, arm: KinematicArm) -> None:
    capture(plan(), arm, TableCamera(arm, dark=1), store)
    store = SessionStore.open(store.folder)
    entries = CaptureLog(store).entries
    assert [e["event"] for e in entries] == ["begun", *["stored"] * VIEWS, "ended"]
    first = entries[1]
    assert first["view"] == 0 and first["attempts"] == 2 and "black" in first["retaken"][0]
    assert first["measured"]["depth_fill"] == 1.0 and first["settle_s"] >= 0.05
    assert store.verify() == []
    size = store.path(LOG_FILE).stat().st_size
    capture(plan(), arm, TableCamera(arm), store)  # nothing to do: nothing is written
    assert store.path(LOG_FILE).stat().st_size == size


def test_a_killed_capture_goes_on_without_losing_a_view(tmp_path: Path, arm: KinematicArm) -> None:
    folder = tmp_path / "session"

    def slow_capture() -> None:
        store = new_store(folder, plan().content_hash)
        capture(plan(), arm, TableCamera(arm, seconds=0.15), store)

    killed_growing(slow_capture, folder / "robot.jsonl", 4, 0.0)
    done = SessionStore.open(folder).completed
    assert 4 <= len(done) < VIEWS
    arm = KinematicArm(joints=plan().joints[max(done)].copy())
    store = SessionStore.open(folder)
    assert capture(plan(), arm, TableCamera(arm), store).skipped == len(done)
    assert store.completed == set(range(VIEWS))
    assert store.verify() == []
    for view in store.session.views:
        assert np.array_equal(view.joints, plan().joints[view.index])


# --- Fixed cameras beside the one in the hand.

LENS = CameraIntrinsics(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)


@dataclass
class StillCamera:
    """Counts its frames in their grey value; gives none where `fails_at` says so."""

    name: str = "still 1"
    fails_at: int = -1
    taken: int = 0
    intrinsics: CameraIntrinsics = LENS
    depth_unit_m: float = 2e-4
    description: dict[str, Any] = field(default_factory=dict)

    def grab(self) -> Frame:
        if self.taken == self.fails_at:
            self.fails_at = -1
            raise DeviceError("the fixed camera gave no frame.")
        self.taken += 1
        rgb = np.full((24, 32, 3), self.taken, np.uint8)
        return Frame(rgb=rgb, depth_m=np.full((24, 32), 0.7, np.float32), time_s=float(self.taken))

    def recover(self) -> None:
        pass


def taken(arm: KinematicArm, store: SessionStore, fixed: Any, **job: Any) -> CaptureSummary:
    work = CaptureJob(fixed=fixed, **job)
    return capture(plan(), arm, TableCamera(arm), store, config=QUICK, job=work)


def test_each_view_has_a_frame_of_each_fixed_camera(store: SessionStore, arm: KinematicArm) -> None:
    still = StillCamera()
    assert taken(arm, store, fixed_stores(store, {"left": still}), views=(0, 2, 3)).complete
    left = open_cameras(SessionStore.open(store.folder))["left"]
    assert [v.index for v in left.session.views] == [0, 2, 3]
    assert [int(left.rgb(k)[0, 0, 0]) for k in (0, 2, 3)] == [1, 2, 3]
    assert np.allclose(left.depth_m(2), 0.7)
    assert (left.session.intrinsics.width, left.session.depth_unit_m) == (32, 2e-4)
    assert left.check().sound and store.check().sound


def test_a_view_counts_when_all_cameras_have_it(store: SessionStore, arm: KinematicArm) -> None:
    still = StillCamera(fails_at=1)
    fixed = fixed_stores(store, {"left": still})
    refused("camera gave no frame", taken, arm, store, fixed, views=(0, 1), error=DeviceError)
    assert store.completed == {0}
    again = SessionStore.open(store.folder)
    assert taken(arm, again, fixed_stores(again, {"left": still}), views=(0, 1)).complete
    assert open_cameras(again)["left"].completed == again.completed == {0, 1}


def test_a_retaken_view_is_of_all_cameras(store: SessionStore, arm: KinematicArm) -> None:
    fixed = fixed_stores(store, {"left": StillCamera()})
    taken(arm, store, fixed, views=(0, 1))
    taken(arm, store, fixed, views=(), retake=(1,))
    left = open_cameras(store)["left"]
    assert [int(left.rgb(k)[0, 0, 0]) for k in (0, 1)] == [1, 3]


def test_a_capture_goes_on_with_its_first_cameras(store: SessionStore, arm: KinematicArm) -> None:
    still = StillCamera()
    taken(arm, store, fixed_stores(store, {"left": still}), views=(0,))
    refused(r"begun with the fixed cameras left, and .* names none", fixed_stores, store, {})
    refused("names left, right", fixed_stores, store, {"left": still, "right": StillCamera()})
    with pytest.raises(InputError, match=r"'left' of .* is still 1, .* connects still 2"):
        fixed_stores(store, {"left": StillCamera(name="still 2")})


@pytest.mark.parametrize("text", ["left", "left=", "=12", "left=1,left=2", "left=1,right=1"])
def test_other_forms_of_the_option_are_refused(text: str) -> None:
    refused("left=SERIAL,right=SERIAL is expected", serials_of, text)


def test_the_simulated_lab_has_no_fixed_camera() -> None:
    assert serials_of("left=12, top=34") == {"left": "12", "top": "34"}
    refused("no name of a camera", serials_of, "a/b=12")
    with ExitStack() as stack, pytest.raises(InputError, match="simulated lab has one camera"):
        open_fixed("left=12", True, stack)
