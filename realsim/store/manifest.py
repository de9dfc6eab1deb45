"""The list of a session's files with their checksums: `manifest.jsonl`.

One line {"path", "sha256", "bytes"} is appended when a file's bytes are complete on the disk; the
last line of a path wins. A line torn by a kill is cut off when the manifest is next opened. A file
gets its name right after its line: a kill between the two leaves the bytes under a temporary name,
and `finish_interrupted` gives them their name.
"""

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from realsim.errors import InputError
from realsim.store import atomic

NAME = "manifest.jsonl"
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


class Manifest:
    """The manifest of one folder."""

    def __init__(self, folder: Path) -> None:
        """Read the manifest of the folder and repair a torn last line."""
        self._folder = folder
        self._file = folder / NAME
        atomic.repair_lines(self._file)
        self._entries: dict[str, Entry] = {}
        for number, line in enumerate(atomic.complete_lines(self._file), start=1):
            entry = self._parsed(line, number)
            if entry.bytes == REMOVED:
                self._entries.pop(entry.path, None)
            else:
                self._entries[entry.path] = entry

    def _parsed(self, line: str, number: int) -> Entry:
        try:
            record: dict[str, Any] = json.loads(line)
            return Entry(
                path=str(record["path"]), sha256=str(record["sha256"]), bytes=int(record["bytes"])
            )
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{self._file}, line {number} is not a manifest entry ({line[:80]!r}). Lines with "
                "path, sha256 and bytes are expected; delete the line to go on without that check."
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
        new = list(entries)
        lines = [json.dumps({"path": e.path, "sha256": e.sha256, "bytes": e.bytes}) for e in new]
        if lines:
            atomic.append_line(self._file, "\n".join(lines))
            self._entries.update({e.path: e for e in new})

    def remove(self, path: str) -> None:
        """Take a file away and off the list; one that is not there is no error."""
        (self._folder / path).unlink(missing_ok=True)
        if path in self._entries:
            line = json.dumps({"path": path, "sha256": "", "bytes": REMOVED})
            atomic.append_line(self._file, line)
            del self._entries[path]

    def write(self, path: str, data: bytes) -> None:
        """Write a file whole or not at all, and list it."""
        entry = entry_of(path, data)
        atomic.write_bytes(self._folder / path, data, announce=lambda: self.add([entry]))

    def finish_interrupted(self) -> None:
        """Give listed bytes that a kill left under a temporary name their name; delete the rest."""
        for temporary, final in atomic.leftovers(self._folder):
            path = final.relative_to(self._folder).as_posix()
            if self._entries.get(path) == entry_of(path, temporary.read_bytes()):
                os.replace(temporary, final)
            else:
                temporary.unlink(missing_ok=True)

    def verify(self) -> list[Fault]:
        """Return every listed file that is missing or has other bytes than were written."""
        faults: list[Fault] = []
        for path, entry in self._entries.items():
            file = self._folder / path
            if not file.is_file():
                faults.append(Fault(path=path, kind="missing", found="no file"))
                continue
            data = file.read_bytes()
            if entry_of(path, data) != entry:
                found = f"{len(data)} bytes instead of {entry.bytes}"
                if len(data) == entry.bytes:
                    found = f"{len(data)} bytes with another checksum"
                faults.append(Fault(path=path, kind="changed", found=found))
        return faults
