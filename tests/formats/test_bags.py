"""Whole recordings, written by rosbags in three containers and read back.

Which topics of a recording are read, and what is asked for where they do not say enough.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.formats.bags import BagChoice, open_bag
from realsim.formats.bags import scan as stored_module
from realsim.formats.bags.tf_tree import T_BASE_BASELINK
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.robots.arm import UR5
from written_bags import (
    COLOUR,
    DEPTH,
    FRAME,
    HEIGHT,
    KINDS,
    T0,
    WIDTH,
    Bag,
    S,
    pictures,
    recorded,
    refused,
    same_pictures,
    stamp,
)

# --- what was sent is what comes ------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_container_gives_back_what_was_sent(tmp_path: Path, kind: str) -> None:
    sent = recorded(tmp_path, kind)
    source = open_bag(sent.path)
    assert len(source) == 6
    assert source.depth_unit_m == 1e-3
    assert (source.intrinsics.fx, source.intrinsics.width) == (30.0, WIDTH)
    for k, frame in enumerate(same_pictures(source, range(6))):
        assert np.allclose(frame.joints, sent.q[k], atol=1e-12)
        assert frame.time_s == pytest.approx(stamp(k) / S, abs=1e-6)
        assert frame.name.startswith(COLOUR)
    assert source.extra["topics"]["depth"] == DEPTH
    assert any("millimetres" in note for note in source.notes)


def test_one_storage_file_is_a_recording_too(tmp_path: Path) -> None:
    for kind, ending in (("sqlite3", ".db3"), ("mcap", ".mcap")):
        folder = tmp_path / kind
        folder.mkdir()
        path = recorded(folder, kind).path
        assert len(open_bag(path / f"recording{ending}")) == 6
        (path / "metadata.yaml").unlink()
        source = open_bag(path)
        assert len(source) == 6
        assert any("metadata.yaml" in note for note in source.notes)


# --- joining --------------------------------------------------------------------------------------


def test_frames_without_partner_are_left_out_and_named(tmp_path: Path) -> None:
    sent = recorded(tmp_path, "mcap", n=8, without=(0, 3, 4))
    source = open_bag(sent.path)
    kept = [1, 2, 5, 6, 7]
    for k, frame in zip(kept, same_pictures(source, kept), strict=True):
        assert np.allclose(frame.joints, sent.q[k])
    note = next(n for n in source.notes if "left out" in n)
    assert note.startswith(f"3 of 8 images of {COLOUR}")
    lost = [round(stamp(k) / S, 6) for k in (0, 3, 4)]
    assert source.extra["left_out_s"][COLOUR] == pytest.approx(lost)


@pytest.mark.parametrize(("kind", "pending"), [("ros1", 10**9), ("mcap", 3000)])
def test_the_order_of_recording_does_not_matter(
    tmp_path: Path, kind: str, pending: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Depth a minute late and backwards: joined by stamp all the same, in bounded memory."""
    monkeypatch.setattr(stored_module, "PENDING_BYTES", pending)
    bag = recorded(tmp_path, kind, n=7, write=False).bag
    bag.messages = [
        (t if topic != DEPTH else T0 + 120 * S - (t - T0), topic, message)
        for t, topic, message in bag.messages
    ]
    source = open_bag(bag.write())
    same_pictures(source, range(7))
    assert len(source) == 7
    assert len(list(source.frames(5))) == 2


def test_clocks_that_do_not_overlap_are_refused_and_can_be_joined_by_receive_time(
    tmp_path: Path,
) -> None:
    sent = recorded(tmp_path, write=False, joints=False)
    for k, q in enumerate(sent.q):
        sent.bag.joints(q, stamp(k) - T0 + 5 * S, receive=stamp(k))  # s since the robot booted
    path = sent.bag.write()
    refused(path, "/joint_states", "5.000 .. 5.500", "clock=receive")
    source = open_bag(path, BagChoice(clock="receive"))
    for k, frame in enumerate(source.frames()):
        assert np.allclose(frame.joints, sent.q[k], atol=1e-6)


