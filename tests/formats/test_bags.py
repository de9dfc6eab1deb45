"""Whole recordings, written by rosbags in three containers and read back."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from realsim.errors import InputError, RealsimError, UnitError
from realsim.formats.bags import BagChoice, BagSource, open_bag
from realsim.formats.bags import stored as stored_module
from realsim.formats.bags.joints import UR_JOINTS
from realsim.formats.bags.tf_tree import T_BASE_BASELINK
from realsim.formats.frame_source import FrameSource
from realsim.geometry import se3
from realsim.interop import quaternion_xyzw_from_R
from realsim.records import CameraIntrinsics
from realsim_capture_plans.arms.kinematics import UR5

S = 10**9
T0 = 1_700_000_000 * S
WIDTH, HEIGHT = 32, 24
KINDS = ("ros1", "sqlite3", "mcap")
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
FRAME = "camera_color_optical_frame"
PERIOD_S = 0.1
TF = "tf2_msgs/msg/TFMessage"


class Bag:
    """Messages to be written, then a file."""

    def __init__(self, path: Path, kind: str = "ros1") -> None:
        self.kind, self.is_ros1 = kind, kind == "ros1"
        self.path = path / ("recording.bag" if self.is_ros1 else "recording")
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        if self.is_ros1:
            self.store.register(
                get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF)
            )
        self.t = self.store.types
        self.messages: list[tuple[int, str, Any]] = []

    def write(self) -> Path:
        writer: Any
        if self.is_ros1:
            from rosbags.rosbag1 import Writer

            writer = Writer(self.path)
        else:
            from rosbags.rosbag2 import StoragePlugin
            from rosbags.rosbag2 import Writer as Writer2

            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(self.path, version=9, storage_plugin=plugin)
        serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        with writer:
            connections: dict[str, Any] = {}
            for receive_ns, topic, message in sorted(self.messages, key=lambda m: m[0]):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], receive_ns, serialize(message, kind))
        return self.path

    def header(self, t: int, frame_id: str = FRAME) -> Any:
        stamp = self.t["builtin_interfaces/msg/Time"](t // S, t % S)
        return self.t["std_msgs/msg/Header"](*((0,) if self.is_ros1 else ()), stamp, frame_id)

    def image(
        self, topic: str, pixels: Any, encoding: str, t: int,
        receive: int | None = None, frame_id: str = FRAME,
    ) -> None:  # fmt: skip
        flat = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
        h, w = pixels.shape[:2]
        message = self.t["sensor_msgs/msg/Image"](
            self.header(t, frame_id), h, w, encoding, 0, flat.size // h, flat
        )
        self.messages.append((t if receive is None else receive, topic, message))

    def packed(self, topic: str, data: bytes, form: str, t: int, frame_id: str = FRAME) -> None:
        message = self.t["sensor_msgs/msg/CompressedImage"](
            self.header(t, frame_id), form, np.frombuffer(data, np.uint8)
        )
        self.messages.append((t, topic, message))

    def info(
        self, topic: str, t: int = T0, *, model: str = "plumb_bob", d: Any = (0.0,) * 5,
        f: float = 30.0, frame_id: str = FRAME,
    ) -> None:  # fmt: skip
        K = np.array([f, 0, 15.5, 0, f + 1, 11.5, 0, 0, 1])
        roi = self.t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        message = self.t["sensor_msgs/msg/CameraInfo"](
            self.header(t, frame_id), HEIGHT, WIDTH, model, np.array(d, float), K,
            np.eye(3).ravel(), np.zeros(12), 0, 0, roi,
        )  # fmt: skip
        self.messages.append((t, topic, message))

    def joints(self, q: Any, t: int, dq: Any = None, prefix: str = "", receive: int = 0) -> None:
        order = sorted(range(6), key=lambda i: UR_JOINTS[i])  # as the driver: by the alphabet
        names = [prefix + UR_JOINTS[i] for i in order]
        velocity = np.zeros(0) if dq is None else np.asarray(dq, float)[order]
        message = self.t["sensor_msgs/msg/JointState"](
            self.header(t, ""), names, np.asarray(q, float)[order], velocity, np.zeros(0)
        )
        self.messages.append((receive or t, "/joint_states", message))

    def tf(self, parent: str, child: str, T: Any, t: int, static: bool = False) -> None:
        x, y, z, w = (float(v) for v in quaternion_xyzw_from_R(T[:3, :3]))
        transform = self.t["geometry_msgs/msg/Transform"](
            self.t["geometry_msgs/msg/Vector3"](*(float(v) for v in T[:3, 3])),
            self.t["geometry_msgs/msg/Quaternion"](x, y, z, w),
        )
        stamped = self.t["geometry_msgs/msg/TransformStamped"](
            self.header(0 if static else t, parent), child, transform
        )
        topic = "/tf_static" if static else "/tf"
        self.messages.append((t, topic, self.t[TF]([stamped])))


@dataclass
class Sent:
    """What went into a recording."""

    bag: Bag
    rgb: list[Any] = field(default_factory=list)
    depth: list[Any] = field(default_factory=list)
    q: list[Any] = field(default_factory=list)
    path: Path = Path()


def stamp(k: int) -> int:
    return T0 + round(k * PERIOD_S * S)


def pictures(k: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(k)
    rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return rgb, rng.integers(300, 900, (HEIGHT, WIDTH), dtype=np.uint16)


def recorded(
    folder: Path, kind: str = "ros1", n: int = 6, *, joints: bool = True,
    without: Sequence[int] = (), jitter_s: float = 0.004,
    change: Callable[[Bag], None] | None = None, write: bool = True,
) -> Sent:  # fmt: skip
    """Record n frames of colour, depth (a little later) and joints; `without` have no depth."""
    bag = Bag(folder, kind)
    sent = Sent(bag)
    bag.info("/camera/color/camera_info")
    bag.info("/camera/aligned_depth_to_color/camera_info")
    rng = np.random.default_rng(5)
    for k in range(n):
        rgb, depth = pictures(k)
        sent.rgb.append(rgb)
        sent.depth.append(depth)
        bag.image(COLOUR, rgb, "rgb8", stamp(k))
        if k not in without:
            bag.image(DEPTH, depth, "16UC1", stamp(k) + round(jitter_s * S))
        sent.q.append(rng.uniform(-3, 3, 6))
        if joints:
            for d in (-5, 5):  # standing still around the frame
                bag.joints(sent.q[k], stamp(k) + d * 10**6, np.full(6, 1e-3))
    if change is not None:
        change(bag)
    if write:
        sent.path = bag.write()
    return sent


def refused(
    path: Path, choice: BagChoice | None = None, kind: type[RealsimError] = InputError
) -> str:
    with pytest.raises(kind) as caught:
        source = open_bag(path, choice)
        list(source.frames())
    assert "\n" not in str(caught.value).strip()
    return str(caught.value)


# --- what was sent is what comes ------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_container_gives_back_what_was_sent(tmp_path: Path, kind: str) -> None:
    sent = recorded(tmp_path, kind)
    source = open_bag(sent.path)
    as_source: FrameSource = source
    assert len(as_source) == 6
    assert source.depth_unit_m == 1e-3
    assert (source.intrinsics.fx, source.intrinsics.width) == (30.0, WIDTH)
    for k, frame in enumerate(source.frames()):
        assert np.array_equal(frame.rgb, sent.rgb[k])
        assert frame.depth_counts is not None
        assert np.array_equal(frame.depth_counts, sent.depth[k])
        assert frame.joints is not None
        assert np.allclose(frame.joints, sent.q[k], atol=1e-12)
        assert frame.time_s == pytest.approx(stamp(k) / S, abs=1e-6)
        assert frame.name.startswith(COLOUR)
    assert source.extra["topics"]["depth"] == DEPTH
    assert any("millimetres" in note for note in source.notes)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_from_a_number_on_are_the_tail_of_all(tmp_path: Path, kind: str) -> None:
    source = open_bag(recorded(tmp_path, kind).path)
    names = [f.name for f in source.frames()]
    for start in (0, 1, 4, 5, 6, 9):
        assert [f.name for f in source.frames(start)] == names[start:]


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


def test_two_readings_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    source = open_bag(recorded(tmp_path, "mcap").path)
    for a, b in zip(source.frames(), source.frames(), strict=True):
        assert a.name == b.name
        assert np.array_equal(a.rgb, b.rgb)


# --- joining --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_frames_without_partner_are_left_out_and_named(tmp_path: Path, kind: str) -> None:
    sent = recorded(tmp_path, kind, n=8, without=(0, 3, 4))
    source = open_bag(sent.path)
    kept = [1, 2, 5, 6, 7]
    for k, frame in zip(kept, source.frames(), strict=True):
        assert np.array_equal(frame.rgb, sent.rgb[k])
        assert frame.depth_counts is not None
        assert np.array_equal(frame.depth_counts, sent.depth[k])
        assert frame.joints is not None
        assert np.allclose(frame.joints, sent.q[k])
    note = next(n for n in source.notes if "left out" in n)
    assert note.startswith(f"3 of 8 images of {COLOUR}")
    lost = [round(stamp(k) / S, 6) for k in (0, 3, 4)]
    assert source.extra["left_out_s"][COLOUR] == pytest.approx(lost)


@pytest.mark.parametrize("pending", [stored_module.PENDING_BYTES, 3000])
@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_recording_does_not_matter(
    tmp_path: Path, kind: str, pending: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Depth a minute late and backwards: joined by stamp all the same, in bounded memory."""
    monkeypatch.setattr(stored_module, "PENDING_BYTES", pending)
    sent = recorded(tmp_path, kind, n=7, write=False)
    bag = sent.bag
    bag.messages = [
        (t if topic != DEPTH else T0 + 120 * S - (t - T0), topic, message)
        for t, topic, message in bag.messages
    ]
    source = open_bag(bag.write())
    for k, frame in enumerate(source.frames()):
        assert np.array_equal(frame.rgb, sent.rgb[k])
        assert frame.depth_counts is not None
        assert np.array_equal(frame.depth_counts, sent.depth[k])
    assert len(source) == 7
    assert len(list(source.frames(5))) == 2


