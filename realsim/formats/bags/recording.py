"""A recording as topics and serialised messages, whatever container they are in.

ROS1 .bag, ROS2 folders and files (sqlite3, MCAP) are read by rosbags; a file that it cannot read
is an error of one sentence with the tool that repairs it.
"""

import contextlib
from collections.abc import Collection, Generator, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from realsim.errors import InputError, RealsimError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

SUFFIXES = (".bag", ".db3", ".mcap")
METADATA = "metadata.yaml"
REASON_CHARACTERS = 200
"""Most characters of what the reader says; it may quote whole message definitions."""
REMEDY = {
    ".bag": "The recorder was probably stopped before it wrote the index: run `rosbag reindex "
    "FILE` (ROS1) and import the result, or copy the file again.",
    ".db3": "Copy it again, or save what is left with `sqlite3 FILE .recover | sqlite3 NEW.db3`.",
    ".mcap": "The recorder was probably stopped before it wrote the index: run `mcap recover FILE "
    "-o NEW.mcap` and import the result, or copy the file again.",
    "": "Run `ros2 bag reindex FOLDER`, or copy the folder again with all its files.",
}


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording."""

    name: str
    msgtype: str
    count: int


class Recording:
    """An open recording; a context manager, because files are open behind it."""

    def __init__(self, path: Path | str) -> None:
        """Find the container; see `__enter__` for opening it.

        Raises:
            InputError: nothing there that is a recording; the message says what is.
        """
        self.path, self.notes = _located(Path(path))
        self.is_ros2 = self.path.suffix != ".bag"
        self.topics: dict[str, Topic] = {}
        self._reader: AnyReader | None = None

    @property
    def container(self) -> str:
        """What kind of file it is."""
        if not self.is_ros2:
            return "ROS1 bag"
        files = sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]
        is_mcap = any(".mcap" in f.name for f in files)
        return "ROS2 bag (MCAP)" if is_mcap else "ROS2 bag (sqlite3)"

    def __enter__(self) -> "Recording":
        """Open it and list its topics.

        Raises:
            InputError: it is damaged, cut off, or parts of it are missing.
        """
        from rosbags.highlevel import AnyReader

        with self._readable("opened"):
            store = _ros2_types() if self.is_ros2 else None
            reader = AnyReader([self.path], default_typestore=store)
            reader.open()
            self._reader = reader
            for c in reader.connections:
                if not (isinstance(c.topic, str) and isinstance(c.msgtype, str)):  # pyright: ignore[reportUnnecessaryIsInstance]
                    raise TypeError(f"a topic named {c.topic!r:.40} of type {c.msgtype!r:.40}")
                known = self.topics.get(c.topic)
                count = c.msgcount + (known.count if known else 0)
                self.topics[c.topic] = Topic(c.topic, c.msgtype, count)
        return self

    def __exit__(self, *_: object) -> None:
        """Close the files."""
        if self._reader is not None:
            # Damaged metadata can make closing fail when everything has been read.
            with contextlib.suppress(Exception):
                self._reader.close()
            self._reader = None

    def of_type(self, *msgtypes: str) -> list[Topic]:
        """Return the topics of these types that have messages, by name."""
        found = [t for t in self.topics.values() if t.msgtype in msgtypes and t.count > 0]
        return sorted(found, key=lambda t: t.name)

    def listing(self) -> str:
        """Return all topics with type and count, for a message to a person."""
        topics = sorted(self.topics.values(), key=lambda t: t.name)
        shown = [f"{t.name} ({t.msgtype.replace('/msg/', '/')}, {t.count})" for t in topics[:30]]
        rest = f" and {len(topics) - len(shown)} more" if len(topics) > len(shown) else ""
        return ", ".join(shown) + rest if shown else "none at all"

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, receive time [ns], serialised message) in the order of receive time.

        Args:
            topics: whose messages; none gives none.
            start_ns: first receive time.
            stop_ns: receive time to stop before.

        Raises:
            InputError: the file is damaged.
        """
        reader = self._open_reader()
        connections = [c for c in reader.connections if c.topic in topics]
        if not connections:
            return
        with self._readable("read"):
            for c, time_ns, data in reader.messages(connections, start=start_ns, stop=stop_ns):
                yield c.topic, time_ns, bytes(data)

    def first(self, topic: str) -> bytes:
        """Return the first message of a topic.

        Raises:
            InputError: it has none.
        """
        for _, _, data in self.messages([topic]):
            return data
        raise InputError(f"{self.path.name}: topic {topic} has no messages.")

    def decoded(self, topic: str) -> Iterator[Any]:
        """Yield the messages of a topic as objects; for small ones."""
        reader = self._open_reader()
        msgtype = self.topics[topic].msgtype
        for _, _, data in self.messages([topic]):
            with self._readable("read"):
                message = reader.deserialize(data, msgtype)
            yield message

    def first_decoded(self, topic: str) -> Any:
        """Return the first message of a topic as an object.

        Raises:
            InputError: it has none, whatever the recording's table of contents says.
        """
        for message in self.decoded(topic):
            return message
        raise InputError(f"{self.path.name}: topic {topic} has no messages.")

    def _open_reader(self) -> "AnyReader":
        if self._reader is None:
            raise RuntimeError("the recording is used outside its `with` block")
        return self._reader

    @contextlib.contextmanager
    def _readable(self, what: str) -> Generator[None]:
        """Turn whatever a damaged file makes the reader raise into one sentence."""
        try:
            yield
        except RealsimError:
            raise
        except Exception as error:
            remedy = REMEDY[self.path.suffix if self.path.is_file() else ""]
            lines = str(error).strip().splitlines() or ["no reason given"]
            reason = lines[0][:REASON_CHARACTERS].rstrip(" .:")
            raise InputError(
                f"{self.path} cannot be {what}: {type(error).__name__}, {reason} "
                f"({_size(self.path)}). {remedy}"
            ) from error


