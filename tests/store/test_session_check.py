"""A check finds every damage and no more; a repair takes out what is damaged and nothing else."""

import filecmp
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from begun_sessions import begun
from bop_scenes import edit
from file_trees import bytes_of
from realsim.records import CameraIntrinsics, View
from realsim.store import SessionStore
from realsim.store.manifest import NAME as MANIFEST
from realsim.store.opening import BEGUN_FILE, RECOVERED, finish_beginning, read_begun
from realsim.store.session_check import check_session
from realsim.store.session_repair import repair_session
from refusals import refused
from stored_sessions import CAMERA, VIEWS, add, flip, images_of, view_of

DEAD = 2**22 + 1
"""A process number that no process has."""


@pytest.fixture
def session(small_session: Path, tmp_path: Path) -> Path:
    # Nothing is linked: these tests damage images where they stand.
    return Path(shutil.copytree(small_session, tmp_path / "s"))


def test_a_sound_session_is_sound_and_looking_changes_nothing(session: Path) -> None:
    before = bytes_of(session)
    report = SessionStore.open(session).check()
    assert report.sound and report.views == tuple(range(VIEWS)) and report.findings == ()
    assert (report.planned, report.not_captured) == (8, (6, 7))
    # 12 images, robot.jsonl, session.json and its beginning, scene_camera.json, plan.json, hand_eye
    assert (report.files_ok, report.unproven, report.beside) == (18, (), ())
    assert [r.views for r in report.inner] == [(0, 1, 2)]
    assert check_session(session, decode=True) == report
    repaired = repair_session(session)
    assert repaired.moved == repaired.dropped_views == repaired.notes == ()
    assert bytes_of(session) == before


def test_every_flipped_byte_is_found_and_only_its_view_is_lost(session: Path) -> None:
    # Law: one bit anywhere is found, the repair makes the session sound, all other views and
    # files stay bit for bit, and what was damaged is kept aside.
    original = bytes_of(session)
    rng = np.random.default_rng(0)
    images = ("rgb/000000", "rgb/000003", "depth/000005")
    for path, whole in original.items():
        if path.startswith("calibration/capture") or (
            path.endswith(".png") and not path.startswith(images)
        ):
            continue
        for place in {0, len(whole) - 1, int(rng.integers(0, len(whole)))}:
            if whole[place : place + 1] == b"\n":
                continue  # two lines in one, or a torn one: see the cut file below
            flip(session / path, place)
            assert not check_session(session).sound, (path, place)
            expected = set(range(VIEWS))
            if path.startswith(("rgb", "depth")):
                expected -= {int(Path(path).stem)}
            elif path == "robot.jsonl":
                expected -= {whole[:place].count(b"\n")}
            repaired = repair_session(session)
            assert repaired.after.sound, (path, place, repaired.after.findings)
            store = SessionStore.open(session)
            assert store.verify() == []
            assert set(repaired.after.views) == expected == store.completed, (path, place)
            kept = bytes_of(session)
            for index in expected:
                for name in (f"rgb/{index:06d}.png", f"depth/{index:06d}.png"):
                    assert kept[name] == original[name]
                assert np.array_equal(store.session.view(index).joints, view_of(index).joints)
                assert store.session.view(index).T_world_cam is not None
            damaged = {p for p in kept if p.startswith("damaged/")}
            assert any(p.startswith(f"damaged/{path}") for p in damaged), (path, place)
            assert all(path in p or path == "robot.jsonl" or "0000" in path for p in damaged)
            for index in set(range(VIEWS)) - expected:  # the same capture takes them again
                add(store, index)
                assert store.session.view(index).T_world_cam is None
            assert store.completed == set(range(VIEWS)) and check_session(session).sound
            shutil.rmtree(session)
            for name, data in original.items():
                (session / name).parent.mkdir(parents=True, exist_ok=True)
                (session / name).write_bytes(data)


def test_a_lost_image_costs_its_view(session: Path) -> None:
    path = "depth/000002.png"
    (session / path).unlink()
    before = bytes_of(session)
    SessionStore.open(session).close()
    assert bytes_of(session) == before
    report = check_session(session)
    assert report.paths("missing") == (path,) and report.damaged_views == (2,) and not report.sound
    repaired = repair_session(session)
    store = SessionStore.open(session)
    assert repaired.dropped_views == (2,) and "captured" in repaired.notes[0]
    assert store.completed == set(range(VIEWS)) - {2}
    assert (session / "damaged/rgb/000002.png").is_file()
    add(store, 2, take=1)
    assert check_session(session).sound


