"""Devices that stop, frames that are wrong, and a person who clears, redoes, skips and pauses.

Arm, camera and table are the simulated lab's; what goes wrong is added to them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike

from begun_sessions import begun
from given_plans import QUICK, TURNED_HOME, driven_clear, joints_looking_at, plan_through, ring_plan
from plain_meshes import square
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import SessionStore
from realsim_capture_plans.capturing.capture import CaptureJob, CaptureSummary, capture
from realsim_capture_plans.capturing.contact_sheet import SHEET_FILE, write_contact_sheet
from realsim_capture_plans.capturing.log import CaptureLog
from realsim_capture_plans.capturing.operator import CaptureStatus, Command, Operator
from realsim_capture_plans.devices.interfaces import ArmStoppedError, DeviceError, Frame, Stop
from realsim_capture_plans.devices.ur import UrArm
from realsim_capture_plans.devices.ur_loopback import LoopbackController
from realsim_capture_plans.lab import LabConfig, SimulatedLab
from realsim_capture_plans.lab.lab import SimulatedArm, SimulatedDepthCamera
from realsim_capture_plans.planning.record import CapturePlan

VIEWS = 9
RENDERED: dict[bytes, Frame] = {}
CLOCK = count(1)


@lru_cache(maxsize=1)
def plan() -> CapturePlan:
    """An arc of views round the lab's objects."""
    center = np.array([0.45, 0.0, 0.03])
    turns = np.linspace(0.0, np.pi, VIEWS)
    eyes = [center + 0.36 * np.array([-0.3 * np.sin(a), 0.3 * np.cos(a), 0.95]) for a in turns]
    return plan_through(np.stack(joints_looking_at(center, eyes, TURNED_HOME)), TURNED_HOME, center)


class StoppingArm(SimulatedArm):
    """Stops half way to the goals of some moves, until it is recovered."""

    def __init__(self, stops: dict[int, Stop], *, patience: int = 0) -> None:
        """Stop in the moves of these numbers; refuse the first `patience` recoveries."""
        super().__init__()
        self.stops, self.patience = stops, patience
        self.moves, self.recovered = 0, 0
        self.path: list[Array] = [self._joints.copy()]
        self.stopped = False

    def move(self, joints: ArrayLike, speed: float = 1.05, acceleration: float = 1.4) -> None:
        assert not self.stopped, "an arm that is stopped was told to move"
        self.moves += 1
        goal = np.asarray(joints, dtype=np.float64)
        stop = self.stops.pop(self.moves, None)
        if stop is not None:
            super().move((self._joints + goal) / 2, speed, acceleration)
            self.path.append(self._joints.copy())
            self.stopped = True
            raise ArmStoppedError(f"{stop}: release it at the pendant.", stop)
        super().move(goal, speed, acceleration)
        self.path.append(self._joints.copy())

    def recover(self) -> None:
        if self.patience > 0:
            self.patience -= 1
            raise ArmStoppedError("the protective stop is still there.", "protective stop")
        self.recovered += 1
        self.stopped = False


Spoil = dict[int, Callable[[Frame, Frame], Frame]] | None


class SpoiltCamera:
    """The lab's camera with frames that are spoilt: {number of the grab: what is done to it}."""

    def __init__(self, arm: SimulatedArm, camera: SimulatedDepthCamera, spoil: Spoil) -> None:
        """Spoil these grabs, counted from 1; each is given the frame and the one before."""
        self._arm, self._camera, self.spoil = arm, camera, spoil or {}
        self.name, self.description = camera.name, camera.description
        self.intrinsics, self.depth_unit_m = camera.intrinsics, camera.depth_unit_m
        self.grabs, self.recovered = 0, 0
        self._last: Frame | None = None

    def grab(self) -> Frame:
        self.grabs += 1
        frame = self._rendered()
        before, spoil = self._last, self.spoil.get(self.grabs)
        self._last = frame
        return frame if spoil is None else spoil(frame, before or frame)

    def _rendered(self) -> Frame:
        """The lab gives the same frame at the same joints: each is rendered once for all tests."""
        joints = self._arm.state().joints.tobytes()
        if joints not in RENDERED:
            RENDERED[joints] = self._camera.grab()
        return replace(RENDERED[joints], time_s=float(next(CLOCK)))

    def recover(self) -> None:
        self.recovered += 1


