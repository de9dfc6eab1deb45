"""Fetching the chosen images out of a recording in one pass, with bounded memory."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.errors import InputError
from realsim.formats.bags.clocks import Times
from realsim.formats.bags.recording import Recording
from realsim.formats.bags.scan import ImageTimes
from realsim.formats.bags.wire import NS_PER_S, ImageMessage, MessageError, header_of, image_of

PENDING_BYTES = 128 << 20
"""Images that wait for the rest of their frame take at most this; beyond it they are let go and
fetched again on their own."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StoredImages:
    """Where the images of N frames are in the recording: entry n belongs to frame n."""

    topic: str
    compressed: bool
    stamp_ns: Times
    """(N,) when each was taken [ns]."""
    header_ns: Times
    """(N,) stamp in its message [ns]."""
    receive_ns: Times
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
        return StoredImages(
            topic=self.topic,
            compressed=self.compressed,
            stamp_ns=self.stamp_ns[index],
            header_ns=self.header_ns[index],
            receive_ns=self.receive_ns[index],
        )

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

    def read(self, start: int) -> Iterator[tuple[int, list[ImageMessage]]]:
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
            key = (topic, receive_ns, header_of(data, self._recording.is_ros2).stamp_ns)
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
            topic, receive_ns, _ = self._streams[0].key(following)
            raise InputError(
                f"{self._recording.path}: an image of {topic} recorded at "
                f"{receive_ns / NS_PER_S:.6f} s is not there any more. Was the file changed?"
            )

    def one(self, stream: int, n: int) -> ImageMessage:
        """Return the image of frame n of a stream, fetched on its own.

        Raises:
            InputError: it is not there any more.
        """
        topic, receive_ns, header_ns = self._streams[stream].key(n)
        is_ros2 = self._recording.is_ros2
        for _, _, data in self._recording.messages([topic], receive_ns, receive_ns + 1):
            if header_of(data, is_ros2).stamp_ns == header_ns:
                return self._image(stream, data)
        raise InputError(
            f"{self._recording.path}: the image of {topic} recorded at "
            f"{receive_ns / NS_PER_S:.6f} s is not there any more. Was the file changed?"
        )

    def _image(self, stream: int, data: bytes) -> ImageMessage:
        s = self._streams[stream]
        try:
            return image_of(data, self._recording.is_ros2, s.compressed)
        except MessageError as error:
            raise InputError(f"{self._recording.path.name}, {s.topic}: {error}.") from error
