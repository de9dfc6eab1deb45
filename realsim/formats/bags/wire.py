"""The messages whose bytes matter for speed, read straight from their serialised form.

A full deserialisation copies images and takes tens of microseconds for every joint reading. Here
images stay views into the message, and the few other types are walked field by field. Both
encodings of ROS are read: ROS1 (packed, little endian) and ROS2's plain CDR (aligned).
"""

import struct
from typing import NamedTuple

import numpy as np

from realsim.arrays import Array, UInt8
from realsim.errors import InputError

NS_PER_S = 1_000_000_000
CDR_HEADER = 4
"""Bytes of encapsulation before the content; alignment counts from behind them."""
CDR_LITTLE, CDR_BIG = b"\x00\x01", b"\x00\x00"


class MessageError(InputError):
    """A message ends before its fields do; whoever knows the topic adds it."""


class Header(NamedTuple):
    """std_msgs/Header: when and in which frame."""

    stamp_ns: int
    frame_id: str


class ImageMessage(NamedTuple):
    """sensor_msgs/Image or CompressedImage; `pixels` is a view of the message."""

    stamp_ns: int
    frame_id: str
    encoding: str
    """Encoding of the pixels; of a compressed image its `format`."""
    pixels: UInt8
    """(N,) bytes as they were sent."""
    width: int = 0
    """0 for a compressed image: its own header says it."""
    height: int = 0
    step: int = 0
    """Bytes from row to row."""
    big_endian: bool = False


class JointMessage(NamedTuple):
    """sensor_msgs/JointState."""

    stamp_ns: int
    names: tuple[str, ...]
    position: Array
    velocity: Array


class TransformMessage(NamedTuple):
    """One geometry_msgs/TransformStamped: parent, child, and x y z qx qy qz qw."""

    stamp_ns: int
    parent: str
    child: str
    numbers: tuple[float, ...]


class Cursor:
    """A place in a serialised message that moves on as fields are read."""

    __slots__ = ("_data", "_is_cdr", "_order", "at")

    def __init__(self, data: bytes, is_ros2: bool) -> None:
        """Start at the first field.

        Raises:
            InputError: a ROS2 message that is not plain CDR.
        """
        self._data = data
        self._is_cdr = is_ros2
        self._order = "<"
        self.at = 0
        if is_ros2:
            if data[:2] not in (CDR_LITTLE, CDR_BIG):
                raise InputError(
                    f"a message is encoded as 0x{data[:2].hex()}; plain CDR (0x0000 or 0x0001) is "
                    "read. Convert the recording with `ros2 bag convert`."
                )
            self._order = "<" if data[:2] == CDR_LITTLE else ">"
            self.at = CDR_HEADER

    def _align(self, size: int) -> None:
        if self._is_cdr:
            self.at += (CDR_HEADER - self.at) % size

    def _take(self, size: int) -> int:
        """Move on by a number of bytes and return where they start.

        Raises:
            MessageError: the message does not have them.
        """
        start = self.at
        if start + size > len(self._data):
            raise MessageError(
                f"a message of {len(self._data)} bytes is damaged: {size} bytes from {start} on "
                "are not there"
            )
        self.at += size
        return start

    def numbers(self, code: str, size: int, count: int = 1) -> tuple[float, ...]:
        """Return `count` numbers of `size` bytes each, by their struct code."""
        self._align(size)
        start = self._take(size * count)
        return struct.unpack_from(f"{self._order}{count}{code}", self._data, start)

    def u32(self) -> int:
        """Return an unsigned integer of 32 bit."""
        return int(self.numbers("I", 4)[0])

    def u8(self) -> int:
        """Return a byte."""
        return int(self.numbers("B", 1)[0])

    def string(self) -> str:
        """Return a string; CDR's ends with a zero, ROS1's does not."""
        length = self.u32()
        start = self._take(length)
        return self._data[start : self.at].rstrip(b"\0").decode("utf-8", "replace")

    def bytes_view(self) -> UInt8:
        """Return a sequence of bytes as a view of the message."""
        length = self.u32()
        start = self._take(length)
        return np.frombuffer(self._data, np.uint8)[start : self.at]

    def doubles(self) -> Array:
        """Return a sequence of doubles."""
        length = self.u32()
        if length == 0:
            return np.zeros(0)
        self._align(8)
        start = self._take(8 * length)
        values = np.frombuffer(self._data, f"{self._order}f8", length, start)
        return values.astype(np.float64, copy=False)

    def header(self) -> Header:
        """Return a std_msgs/Header."""
        if not self._is_cdr:
            self.u32()  # seq, which ROS2 does not have
        seconds = self.u32()
        return Header(seconds * NS_PER_S + self.u32(), self.string())


def header_of(data: bytes, is_ros2: bool) -> Header:
    """Return the header of any message that begins with one."""
    return Cursor(data, is_ros2).header()


def body_of(data: bytes, is_ros2: bool) -> bytes:
    """Return what stands behind the header, to see whether a message changed."""
    cursor = Cursor(data, is_ros2)
    cursor.header()
    return data[cursor.at :]


def image_of(data: bytes, is_ros2: bool, compressed: bool) -> ImageMessage:
    """Return an image message whose pixels are a view of `data`."""
    cursor = Cursor(data, is_ros2)
    stamp, frame_id = cursor.header()
    if compressed:
        encoding = cursor.string()
        return ImageMessage(stamp, frame_id, encoding, cursor.bytes_view())
    height, width = cursor.u32(), cursor.u32()
    encoding = cursor.string()
    big_endian = bool(cursor.u8())
    step = cursor.u32()
    pixels = cursor.bytes_view()
    return ImageMessage(stamp, frame_id, encoding, pixels, width, height, step, big_endian)


def joints_of(data: bytes, is_ros2: bool) -> JointMessage:
    """Return a joint reading with all its names."""
    cursor = Cursor(data, is_ros2)
    stamp, _ = cursor.header()
    names = tuple(cursor.string() for _ in range(cursor.u32()))
    return JointMessage(stamp, names, cursor.doubles(), cursor.doubles())


def transforms_of(data: bytes, is_ros2: bool) -> list[TransformMessage]:
    """Return the transforms of a tf message."""
    cursor = Cursor(data, is_ros2)
    found: list[TransformMessage] = []
    for _ in range(cursor.u32()):
        stamp, parent = cursor.header()
        child = cursor.string()
        numbers = cursor.numbers("d", 8, 7)
        # ROS1 wrote frames with a leading slash for years; they mean the same.
        found.append(TransformMessage(stamp, parent.lstrip("/"), child.lstrip("/"), numbers))
    return found
