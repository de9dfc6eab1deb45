"""`realsim import`: what goes in comes out, going on after a kill, and nothing is guessed."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from begun_sessions import begun
from realsim.app.console import Console
from realsim.app.importing.session import import_session
from realsim.app.importing.source import ImportRequest, kinds_of, open_source, run_import
from realsim.errors import UnitError
from realsim.geometry import se3
from realsim.robots.arm import find_arm
from realsim.store import SessionStore, atomic
from refusals import refused
from sources_in_memory import CAMERA, Recording, frame_of, ten
from typed_commands import realsim
from written_bags import recorded, stamp

DATA = Path(os.environ.get("REALSIM_DATA", Path(__file__).parents[2] / "../shared/data"))
QUIET = Console(quiet=True)


def check_equal(folder: Path, frames) -> None:
    store = SessionStore.open(folder)
    assert store.verify() == [] and len(store.session.views) == len(frames)
    for frame, view in zip(frames, store.session.views, strict=True):
        assert view.time_s == frame.time_s
        assert np.array_equal(store.rgb(view.index), frame.rgb)
        metres = (frame.depth_counts * np.float64(1e-4)).astype(np.float32)
        assert np.array_equal(store.depth_m(view.index), metres)
        assert np.array_equal(view.joints, frame.joints)
        np.testing.assert_allclose(view.T_base_ee, frame.T_base_ee, atol=1e-12)
        np.testing.assert_allclose(view.T_world_cam, frame.T_world_cam, atol=1e-12)
    store.close()


@pytest.mark.parametrize("stop", [0, 5])
def test_an_import_goes_on_where_it_stopped(tmp_path, stop):
    broken, again = Recording(ten(), stop=stop), Recording(ten())
    refused(f"frame {stop} cannot", import_session, broken, tmp_path / "s", QUIET)
    assert import_session(again, tmp_path / "s", QUIET).imported == 10 - stop
    assert again.read == list(range(max(stop - 1, 0), 10))  # one frame more, to compare it
    check_equal(tmp_path / "s", ten())
    done = Recording(ten())
    assert import_session(done, tmp_path / "s", QUIET).imported == 0 and done.read == []


def test_another_source_is_refused_until_it_is_said(tmp_path):
    folder = tmp_path / "s"
    import_session(Recording(ten()), folder, QUIET)
    others = [Recording(ten(), content="b"), Recording(ten(), camera=replace(CAMERA, fx=36.0))]
    for other in others:
        refused(r"another source.*--overwrite", import_session, other, folder, QUIET)
        check_equal(folder, ten())
    broken = Recording(ten(), content="b", stop=5)
    kept = "cannot.*earlier import in .* stays as it was"
    refused(kept, import_session, broken, folder, QUIET, overwrite=True)
    check_equal(folder, ten())
    folder.rename(tmp_path / ".s.replaced")  # as of a kill just before the new one has its name
    refused("another source", import_session, others[0], folder, QUIET)
    check_equal(folder, ten())
    import_session(Recording(ten()[:4], content="b"), folder, QUIET, overwrite=True)
    check_equal(folder, ten()[:4])
    assert [p.name for p in tmp_path.iterdir()] == ["s"]
    atomic.write_text(folder / "review/journal.jsonl", "what people decided\n")
    import_session(others[0], folder, QUIET, overwrite=True)
    check_equal(folder, ten())
    check_equal(tmp_path / "s.before", ten()[:4])
    assert (tmp_path / "s.before/review/journal.jsonl").is_file()


def test_nobodys_folder_and_no_captured_session_is_touched(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a/thesis.tex").write_text("precious")
    begun(tmp_path / "b", CAMERA).close()
    for name, why in (("a", r"not empty.*thesis\.tex"), ("b", "never replaced")):
        refused(why, import_session, Recording(ten()), tmp_path / name, QUIET, overwrite=True)
    refused("is a file", import_session, Recording(ten()), tmp_path / "a/thesis.tex", QUIET)
    refused("no frames", import_session, Recording([]), tmp_path / "c", QUIET)
    assert (tmp_path / "a/thesis.tex").read_text() == "precious" and not (tmp_path / "c").exists()


def far(T: np.ndarray, scale: float) -> np.ndarray:
    T = T.copy()
    T[:3, 3] *= scale
    return T


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (lambda f: replace(f, time_s=frame_of(4).time_s), "time stamps must increase"),
        (lambda f: replace(f, rgb=f.rgb[:20]), r"camera is of 40x30"),
        (lambda f: replace(f, T_base_ee=far(f.T_base_ee, 1e4)), "reading rotvec,mm"),
        (lambda f: replace(f, T_world_cam=far(f.T_world_cam, 1e4)), "millimetres"),
    ],
)
def test_a_frame_that_cannot_be_is_named_and_the_rest_stays(tmp_path, fault, message):
    frames = ten()
    frames[5] = fault(frames[5])
    refused(rf"frame 5 \(f5\).*{message}", import_session, Recording(frames), tmp_path / "s", QUIET)
    check_equal(tmp_path / "s", ten()[:5])


def test_depth_that_is_empty_or_not_there_is_told_before_register_asks_for_it(tmp_path, capsys):
    frames = ten()
    frames[3] = replace(frames[3], depth_counts=0 * frames[3].depth_counts)
    import_session(Recording(frames), tmp_path / "a", QUIET)
    told = capsys.readouterr().err
    assert "note: a note with [square] brackets." in told
    assert "empty (at least 99 % of the pixels are 0): 1, of f3." in told
    assert "register" not in told
    bare = [replace(f, depth_counts=None) for f in frames]
    for some in ([frames[3]], bare):
        import_session(Recording(some), tmp_path / f"b{len(some)}", QUIET)
        assert "has no depth, and `realsim register` needs it" in capsys.readouterr().err


# --- folders: camera and poses ----------------------------------------------------------------


def make_folder(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["image x y z qx qy qz qw"]
    for k in range(6):
        frame = frame_of(k)
        counts = np.full((30, 40), 600 + 7 * k, dtype=np.uint16)
        cv2.imwrite(str(folder / f"rgb_{k:03d}.png"), frame.rgb[..., ::-1])
        cv2.imwrite(str(folder / f"depth_{k:03d}.png"), counts)
        t = frame.T_base_ee[:3, 3]
        w, x, y, z = se3.quaternion_wxyz(frame.T_base_ee[:3, :3])
        lines.append(f"rgb_{k:03d}.png " + " ".join(f"{v!r}" for v in map(float, [*t, x, y, z, w])))
    (folder / "poses").mkdir(exist_ok=True)
    (folder / "poses/robot.txt").write_text("\n".join([lines[0], *reversed(lines[1:])]) + "\n")
    (folder / "K.txt").write_text("35 0 20\n0 35 15\n0 0 1\n")
    return folder


def test_a_folder_with_camera_and_poses(tmp_path):
    """Poses stand in another order than the images, and beside their names."""
    folder = make_folder(tmp_path / "in")
    request = ImportRequest(source=folder, depth_unit=0.001, depth_coding="plain")
    summary = run_import(request, tmp_path / "s", QUIET)
    assert (summary.frames, summary.with_tool_pose, summary.with_depth) == (6, 6, 6)
    for v in SessionStore.open(tmp_path / "s").session.views:
        np.testing.assert_allclose(v.T_base_ee, frame_of(v.index).T_base_ee, atol=1e-9)
    camera = replace(request, poses_of="camera")
    run_import(camera, tmp_path / "c", QUIET)
    view = SessionStore.open(tmp_path / "c").session.views[2]
    assert view.T_base_ee is None
    np.testing.assert_allclose(view.T_world_cam, frame_of(2).T_base_ee, atol=1e-9)
    os.truncate(folder / "rgb_004.png", 900)
    refused(r"rgb_004\.png is truncated", run_import, request, tmp_path / "t", QUIET)
    assert not (tmp_path / "t").exists()


def test_seven_joints_come_too_and_are_the_named_arms(tmp_path):
    folder = make_folder(tmp_path / "in")
    file = folder / "poses/robot.txt"
    header, *rows = file.read_text().splitlines()
    q = {row.split()[0]: np.arange(7) / 10 + k for k, row in enumerate(rows)}
    lines = [f"{row} {' '.join(map(str, q[row.split()[0]]))}" for row in rows]
    names = " ".join(f"q{k + 1}_rad" for k in range(7))
    file.write_text("\n".join([f"{header} {names}", *lines]) + "\n")
    request = ImportRequest(source=folder, depth_unit=0.001, depth_coding="plain", arm="panda")
    assert run_import(request, tmp_path / "s", QUIET).with_joints == 6
    for v in SessionStore.open(tmp_path / "s").session.views:
        np.testing.assert_allclose(v.joints, q[f"rgb_{v.index:03d}.png"])
    why = r"7 joint angles.*--arm ur5, a UR5, has 6.*Panda"
    refused(why, open_source, replace(request, arm="ur5"), QUIET)


def test_a_recordings_joints_are_those_of_the_named_arm(tmp_path):
    called = find_arm("panda").joint_names
    q = np.linspace(-1.0, 1.0, 7)

    def panda(bag) -> None:
        for k in range(3):
            for d in (-5, 5):
                bag.joints(q + k, stamp(k) + d * 10**6, prefix="left_", called=called)

    sent = recorded(tmp_path, n=3, joints=False, change=panda)
    request = ImportRequest(source=sent.path, arm="panda")
    frames = list(open_source(request, QUIET).frames())
    assert np.allclose([f.joints for f in frames], [q, q + 1, q + 2])
    plain = open_source(replace(request, arm=None), QUIET)
    assert next(plain.frames()).joints is None
    assert any("shoulder_pan_joint" in note and "--arm" in note for note in plain.notes)


def test_poses_are_read_as_said_or_not_at_all(tmp_path):
    folder = make_folder(tmp_path / "in")
    shutil.rmtree(folder / "poses")
    rows = [f"{k} {300 + 10 * k} 20 400 0.1 {0.2 * k} 0.3" for k in range(6)]
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    request = ImportRequest(source=folder, depth_unit=0.001, poses=folder / "poses.txt")
    refused(r"not clear.*--reading", open_source, request, QUIET)
    refused(".", open_source, replace(request, reading="rotvec,m"), QUIET, error=UnitError)
    source = open_source(replace(request, reading="rotvec,rad,mm"), QUIET)
    T = next(source.frames(5)).T_base_ee
    np.testing.assert_allclose(T[:3, 3], [0.35, 0.02, 0.4])
    none = open_source(replace(request, poses=None, no_poses=True), QUIET)
    assert next(none.frames()).T_base_ee is None


def test_the_camera_is_found_named_or_asked_for(tmp_path):
    folder = make_folder(tmp_path / "in")
    request = ImportRequest(source=folder, depth_unit=0.001)
    assert open_source(request, QUIET).intrinsics.fx == 35
    bop = {"fx": 35.5, "fy": 35, "cx": 20, "cy": 15, "depth_scale": 1.0, "width": 40, "height": 30}
    (folder / "camera.json").write_text(json.dumps(bop))
    refused(r"several cameras: K\.txt, camera\.json", open_source, request, QUIET)
    (folder / "K.txt").unlink()
    source = open_source(replace(request, depth_unit=None), QUIET)
    assert source.depth_unit_m == 0.001 and source.intrinsics.fx == 35.5  # as its depth_scale says
    (folder / "camera.json").unlink()
    refused(r"camera of the images \(40x30 px\)", open_source, request, QUIET)
    other = tmp_path / "other.txt"
    other.write_text("700 0 320\n0 700 240\n0 0 1\n")
    refused("another image size", open_source, replace(request, intrinsics=other), QUIET)


# --- what it is -------------------------------------------------------------------------------


def test_the_kind_is_known_by_the_content(tmp_path):
    (tmp_path / "recording").write_bytes(b"#ROSBAG V2.0\n")
    assert list(kinds_of(tmp_path / "recording")) == ["bag"]
    (tmp_path / "x.dat").write_bytes(b"\x89MCAP0\r\n...")
    assert "MCAP" in kinds_of(tmp_path / "x.dat")["bag"]
    folder = make_folder(tmp_path / "in")
    assert list(kinds_of(folder)) == ["folder"]
    (folder / "scene_camera.json").write_text("{}")
    (folder / "cameras.txt").write_text("")
    (folder / "images.txt").write_text("")
    (tmp_path / "notes.txt").write_text("hello")
    import_session(Recording(ten()), tmp_path / "s", QUIET)
    for name, why in (
        ("in", r"several things \(bop: .*colmap: .*--kind"),
        ("notes.txt", "a file of no known kind"),
        ("nowhere", "does not exist"),
        ("s", "is a session already"),
    ):
        refused(why, open_source, ImportRequest(source=tmp_path / name), QUIET)


def test_a_real_bag_becomes_a_session(tmp_path):
    bag = DATA / "bags/single_depth_color_640x480.bag"
    if not bag.is_file():
        pytest.skip(f"no recording at {bag}")
    why = r"--max-pair-gap 0\.11\), or import colour.*--no-depth"
    refused(why, open_source, ImportRequest(source=bag), QUIET)
    summary = run_import(ImportRequest(source=bag, max_pair_gap=0.11), tmp_path / "s", QUIET)
    store = SessionStore.open(tmp_path / "s")
    assert summary.frames == len(store.session.views) >= 1 and store.verify() == []
    assert store.rgb(0).shape == (480, 640, 3)


# --- the command ------------------------------------------------------------------------------


def test_the_command_names_what_is_missing_and_then_imports(tmp_path):
    folder = make_folder(tmp_path / "in")
    first = realsim("import", folder, tmp_path / "s")
    assert first.returncode == 2 and "Traceback" not in first.stderr
    assert "--depth-coding" in first.stderr or "--depth-unit" in first.stderr
    assert not (tmp_path / "s").exists()
    options = ("--depth-unit", 0.001, "--depth-coding", "plain", "--quiet")
    done = realsim("import", folder, tmp_path / "s", *options)
    assert done.returncode == 0, done.stderr
    assert "6 (6 now)" in done.stdout and SessionStore.open(tmp_path / "s").verify() == []
    assert realsim("import", folder).returncode == 2
