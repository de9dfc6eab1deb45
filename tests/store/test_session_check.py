"""A check finds every damage and no more; a repair takes out what is damaged and nothing else."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from file_trees import bytes_of
from realsim.records import CameraIntrinsics, CaptureSession, View
from realsim.store import SessionStore
from realsim.store.manifest import NAME as MANIFEST
from realsim.store.session_check import check_session
from realsim.store.session_repair import repair_session
from refusals import refused
from stored_sessions import CAMERA, VIEWS, add, flip, images_of, view_of

DEAD = 2**22 + 1
"""A process number that no process has."""


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
    for path in original:
        if path.startswith("calibration/capture") or (
            path.endswith(".png") and not path.startswith(images)
        ):
            continue
        size = len(original[path])
        for place in {0, size - 1, int(rng.integers(0, size))}:
            if original[path][place : place + 1] == b"\n":
                continue  # two lines in one, or a torn one: see the cut file below
            flip(session / path, place)
            assert not check_session(session).sound, (path, place)
            expected = set(range(VIEWS))
            if path.startswith(("rgb", "depth")):
                expected -= {int(Path(path).stem)}
            elif path == "robot.jsonl":
                expected -= {original[path][:place].count(b"\n")}
            repaired = repair_session(session)
            assert repaired.after.sound, (path, place, repaired.after.findings)
            store = SessionStore.open(session)
            assert store.verify() == []
            if path != "manifest.jsonl":
                assert set(repaired.after.views) == expected == store.completed, (path, place)
            else:
                assert set(repaired.after.views) == set(range(VIEWS))
            kept = bytes_of(session)
            for index in expected:
                for name in (f"rgb/{index:06d}.png", f"depth/{index:06d}.png"):
                    assert kept[name] == original[name]
                assert np.array_equal(store.session.view(index).joints, view_of(index).joints)
                T = store.session.view(index).T_world_cam
                assert T is not None
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
    robot, manifest = (session / "robot.jsonl").read_bytes(), (session / MANIFEST).read_bytes()
    cameras = (session / "scene_camera.json").read_bytes()
    add(SessionStore.open(session), 6)
    new_robot = (session / "robot.jsonl").read_bytes()
    new_manifest = (session / MANIFEST).read_bytes()
    new_cameras = (session / "scene_camera.json").read_bytes()
    (session / f"rgb/.000007.png.{DEAD}.part").write_bytes(b"half")
    # In the order of the writes: the line (whole or torn), the cameras, the manifest.
    for robot_bytes, camera_bytes, manifest_bytes, views in (
        (robot, cameras, manifest, 6),
        (new_robot[:-40], cameras, manifest, 6),
        (new_robot, cameras, manifest, 7),
        (new_robot, new_cameras, manifest, 7),
        (new_robot, new_cameras, new_manifest[: len(manifest) + 100], 7),
        (new_robot, new_cameras, new_manifest[: new_manifest[:-1].rfind(b"\n") + 1], 7),
        (new_robot, new_cameras, new_manifest[:-70], 7),
        (new_robot, new_cameras, new_manifest, 7),
    ):
        (session / "scene_camera.json").write_bytes(camera_bytes)
        (session / "robot.jsonl").write_bytes(robot_bytes)
        (session / MANIFEST).write_bytes(manifest_bytes)
        report = check_session(session)
        assert report.sound and len(report.views) == views, report.findings
        assert report.paths("leftover") == (f"rgb/.000007.png.{DEAD}.part",)
        assert set(report.paths("unlisted")) == (
            set() if views == 7 else {"rgb/000006.png", "depth/000006.png"}
        )
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
    session = CaptureSession(name="c", intrinsics=CAMERA, views=(), depth_unit_m=2.5e-4)
    store = SessionStore.create(tmp_path, session)
    rgb, counts = images_of(0)
    counts[0, :3] = [0, 1, 65535]
    store.add_view(View(index=0), rgb, depth_counts=counts)
    assert np.array_equal(store.read_image("depth/000000.png"), counts)
    store.add_view(View(index=1), rgb, store.depth_m(0))
    assert (tmp_path / "depth/000001.png").read_bytes() == (
        tmp_path / "depth/000000.png"
    ).read_bytes()
    refused("not both", store.add_view, View(index=2), rgb, store.depth_m(0), depth_counts=counts)
    refused("uint16", store.add_view, View(index=2), rgb, depth_counts=counts.astype(np.int32))
    refused("size", store.add_view, View(index=2), rgb, depth_counts=counts[:3])


def test_many_views_are_listed_for_bop_when_the_store_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("realsim.store.session_store.EAGER_VIEWS", 16)
    camera = CameraIntrinsics(width=2, height=2, fx=2, fy=2, cx=0.5, cy=0.5)
    session = CaptureSession(name="m", intrinsics=camera, views=(), depth_unit_m=1e-4)
    rgb = np.zeros((2, 2, 3), np.uint8)
    with SessionStore.create(tmp_path, session) as store:
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
