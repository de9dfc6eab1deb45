"""Joining what recordings hold: clocks, depth units, joints, tf, depth seen by another camera.

librealsense's own recordings: a real .bag of a D435, and a .db3 by the SDK's software device.
"""

import sqlite3
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real_data import DATA, needs
from realsim.errors import UnitError
from realsim.formats.bags import BagChoice, joints, open_bag, pixels, wire
from realsim.formats.bags.joints import UR_JOINTS, JointTrack, prefixes
from realsim.formats.bags.reproject import depth_in_colour
from realsim.formats.bags.tf_tree import TfTree, arm_frames
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.interop import quaternion_xyzw_from_R
from realsim.records import CameraIntrinsics
from refusals import refused

S = wire.NS_PER_S

# --- clocks ---------------------------------------------------------------------------------------

TIMES = st.lists(st.integers(0, 10**6), min_size=1, max_size=30, unique=True).map(sorted)


@given(TIMES, TIMES, st.integers(0, 10**9))
@settings(max_examples=10, deadline=None)
def test_pairs_are_one_to_one_symmetric_and_shift_with_the_clock(
    a: list[int], b: list[int], shift: int
) -> None:
    ta, tb = np.array(a), np.array(b)
    found = joints.pairs(ta, tb, 1e-4)
    assert len(set(found[:, 0])) == len(set(found[:, 1])) == len(found)
    assert np.all(np.abs(ta[found[:, 0]] - tb[found[:, 1]]) <= 1e5)
    assert np.array_equal(joints.pairs(ta + shift, tb + shift, 1e-4), found)
    for i, j in found:  # nobody else is nearer to either
        assert abs(ta[i] - tb[j]) == np.abs(ta[i] - tb).min() == np.abs(ta - tb[j]).min()
    same = joints.pairs(ta, ta, 1e-4)
    assert np.array_equal(same, np.stack([np.arange(len(ta))] * 2, -1))


# --- depth unit -----------------------------------------------------------------------------------


def test_depth_units() -> None:
    depth = [np.full((4, 4), 400, np.uint16)]
    assert pixels.unit_of(depth, "t", "16UC1", None, None)[0] == 1e-3
    assert pixels.unit_of(depth, "t", "mono16", None, 2e-4)[0] == 2e-4
    assert pixels.unit_of(depth, "t", "mono16", 5e-4, 2e-4)[0] == 5e-4
    refused("has no unit", pixels.unit_of, depth, "t", "mono16", None, None, error=UnitError)
    for counts in (30, 50000):
        image, how = np.full((4, 4), counts, np.uint16), ("t", "16UC1", None, None)
        refused("depth_unit_m=", pixels.unit_of, [image], *how, error=UnitError)
    near, far = (np.full((4, 4), z, np.float32) for z in (0.5, 6.0))
    assert pixels.unit_of([near], "t", "32FC1", None, None)[0] == 1e-4
    assert pixels.unit_of([far], "t", "32FC1", None, None)[0] == 1e-3
    millimetres = [near * 1000]
    refused("depth", pixels.unit_of, millimetres, "t", "32FC1", None, None, error=UnitError)


# --- joints ---------------------------------------------------------------------------------------


def track_of(times_s: Any, q: Any, dq: Any = None, prefix: str = "") -> JointTrack:
    track = JointTrack(prefix)
    order = [3, 0, 5, 1, 4, 2]
    names = (*(prefix + UR_JOINTS[i] for i in order), "gripper")
    for k, t in enumerate(times_s):
        velocity = np.zeros(0) if dq is None else np.append(dq[k][order], 9.0)
        position = np.append(q[k][order], 0.04)
        track.add(wire.JointMessage(0, names, position, velocity), round(t * S))
    track.finish()
    return track


