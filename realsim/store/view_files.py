"""The images of a view: where they are, and what they must be.

`robot.jsonl`: one line per view, each with a checksum of its own.

A view counts when its line is whole. The checksum of a line tells which view a damaged file has
lost: the others go on. Lines without one (written by other tools) are read as they are.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import images
from realsim.errors import InputError, RealsimError
from realsim.store import atomic
from realsim.store.manifest import Entry


def rgb_path(index: int) -> str:
    """Return where the colour image of a view is, relative to the session."""
    return f"rgb/{index:06d}.png"


def depth_path(index: int) -> str:
    """Return where the depth image of a view is, relative to the session."""
    return f"depth/{index:06d}.png"


def is_whole(path: Path) -> bool:
    """Return whether the file is there and can be decoded to its end."""
    try:
        images.read_image(path)
    except (OSError, RealsimError):
        return False
    return True


def check_sizes(
    index: int,
    size: tuple[int, int],
    rgb: NDArray[Any],
    depth_m: NDArray[Any] | None,
    depth_counts: NDArray[Any] | None,
) -> None:
    """Check that the images of view `index` are of the camera's size (height, width).

    Raises:
        InputError: they are not, or depth is given twice or as another type.
    """
    depth = depth_m if depth_counts is None else depth_counts
    if depth_m is not None and depth_counts is not None:
        raise InputError(f"view {index}: give depth_m or depth_counts, not both.")
    if depth_counts is not None and depth_counts.dtype != np.uint16:
        raise InputError(
            f"view {index}: depth_counts are {depth_counts.dtype}; uint16 is needed. Metres go "
            "into depth_m."
        )
    found = rgb.shape[:2] if depth is None else (*rgb.shape[:2], *depth.shape)
    if found not in (size, size + size) or rgb.ndim != 3:
        raise InputError(
            f"view {index}: colour {rgb.shape} and depth "
            f"{None if depth is None else depth.shape} do not have the camera's size {size} "
            "(height, width)."
        )


CHECK = "sha256"
"""Key of a line's checksum: of the line's JSON without this key."""
SHOWN = 80
"""Characters of a damaged line that a message shows."""


def line_of(record: dict[str, Any]) -> str:
    """Return the line of a view's record; NaN and infinity are refused."""
    body = json.dumps(record, allow_nan=False)
    check = hashlib.sha256(body.encode()).hexdigest()
    return f'{body[:-1]}, "{CHECK}": "{check}"}}'


def record_of(line: str) -> dict[str, Any]:
    """Return the record of a line, without its checksum.

    Raises:
        ValueError: the line is not a view, or not the line that was written.
    """
    try:
        record: dict[str, Any] = json.loads(line)
        check = record.pop(CHECK, None)
        known = record | {"index": int(record["index"]), "depth": bool(record["depth"])}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"is not a view ({line[:SHOWN]!r})") from error
    if check is not None and hashlib.sha256(json.dumps(record).encode()).hexdigest() != check:
        raise ValueError(f"has another checksum than was written ({line[:SHOWN]!r})")
    return known


class RobotLines:
    """The lines of one session, in memory and on disk."""

    def __init__(self, path: Path) -> None:
        """Read the whole lines; a torn last one is not among them.

        Raises:
            InputError: a line is damaged.
        """
        self._path = path
        self.records: dict[int, dict[str, Any]] = {}
        """The records by view number; the last line of a view wins."""
        for number, line in enumerate(atomic.complete_lines(path), start=1):
            try:
                record = record_of(line)
            except ValueError as error:
                raise InputError(
                    f"{path}, line {number} {error}. `realsim check --repair` on the session takes "
                    "the line out: its view is then captured again."
                ) from error
            self.records[record["index"]] = record
        self._read_digest()

    def _read_digest(self) -> None:
        data = self._path.read_bytes() if self._path.is_file() else b""
        self._digest, self._size = hashlib.sha256(data), len(data)

    def append(self, record: dict[str, Any]) -> None:
        """Append a view's line and flush it to the disk: from here on the view counts."""
        line = line_of(record)
        atomic.append_line(self._path, line)
        self.records[int(record["index"])] = record
        data = (line + "\n").encode()
        self._digest.update(data)
        self._size += len(data)

    def entry(self, name: str) -> Entry:
        """Return the manifest's entry of the file, without reading it again."""
        if self._path.stat().st_size != self._size:  # somebody else wrote, too
            self._read_digest()
        return Entry(path=name, sha256=self._digest.hexdigest(), bytes=self._size)
