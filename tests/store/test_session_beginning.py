"""What a session was begun with outlives its header."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, CaptureSession, View
from realsim.store import SessionStore, atomic
from realsim.store.begun import BEGUN_FILE, RECOVERED, read_begun
from realsim.store.session_check import check_session
from realsim.store.session_repair import repair_session

CAMERA = CameraIntrinsics(
    width=40, height=30, fx=38.1, fy=38.2, cx=19.7, cy=14.9, distortion=np.array([0.05, 0.01])
)
VIEWS = 6


def images_of(index: int, take: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng([index, take])
    rgb = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    return rgb, rng.integers(3000, 4000, (30, 40)).astype(np.uint16)


def view_of(index: int) -> View:
    rng = np.random.default_rng(index)
    return View(
        index=index, T_base_ee=se3.random_transform(rng), joints=rng.normal(size=6),
        time_s=100.0 + index,
    )  # fmt: skip


def add(store: SessionStore, index: int, take: int = 0) -> None:
    rgb, counts = images_of(index, take)
    store.add_view(view_of(index), rgb, depth_counts=counts)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions") / "whole"
    session = CaptureSession(name="whole", intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(folder, session, {"plan_hash": "p" * 64, "camera": "D405 17"})
    store.write_json("plan.json", {"sha256": "p" * 64, "content": {"joints": [[0] * 6] * 8}})
    for index in range(VIEWS):
        add(store, index)
    Ts = se3.random_transform(np.random.default_rng(5), VIEWS)
    store.set_cameras(CAMERA, {k: Ts[k] for k in range(VIEWS)})
    store.write_json("calibration/hand_eye.json", {"a": list(range(50))})
    inner = SessionStore.create(folder / "calibration/capture", session, {"plan_hash": "q"})
    for index in range(3):
        add(inner, index)
    return folder


@pytest.fixture
def session(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "s"))


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in sorted(folder.rglob("*")) if p.is_file()
    }  # fmt: skip


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("beginning", ["kept", "lost", "damaged"])
@pytest.mark.parametrize("damage", ["missing", "empty", "junk", "value", "other arm"])
def test_a_lost_header_is_made_anew_from_what_is_there(
    session: Path, damage: str, beginning: str
) -> None:
    before = SessionStore.open(session)
    if beginning == "lost":
        before.remove(BEGUN_FILE)
    if beginning == "damaged":
        flip(session / BEGUN_FILE, 400)
    path = session / "session.json"
    if damage == "missing":
        path.unlink()
    elif damage == "value":
        header = json.loads(path.read_text())
        header["camera"]["fx"] = 99.0
        path.write_text(json.dumps(header))
    elif damage == "other arm":
        header = json.loads(path.read_text())
        path.write_text(json.dumps(header | {"extra": {"arm": "UR5e", "plan_hash": "p" * 64}}))
    else:
        path.write_bytes(b"" if damage == "empty" else b"{]")
    assert not check_session(session).sound
    repaired = repair_session(session)
    assert repaired.after.sound and "made anew" in repaired.notes[0]
    after = SessionStore.open(session)
    assert after.session.depth_unit_m == 1e-4 and after.extra["plan_hash"] == "p" * 64
    assert np.array_equal(after.session.intrinsics.K, CAMERA.K)
    assert np.array_equal(after.session.intrinsics.distortion, CAMERA.distortion)
    for index in range(VIEWS):
        now, then = (s.session.view(index).T_world_cam for s in (after, before))
        assert now is not None and then is not None
        np.testing.assert_allclose(now, then, atol=1e-12)
    if beginning == "kept":
        # Law: what the session was begun with is what it is after the repair, and opening and
        # repairing again change nothing.
        assert after.extra == before.extra and after.created == before.created
        assert after.session.name == "whole"
    else:
        assert after.extra.get("camera") == ("D405 17" if damage == "value" else None)
        unknown = damage in ("missing", "empty", "junk")
        assert after.extra.get(RECOVERED, False) == unknown
        assert (session / BEGUN_FILE).exists() != unknown  # no copy of what is not known
        assert unknown == any("capture adds no views" in n for n in repaired.notes)
    again = bytes_of(session)
    assert repair_session(session).notes == () and bytes_of(session) == again


def test_a_header_lost_before_the_first_view_is_what_it_was(tmp_path: Path) -> None:
    session = CaptureSession(name="n", intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    before = SessionStore.create(tmp_path, session, {"arm": "UR5", "lab": {"seed": 3}})
    whole = (tmp_path / "session.json").read_bytes()
    (tmp_path / "session.json").write_text('{"broken')
    assert repair_session(tmp_path).after.sound
    after = SessionStore.open(tmp_path)
    assert after.extra == before.extra
    assert json.loads(whole) == json.loads((tmp_path / "session.json").read_bytes())


def test_the_capture_log_still_tells_the_devices(session: Path) -> None:
    store = SessionStore.open(session)
    begun = {"event": "begun", "arm": {"model": "UR5", "serial": "1"}, "camera": {"serial": "17"}}
    store.write_bytes("capture_log.jsonl", (json.dumps(begun) + "\n").encode())
    store.remove(BEGUN_FILE)
    (session / "session.json").write_text('{"broken')
    repair_session(session)
    extra = SessionStore.open(session).extra
    assert extra["arm_description"] == begun["arm"] and extra[RECOVERED]
    assert extra["camera_description"] == {"serial": "17"}
    # Somebody who knows says so by hand: the repair takes it over, and keeps it from then on.
    header = json.loads((session / "session.json").read_text())
    del header["extra"][RECOVERED]
    (session / "session.json").write_text(json.dumps(header))
    assert repair_session(session).after.sound
    assert RECOVERED not in SessionStore.open(session).extra
    assert read_begun(session) is not None


def test_a_session_of_before_gets_its_beginning_when_it_is_opened(session: Path) -> None:
    whole = (session / BEGUN_FILE).read_bytes()
    store = SessionStore.open(session)
    store.remove(BEGUN_FILE)
    before = json.loads(whole)
    SessionStore.open(session)
    assert json.loads((session / BEGUN_FILE).read_bytes())["extra"] == before["extra"]
    # Not from a header that is not what was written.
    SessionStore.open(session).remove(BEGUN_FILE)
    path = session / "session.json"
    path.write_text(path.read_text().replace("D405 17", "D405 18"))
    SessionStore.open(session)
    assert not (session / BEGUN_FILE).exists()


def test_a_damaged_header_says_how_to_go_on(session: Path) -> None:
    path = session / "session.json"
    for data in ('{"broken', "[]", '{"format": "x"}', '{"format": "realsim session"}', None):
        if data is None:
            path.unlink()
        else:
            path.write_text(data)
        with pytest.raises(InputError, match=r"session\.json.*`realsim check .*/s --repair`"):
            SessionStore.open(session)
    record = CaptureSession(name="x", intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    with pytest.raises(InputError, match=r"holds views of a session .* --repair"):
        SessionStore.create(session, record)
    header = json.loads(atomic.json_bytes({"format": "realsim session", "format_version": 99}))
    path.write_text(json.dumps(header))
    with pytest.raises(InputError, match="newer realsim") as told:
        SessionStore.open(session)
    assert "--repair" not in str(told.value)