def test_joints_are_joined_by_name_and_interpolated() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.uniform(-3, 3, (2, 6))
    track = track_of([1.0, 1.1], [a, b], prefix="left_")
    found = track.at(round(1.025 * S), 0.25)
    assert found is not None and np.allclose(found[0], 0.75 * a + 0.25 * b)
    assert found[1] == pytest.approx(np.abs(b - a).max() / 0.1)
    assert track.at(round(1.4 * S), 0.25) is None
    assert track_of([1.0, 2.0], [a, b]).at(round(1.5 * S), 0.25) is None
    gripper = wire.JointMessage(0, ("gripper",), np.zeros(1), np.zeros(0))
    assert not track.add(gripper, 5)
    assert prefixes(["x", *("left_" + n for n in UR_JOINTS), "wrist_1_joint"]) == ["left_"]


def test_the_recorded_velocity_tells_standstill_and_zeros_do_not() -> None:
    times = np.arange(20) * 0.008
    q = np.outer(times, np.ones(6))  # 1 rad/s
    at = round(0.08 * S)
    moving = track_of(times, q).at(at, 0.25)
    slow = track_of(times, q, np.full((20, 6), 0.003)).at(at, 0.25)
    unset = track_of(times, q, np.zeros((20, 6))).at(at, 0.25)
    assert moving is not None and slow is not None and unset is not None
    assert (moving[1], slow[1], unset[1]) == pytest.approx((1.0, 0.003, 1.0))


def test_degrees_are_refused() -> None:
    refused("degrees", track_of([0, 1], np.full((2, 6), 90.0)).check_radians, "/joint_states")


# --- tf -------------------------------------------------------------------------------------------


def send(tree: TfTree, parent: str, child: str, T: Any, time_s: float, static: bool) -> None:
    numbers = (*T[:3, 3], *quaternion_xyzw_from_R(T[:3, :3]))
    tree.add(wire.TransformMessage(0, parent, child, numbers), round(time_s * S), static)


def test_chains_are_composed_and_edges_follow_their_twist() -> None:
    rng = np.random.default_rng(2)
    T_ab, T_cb, T_dc = se3.random_transform(rng, 3)
    xi = rng.normal(0, 0.3, 6)
    tree = TfTree()
    send(tree, "b", "a", se3.invert(T_ab), 0, True)
    send(tree, "b", "c", se3.invert(T_cb), 1.0, False)
    send(tree, "b", "c", se3.invert(T_cb) @ se3.exp(xi), 1.1, False)
    send(tree, "c", "d", se3.invert(T_dc), 0, True)
    tree.finish()
    expected = T_ab @ se3.invert(T_cb) @ se3.exp(0.3 * xi) @ se3.invert(T_dc)
    found, back = (tree.lookup(*way, round(1.03 * S), 0.25) for way in (("a", "d"), ("d", "a")))
    assert found is not None and np.allclose(found, expected, atol=1e-12)
    assert back is not None and np.allclose(back @ found, np.eye(4), atol=1e-12)
    assert tree.lookup("a", "d", 2 * S, 0.25) is None
    assert tree.lookup("a", "nowhere", S, 0.25) is None
    assert tree.times_ns("a", "d").tolist() == [S, round(1.1 * S)]


def test_arm_frames_are_named_when_not_there_or_not_one() -> None:
    tree = TfTree()
    send(tree, "base", "wrist_3_link", np.eye(4), 1.0, False)
    send(tree, "wrist_3_link", "tool0", np.eye(4), 0.0, True)
    send(tree, "elsewhere", "marker", np.eye(4), 0, True)
    tree.finish()
    assert arm_frames(tree, None, None, False) is not None
    refused("no frame 'flange'", arm_frames, tree, None, "flange", False)
    send(tree, "tool0", "gripper_base", np.eye(4), 0, True)
    tree.finish()
    found = arm_frames(tree, None, None, False)
    assert found is not None and found[:2] == ("base", "tool0")  # not the gripper's base
    refused("does not join", arm_frames, tree, "elsewhere", None, False)
    send(tree, "right_base", "right_tool0", np.eye(4), 0, True)
    tree.finish()
    refused("several arms", arm_frames, tree, None, None, False)
    found = arm_frames(tree, None, "right_tool0", False)
    assert found is not None and found[:2] == ("right_base", "right_tool0")
    assert arm_frames(TfTree(), None, None, False) is None


