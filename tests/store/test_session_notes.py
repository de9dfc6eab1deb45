"""What a check notes: lost checksums, second lines, clocks that go back."""

import json
from pathlib import Path

import pytest

from file_trees import bytes_of
from realsim.errors import InputError
from realsim.records import CaptureSession, View
from realsim.store import SessionStore
from realsim.store.manifest import NAME as MANIFEST
from realsim.store.session_check import check_session
from realsim.store.session_repair import repair_session
from stored_sessions import CAMERA, VIEWS, add, images_of


@pytest.mark.parametrize("left", [None, b'{"path": "half'])
def test_views_without_a_manifest_are_not_taken_for_sound(
    session: Path, left: bytes | None
) -> None:
    (session / MANIFEST).unlink()
    if left is not None:
        (session / MANIFEST).write_bytes(left)
    path = session / "rgb/000001.png"
    path.write_bytes(path.read_bytes()[:-300])
    before = bytes_of(session)
    with pytest.raises(InputError, match=r"manifest\.jsonl is lost.*--repair"):
        SessionStore.open(session)
    assert bytes_of(session) == before
    report = check_session(session)
    assert not report.sound and report.damaged_views == (1,)
    assert len(report.unproven) == 17 and "calibration/" in dict(report.beside)
    repaired = repair_session(session)
    assert repaired.after.sound and repaired.dropped_views == (1,)
    assert SessionStore.open(session).completed == set(range(VIEWS)) - {1}
    assert repaired.after.unproven == ()


def test_a_file_that_lost_its_checksum_is_named(session: Path) -> None:
    add(SessionStore.open(session), 6)
    path = session / MANIFEST
    lines = path.read_bytes().splitlines(keepends=True)
    at = next(k for k, line in enumerate(lines) if b"depth/000006" in line)
    path.write_bytes(b"".join(lines[:at]) + lines[at][:60])
    report = check_session(session)
    assert report.sound and "depth/000006.png" in report.unproven
    kinds = {f.path: f.kind for f in report.findings}
    assert kinds["depth/000006.png"] == "unproven" and kinds[MANIFEST] == "torn"
    assert "the checksum of depth/000006.png is lost" in report.findings[0].found
    repaired = repair_session(session)
    assert any("depth/000006.png" in n and "nothing can tell" in n for n in repaired.notes)
    assert repaired.after.findings == () and repaired.after.unproven == ()
    # What cannot be read is not listed by opening, and stays damage.
    path.write_bytes(b"".join(lines[:at]))
    image = session / "depth/000006.png"
    image.write_bytes(image.read_bytes()[:-300])
    assert check_session(session).damaged_views == (6,)
    store = SessionStore.open(session)
    assert [f.path for f in store.stored_faults()] == ["depth/000006.png"]
    assert check_session(session).damaged_views == (6,)


def test_a_second_line_of_a_view_is_noted_unless_it_was_retaken(session: Path) -> None:
    path = session / "robot.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines, lines[2]]))
    report = check_session(session)
    assert report.sound and len(report.views) == VIEWS
    (note,) = [f for f in report.findings if f.kind == "repeated"]
    assert "view 2 has 2 lines (3, 7)" in note.found and "1 of them repeat" in note.found
    path.write_bytes(b"".join(lines))
    store = SessionStore.open(session)
    store.write_json("retaken/000003_1.json", {"index": 3})
    for name in ("rgb/000003.png", "depth/000003.png"):
        store.remove(name)
    rgb, counts = images_of(3, 1)
    store.add_view(View(index=3, time_s=200.0), rgb, depth_counts=counts)
    assert check_session(session).findings == ()


def test_time_that_goes_back_where_a_run_began_is_no_note(tmp_path: Path) -> None:
    session = CaptureSession(name="t", intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(tmp_path, session)
    for index, time_s in enumerate((5.0, 6.0, 2.0, 3.0)):
        store.add_view(View(index=index, time_s=time_s), images_of(index)[0])

    def log(*events: str | int) -> None:
        lines = [
            {"event": "stored", "view": e} if isinstance(e, int) else {"event": e} for e in events
        ]
        store.write_bytes(
            "capture_log.jsonl", "".join(json.dumps(x) + "\n" for x in lines).encode()
        )

    for known in (("begun", 0, 1, "ended", "begun", 2, 3), ("begun", 0, 1, "recovered", 2, 3),
                  ("begun", 0, "begun", 2, 3)):  # fmt: skip
        log(*known)
        assert check_session(tmp_path).findings == ()
    log("begun", 0, 1, 2, 3)  # one run: its camera's clock went back
    assert [f.kind for f in check_session(tmp_path).findings] == ["time"]
    log("begun", 0, 1, "begun", 2, 3, "begun", 1)  # taken again, and stored last
    for path in ("rgb/000001.png",):
        store.remove(path)
    store.write_json("retaken/000001_1.json", {"index": 1})
    store.add_view(View(index=1, time_s=1.0), images_of(1, 1)[0])
    assert check_session(tmp_path).findings == ()
