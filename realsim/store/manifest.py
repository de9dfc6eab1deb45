"""The list of a session's files with their checksums: `manifest.jsonl`.

One line {"path", "sha256", "bytes", "check"} is appended when a file's bytes are complete on the
disk; the last line of a path wins. A line torn by a kill is cut off when the manifest is next
opened. A file gets its name right after its line: a kill between the two leaves the bytes under a
temporary name, and `finish_interrupted` gives them their name.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from realsim.errors import InputError
from realsim.store import atomic

NAME = "manifest.jsonl"
CHECK = "check"
CHECK_DIGITS = 16
"""A damaged line of the list must not make a sound file look damaged: every line has a checksum."""
SHOWN = 80
"""Characters of a damaged line that a message shows."""
REMOVED = -1
"""The size that a line gives when its file was taken away."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """What a complete file looked like."""

    path: str
    """Relative to the session, with forward slashes."""
    sha256: str
    bytes: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Fault:
    """A file that is not what the manifest says."""

    path: str
    kind: Literal["missing", "changed"]
    found: str
    """What is there instead, for a message."""


def entry_of(path: str, data: bytes) -> Entry:
    """Return the entry of a file with these bytes."""
    return Entry(path=path, sha256=hashlib.sha256(data).hexdigest(), bytes=len(data))


def line_of(entry: Entry) -> str:
    """Return the manifest's line of an entry, with a checksum of the line itself."""
    body = json.dumps({"path": entry.path, "sha256": entry.sha256, "bytes": entry.bytes})
    return f'{body[:-1]}, "{CHECK}": "{_check_of(body)}"}}'


def _check_of(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()[:CHECK_DIGITS]


def entry_from(line: str) -> Entry:
    """Return the entry of a manifest's line.

    Raises:
        ValueError: it is none, or not the line that was written.
    """
    try:
        record: dict[str, Any] = json.loads(line)
        check = record.pop(CHECK, None)
        entry = Entry(
            path=str(record["path"]), sha256=str(record["sha256"]), bytes=int(record["bytes"])
        )
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"is not a manifest entry ({line[:SHOWN]!r})") from error
    if check is not None and check != _check_of(json.dumps(record)):
        raise ValueError(f"has another checksum than was written ({line[:SHOWN]!r})")
    return entry


def take(entries: dict[str, Entry], entry: Entry) -> None:
    """Put the entry of a line into those of the lines before it; some lines remove one."""
    if entry.bytes == REMOVED:
        entries.pop(entry.path, None)
    else:
        entries[entry.path] = entry


def fault_of(folder: Path, entry: Entry) -> Fault | None:
    """Return what is wrong with a listed file; None if it has the bytes that were written."""
    file = folder / entry.path
    if not file.is_file():
        return Fault(path=entry.path, kind="missing", found="no file")
    data = file.read_bytes()
    if entry_of(entry.path, data) == entry:
        return None
    found = f"{len(data)} bytes instead of {entry.bytes}"
    if len(data) == entry.bytes:
        found = f"{len(data)} bytes with another checksum"
    return Fault(path=entry.path, kind="changed", found=found)


def size_fault_of(folder: Path, entry: Entry) -> Fault | None:
    """Return what existence and size alone show to be wrong with a listed file."""
    try:
        size = (folder / entry.path).stat().st_size
    except OSError:
        return Fault(path=entry.path, kind="missing", found="no file")
    if size == entry.bytes:
        return None
    found = f"{size} bytes instead of {entry.bytes}"
    return Fault(path=entry.path, kind="changed", found=found)


class Manifest:
    """The manifest of one folder."""

    def __init__(self, folder: Path) -> None:
        """Read the manifest of the folder and repair a torn last line.

        Raises:
            InputError: a line is no entry.
        """
        self._folder = folder
        self._due: list[Entry] = []
        self._file = folder / NAME
        atomic.repair_lines(self._file)
        self._entries: dict[str, Entry] = {}
        for number, line in enumerate(atomic.complete_lines(self._file), start=1):
            try:
                take(self._entries, entry_from(line))
            except ValueError as error:
                raise InputError(
                    f"{self._file}, line {number} {error}. "
                    "`realsim check --repair` on the session takes the line out; its file is then "
                    "listed anew."
                ) from error

    @property
    def entries(self) -> dict[str, Entry]:
        """The last entry of every path."""
        return dict(self._entries)

    def __contains__(self, path: str) -> bool:
        """Return whether the path is listed."""
        return path in self._entries

    def add(self, entries: Iterable[Entry]) -> None:
        """Append entries of files that are complete, in one write."""
        new = [*self._due, *entries]
        if new:
            atomic.append_line(self._file, "\n".join(line_of(e) for e in new))
            self._entries.update({e.path: e for e in new})
            self._due = []

    def add_sealed(self, entries: Iterable[Entry]) -> None:
        """Append entries of files that count already: what a full disk refuses now comes later."""
        self._due = [*self._due, *entries]
        self.add(())

    def remove(self, path: str) -> None:
        """Take a file off the list and away; one that is not there is no error.

        In this order: after a kill in between, nothing that is listed is missing.
        """
        self.forget(path)
        (self._folder / path).unlink(missing_ok=True)

    def forget(self, *paths: str) -> None:
        """Take paths off the list; the files stay."""
        gone = [Entry(path=p, sha256="", bytes=REMOVED) for p in paths if p in self._entries]
        if gone:
            atomic.append_line(self._file, "\n".join(line_of(e) for e in gone))
            for entry in gone:
                del self._entries[entry.path]

    def write(self, path: str, data: bytes) -> None:
        """Write a file whole or not at all, and list it."""
        entry = entry_of(path, data)
        atomic.write_bytes(self._folder / path, data, announce=lambda: self.add([entry]))

    def write_derived(self, files: Mapping[str, bytes]) -> None:
        """Write files that can be made again from others, and list them: two lines in all.

        Each is whole or not there after a kill; when their bytes reach the disk is left to the
        system, so that a power cut may leave some that `verify` then names. Files that are replaced
        leave the list first: after a kill in between they are unlisted, not listed wrongly.
        """
        self.forget(*files)
        for path, data in files.items():
            atomic.write_bytes(self._folder / path, data, flush=False)
        self.add([entry_of(path, data) for path, data in files.items()])

    def finish_interrupted(self) -> None:
        """Give listed bytes that a kill left under a temporary name their name; delete the rest."""
        for temporary, final in atomic.leftovers(self._folder):
            path = final.relative_to(self._folder).as_posix()
            if self._entries.get(path) == entry_of(path, temporary.read_bytes()):
                os.replace(temporary, final)
            else:
                temporary.unlink(missing_ok=True)

    def is_as_written(self, path: str) -> bool:
        """Return whether a file that is there has the bytes that were listed, if any were."""
        entry = self._entries.get(path)
        if entry is None or fault_of(self._folder, entry) is None:
            return True
        now = Manifest(self._folder)._entries.get(path)  # another process may have written it since
        return now is None or (now != entry and fault_of(self._folder, now) is None)

    def verify(self) -> list[Fault]:
        """Return every listed file that is missing or has other bytes than were written."""
        faults = (fault_of(self._folder, entry) for entry in self._entries.values())
        return [fault for fault in faults if fault is not None]
