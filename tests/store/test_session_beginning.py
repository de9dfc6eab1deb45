"""What a session was begun with outlives its header."""

import json
from pathlib import Path

import numpy as np
import pytest

from bop_scenes import edit
from file_trees import bytes_of
from realsim.records import CaptureSession
from realsim.store import SessionStore, atomic
from realsim.store.opening import BEGUN_FILE, RECOVERED, finish_beginning, read_begun
from realsim.store.session_check import check_session
from realsim.store.session_repair import repair_session
from refusals import refused
from stored_sessions import CAMERA, VIEWS, flip


@pytest.mark.parametrize(
    ("damage", "beginning"),
    [("missing", "kept"), ("junk", "lost"), ("value", "damaged"), ("other arm", "kept")],
)
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
        edit(path, lambda header: header["camera"].update(fx=99.0))
    elif damage == "other arm":
        header = json.loads(path.read_text())
        path.write_text(json.dumps(header | {"extra": {"arm": "UR5e", "plan_hash": "p" * 64}}))
    else:
        path.write_bytes(b"{]")
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
        unknown = damage in ("missing", "junk")
        assert after.extra.get(RECOVERED, False) == unknown
        assert (session / BEGUN_FILE).exists() != unknown  # no copy of what is not known
        assert unknown == any("capture adds no views" in n for n in repaired.notes)
    again = bytes_of(session)
    assert repair_session(session).notes == () and bytes_of(session) == again


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
    edit(session / "session.json", lambda header: header["extra"].pop(RECOVERED))
    assert repair_session(session).after.sound
    assert RECOVERED not in SessionStore.open(session).extra
    assert read_begun(session) is not None


def test_a_damaged_header_says_how_to_go_on(session: Path) -> None:
    path = session / "session.json"
    for data in ('{"broken', "[]", '{"format": "x"}', '{"format": "realsim session"}', None):
        if data is None:
            path.unlink()
        else:
            path.write_text(data)
        refused(r"session\.json.*`realsim check .*/s --repair`", SessionStore.open, session)
    record = CaptureSession(name="x", intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    refused(r"holds views of a session .* --repair", SessionStore.create, session, record)
    header = json.loads(atomic.json_bytes({"format": "realsim session", "format_version": 99}))
    path.write_text(json.dumps(header))
    said = refused("newer realsim", SessionStore.open, session)
    assert "--repair" not in said


@pytest.mark.parametrize("listed", [-1, 0, 20, 10_000])
def test_a_header_that_a_kill_kept_from_its_name_gets_it_or_goes(tmp_path: Path, listed: int):
    whole = CaptureSession(name="new", intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    SessionStore.create(tmp_path, whole).close()
    header, manifest = tmp_path / "session.json", tmp_path / "manifest.jsonl"
    line = next(x for x in manifest.read_text().splitlines(True) if '"session.json"' in x)
    for path in tmp_path.iterdir():
        if path != header:
            path.unlink()
    header.rename(tmp_path / ".session.json.999999999.part")
    if listed < 0:  # asked to end: the bytes are gone, and the list has them
        (tmp_path / ".session.json.999999999.part").unlink()
        manifest.write_text(line)
    elif listed:
        manifest.write_text(line[:listed])  # the last line may be torn
    finish_beginning(tmp_path)
    if listed < len(line):
        assert list(tmp_path.iterdir()) == []
    else:
        assert SessionStore.open(tmp_path).session.name == "new"
