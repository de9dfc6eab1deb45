"""The two passes over a recording: when everything happened, then the chosen images.

The first decodes no image, only their headers; the second has bounded memory.
"""

from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Int64, Mask
from realsim.errors import InputError
from realsim.formats.bags import cameras as rs
from realsim.formats.bags import wire
from realsim.formats.bags.joints import JointTrack
from realsim.formats.bags.recording import Recording
from realsim.formats.bags.tf_tree import TfTree
from realsim.formats.bags.topics import BagChoice, ImageTopic, Topics

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
    stamp_ns: Int64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,) sorted, each once."""
    header_ns: Int64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,) stamp in the message, by which it is found again."""
    receive_ns: Int64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
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
    header: Int64, receive: Int64, frames: "rs.FrameTimes | None", by_receive: bool
) -> tuple[Int64, Mask]:
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
    track = JointTrack(topics.joint_prefix, choice.joint_names) if topics.joints else None
    tree = TfTree()
    handlers = _handlers(recording, topics, images, track, tree, by_receive)
    for topic, receive_ns, data in recording.messages(list(handlers)):
        try:
            handlers[topic](receive_ns, data)
        except wire.MessageError as error:
            raise InputError(
                f"{recording.path.name}, {topic} at {receive_ns / wire.NS_PER_S:.6f} s: {error}."
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
            times.stamps.append(wire.header_of(data, is_ros2).stamp_ns)
            times.receives.append(receive_ns)

        return handle

    def metadata_handler(frames: rs.FrameTimes) -> Callable[[int, bytes], None]:
        return lambda receive_ns, data: frames.add(receive_ns, rs.text_of(data))

    def tf_handler(static: bool) -> Callable[[int, bytes], None]:
        def handle(receive_ns: int, data: bytes) -> None:
            for t in wire.transforms_of(data, is_ros2):
                if static or by_receive or t.stamp_ns:
                    tree.add(t, receive_ns if by_receive else t.stamp_ns, static)

        return handle

    def joint_handler(receive_ns: int, data: bytes) -> None:
        message = wire.joints_of(data, is_ros2)
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
        body = wire.body_of(data, is_ros2)
        if not first:
            first.append(body)
        elif body != first[0]:
            raise InputError(
                f"{topic} changes during the recording (at {receive_ns / wire.NS_PER_S:.6f} s): a "
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
            stamps.append(wire.header_of(data, recording.is_ros2).stamp_ns)
            if len(stamps) >= STAMPS_LOOKED_AT:
                break
        if stamps and not any(stamps):
            found.append(name)
    return found


PENDING_BYTES = 128 << 20
"""Images that wait for the rest of their frame take at most this; beyond it they are let go and
fetched again on their own."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StoredImages:
    """Where the images of N frames are in the recording: entry n belongs to frame n."""

    topic: str
    compressed: bool
    stamp_ns: Int64
    """(N,) when each was taken [ns]."""
    header_ns: Int64
    """(N,) stamp in its message [ns]."""
    receive_ns: Int64
    """(N,) when it was recorded [ns]."""

    @classmethod
    def of(cls, times: ImageTimes, which: ArrayLike | None = None) -> "StoredImages":
        """Return the images of a scanned topic, all or those with the numbers `which`."""
        images = cls(
            topic=times.topic.name,
            compressed=times.topic.compressed,
            stamp_ns=times.stamp_ns,
            header_ns=times.header_ns,
            receive_ns=times.receive_ns,
        )
        return images if which is None else images.at(which)

    def at(self, which: ArrayLike) -> "StoredImages":
        """Return the images with these numbers, or where a mask is true."""
        index = np.asarray(which)
        return replace(
            self, stamp_ns=self.stamp_ns[index], header_ns=self.header_ns[index],
            receive_ns=self.receive_ns[index],
        )  # fmt: skip

    def key(self, n: int) -> "Key":
        """Return what finds image n again."""
        return self.topic, int(self.receive_ns[n]), int(self.header_ns[n])


Key = tuple[str, int, int]
"""Topic, receive time and header stamp."""


class Messages:
    """The images of all frames, from one or two topics of an open recording."""

    def __init__(self, recording: Recording, streams: Sequence[StoredImages]) -> None:
        """Prepare to read; every stream has an entry for every frame."""
        self._recording = recording
        self._streams = list(streams)

    def read(self, start: int) -> Iterator[tuple[int, list[wire.ImageMessage]]]:
        """Yield (number, an image of every stream) of the frames from `start` on.

        Raises:
            InputError: an image is not there any more, or damaged.
        """
        end = len(self._streams[0].stamp_ns)
        if start >= end:
            return
        owner = {s.key(n): n for s in self._streams for n in range(start, end)}
        pending: dict[Key, bytes] = {}
        gone: set[Key] = set()
        size = 0
        following = start
        first_ns = min(int(s.receive_ns[start:].min()) for s in self._streams)
        topics = {s.topic for s in self._streams}
        for topic, receive_ns, data in self._recording.messages(topics, start_ns=first_ns):
            key = (topic, receive_ns, wire.header_of(data, self._recording.is_ros2).stamp_ns)
            if key not in owner or key in pending:
                continue
            pending[key] = data
            size += len(data)
            while following < end:
                keys = [s.key(following) for s in self._streams]
                if not all(k in pending or k in gone for k in keys):
                    break
                images = [
                    self._image(i, pending.pop(k)) if k in pending else self.one(i, following)
                    for i, k in enumerate(keys)
                ]
                size = sum(map(len, pending.values()))
                yield following, images
                following += 1
            while size > PENDING_BYTES:
                farthest = max(pending, key=lambda k: owner[k])
                size -= len(pending.pop(farthest))
                gone.add(farthest)
        if following < end:
            raise self._lost("an", self._streams[0].key(following))

    def one(self, stream: int, n: int) -> wire.ImageMessage:
        """Return the image of frame n of a stream, fetched on its own.

        Raises:
            InputError: it is not there any more.
        """
        key = topic, receive_ns, header_ns = self._streams[stream].key(n)
        is_ros2 = self._recording.is_ros2
        for _, _, data in self._recording.messages([topic], receive_ns, receive_ns + 1):
            if wire.header_of(data, is_ros2).stamp_ns == header_ns:
                return self._image(stream, data)
        raise self._lost("the", key)

    def _lost(self, article: str, key: Key) -> InputError:
        topic, receive_ns, _ = key
        return InputError(
            f"{self._recording.path}: {article} image of {topic} recorded at "
            f"{receive_ns / wire.NS_PER_S:.6f} s is not there any more. Was the file changed?"
        )

    def _image(self, stream: int, data: bytes) -> wire.ImageMessage:
        s = self._streams[stream]
        try:
            return wire.image_of(data, self._recording.is_ros2, s.compressed)
        except wire.MessageError as error:
            raise InputError(f"{self._recording.path.name}, {s.topic}: {error}.") from error