def blurred(frame: Frame, before: Frame) -> Frame:
    kernel = np.eye(11, dtype=np.float32) / 11  # 15 px of motion along the diagonal
    return replace(frame, rgb=cv2.filter2D(frame.rgb, -1, kernel))


def black(frame: Frame, before: Frame) -> Frame:
    return replace(frame, rgb=np.zeros_like(frame.rgb))


def frozen(frame: Frame, before: Frame) -> Frame:
    return replace(before, time_s=frame.time_s)


def burnt_out(frame: Frame, before: Frame) -> Frame:
    return replace(frame, rgb=np.minimum(frame.rgb.astype(np.int64) * 3, 255).astype(np.uint8))


def no_depth(frame: Frame, before: Frame) -> Frame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


def glare(frame: Frame, before: Frame) -> Frame:
    depth = frame.depth_m.copy()
    h, w = depth.shape
    depth[h // 4 : 3 * h // 4, w // 3 : 2 * w // 3] = 0
    return replace(frame, depth_m=depth)


def unplugged(frame: Frame, before: Frame) -> Frame:
    raise DeviceError("the camera does not answer: plug it in.")


@dataclass
class Person(Operator):
    """Gives prepared answers and types prepared keys before the views."""

    answers: list[Command] = field(default_factory=list)
    keys: dict[int, list[Command]] = field(default_factory=dict)
    told: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    statuses: list[CaptureStatus] = field(default_factory=list)
    meanwhile: Callable[[], None] | None = None

    def show(self, status: CaptureStatus) -> None:
        self.statuses.append(status)

    def tell(self, text: str, *, trouble: bool = False) -> None:
        self.told.append(("! " if trouble else "") + text)

    def commands(self) -> list[Command]:
        return self.keys.pop(self.statuses[-1].stored if self.statuses else 0, [])

    def ask(self, text: str, choices: Sequence[Command]) -> Command | None:
        self.asked.append(text)
        if self.meanwhile is not None:
            self.meanwhile()
        answer = self.answers.pop(0)
        assert answer in choices
        return answer


@lru_cache(maxsize=1)
def lab() -> tuple[SimulatedLab, Sequence[PlacedMesh]]:
    """The lab, and its objects as they stand on a ground of two triangles."""
    made = SimulatedLab(LabConfig(seed=3, n_objects=4, width=640, height=360))
    true = made.truth.objects
    objects = [PlacedMesh(o.instance, made.models[o.obj_id].mesh, o.T_world_obj) for o in true]
    ground = PlacedMesh(BACKGROUND, square(1.0), se3.from_translation([0.5, 0.0, 0.0]))
    return made, [ground, *objects]


@dataclass
class Bench:
    """An arm with a camera in the lab, and a session."""

    arm: SimulatedArm
    camera: SpoiltCamera
    store: SessionStore

    def capture(self, **job: Any) -> CaptureSummary:
        work = CaptureJob(**job)
        return capture(plan(), self.arm, self.camera, self.store, config=QUICK, job=work)


def bench(folder: Path, spoil: Spoil = None, arm: SimulatedArm | None = None) -> Bench:
    a = arm or SimulatedArm()
    there, on_table = lab()
    camera = SimulatedDepthCamera(there.config, there.truth, a, lambda: on_table)
    extra = {"plan_hash": plan().content_hash}
    store = begun(folder, camera.intrinsics, extra, unit_m=camera.depth_unit_m)
    return Bench(arm=a, camera=SpoiltCamera(a, camera, spoil), store=store)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    """The session that nothing disturbed."""
    b = bench(tmp_path_factory.mktemp("reference") / "s")
    summary = b.capture()
    assert summary.complete and summary.rejected == summary.noted == summary.warnings == ()
    return b.store


def assert_same_views(store: SessionStore, reference: SessionStore) -> None:
    assert store.completed == reference.completed and store.verify() == []
    for k in reference.completed:
        name = f"rgb/{k:06d}.png"
        assert store.path(name).read_bytes() == reference.path(name).read_bytes()
        assert np.array_equal(store.depth_m(k), reference.depth_m(k))


def test_a_stop_that_a_person_clears_costs_no_view(tmp_path: Path, reference: SessionStore) -> None:
    arm = StoppingArm({4: "protective stop", 7: "connection lost"}, patience=1)
    b = bench(tmp_path / "s", arm=arm)
    person = Person(answers=["go", "go", "go"])
    assert b.capture(operator=person).complete and arm.recovered == 2
    assert len(person.asked) == 3  # one recovery was refused
    assert sum("release it at the pendant" in t for t in person.told) == 2
    assert driven_clear(plan(), arm.path)
    assert_same_views(b.store, reference)
    events = [e["event"] for e in CaptureLog(b.store).entries]
    assert events.count("trouble") == 3 and events.count("recovered") == 2


def test_an_arm_moved_by_hand_during_a_pause_is_led_back(
    tmp_path: Path, reference: SessionStore
) -> None:
    arm = StoppingArm({})
    b = bench(tmp_path / "s", arm=arm)
    away = plan().home + 0.3 * np.eye(6)[0]

    def by_hand() -> None:
        SimulatedArm.move(arm, away)
        arm.path.append(away)

    person = Person(answers=["go"], keys={4: ["pause"]}, meanwhile=by_hand)
    b.capture(operator=person)
    assert "paused" in person.asked[0]
    after = next(i for i, q in enumerate(arm.path) if np.array_equal(q, away))
    assert driven_clear(plan(), arm.path[after:])
    assert_same_views(b.store, reference)


def test_a_camera_that_is_gone_is_waited_for(tmp_path: Path, reference: SessionStore) -> None:
    b = bench(tmp_path / "s", {3: unplugged})
    person = Person(answers=["go"])
    b.capture(operator=person)
    assert b.camera.recovered == 1 and "! the camera does not answer: plug it in." in person.told
    assert_same_views(b.store, reference)
    b = bench(tmp_path / "nobody", {3: unplugged})
    with pytest.raises(DeviceError, match="plug it in"):
        b.capture()
    assert b.store.completed == {0, 1}
    assert b.capture().captured == VIEWS - 2
    assert_same_views(b.store, reference)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (blurred, "blurred"),
        (black, "black"),
        (frozen, "frozen"),
        (burnt_out, "saturated"),
        (no_depth, "pixels have depth"),
        (glare, "depth fills"),
    ],
)
def test_one_spoilt_frame_is_taken_again(
    tmp_path: Path, reference: SessionStore, spoil: Callable[[Frame, Frame], Frame], reason: str
) -> None:
    b = bench(tmp_path / "s", {6: spoil})
    summary = b.capture()
    assert [k for k, _ in summary.rejected] == [5] and reason in summary.rejected[0][1]
    assert summary.noted == () and summary.complete
    assert_same_views(b.store, reference)
    entry = CaptureLog(b.store).views()[5]
    assert entry["attempts"] == 2 and reason in entry["retaken"][0] and entry["notes"] == []


