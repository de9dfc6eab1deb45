"""A session, its grasps and trajectories come back as they were; a kill leaves no half view."""

import json
import shutil
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bop_scenes import edit
from killed_children import killed_growing
from realsim import store as stores
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, CaptureSession, View
from realsim.store import SessionStore, atomic
from realsim.store.manifest import Manifest, entry_of
from realsim.store.trajectories import load_trajectories, save_trajectories
from refusals import refused
from tried_grasps import assert_same, attempts_of, tried_set

CAMERA = CameraIntrinsics(
    width=64, height=48, fx=60.1, fy=60.2, cx=31.7, cy=23.9,
    distortion=np.array([-0.05, 0.06, 1e-4, -2e-4, 0.01]),
)  # fmt: skip
UNIT = 1e-4


def empty_session(name="table"):
    return CaptureSession(name=name, intrinsics=CAMERA, depth_unit_m=UNIT)


def make_view(index):
    rng = np.random.default_rng(index)
    T, q = se3.random_transform(rng), rng.normal(size=6)
    return View(index=index, T_base_ee=T, joints=q, time_s=1e9 * rng.random())


def make_images(index):
    rng = np.random.default_rng([index, 1])
    rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    depth_m = rng.uniform(0.1, 1.0, (48, 64)).astype(np.float32)
    depth_m[:4] = 0
    return rgb, depth_m


def filled(folder, n=3):
    store = SessionStore.create(folder, empty_session(), {"plan": "hemisphere"})
    for i in range(n):
        store.add_view(make_view(i), *make_images(i))
    return store


# --- round trips ---------------------------------------------------------------------------------


def test_a_session_comes_back_bit_for_bit(tmp_path):
    filled(tmp_path / "s", 5)
    store = SessionStore.open(tmp_path / "s")
    assert store.completed == {0, 1, 2, 3, 4} and store.extra == {"plan": "hemisphere"}
    s = store.session
    assert s.name == "table" and s.depth_unit_m == UNIT
    assert np.array_equal(s.intrinsics.distortion, CAMERA.distortion)
    assert np.array_equal(s.intrinsics.K, CAMERA.K)
    for view in s.views:
        assert_same(view, make_view(view.index))
        rgb, depth_m = make_images(view.index)
        assert np.array_equal(store.rgb(view.index), rgb)
        found = store.depth_m(view.index)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, depth_m, atol=UNIT / 2 + 1e-7)
        assert (found[:4] == 0).all()
    assert store.verify() == []


def test_depth_that_does_not_fit_becomes_no_measurement(tmp_path):
    store = SessionStore.create(tmp_path, empty_session())
    depth_m = np.full((48, 64), 0.5, np.float32)
    depth_m[0, :4] = [np.nan, -0.1, 70_000 * UNIT, np.inf]
    depth_m[0, 4:6] = [65_535 * UNIT, UNIT]
    store.add_view(View(index=0), make_images(0)[0], depth_m)
    found = store.depth_m(0)[0, :6]
    np.testing.assert_allclose(found, [0, 0, 0, 0, 6.5535, 1e-4], rtol=1e-6)


def test_camera_poses_come_back_bit_for_bit(tmp_path):
    store = filled(tmp_path)
    Ts = se3.random_transform(np.random.default_rng(9), 3)
    new = CameraIntrinsics(width=64, height=48, fx=61, fy=61, cx=32, cy=24)
    store.set_cameras(new, {i: Ts[i] for i in (0, 1)})
    for s in (store.session, SessionStore.open(tmp_path).session):
        assert s.intrinsics.fx == 61 and not s.intrinsics.is_distorted
        for i in (0, 1):
            assert_same(s.view(i), replace(make_view(i), T_world_cam=Ts[i]))
        assert_same(s.view(2), make_view(2))
    entry = store.read_json("scene_camera.json")["1"]
    R = np.reshape(entry["cam_R_w2c"], (3, 3))
    np.testing.assert_allclose(R, Ts[1][:3, :3].T, atol=1e-12)
    np.testing.assert_allclose(entry["cam_t_w2c"], 1e3 * se3.invert(Ts[1])[:3, 3], atol=1e-9)
    assert "cam_distortion" not in entry
    refused("view 8", store.set_cameras, new, {8: np.eye(4)})