# --- reprojection ---------------------------------------------------------------------------------

CAMERA = CameraIntrinsics(width=80, height=60, fx=70, fy=71, cx=39.2, cy=30.1)


@pytest.mark.parametrize(("zoom", "roll"), [(0.5, 0.3), (1.7, 0.0)])
def test_a_plane_stays_a_plane_without_holes(zoom: float, roll: float) -> None:
    normal, distance = np.array([0.2, -0.1, 1.0]), 0.6
    rays = np.stack(np.meshgrid((np.arange(80) - CAMERA.cx) / CAMERA.fx,
                                (np.arange(60) - CAMERA.cy) / CAMERA.fy), -1)  # fmt: skip
    z = distance / (rays @ normal[:2] + normal[2])
    counts = np.rint(z / 1e-4).astype(np.uint16)
    R = se3.exp_so3(np.array([0.02, -0.03, roll]))
    T = se3.from_rt(R, np.array([0.02, -0.01, 0.015]))
    colour = CameraIntrinsics(
        width=100, height=70, fx=70 * zoom, fy=72 * zoom, cx=50, cy=34,
        distortion=np.array([0.05, -0.02, 1e-3, -1e-3, 0.0]),
    )  # fmt: skip
    found = depth_in_colour(counts, CAMERA, colour, T, 1e-4)
    n2 = R @ normal
    d2 = distance + n2 @ T[:3, 3]
    rays2 = ray_table(colour).astype(np.float64)
    expected = d2 / (rays2 @ n2)
    points = rays2 * expected[..., None]
    back = project(CAMERA, se3.transform(se3.invert(T), points.reshape(-1, 3))).reshape(70, 100, 2)
    margin = 2.0
    inside = np.all((back > margin) & (back < [79 - margin, 59 - margin]), -1)
    assert inside.sum() > 300
    assert np.all(found[inside] > 0)  # no holes
    error = found[inside] * 1e-4 - expected[inside]
    # A sample is at most half a pixel of the coarser camera away from the centre it stands for.
    slope = sum(np.abs(np.gradient(expected, axis=a)).max() for a in (0, 1))
    assert np.abs(error).max() < 0.6 * max(zoom, 1.0) * slope + 1e-4
    outside = ~np.all((back > -margin) & (back < [79 + margin, 59 + margin]), -1)
    assert not np.any(found[outside])


def test_the_nearer_surface_hides_the_farther() -> None:
    counts = np.full((60, 80), 10000, np.uint16)
    counts[20:40, 30:50] = 5000
    T = se3.from_translation([0.05, 0, 0])
    found = depth_in_colour(counts, CAMERA, CAMERA, T, 1e-4)
    # 5 cm of baseline: 7 px at 0.5 m, 3.5 px at 1 m.
    assert np.all(found[22:38, 38:56] == 5000)
    assert np.all(found[22:38, 5:30] == 10000)


RECORDING = DATA / "bags/single_depth_color_640x480.bag"
WIDTH, HEIGHT = 320, 240
T_COLOUR_DEPTH = se3.from_rt(se3.exp_so3(np.array([0.01, -0.02, 0.03])), [0.015, 0.001, 0.002])
FRAMES = 5


# --- a real recording -----------------------------------------------------------------------------