def test_a_cut_robot_file_costs_the_views_whose_lines_are_gone(session: Path) -> None:
    path = session / "robot.jsonl"
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 55 // 100])
    report = check_session(session)
    assert "robot.jsonl" in report.paths("changed") and report.paths("torn") == ("robot.jsonl",)
    assert report.damaged_views == (3, 4, 5)
    repaired = repair_session(session)
    assert repaired.after.sound and repaired.after.views == (0, 1, 2)
    assert (session / "damaged/rgb/000004.png").read_bytes()
    assert not (session / "rgb/000004.png").exists()


def test_a_header_that_cannot_be_made_anew_is_left_alone(session: Path) -> None:
    (session / "session.json").write_text("{]")
    (session / "scene_camera.json").write_text("{]")
    before = bytes_of(session)
    refused(r"Restore one of the two .* were not touched", repair_session, session)
    assert bytes_of(session) == before


def test_what_a_kill_leaves_is_no_damage(session: Path) -> None:
    names = ("robot.jsonl", "scene_camera.json", MANIFEST)
    robot, cameras, manifest = ((session / name).read_bytes() for name in names)
    add(SessionStore.open(session), 6)
    new_robot, new_cameras, new_manifest = ((session / name).read_bytes() for name in names)
    (session / f"rgb/.000007.png.{DEAD}.part").write_bytes(b"half")
    # In the order of the writes: the line (whole or torn), the cameras, the manifest.
    for *contents, views in (
        (robot, cameras, manifest, 6),
        (new_robot[:-40], cameras, manifest, 6),
        (new_robot, cameras, manifest, 7),
        (new_robot, new_cameras, manifest, 7),
        (new_robot, new_cameras, new_manifest[: len(manifest) + 100], 7),
        (new_robot, new_cameras, new_manifest[: new_manifest[:-1].rfind(b"\n") + 1], 7),
        (new_robot, new_cameras, new_manifest[:-70], 7),
        (new_robot, new_cameras, new_manifest, 7),
    ):
        for name, content in zip(names, contents, strict=True):
            (session / name).write_bytes(content)
        report = check_session(session)
        assert report.sound and len(report.views) == views, report.findings
        assert report.paths("leftover") == (f"rgb/.000007.png.{DEAD}.part",)
        unlisted = {"rgb/000006.png", "depth/000006.png"} if views == 6 else set()
        assert set(report.paths("unlisted")) == unlisted
    opened = SessionStore.open(session)
    assert opened.verify() == [] and check_session(session).findings == ()


def test_a_view_taken_again_keeps_its_own_line(session: Path) -> None:
    store = SessionStore.open(session)
    for path in ("rgb/000001.png", "depth/000001.png"):
        store.remove(path)
    add(store, 1, take=1)
    assert check_session(session).sound
    # The newer line is damaged: the older one does not belong to these images.
    flip(session / "robot.jsonl", (session / "robot.jsonl").stat().st_size - 120)
    assert check_session(session).damaged_views == (1,)
    assert repair_session(session).after.views == (0, 2, 3, 4, 5)


def test_a_sub_session_is_repaired_too(session: Path) -> None:
    flip(session / "calibration/capture/depth/000001.png", 60)
    report = check_session(session)
    assert not report.sound and report.findings == ()
    assert report.inner[0].damaged_views == (1,)
    repaired = repair_session(session)
    assert repaired.after.sound and repaired.inner[0].dropped_views == (1,)
    assert (session / "calibration/capture/damaged/depth/000001.png").is_file()


def test_depth_counts_are_stored_as_they_are(tmp_path: Path) -> None:
    store = begun(tmp_path, CAMERA, unit_m=2.5e-4)
    rgb, counts = images_of(0)
    counts[0, :3] = [0, 1, 65535]
    store.add_view(View(index=0), rgb, depth_counts=counts)
    assert np.array_equal(store.read_image("depth/000000.png"), counts)
    store.add_view(View(index=1), rgb, store.depth_m(0))
    assert filecmp.cmp(tmp_path / "depth/000001.png", tmp_path / "depth/000000.png", shallow=False)
    refused("not both", store.add_view, View(index=2), rgb, store.depth_m(0), depth_counts=counts)
    refused("uint16", store.add_view, View(index=2), rgb, depth_counts=counts.astype(np.int32))
    refused("size", store.add_view, View(index=2), rgb, depth_counts=counts[:3])


