"""The first pass: when everything happened. Images are not decoded, only their headers read."""

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.bags import realsense as rs
from realsim.formats.bags.choice import BagChoice
from realsim.formats.bags.clocks import Times
from realsim.formats.bags.joints import JointTrack
from realsim.formats.bags.recording import Recording
from realsim.formats.bags.tf_tree import TfTree
from realsim.formats.bags.topics import ImageTopic, Topics
from realsim.formats.bags.wire import (
    NS_PER_S,
    MessageError,
    body_of,
    header_of,
    joints_of,
    transforms_of,
)

STAMPS_LOOKED_AT = 3
"""A topic whose first stamps are all zero has a sender that never set them."""


@dataclass(slots=True)
class ImageTimes:
    """When the images of one topic were taken and when they were recorded."""

    topic: ImageTopic
    stamps: "array[int]" = field(default_factory=lambda: array("q"))
    receives: "array[int]" = field(default_factory=lambda: array("q"))
    frames: "rs.FrameTimes | None" = None
    """librealsense's metadata, where the header does not have the frame's time."""
    stamp_ns: Times = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,) sorted, each once."""
    header_ns: Times = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,) stamp in the message, by which it is found again."""
    receive_ns: Times = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,) when each was recorded."""

    def finish(self, by_receive: bool) -> list[str]:
        """Sort the frames by time and drop repeated and unstamped ones; return notes."""
        header = np.frombuffer(self.stamps, np.int64)
        receive = np.frombuffer(self.receives, np.int64)
        stamp, known = _true_stamps(header, receive, self.frames, by_receive)
        times, first = np.unique(stamp[known], return_index=True)
        self.stamp_ns = times
        self.header_ns, self.receive_ns = header[known][first], receive[known][first]
        notes: list[str] = []
        unknown, repeated = int(np.sum(~known)), int(np.sum(known)) - len(times)
        if unknown:
            notes.append(f"{self.topic.name}: {unknown} images without a time stamp left out.")
        if repeated:
            notes.append(f"{self.topic.name}: {repeated} images with a repeated time left out.")
        return notes


def _true_stamps(
    header: Times, receive: Times, frames: "rs.FrameTimes | None", by_receive: bool
) -> tuple[Times, NDArray[np.bool_]]:
    """Return the time of every image and whether it is known."""
    if by_receive:
        return receive, np.ones(len(receive), dtype=bool)
    if frames is not None and frames.stamps_ns:
        stamps = [frames.stamps_ns.get(int(r), -1) for r in receive]
        stamp = np.array(stamps, dtype=np.int64)
        return stamp, stamp >= 0
    return header, header > 0


@dataclass(slots=True)
class Scan:
    """What the first pass found."""

    colour: ImageTimes
    depth: ImageTimes | None
    joints: JointTrack | None
    tree: TfTree
    clock: str
    notes: list[str]


def scan(recording: Recording, topics: Topics, choice: BagChoice) -> Scan:
    """Read the times of all images, and all joints and transforms.

    Raises:
        InputError: a message is damaged, or the camera changed on the way.
    """
    notes: list[str] = []
    by_receive = choice.clock == "receive"
    unset = [] if by_receive else _unset_stamps(recording, topics)
    if unset:
        by_receive = True
        notes.append(
            f"time stamps in {', '.join(unset)} are all zero: everything was joined by the time of "
            "recording instead, which is less exact."
        )
    images = [ImageTimes(t) for t in (topics.colour, topics.depth) if t is not None]
    track = JointTrack(topics.joint_prefix) if topics.joints else None
    tree = TfTree()
    handlers = _handlers(recording, topics, images, track, tree, by_receive)
    for topic, receive_ns, data in recording.messages(list(handlers)):
        try:
            handlers[topic](receive_ns, data)
        except MessageError as error:
            raise InputError(
                f"{recording.path.name}, {topic} at {receive_ns / NS_PER_S:.6f} s: {error}."
            ) from error
    for image in images:
        notes += image.finish(by_receive)
    if track is not None:
        track.finish()
        track.check_radians(str(topics.joints))
    tree.finish()
    return Scan(
        colour=images[0],
        depth=images[1] if len(images) > 1 else None,
        joints=track,
        tree=tree,
        clock="receive" if by_receive else "header",
        notes=notes,
    )


def _handlers(
    recording: Recording,
    topics: Topics,
    images: list[ImageTimes],
    track: JointTrack | None,
    tree: TfTree,
    by_receive: bool,
) -> dict[str, Callable[[int, bytes], None]]:
    """Return what to do with a message of every topic that is read."""
    is_ros2 = recording.is_ros2
    handlers: dict[str, Callable[[int, bytes], None]] = {}

    def image_handler(times: ImageTimes) -> Callable[[int, bytes], None]:
        def handle(receive_ns: int, data: bytes) -> None:
            times.stamps.append(header_of(data, is_ros2).stamp_ns)
            times.receives.append(receive_ns)

        return handle

    def metadata_handler(frames: rs.FrameTimes) -> Callable[[int, bytes], None]:
        return lambda receive_ns, data: frames.add(receive_ns, rs.text_of(data))

    def tf_handler(static: bool) -> Callable[[int, bytes], None]:
        def handle(receive_ns: int, data: bytes) -> None:
            for t in transforms_of(data, is_ros2):
                if static or by_receive or t.stamp_ns:
                    tree.add(t, receive_ns if by_receive else t.stamp_ns, static)

        return handle

    def joint_handler(receive_ns: int, data: bytes) -> None:
        message = joints_of(data, is_ros2)
        if track is not None and (by_receive or message.stamp_ns):
            track.add(message, receive_ns if by_receive else message.stamp_ns)

    for times in images:
        handlers[times.topic.name] = image_handler(times)
        metadata = rs.metadata_topic(times.topic.name, recording)
        if metadata is not None:
            times.frames = rs.FrameTimes()
            handlers[metadata] = metadata_handler(times.frames)
    for info in (topics.colour_info, topics.depth_info):
        if info is not None:
            handlers[info] = _same_camera(info, is_ros2)
    for name in topics.tf:
        handlers[name] = tf_handler("static" in name.rpartition("/")[2])
    if topics.joints is not None:
        handlers[topics.joints] = joint_handler
    return handlers


def _same_camera(topic: str, is_ros2: bool) -> Callable[[int, bytes], None]:
    """Return a check that all CameraInfo messages of a topic say the same."""
    first: list[bytes] = []

    def handle(receive_ns: int, data: bytes) -> None:
        body = body_of(data, is_ros2)
        if not first:
            first.append(body)
        elif body != first[0]:
            raise InputError(
                f"{topic} changes during the recording (at {receive_ns / NS_PER_S:.6f} s): a "
                "session has one camera. Was it switched to another mode or calibrated? Give the "
                "camera in a file (intrinsics=), or cut the recording."
            )

    return handle


def _unset_stamps(recording: Recording, topics: Topics) -> list[str]:
    """Return the topics whose first stamps are all zero; frames of librealsense have their own."""
    images = [t.name for t in (topics.colour, topics.depth) if t is not None]
    names = [n for n in images if rs.metadata_topic(n, recording) is None]
    names += [topics.joints] if topics.joints else []
    found: list[str] = []
    for name in names:
        stamps: list[int] = []
        for _, _, data in recording.messages([name]):
            stamps.append(header_of(data, recording.is_ros2).stamp_ns)
            if len(stamps) >= STAMPS_LOOKED_AT:
                break
        if stamps and not any(stamps):
            found.append(name)
    return found