@pytest.mark.real
@needs(RECORDING)
def test_a_real_d435s_depth_lies_on_its_colour_image() -> None:
    source = open_bag(RECORDING, BagChoice(max_pair_gap_s=0.11))
    assert len(source) == 1
    assert source.depth_unit_m == 0.001
    assert source.intrinsics.fx == pytest.approx(613.20367)
    assert source.extra["camera"]["Name"] == "Intel RealSense D435"
    assert source.reprojection is not None
    T = source.reprojection.T_colour_depth
    assert T[:3, 3] == pytest.approx([0.0143113, 0.0006023, 0.0006108], abs=1e-6)

    def distance_px(T_tried: Any) -> float:
        """Median-free mean distance of depth edges from colour edges, at most 8 px."""
        assert source.reprojection is not None
        tried = replace(source, reprojection=replace(source.reprojection, T_colour_depth=T_tried))
        frame = next(iter(tried.frames()))
        assert frame.depth_counts is not None
        depth = frame.depth_counts.astype(np.float32)
        edges = cv2.Canny(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), 60, 150)
        far = cv2.distanceTransform((edges == 0).astype(np.uint8), cv2.DIST_L2, 5)
        steps = cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((3, 3))) > 80
        whole = cv2.erode((depth > 0).astype(np.uint8), np.ones((5, 5))) > 0
        assert np.sum(steps & whole) > 50
        return float(np.minimum(far[steps & whole], 8).mean())

    turned, shifted = se3.from_rt(T[:3, :3].T, T[:3, 3]), se3.from_rt(T[:3, :3], -T[:3, 3])
    right = distance_px(T)
    assert right < 4
    for wrong in (se3.invert(T), np.eye(4), turned, shifted):
        assert distance_px(wrong) > 1.5 * right


# --- the SDK's recorder ---------------------------------------------------------------------------


def wall(k: int) -> Any:
    """Return depth counts (H, W) of a slope that no two frames share."""
    u = np.arange(WIDTH)[None] + np.zeros((HEIGHT, 1))
    return (4000 + 2 * u + k).astype(np.uint16)


def picture(k: int) -> Any:
    return np.random.default_rng(k).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def record(rs: Any, path: Path, model: Any = None, coefficients: Any = (0.0,) * 5) -> Path:
    """Record frames of a device with two sensors; colour comes 20 ms after its depth."""
    device = rs.software_device()
    device.register_info(rs.camera_info.name, "Software D435")
    device.register_info(rs.camera_info.serial_number, "SW0002")

    def stream(name: str, kind: Any, uid: int, pixel: Any, size: int, focal: float) -> Any:
        sensor = device.add_sensor(name)
        s, raw = rs.video_stream(), rs.intrinsics()
        raw.width, raw.height = WIDTH, HEIGHT
        raw.fx, raw.fy, raw.ppx, raw.ppy = focal, focal + 1, 159.5, 119.5
        raw.model, raw.coeffs = model or rs.distortion.brown_conrady, list(coefficients)
        s.type, s.index, s.uid, s.width, s.height, s.fps = kind, 0, uid, WIDTH, HEIGHT, 30
        s.bpp, s.fmt, s.intrinsics = size, pixel, raw
        return sensor, sensor.add_video_stream(s).as_video_stream_profile()

    stereo, depth = stream("Stereo Module", rs.stream.depth, 1, rs.format.z16, 2, 250.0)
    rgb, colour = stream("RGB Camera", rs.stream.color, 2, rs.format.rgb8, 3, 260.0)
    stereo.add_read_only_option(rs.option.depth_units, 1e-4)
    extrinsics = rs.extrinsics()
    extrinsics.rotation = list(T_COLOUR_DEPTH[:3, :3].T.ravel())  # by columns
    extrinsics.translation = list(T_COLOUR_DEPTH[:3, 3])
    depth.register_extrinsics_to(colour, extrinsics)
    recorder = rs.recorder(str(path), device)
    sensors, queue = recorder.query_sensors(), rs.frame_queue(100)
    for sensor, profile in zip(sensors, (depth, colour), strict=True):
        sensor.open(profile)
        sensor.start(queue)
    for k in range(FRAMES):
        shots = (stereo, depth, wall(k), 2), (rgb, colour, picture(k), 3)
        for sensor, profile, image, size in shots:
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp, frame.stride = image, size, WIDTH * size
            frame.timestamp, frame.frame_number = 1000.0 + 33.0 * k, k + 1
            frame.domain, frame.profile = rs.timestamp_domain.hardware_clock, profile
            sensor.on_video_frame(frame)
            time.sleep(0.02)  # later than half a frame: the time of recording would not join them
    time.sleep(0.2)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    del recorder
    return path