def test_many_views_are_listed_for_bop_when_the_store_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("realsim.store.session_store.EAGER_VIEWS", 16)
    camera = CameraIntrinsics(width=2, height=2, fx=2, fy=2, cx=0.5, cy=0.5)
    rgb = np.zeros((2, 2, 3), np.uint8)
    with begun(tmp_path, camera) as store:
        for index in range(48):
            store.add_view(View(index=index), rgb)
            listed = len(json.loads((tmp_path / "scene_camera.json").read_text()))
            assert listed >= min(index + 1, 16) and listed >= (index + 1) / 1.2
    assert len(json.loads((tmp_path / "scene_camera.json").read_text())) == 48
    assert store.verify() == [] and store.check().sound
    store.add_view(View(index=48), rgb)  # without a close, the next open does it
    SessionStore.open(tmp_path)
    assert len(json.loads((tmp_path / "scene_camera.json").read_text())) == 49
    assert os.listdir(tmp_path / "rgb")


# --- What a session was begun with outlives its header.


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
        edit(path, lambda header: header.update(extra={"arm": "UR5e", "plan_hash": "p" * 64}))
    else:
        path.write_bytes(b"{]")
    assert not check_session(session).sound
    repaired = repair_session(session)
    assert repaired.after.sound and "made anew" in repaired.notes[0]
    after = SessionStore.open(session)
    assert after.session.depth_unit_m == 1e-4 and after.extra["plan_hash"] == "p" * 64
    assert np.array_equal(after.session.intrinsics.K, CAMERA.K)
    assert np.array_equal(after.session.intrinsics.distortion, CAMERA.distortion)
    now, then = (np.array([v.T_world_cam for v in s.session.views], float) for s in (after, before))
    assert now.shape == (VIEWS, 4, 4)
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
    refused(r"holds views of a session .* --repair", begun, session, CAMERA)
    path.write_text(json.dumps({"format": "realsim session", "format_version": 99}))
    assert "--repair" not in refused("newer realsim", SessionStore.open, session)


@pytest.mark.parametrize("listed", [-1, 0, 20, 10_000])
def test_a_header_that_a_kill_kept_from_its_name_gets_it_or_goes(tmp_path: Path, listed: int):
    begun(tmp_path, CAMERA, name="new").close()
    manifest, header = tmp_path / "manifest.jsonl", (tmp_path / "session.json").read_bytes()
    line = next(x for x in manifest.read_text().splitlines(True) if '"session.json"' in x)
    for path in tmp_path.iterdir():
        path.unlink()
    if listed >= 0:  # else asked to end: the bytes are gone, and the list has them
        (tmp_path / ".session.json.999999999.part").write_bytes(header)
    if listed:
        manifest.write_text(line if listed < 0 else line[:listed])  # the last line may be torn
    finish_beginning(tmp_path)
    if listed < len(line):
        assert list(tmp_path.iterdir()) == []
    else:
        assert SessionStore.open(tmp_path).session.name == "new"


# --- What a check notes: lost checksums, second lines, clocks that go back.


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
    refused(r"manifest\.jsonl is lost.*--repair", SessionStore.open, session)
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
    store = begun(tmp_path, CAMERA)
    for index, time_s in enumerate((5.0, 6.0, 2.0, 3.0)):
        store.add_view(View(index=index, time_s=time_s), images_of(index)[0])

    def log(*events: str | int) -> None:
        stored = {"event": "stored"}
        rows = [stored | {"view": e} if isinstance(e, int) else {"event": e} for e in events]
        store.write_bytes("capture_log.jsonl", "".join(f"{json.dumps(x)}\n" for x in rows).encode())

    for known in (("begun", 0, 1, "ended", "begun", 2, 3), ("begun", 0, 1, "recovered", 2, 3),
                  ("begun", 0, "begun", 2, 3)):  # fmt: skip
        log(*known)
        assert check_session(tmp_path).findings == ()
    log("begun", 0, 1, 2, 3)  # one run: its camera's clock went back
    assert [f.kind for f in check_session(tmp_path).findings] == ["time"]
    log("begun", 0, 1, "begun", 2, 3, "begun", 1)  # taken again, and stored last
    store.remove("rgb/000001.png")
    store.write_json("retaken/000001_1.json", {"index": 1})
    store.add_view(View(index=1, time_s=1.0), images_of(1, 1)[0])
    assert check_session(tmp_path).findings == ()
