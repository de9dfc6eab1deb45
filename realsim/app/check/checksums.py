"""Files against the list of checksums that an export wrote beside them (SHA256SUMS)."""

import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from realsim.app.console import Console, shortened
from realsim.app.export.card import CARD_FILE
from realsim.errors import InputError
from realsim.formats.export_folder import SUMS_FILE
from realsim.store.provenance import sha256_of

ABOVE = 2
"""Folders above the given one that may hold the list: a scene of BOP stands in a split of a root,
one of GraspNet in scenes/ of it."""
LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")
"""As sha256sum writes it: 64 digits, a space, a mode and the path."""
LONGEST_LINE = 5000
"""Characters; a path has 4096 at most."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ChecksumReport:
    """How the files of a folder agree with the list of their checksums."""

    file: str
    """The list."""
    listed: int
    """Files that it lists of the folder."""
    changed: tuple[str, ...]
    """Those that hold other bytes, or cannot be read; by their paths beside the list."""
    missing: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether every listed file is as it was written."""
        return not self.changed and not self.missing

    def faults(self) -> list[str]:
        """Return one line for each file that is not as it was written."""
        return [f"{p}: the file is missing" for p in self.missing] + [
            f"{p}: other bytes than were written (SHA-256 differs)" for p in self.changed
        ]

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return asdict(self) | {"agrees": self.agrees}


def checksum_list(folder: Path) -> Path | None:
    """Return the SHA256SUMS of a folder, or of one up to two levels above that lists its files."""
    folder = folder.resolve()
    for home in (folder, *folder.parents[:ABOVE]):
        path = home / SUMS_FILE
        if path.is_file() and next(listed_sums(path, folder), None) is not None:
            return path
    return None


def check_checksums(
    path: Path, folder: Path, *, progress: Callable[[int, int], None] | None = None
) -> ChecksumReport:
    """Compare the files of a folder with a list of checksums.

    Args:
        path: the list, of this folder or of one above.
        folder: files outside it are not looked at.
        progress: called with (files done, files in all).

    Raises:
        InputError: the list is none, or names files outside its folder.
    """
    folder = folder.resolve()
    listed = list(listed_sums(path, folder))
    changed: list[str] = []
    missing: list[str] = []
    for k, (relative, digest) in enumerate(listed):
        file = path.parent / relative
        if not file.is_file():
            missing.append(relative)
        elif _digest(file) != digest:
            changed.append(relative)
        if progress is not None:
            progress(k + 1, len(listed))
    return ChecksumReport(
        file=str(path), listed=len(listed), changed=tuple(changed), missing=tuple(missing)
    )


def require_as_written(folder: Path, console: Console) -> None:
    """Refuse to call an output finished of which a file is not as it was written.

    Its card may be edited: nothing is read from it.

    Raises:
        InputError: names the files and says what to do.
    """
    faults = [f"{SUMS_FILE}: the file is missing"]
    if (folder / SUMS_FILE).is_file():
        with console.stage("checksums", folder.name) as tick:
            report = check_checksums(folder / SUMS_FILE, folder, progress=tick)
        faults = [fault for fault in report.faults() if not fault.startswith(f"{CARD_FILE}:")]
    if faults:
        raise InputError(
            f"'{folder}' holds the finished export of this very request, but files are not as they "
            f"were written: {'; '.join(shortened(faults, 5, 'and {} more'))}. Restore them, or "
            "delete that folder and run the same command again."
        )


def listed_sums(path: Path, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield (path beside the list, checksum) of every listed file below a folder."""
    prefix = folder.relative_to(path.parent.resolve()).parts
    with path.open(encoding="utf-8", errors="surrogateescape", newline="\n") as lines:
        number = 0
        while line := lines.readline(LONGEST_LINE):
            number += 1
            match = LINE.fullmatch(line.rstrip("\r\n"))
            if match is None:
                raise InputError(
                    f"line {number} of {path} is no checksum as sha256sum writes them (64 "
                    "hexadecimal digits, two spaces, a path)."
                )
            relative = PurePosixPath(match[2])
            if relative.is_absolute() or ".." in relative.parts or "\0" in match[2]:
                raise InputError(
                    f"line {number} of {path} names {match[2]!r}, which is not below its folder."
                )
            if relative.parts[: len(prefix)] == prefix:
                yield str(relative), match[1]


def _digest(file: Path) -> str:
    """Return a file's SHA-256; '' where it cannot be read."""
    try:
        return sha256_of(file)
    except OSError:
        return ""