@pytest.fixture(scope="module")
def recorded(rs: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(rs, tmp_path_factory.mktemp("realsense") / "software.db3")


def test_frames_carry_the_devices_own_time_unit_and_extrinsics(recorded: Path) -> None:
    source = open_bag(recorded)
    assert len(source) == FRAMES
    assert source.depth_unit_m == 1e-4
    assert (source.intrinsics.fx, source.intrinsics.fy) == (260.0, 261.0)
    assert source.extra["camera"]["Serial Number"] == "SW0002"
    assert source.reprojection is not None
    assert np.allclose(source.reprojection.T_colour_depth, T_COLOUR_DEPTH, atol=2e-6)
    unprojected = replace(source, reprojection=None)
    for k, (frame, raw) in enumerate(zip(source.frames(), unprojected.frames(), strict=True)):
        assert frame.time_s == pytest.approx(1.0 + 0.033 * k, abs=1e-9)
        assert np.array_equal(frame.rgb, picture(k))
        assert raw.depth_counts is not None and frame.depth_counts is not None
        assert np.array_equal(raw.depth_counts, wall(k))


def test_projection_agrees_with_the_sdks_own_alignment(rs: Any, recorded: Path) -> None:
    config, pipeline = rs.config(), rs.pipeline()
    config.enable_device_from_file(str(recorded), repeat_playback=False)
    profile = pipeline.start(config)
    profile.get_device().as_playback().set_real_time(False)
    align = rs.align(rs.stream.color)
    theirs: dict[int, Any] = {}
    try:
        while True:
            frames = pipeline.wait_for_frames(1000)
            depth, colour = frames.get_depth_frame(), frames.get_color_frame()
            if depth and colour and depth.get_frame_number() == colour.get_frame_number():
                aligned = align.process(frames).get_depth_frame()
                theirs[depth.get_frame_number()] = np.asanyarray(aligned.get_data()).copy()
    except RuntimeError:
        pass  # the end of the file
    finally:
        pipeline.stop()
    assert theirs
    source = open_bag(recorded)
    ours = list(source.frames())
    for number, image in theirs.items():
        mine = ours[number - 1].depth_counts
        assert mine is not None
        both = (mine > 0) & (image > 0)
        assert both.mean() > 0.85
        # The SDK writes the depth camera's z into the colour image; ours is the colour camera's.
        points = ray_table(source.intrinsics).astype(float) * (mine * 1e-4)[..., None]
        z = se3.transform(se3.invert(T_COLOUR_DEPTH), points.reshape(-1, 3))[:, 2] * 1e4
        difference = (z.reshape(mine.shape) - image)[both]
        assert np.abs(difference).max() < 6  # counts: 2 a pixel
        assert np.percentile(np.abs(difference), 90) < 3
        assert abs(difference.mean()) < 1.5
        assert np.mean((mine > 0) != (image > 0)) < 0.03


def test_another_lens_model_is_refused_though_camera_info_says_plumb_bob(
    rs: Any, tmp_path: Path
) -> None:
    model = rs.distortion.inverse_brown_conrady
    path = record(rs, tmp_path / "inverse.db3", model, (0.1, 0.0, 0.0, 0.0, 0.0))
    refused("Inverse Brown Conrady", open_bag, path)


def test_streams_of_two_clocks_are_refused(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "two.db3"
    path.write_bytes(recorded.read_bytes())
    with sqlite3.connect(path) as database:
        topic = "SELECT id FROM topics WHERE name='/device_0/sensor_1/Color_0/image/metadata'"
        rows = database.execute(f"SELECT id, data FROM messages WHERE topic_id=({topic})")
        for row, data in rows.fetchall():
            other = data.replace(b"Hardware Clock", b"System Time   ")
            database.execute("UPDATE messages SET data=? WHERE id=?", (other, row))
    database.close()
    refused("clock=receive", open_bag, path)
