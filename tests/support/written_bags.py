"""Recordings written by rosbags in three containers: colour, depth, joints, tf."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from realsim.errors import InputError
from realsim.formats.bags import BagChoice, open_bag
from realsim.formats.bags.joints import UR_JOINTS
from realsim.formats.frame_source import FrameSource, SourceFrame
from realsim.interop import quaternion_xyzw_from_R

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
            writer = rosbag1.Writer(self.path)
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = rosbag2.Writer(self.path, version=9, storage_plugin=plugin)
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

    def _sensor(
        self, kind: str, topic: str, t: int, frame_id: str, *values: Any, receive: int | None = None
    ) -> None:
        """Add a message of sensor_msgs, which came when it was made unless `receive` says."""
        message = self.t[f"sensor_msgs/msg/{kind}"](self.header(t, frame_id), *values)
        self.messages.append((t if receive is None else receive, topic, message))

    def image(
        self, topic: str, pixels: Any, encoding: str, t: int,
        receive: int | None = None, frame_id: str = FRAME,
    ) -> None:  # fmt: skip
        flat = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
        h, w = pixels.shape[:2]
        values = (h, w, encoding, 0, flat.size // h, flat)
        self._sensor("Image", topic, t, frame_id, *values, receive=receive)

    def packed(self, topic: str, data: bytes, form: str, t: int, frame_id: str = FRAME) -> None:
        self._sensor("CompressedImage", topic, t, frame_id, form, np.frombuffer(data, np.uint8))

    def info(
        self, topic: str, t: int = T0, *, model: str = "plumb_bob", d: Any = (0.0,) * 5,
        f: float = 30.0, frame_id: str = FRAME,
    ) -> None:  # fmt: skip
        K = np.array([f, 0, 15.5, 0, f + 1, 11.5, 0, 0, 1])
        roi = self.t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        lens = (model, np.array(d, float), K, np.eye(3).ravel(), np.zeros(12))
        self._sensor("CameraInfo", topic, t, frame_id, HEIGHT, WIDTH, *lens, 0, 0, roi)

    def both_infos(self, camera: str = "/camera", **known: Any) -> None:
        """Tell the lens of a camera's colour and of the depth that is aligned to it."""
        for stream in ("color", "aligned_depth_to_color"):
            self.info(f"{camera}/{stream}/camera_info", **known)

    def joints(
        self, q: Any, t: int, dq: Any = None, prefix: str = "", receive: int = 0,
        called: Sequence[str] = UR_JOINTS,
    ) -> None:  # fmt: skip
        order = sorted(range(len(called)), key=lambda i: called[i])  # as drivers: by the alphabet
        names = [prefix + called[i] for i in order]
        velocity = np.zeros(0) if dq is None else np.asarray(dq, float)[order]
        values = (names, np.asarray(q, float)[order], velocity, np.zeros(0))
        self._sensor("JointState", "/joint_states", t, "", *values, receive=receive or t)

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
    q: list[Any] = field(default_factory=list)
    path: Path = Path()


def stamp(k: int) -> int:
    return T0 + round(k * PERIOD_S * S)


def pictures(k: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(k)
    rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return rgb, rng.integers(300, 900, (HEIGHT, WIDTH), dtype=np.uint16)


def same_pictures(source: FrameSource, numbers: Iterable[int]) -> list[SourceFrame]:
    """Hold that the frames of a source are the pictures of these numbers; return the frames."""
    frames = list(source.frames())
    for k, frame in zip(numbers, frames, strict=True):
        rgb, depth = pictures(k)
        assert np.array_equal(frame.rgb, rgb) and np.array_equal(frame.depth_counts, depth), k
    return frames


def recorded(
    folder: Path, kind: str = "ros1", n: int = 6, *, joints: bool = True,
    without: Sequence[int] = (), jitter_s: float = 0.004,
    change: Callable[[Bag], None] | None = None, write: bool = True,
) -> Sent:  # fmt: skip
    """Record n frames of colour, depth (a little later) and joints; `without` have no depth."""
    bag = Bag(folder, kind)
    sent = Sent(bag)
    bag.both_infos()
    rng = np.random.default_rng(5)
    for k in range(n):
        rgb, depth = pictures(k)
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


def refused(path: Path, *words: str, **choice: Any) -> None:
    """Hold that a recording is refused, opened or read, in one line that says all of `words`."""
    with pytest.raises(InputError) as caught:
        list(open_bag(path, BagChoice(**choice)).frames())
    said = str(caught.value).strip()
    assert "\n" not in said and all(word in said for word in words), said