def test_stamps_of_zero_fall_back_to_receive_time(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.both_infos()
    for k in range(4):
        rgb, depth = pictures(k)
        bag.image(COLOUR, rgb, "rgb8", 0, stamp(k))
        bag.image(DEPTH, depth, "16UC1", 0, stamp(k) + 10**6)
    source = open_bag(bag.write())
    assert source.extra["clock"] == "receive"
    assert any("all zero" in n for n in source.notes)
    same_pictures(source, range(4))


# --- the arm --------------------------------------------------------------------------------------


def test_a_moving_arm_is_noted_and_can_be_left_out(tmp_path: Path) -> None:
    def change(bag: Bag) -> None:
        for k in (1, 4):
            bag.joints(np.zeros(6), stamp(k), np.full(6, 0.4))

    path = recorded(tmp_path, change=change).path
    assert any("moved at 2 of 6" in n for n in open_bag(path).notes)
    source = open_bag(path, BagChoice(only_still=True))
    times = [stamp(k) / S for k in (0, 2, 3, 5)]
    assert [f.time_s for f in source.frames()] == pytest.approx(times)
    assert len(source.extra["left_out_s"]["moving"]) == 2
    refused(path, "none of the 6 frames", only_still=True, still_speed=1e-5)


def test_joints_are_not_made_up_in_a_gap(tmp_path: Path) -> None:
    sent = recorded(tmp_path, joints=False, n=12, write=False)
    for k in (0, 1, 9, 10, 11):
        sent.bag.joints(np.full(6, 0.1 * k), stamp(k))
    source = open_bag(sent.bag.write())
    known = [f.joints is not None for f in source.frames()]
    assert known == [True, True, *[False] * 7, True, True, True]
    assert any("gap of more than 0.25 s at 7 of 12" in n for n in source.notes)


def test_two_arms_are_listed(tmp_path: Path) -> None:
    right = partial(Bag.joints, q=np.ones(6), t=stamp(2), prefix="right_")
    path = recorded(tmp_path, change=right).path
    refused(path, "several arms", "joint_prefix='right_'")
    assert open_bag(path, BagChoice(joint_prefix="")).arm.joints is not None
    refused(path, "no joint left_", joint_prefix="left_")


def test_tf_gives_the_flange_in_the_controllers_base(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    q = rng.uniform(-1, 1, (6, 6))
    sent = recorded(tmp_path, "ros1", joints=False, write=False)
    T_base_ee = UR5.forward(q)
    T_ee_cam = se3.random_transform(rng)
    for k in range(6):
        T = se3.invert(T_BASE_BASELINK) @ T_base_ee[k]
        for d in (-8, 8):
            sent.bag.tf("base_link", "wrist_3_link", T, stamp(k) + d * 10**6)
    sent.bag.tf("wrist_3_link", "tool0", np.eye(4), T0, static=True)
    sent.bag.tf("tool0", FRAME, T_ee_cam, T0, static=True)
    path = sent.bag.write()
    source = open_bag(path, BagChoice(world_frame="base_link"))
    for k, frame in enumerate(source.frames()):
        assert frame.T_base_ee is not None and frame.T_world_cam is not None
        assert np.allclose(frame.T_base_ee, T_base_ee[k], atol=1e-9)
        T_world_cam = se3.invert(T_BASE_BASELINK) @ T_base_ee[k] @ T_ee_cam
        assert np.allclose(frame.T_world_cam, T_world_cam, atol=1e-9)
    assert any("180 deg" in n for n in source.notes)
    refused(path, "no frame 'tcp'", ee_frame="tcp")


# --- depth onto the colour pixels -----------------------------------------------------------------


def side_by_side(folder: Path, *, extrinsics: bool) -> Path:
    """Depth of a wall at 0.5 m, by a camera 20 mm to the left with another focal length."""
    bag = Bag(folder)
    bag.info("/camera/color/camera_info", f=40.0)
    bag.info("/camera/depth/camera_info", f=20.0, frame_id="depth_frame")
    for k in range(2):
        bag.image(COLOUR, pictures(k)[0], "rgb8", stamp(k))
        wall = np.full((HEIGHT, WIDTH), 500, np.uint16)
        wall[:, : WIDTH // 2] = 400
        bag.image("/camera/depth/image_rect_raw", wall, "16UC1", stamp(k), frame_id="depth_frame")
    if extrinsics:
        bag.tf("camera_link", FRAME, se3.from_translation([0.02, 0, 0]), T0, static=True)
        bag.tf("camera_link", "depth_frame", np.eye(4), T0, static=True)
    return bag.write()


def test_depth_of_another_camera_is_projected_by_tf(tmp_path: Path) -> None:
    source = open_bag(side_by_side(tmp_path, extrinsics=True))
    assert source.reprojection is not None
    assert np.allclose(source.reprojection.T_colour_depth[:3, 3], [-0.02, 0, 0])
    depth = next(iter(source.frames())).depth_counts
    assert depth is not None and np.all(depth > 0)
    # The step is at depth pixel 15.5 = x 0: at colour pixel 15.5 - 40 * 0.02 / 0.4 = 13.5.
    assert np.all(depth[:, :13] == 400) and np.all(depth[:, 15:] == 500)
    assert any("20.0 mm" in n for n in source.notes)


def test_depth_that_cannot_be_aligned_is_refused_with_the_choices(tmp_path: Path) -> None:
    path = side_by_side(tmp_path, extrinsics=False)
    refused(path, "aligned_depth_to_color", "T_colour_depth=", "without_depth")
    given = BagChoice(T_colour_depth=se3.from_translation([-0.02, 0, 0]))
    assert open_bag(path, given).reprojection is not None
    colour_alone = open_bag(path, BagChoice(without_depth=True))
    assert colour_alone.depth_unit_m is None
    assert [f.depth_counts for f in colour_alone.frames()] == [None, None]


# --- damaged files --------------------------------------------------------------------------------


def test_missing_and_foreign_files_are_named(tmp_path: Path) -> None:
    refused(tmp_path / "no.bag", "does not exist")
    refused(tmp_path, "holds no recording")
    (tmp_path / "a.bag").write_bytes(b"")
    refused(tmp_path / "a.bag", "0 bytes")
    (tmp_path / "a.txt").write_text("x")
    refused(tmp_path / "a.txt", "ends in '.txt'")
    for name in ("b.bag", "b.db3", "b.mcap"):
        (tmp_path / name).write_text("this is a text, not a recording " * 9)
        refused(tmp_path / name, "cannot be opened")
    folder = recorded(tmp_path, "sqlite3").path
    journal = folder / "recording.db3-wal"
    journal.write_bytes(b"messages")
    refused(folder / "recording.db3", "wal_checkpoint")
    refused(folder, "wal_checkpoint")
    journal.unlink()
    (folder / "recording.db3").rename(tmp_path / "lost.db3")
    refused(folder, "recording.db3", "reindex")


def test_a_bag_without_index_says_reindex(tmp_path: Path) -> None:
    path = recorded(tmp_path).path
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    refused(path, "rosbag reindex")


# --- topics ---------------------------------------------------------------------------------------


def test_two_cameras_are_listed_and_one_can_be_chosen(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    for c, cam in enumerate(("/left", "/right")):
        bag.both_infos(cam, f=30.0 + c)
        for k in range(3):
            rgb, depth = pictures(10 * c + k)
            bag.image(f"{cam}/color/image_raw", rgb, "rgb8", stamp(k))
            bag.image(f"{cam}/aligned_depth_to_color/image_raw", depth, "16UC1", stamp(k))
    path = bag.write()
    refused(path, "2 cameras", "colour=/left/color/image_raw")
    source = open_bag(path, BagChoice(colour="/right/color/image_raw"))
    assert source.intrinsics.fx == 31.0
    same_pictures(source, range(10, 13))
    refused(path, "is not a topic of colour images", colour="/up")
    left = "/left/color/image_raw"
    refused(path, "is not a topic of depth images", colour=left, depth=left)


def test_raw_is_preferred_to_compressed_and_compressed_is_read(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.both_infos()
    for k in range(3):
        rgb, depth = pictures(k)
        png = cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()
        png16 = bytes(12) + cv2.imencode(".png", depth)[1].tobytes()
        bag.packed(COLOUR + "/compressed", png, "rgb8; png compressed bgr8", stamp(k))
        bag.packed(DEPTH + "/compressedDepth", png16, "16UC1; compressedDepth png", stamp(k))
    source = open_bag(bag.write())
    assert source.depth_unit_m == 1e-3
    same_pictures(source, range(3))
    both = recorded(tmp_path, "mcap", write=False).bag
    png = cv2.imencode(".png", pictures(0)[0])[1].tobytes()
    both.packed(COLOUR + "/compressed", png, "png", stamp(0))
    assert open_bag(both.write()).extra["topics"]["colour"] == COLOUR


def test_colour_alone_is_imported_and_depth_alone_is_not(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.info("/camera/color/camera_info")
    bag.image(COLOUR, pictures(0)[0], "bgr8", stamp(0))
    source = open_bag(bag.write())
    assert source.depth_unit_m is None
    assert np.array_equal(next(iter(source.frames())).rgb, pictures(0)[0][..., ::-1])
    assert any("no depth images" in n for n in source.notes)
    bag = Bag(tmp_path, "mcap")
    bag.image(DEPTH, pictures(0)[1], "16UC1", stamp(0))
    refused(bag.write(), "only depth images")


def test_without_camera_info_the_camera_can_be_given(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    path = bag.write()
    refused(path, "no CameraInfo", "intrinsics=")
    camera = CameraIntrinsics(width=WIDTH, height=HEIGHT, fx=30, fy=30, cx=16, cy=12)
    assert open_bag(path, BagChoice(intrinsics=camera)).intrinsics is camera
    refused(path, "64x48", intrinsics=replace(camera, width=64, height=48))


def test_bad_cameras_are_refused(tmp_path: Path) -> None:
    bag = recorded(tmp_path, write=False).bag
    bag.info("/camera/color/camera_info", stamp(3), f=55.0)
    refused(bag.write(), "changes during the recording")
    bag = Bag(tmp_path, "mcap")
    bag.info("/camera/color/camera_info", model="equidistant", d=(0.1, 0.1, 0.0, 0.0))
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    refused(bag.write(), "fisheye")