def test_the_folder_is_a_bop_scene_from_its_first_frame_on(tmp_path):
    from realsim.formats.bop.scene import find_scenes, read_scene

    store = filled(tmp_path / "test/000007", 1)
    store.set_cameras(CAMERA, {0: se3.from_translation([0.1, 0.2, 0.3])})
    (ref,) = find_scenes(tmp_path)
    assert (ref.split, ref.scene_id) == ("test", 7)
    scene = read_scene(ref)
    assert scene.session.depth_unit_m == UNIT and scene.ground_truth_file is None
    assert np.array_equal(scene.session.intrinsics.K, CAMERA.K)
    assert np.array_equal(scene.session.intrinsics.distortion, CAMERA.distortion)
    np.testing.assert_allclose(scene.Ts_world_cam[0][:3, 3], [0.1, 0.2, 0.3], atol=1e-12)
    assert np.array_equal(scene.rgb(0), store.rgb(0))
    assert np.array_equal(scene.depth_m(0), store.depth_m(0))


def test_the_same_files_come_back(tmp_path):
    store = filled(tmp_path, 1)
    values = {"a": [1, 0.1, None, "x"]}
    store.write_json("reports/a.json", values)
    assert store.read_json("reports/a.json") == values and store.has("reports/a.json")
    store.write_npz("reports/a.npz", x=np.arange(4), y=np.eye(2))
    first = (tmp_path / "reports/a.npz").read_bytes()
    time.sleep(1.1)
    store.write_npz("reports/a.npz", x=np.arange(4), y=np.eye(2))
    assert (tmp_path / "reports/a.npz").read_bytes() == first
    mask = make_images(0)[1] > 0.5
    store.write_image("mask/a.png", mask)
    assert np.array_equal(store.read_image("mask/a.png") > 0, mask)
    assert store.verify() == []


# --- what cannot be ------------------------------------------------------------------------------


def test_bad_requests_say_what_would_do(tmp_path):
    store = filled(tmp_path, 2)
    rgb, depth_m = make_images(0)
    refused("already holds a session", SessionStore.create, tmp_path, empty_session())
    refused("holds no session", SessionStore.open, tmp_path / "rgb")
    refused("view 1 is already", store.add_view, View(index=1), rgb, depth_m)
    for images in ((rgb[:, :32], depth_m), (rgb, depth_m[:24])):
        refused("size", store.add_view, View(index=5), *images)
    refused(r"view 9 .* 0, 1", store.rgb, 9)
    refused("inside the session", store.write_json, "../outside.json", {})
    refused("JSON", store.write_json, "nan.json", {"x": float("nan")}, error=ValueError)
    assert store.completed == {0, 1} and not store.has("nan.json") and store.verify() == []
    with_views = replace(empty_session(), views=(View(index=0),))
    refused("add_view", SessionStore.create, tmp_path / "new", with_views)


@pytest.mark.parametrize("keep", [0, 400])
def test_a_truncated_png_is_named(tmp_path, keep):
    filled(tmp_path, 1)
    for name, read in (("rgb", SessionStore.rgb), ("depth", SessionStore.depth_m)):
        path = tmp_path / name / "000000.png"
        path.write_bytes(path.read_bytes()[:keep])
        store = SessionStore.open(tmp_path)
        said = refused(rf"{name}.000000\.png is (truncated|not)", read, store, 0)
        assert "capture the view again" in said
    faults = {f.path: f.kind for f in store.verify()}
    assert faults == dict.fromkeys(("rgb/000000.png", "depth/000000.png"), "changed")


def test_derived_files_are_listed_and_replaced_together(tmp_path):
    store = filled(tmp_path, 1)
    lines = len((tmp_path / "manifest.jsonl").read_bytes().splitlines())
    store.write_derived({f"mask/{k:06d}.png": b"first %d" % k for k in range(20)})
    assert store.verify() == []
    listed = (tmp_path / "manifest.jsonl").read_bytes().splitlines()
    assert len(listed) == lines + 20
    store.write_derived({"mask/000003.png": b"second", "labels/x.png": b"new"})
    reopened = SessionStore.open(tmp_path)
    assert reopened.verify() == [] and store.verify() == []
    assert reopened.path("mask/000003.png").read_bytes() == b"second"
    refused("inside the session", store.write_derived, {"mask/a.png": b"1", "../b.png": b"2"})
    assert not store.has("mask/a.png")