@lru_cache(maxsize=1)
def _ros2_types() -> "Typestore":
    """Return ROS2's types: files before Iron, and RealSense's, carry no definitions."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _size(path: Path) -> str:
    return f"{path.stat().st_size} bytes" if path.is_file() else "a folder"


def _located(path: Path) -> tuple[Path, list[str]]:
    """Return the file or folder that rosbags is to open, and what a person should know of it."""
    if not path.exists():
        raise InputError(
            f"{path} does not exist. A ROS1 .bag, a ROS2 folder with {METADATA}, or a .db3 or "
            ".mcap file is expected."
        )
    if path.is_file():
        return path, _check_file(path)
    files = sorted(p for p in path.iterdir() if p.suffix in SUFFIXES)
    if (path / METADATA).is_file():
        for file in files:
            _check_file(file, alone=False)
        return path, []
    if len(files) == 1:
        note = f"{path.name} has no {METADATA}; its only recording {files[0].name} was read."
        return files[0], [note, *_check_file(files[0])]
    if not files:
        raise InputError(
            f"{path} holds no recording: neither {METADATA} nor a file ending in "
            f"{', '.join(SUFFIXES)} is in it. Give the recording's own file or folder."
        )
    names = ", ".join(f.name for f in files[:8])
    raise InputError(
        f"{path} has no {METADATA} and {len(files)} recordings ({names}). If they are the parts of "
        f"one ROS2 recording, run `ros2 bag reindex {path}`; else give one of the files."
    )


def _check_file(path: Path, alone: bool = True) -> list[str]:
    """Return notes on one file of a recording.

    Raises:
        InputError: it is not one, or a part of it is in a journal that is not read.
    """
    if path.suffix not in SUFFIXES:
        raise InputError(
            f"{path} ends in '{path.suffix}'; {', '.join(SUFFIXES)} or a ROS2 folder is read. "
            + ("Give the folder that it is in." if path.name == METADATA else "")
        )
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes). Copy it again from where it was recorded.")
    journal = path.with_name(path.name + "-wal")
    if path.suffix == ".db3" and journal.is_file() and journal.stat().st_size > 0:
        raise InputError(
            f"{path} was not closed: {journal.stat().st_size} bytes of messages are still in "
            f"{journal.name}. Run `sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)'` on a "
            "copy of both files, then import that."
        )
    if alone and path.suffix != ".bag" and (path.parent / METADATA).is_file():
        parts = sorted(p.name for p in path.parent.iterdir() if p.suffix == path.suffix)
        if len(parts) > 1:
            return [
                f"only {path.name} was read; the recording has {len(parts)} parts. Give the folder "
                f"{path.parent.name} to import all of them."
            ]
    return []