def test_a_doubt_that_stays_is_stored_with_a_note_and_three_in_a_row_are_asked_about(
    tmp_path: Path,
) -> None:
    spoil = dict.fromkeys(range(6, 99), blurred)
    b = bench(tmp_path / "s", spoil)
    person = Person(answers=["stop"])
    summary = b.capture(operator=person)
    assert [k for k, _ in summary.noted] == [5, 6, 7] and not summary.complete
    assert "3 views in a row: blurred" in person.asked[0]
    sheet = b.store.read_image(write_contact_sheet(b.store, VIEWS, "test"))
    assert b.store.has(SHEET_FILE) and b.store.verify() == []
    # An amber frame round each of the three: 4 pixels wide on all sides of a 16:9 cell.
    amber = int(np.all(sheet == (255, 170, 0), axis=-1).sum())
    assert amber > 3 * 4 * 2 * (320 + 180) * 0.8
    # Nobody there: the views are stored, noted, and the run goes on to its end.
    b = bench(tmp_path / "nobody", spoil)
    summary = b.capture()
    assert summary.complete and [k for k, _ in summary.noted] == [5, 6, 7, 8]


# --- A whole capture with the UR driver: real ur_rtde, loopback controller, the lab's camera.

STOPS = 4
HOME = np.radians([180.0, -90.0, 90.0, -90.0, -90.0, 0.0])


class PersonAtThePendant(Operator):
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
    plan = ring_plan(lab.scene_center, HOME, STOPS)
    words = {"tcp": "0,0,0.12,0,0,0.5", "joints": ",".join(map(str, HOME))}
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
    assert store.completed == set(range(STOPS))
    for view in store.session.views:
        np.testing.assert_allclose(view.joints, plan.joints[view.index], atol=1e-9)
        np.testing.assert_allclose(view.T_base_ee, plan.Ts_base_ee[view.index], atol=1e-9)
        assert np.mean(store.depth_m(view.index) > 0) > 0.5