# --- kills ---------------------------------------------------------------------------------------


def test_every_prefix_of_a_view_that_a_kill_can_leave_is_cleaned_up(tmp_path):
    # All files in the order in which add_view writes them, cut at every step and within lines.
    lists, rgb = ("robot.jsonl", "manifest.jsonl"), "rgb/000001.png"
    filled(tmp_path / "one", 1)
    robot_before, manifest_before = ((tmp_path / "one" / name).read_bytes() for name in lists)
    shutil.copytree(tmp_path / "one", tmp_path / "whole")
    SessionStore.open(tmp_path / "whole").add_view(make_view(1), *make_images(1))
    robot, manifest = ((tmp_path / "whole" / name).read_bytes() for name in lists)
    assert robot.startswith(robot_before)
    both = [rgb, "depth/000001.png"]
    steps = [
        ("rgb only", [rgb], robot_before, manifest_before, 1),
        ("both images", both, robot_before, manifest_before, 1),
        ("torn robot line", both, robot[:-9], manifest_before, 1),
        ("no manifest line", both, robot, manifest_before, 2),
        ("torn manifest", both, robot, manifest[:-300], 2),
    ]
    for k, (what, images, robot_bytes, manifest_bytes, views) in enumerate(steps):
        folder = tmp_path / str(k)
        shutil.copytree(tmp_path / "one", folder)  # the same session: begun in the same second
        for image in [*images, "session.json"]:
            (folder / image).write_bytes((tmp_path / "whole" / image).read_bytes())
        (folder / "robot.jsonl").write_bytes(robot_bytes)
        (folder / "manifest.jsonl").write_bytes(manifest_bytes)
        (folder / "rgb" / f".000009.png.{2**22 + 1}.part").write_bytes(b"half")
        store = SessionStore.open(folder)
        assert store.completed == set(range(views)), what
        if views == 1:
            store.add_view(make_view(1), *make_images(1))
        store = SessionStore.open(folder)
        assert store.completed == {0, 1} and store.verify() == [], what
        assert set(store.read_json("scene_camera.json")) == {"0", "1"}, what
        assert_same(store.session.view(1), make_view(1))
        listed = Manifest(folder).entries
        assert {"rgb/000001.png", "depth/000001.png", "robot.jsonl"} <= set(listed), what
        assert not list(folder.rglob("*.part")), what


def capture(folder):
    store = SessionStore.open(folder)
    for i in range(10_000):
        if i not in store.completed:
            store.add_view(make_view(i), *make_images(i))


def test_killed_captures_lose_at_most_the_view_in_flight(tmp_path):
    folder = tmp_path / "s"
    SessionStore.create(folder, empty_session())
    rng = np.random.default_rng(0)
    before: set[int] = set()
    for _ in range(2):
        robot = folder / "robot.jsonl"
        killed_growing(partial(capture, folder), robot, 3, rng.uniform(0, 0.02))
        lines = robot.read_bytes().count(b"\n")
        store = SessionStore.open(folder)
        assert before <= store.completed == set(range(lines))
        assert store.verify() == [] and not list(folder.rglob("*.part"))
        assert len(json.loads((folder / "scene_camera.json").read_text())) == lines
        before = store.completed
    assert len(before) >= 6
    assert SessionStore.open(folder).verify() == []
    for i in (0, max(before)):
        assert np.array_equal(store.rgb(i), make_images(i)[0])
        assert_same(store.session.view(i), make_view(i))


def calibrate(folder):
    store = SessionStore.open(folder)
    for k in range(100_000):
        store.set_cameras(CAMERA, {i: se3.from_translation([k, i, 0]) for i in range(3)})
        store.write_json("reports/a.json", k)


def test_killed_calibrations_leave_one_set_of_cameras(tmp_path):
    folder = tmp_path / "s"
    filled(folder, 3)
    wait_s = np.random.default_rng(1).uniform(0, 0.01)
    killed_growing(partial(calibrate, folder), folder / "manifest.jsonl", 5, wait_s)
    store = SessionStore.open(folder)
    assert store.verify() == []
    k = {v.T_world_cam[0, 3] for v in store.session.views}
    assert len(k) == 1
    entry = store.read_json("scene_camera.json")["2"]
    np.testing.assert_allclose(entry["cam_t_w2c"], [-1e3 * k.pop(), -2e3, 0], atol=1e-6)