def test_a_repeated_image_counts_once(tmp_path: Path) -> None:
    rgb, _ = pictures(2)
    again = recorded(
        tmp_path, change=lambda bag: bag.image(COLOUR, rgb, "rgb8", stamp(2), stamp(2) + 10**7)
    )
    source = open_bag(again.path)
    assert len(list(source.frames())) == 6
    assert any("1 images with a repeated time" in n for n in source.notes)


def test_clocks_that_do_not_overlap_are_refused_and_can_be_joined_by_receive_time(
    tmp_path: Path,
) -> None:
    sent = recorded(tmp_path, write=False, joints=False)
    for k in range(6):
        t = stamp(k)
        sent.bag.joints(sent.q[k], t - T0 + 5 * S, receive=t)  # seconds since the robot booted
    path = sent.bag.write()
    message = refused(path)
    assert "/joint_states" in message and "5.000 .. 5.500" in message and "clock=receive" in message
    source = open_bag(path, BagChoice(clock="receive"))
    for k, frame in enumerate(source.frames()):
        assert frame.joints is not None
        assert np.allclose(frame.joints, sent.q[k], atol=1e-6)


def test_stamps_of_zero_fall_back_to_receive_time(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.info("/camera/color/camera_info")
    bag.info("/camera/aligned_depth_to_color/camera_info")
    for k in range(4):
        rgb, depth = pictures(k)
        bag.image(COLOUR, rgb, "rgb8", 0, stamp(k))
        bag.image(DEPTH, depth, "16UC1", 0, stamp(k) + 10**6)
    source = open_bag(bag.write())
    assert source.extra["clock"] == "receive"
    assert any("all zero" in n for n in source.notes)
    for k, frame in enumerate(source.frames()):
        assert frame.depth_counts is not None
        assert np.array_equal(frame.depth_counts, pictures(k)[1])


def test_no_depth_within_half_a_period_is_refused_with_the_gap(tmp_path: Path) -> None:
    path = recorded(tmp_path, jitter_s=0.045, n=1).path
    assert "45.0 ms" in refused(path, BagChoice(max_pair_gap_s=0.01))
    assert len(open_bag(path, BagChoice(max_pair_gap_s=0.05))) == 1


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
    assert "none of the 6 frames" in refused(path, BagChoice(only_still=True, still_speed=1e-5))


def test_joints_are_not_made_up_in_a_gap(tmp_path: Path) -> None:
    sent = recorded(tmp_path, joints=False, n=12, write=False)
    for k in (0, 1, 9, 10, 11):
        sent.bag.joints(np.full(6, 0.1 * k), stamp(k))
    source = open_bag(sent.bag.write())
    known = [f.joints is not None for f in source.frames()]
    assert known == [True, True, *[False] * 7, True, True, True]
    assert any("gap of more than 0.25 s at 7 of 12" in n for n in source.notes)


def test_two_arms_are_listed(tmp_path: Path) -> None:
    def change(bag: Bag) -> None:
        bag.joints(np.ones(6), stamp(2), prefix="right_")

    path = recorded(tmp_path, change=change).path
    message = refused(path)
    assert "several arms" in message and "joint_prefix='right_'" in message
    assert open_bag(path, BagChoice(joint_prefix="")).arm.joints is not None
    assert "no joint left_" in refused(path, BagChoice(joint_prefix="left_"))


@pytest.mark.parametrize("kind", KINDS)
def test_tf_gives_the_flange_in_the_controllers_base(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(4)
    q = rng.uniform(-1, 1, (6, 6))
    sent = recorded(tmp_path, kind, joints=False, write=False)
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
    assert "no frame 'tcp'" in refused(path, BagChoice(ee_frame="tcp"))


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
    assert depth is not None
    assert np.all(depth > 0)
    # The step is at depth pixel 15.5 = x 0: at colour pixel 15.5 - 40 * 0.02 / 0.4 = 13.5.
    assert np.all(depth[:, :13] == 400)
    assert np.all(depth[:, 15:] == 500)
    assert any("20.0 mm" in n for n in source.notes)


def test_depth_that_cannot_be_aligned_is_refused_with_the_choices(tmp_path: Path) -> None:
    path = side_by_side(tmp_path, extrinsics=False)
    message = refused(path)
    for option in ("aligned_depth_to_color", "T_colour_depth=", "without_depth"):
        assert option in message
    given = BagChoice(T_colour_depth=se3.from_translation([-0.02, 0, 0]))
    assert open_bag(path, given).reprojection is not None
    colour_alone = open_bag(path, BagChoice(without_depth=True))
    assert colour_alone.depth_unit_m is None
    assert [f.depth_counts for f in colour_alone.frames()] == [None, None]


# --- topics ---------------------------------------------------------------------------------------


def test_two_cameras_are_listed_and_one_can_be_chosen(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    for c, cam in enumerate(("/left", "/right")):
        for stream in ("color", "aligned_depth_to_color"):
            bag.info(f"{cam}/{stream}/camera_info", f=30.0 + c)
        for k in range(3):
            rgb, depth = pictures(10 * c + k)
            bag.image(f"{cam}/color/image_raw", rgb, "rgb8", stamp(k))
            bag.image(f"{cam}/aligned_depth_to_color/image_raw", depth, "16UC1", stamp(k))
    path = bag.write()
    message = refused(path)
    assert "2 cameras" in message and "colour=/left/color/image_raw" in message
    source = open_bag(path, BagChoice(colour="/right/color/image_raw"))
    assert source.intrinsics.fx == 31.0
    for k, frame in enumerate(source.frames()):
        assert np.array_equal(frame.rgb, pictures(10 + k)[0])
        assert frame.depth_counts is not None
        assert np.array_equal(frame.depth_counts, pictures(10 + k)[1])
    assert "is not a topic of colour images" in refused(path, BagChoice(colour="/up"))
    assert "is not a topic of depth images" in refused(
        path, BagChoice(colour="/left/color/image_raw", depth="/left/color/image_raw")
    )


def test_raw_is_preferred_to_compressed_and_compressed_is_read(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.info("/camera/color/camera_info")
    bag.info("/camera/aligned_depth_to_color/camera_info")
    for k in range(3):
        rgb, depth = pictures(k)
        png = cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()
        png16 = cv2.imencode(".png", depth)[1].tobytes()
        bag.packed(COLOUR + "/compressed", png, "rgb8; png compressed bgr8", stamp(k))
        head = bytes(12)
        form = "16UC1; compressedDepth png"
        bag.packed(DEPTH + "/compressedDepth", head + png16, form, stamp(k))
    source = open_bag(bag.write())
    assert source.depth_unit_m == 1e-3
    for k, frame in enumerate(source.frames()):
        assert np.array_equal(frame.rgb, pictures(k)[0])
        assert frame.depth_counts is not None
        assert np.array_equal(frame.depth_counts, pictures(k)[1])
    both = tmp_path / "both"
    both.mkdir()
    png = cv2.imencode(".png", pictures(0)[0])[1].tobytes()
    path = recorded(
        both, change=lambda b: b.packed(COLOUR + "/compressed", png, "png", stamp(0))
    ).path
    assert open_bag(path).extra["topics"]["colour"] == COLOUR


def test_colour_alone_is_imported_and_depth_alone_is_not(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.info("/camera/color/camera_info")
    bag.image(COLOUR, pictures(0)[0], "bgr8", stamp(0))
    source = open_bag(bag.write())
    assert source.depth_unit_m is None
    assert np.array_equal(next(iter(source.frames())).rgb, pictures(0)[0][..., ::-1])
    assert any("no depth images" in n for n in source.notes)
    other = tmp_path / "other"
    other.mkdir()
    bag = Bag(other)
    bag.image(DEPTH, pictures(0)[1], "16UC1", stamp(0))
    assert "only depth images" in refused(bag.write())


def test_without_camera_info_the_camera_can_be_given(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    path = bag.write()
    message = refused(path)
    assert "no CameraInfo" in message and "intrinsics=" in message
    camera = CameraIntrinsics(width=WIDTH, height=HEIGHT, fx=30, fy=30, cx=16, cy=12)
    assert open_bag(path, BagChoice(intrinsics=camera)).intrinsics is camera
    wrong = CameraIntrinsics(width=64, height=48, fx=30, fy=30, cx=16, cy=12)
    assert "64x48" in refused(path, BagChoice(intrinsics=wrong))


def test_bad_cameras_are_refused(tmp_path: Path) -> None:
    def other_mode(bag: Bag) -> None:
        bag.info("/camera/color/camera_info", stamp(3), f=55.0)

    assert "changes during the recording" in refused(recorded(tmp_path, change=other_mode).path)
    bag = Bag(tmp_path / "fisheye.bag")
    bag.path = tmp_path / "fisheye.bag"
    bag.info("/camera/color/camera_info", model="equidistant", d=(0.1, 0.1, 0.0, 0.0))
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    assert "fisheye" in refused(bag.write())


def test_an_unknown_depth_unit_is_asked_for(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.info("/camera/color/camera_info")
    bag.info("/camera/aligned_depth_to_color/camera_info")
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    bag.image(DEPTH, pictures(0)[1], "mono16", stamp(0))
    path = bag.write()
    assert "depth_unit_m=0.001" in refused(path, kind=UnitError)
    assert open_bag(path, BagChoice(depth_unit_m=1e-4 * 5)).depth_unit_m == 5e-4


# --- damaged files --------------------------------------------------------------------------------


def test_missing_and_foreign_files_are_named(tmp_path: Path) -> None:
    assert "does not exist" in refused(tmp_path / "no.bag")
    assert "holds no recording" in refused(tmp_path)
    (tmp_path / "a.bag").write_bytes(b"")
    assert "0 bytes" in refused(tmp_path / "a.bag")
    (tmp_path / "a.txt").write_text("x")
    assert "ends in '.txt'" in refused(tmp_path / "a.txt")
    for name in ("b.bag", "b.db3", "b.mcap"):
        (tmp_path / name).write_text("this is a text, not a recording " * 9)
        assert "cannot be opened" in refused(tmp_path / name)
    folder = recorded(tmp_path, "sqlite3").path
    journal = folder / "recording.db3-wal"
    journal.write_bytes(b"messages")
    assert "wal_checkpoint" in refused(folder / "recording.db3")
    assert "wal_checkpoint" in refused(folder)
    journal.unlink()
    (folder / "recording.db3").rename(tmp_path / "lost.db3")
    message = refused(folder)
    assert "recording.db3" in message and "reindex" in message


def cuts(data: bytes) -> Iterator[bytes]:
    rng = np.random.default_rng(6)
    for share in (0.02, 0.3, 0.7, 0.95, 0.999):
        yield data[: int(share * len(data))]
    for _ in range(25):
        damaged = bytearray(data)
        for _ in range(int(rng.integers(1, 40))):
            damaged[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        yield bytes(damaged)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_one_sentence_or_read(tmp_path: Path, kind: str) -> None:
    sent = recorded(tmp_path, kind, n=3)
    ending = {"ros1": ".bag", "sqlite3": ".db3", "mcap": ".mcap"}[kind]
    file = sent.path if kind == "ros1" else sent.path / f"recording{ending}"
    whole = file.read_bytes()
    outcomes: list[str] = []
    for n, damaged in enumerate(cuts(whole)):
        path = tmp_path / f"damaged_{n}{ending}"
        path.write_bytes(damaged)
        try:
            source = open_bag(path)
            outcomes.append(f"{len(list(source.frames()))} frames")
        except RealsimError as error:
            assert "\n" not in str(error).strip()
            outcomes.append("refused")
        path.unlink()
    assert outcomes[:4] == ["refused"] * 4


def test_a_bag_without_index_says_reindex(tmp_path: Path) -> None:
    path = recorded(tmp_path).path
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    assert "rosbag reindex" in refused(path)


# --- all the way ----------------------------------------------------------------------------------


def test_an_import_is_a_session_with_the_same_pixels(tmp_path: Path) -> None:
    from realsim.app.console import Console
    from realsim.app.import_session import import_session
    from realsim.store.session_store import SessionStore

    sent = recorded(tmp_path, "mcap", without=(2,))
    source: BagSource = open_bag(sent.path)
    import_session(source, tmp_path / "session", Console(quiet=True))
    store = SessionStore.open(tmp_path / "session")
    assert len(store.session.views) == 5
    for view, k in zip(store.session.views, (0, 1, 3, 4, 5), strict=True):
        assert np.array_equal(store.rgb(view.index), sent.rgb[k])
        assert np.allclose(store.depth_m(view.index), sent.depth[k] * 1e-3)
        assert view.joints is not None
        assert np.allclose(view.joints, sent.q[k])