# --- atomic files and the manifest ---------------------------------------------------------------


def test_a_file_killed_between_its_line_and_its_name_gets_its_name(tmp_path):
    store = filled(tmp_path, 1)
    store.write_json("reports/a.json", [1])
    new = atomic.json_bytes([2])
    for is_listed in (False, True):  # not listed yet: the old file holds
        (tmp_path / f"reports/.a.json.{2**22 + 1}.part").write_bytes(new)
        if is_listed:
            Manifest(tmp_path).add([entry_of("reports/a.json", new)])
        store = SessionStore.open(tmp_path)
        assert store.read_json("reports/a.json") == [1 + is_listed] and store.verify() == []
    assert not list(tmp_path.rglob("*.part"))


# --- grasps and their trajectories ---------------------------------------------------------------


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_sets_with_measures_come_back_bit_for_bit(tmp_path_factory, seed):
    folder = tmp_path_factory.mktemp("g")
    s = tried_set(np.random.default_rng(seed), 12)
    stores.save_grasps(folder, s)
    assert_same(s, stores.load_grasps(folder)[0])


def test_files_of_the_first_format_are_still_read(tmp_path):
    s = tried_set(np.random.default_rng(1), 12, measures=())
    note = stores.save_grasps(tmp_path, s).with_suffix(".json")
    edit(note, lambda head: head.update(format_version=1))
    edit(note, lambda head: head.pop("measures"))
    assert_same(s, stores.load_grasps(tmp_path)[0])


def test_a_newer_format_is_refused_by_its_number(tmp_path):
    path = stores.save_grasps(tmp_path, tried_set(np.random.default_rng(1), 3))
    for found in (3, 0, "2", None):
        edit(path.with_suffix(".json"), lambda head, v=found: head.update(format_version=v))
        refused(r"format.version", stores.load_grasps, tmp_path)


def tried(seed):
    """Return grasps, and attempts at them."""
    rng = np.random.default_rng(seed)
    s = tried_set(rng, 20)
    return s, attempts_of(rng, s)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_attempts_come_back_bit_for_bit(tmp_path_factory, seed):
    folder, (s, t) = tmp_path_factory.mktemp("t"), tried(seed)
    path = save_trajectories(folder, s, t)
    data = path.read_bytes()
    assert_same(t, load_trajectories(folder, s))
    assert save_trajectories(folder, s, t).read_bytes() == data


def test_in_a_session_they_are_listed_with_their_checksum(tmp_path):
    store, (s, t) = SessionStore.create(tmp_path, empty_session()), tried(2)
    stores.save_grasps(store, s)
    path = save_trajectories(store, s, t)
    store = SessionStore.open(tmp_path)
    assert store.verify() == []
    for where in (store, tmp_path, tmp_path / "grasps"):
        assert_same(t, load_trajectories(where, stores.load_grasps(store)[0]))
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert [f.path for f in store.verify()] == [path.relative_to(tmp_path).as_posix()]


def test_where_none_were_kept_there_are_none(tmp_path):
    assert load_trajectories(tmp_path, tried_set(np.random.default_rng(0), 3)) is None


def test_attempts_of_other_grasps_are_refused(tmp_path):
    s, t = tried(3)
    save_trajectories(tmp_path, s, t)
    moved = s.Ts_obj_grasp @ se3.from_translation([0.0, 0.0, 1e-6])
    refused("other grasps", load_trajectories, tmp_path, replace(s, Ts_obj_grasp=moved))
    refused("rows", save_trajectories, tmp_path, s, replace(t, rows=t.rows + 100))
    # What the scores became later does not make them other grasps.
    assert load_trajectories(tmp_path, replace(s, measures={})) is not None


def test_a_torn_file_is_named(tmp_path):
    s, t = tried(4)
    path = save_trajectories(tmp_path, s, t)
    data = path.read_bytes()
    for share in (0.0, 0.3, 0.7, 0.99):
        path.write_bytes(data[: int(share * len(data))])
        refused("not a complete file of trajectories", load_trajectories, tmp_path, s)
