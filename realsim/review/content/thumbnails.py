"""Small photographs of the views, kept beside the session so that it opens quickly again.

SESSION/review/thumbnails/000012.jpg is an ordinary JPEG with a line after its end that says of
which photograph it was made, how, and its own checksum. One that is damaged, or of a photograph,
size or quality that is not asked for, is made anew. The folder can be deleted at any time.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from realsim.arrays import UInt8
from realsim.errors import InputError
from realsim.images import resized
from realsim.pages.pictures import jpeg_bytes
from realsim.review.content import quick_png
from realsim.store import SessionStore, atomic
from realsim.store.manifest import Manifest
from realsim.store.session_store import rgb_path

FOLDER = "review/thumbnails"
"""Where in a session they lie."""
WAY = 1
"""Version of the way they are made: others are made anew."""
MARK = b"\nrealsim "
"""Begins the line after the JPEG."""
JPEG_END = b"\xff\xd9"


class Thumbnails:
    """The small photographs of one session: kept ones where they are sound, else new ones."""

    def __init__(self, store: SessionStore, width_px: int, quality: int) -> None:
        """Look at what is kept lazily; nothing is read yet.

        Args:
            store: the session.
            width_px: their width [px].
            quality: JPEG quality [%].
        """
        self._folder = store.path(FOLDER)
        self._photographs = {v.index: store.path(rgb_path(v.index)) for v in store.session.views}
        listed = Manifest(store.folder).entries
        self._sums = {
            i: listed[rgb_path(i)].sha256 for i in self._photographs if rgb_path(i) in listed
        }
        self._width_px, self._quality = width_px, quality
        self._made: dict[int, bytes] = {}

    def take(self, index: int, rgb: UInt8) -> None:
        """Make that of a view whose photograph (H, W, 3) is decoded anyway, if none is kept."""
        if self.kept(index) is None:
            self._make(index, rgb)

    def kept(self, index: int) -> bytes | None:
        """Return the JPEG of a view that is made or kept already; None = there is none."""
        if index in self._made:
            return self._made[index]
        found = _read(self._file(index), self._origin(index))
        if found is not None:
            self._made[index] = found
        return found

    def of(
        self,
        indices: Sequence[int],
        damaged: dict[int, str],
        progress: Callable[[int, int], None] | None = None,
    ) -> Mapping[int, bytes]:
        """Return the JPEGs of views; those that are not kept are made, and kept.

        Args:
            indices: numbers of the views.
            damaged: is given view -> why for photographs that are missing or damaged; those of
                views that stand in it already are not read.
            progress: called with how many are done, of how many.
        """
        found: dict[int, bytes] = {}
        for done, index in enumerate(indices, 1):
            try:
                jpeg = self.kept(index)
                if jpeg is None and index not in damaged:
                    jpeg = self._make(index, quick_png.read_rgb(self._photographs[index]))
                if jpeg is not None:
                    found[index] = jpeg
            except InputError as error:
                damaged[index] = str(error)
            if progress is not None:
                progress(done, len(indices))
        return found

    def _make(self, index: int, rgb: UInt8) -> bytes:
        jpeg = thumbnail(rgb, self._width_px, self._quality)
        self._made[index] = jpeg
        # A session that may not be written is shown all the same.
        with suppress(OSError):
            data = jpeg + _line(jpeg, self._origin(index))
            atomic.write_bytes(self._file(index), data, flush=False)
        return jpeg

    def _file(self, index: int) -> Path:
        return self._folder / f"{index:06d}.jpg"

    def _origin(self, index: int) -> str:
        """Return what a thumbnail depends on; a photograph that is not listed is told by itself."""
        if index not in self._sums:
            path = self._photographs[index]
            if not path.is_file():
                raise InputError(
                    f"{path} does not exist; a photograph was expected there. `realsim check` "
                    "names what else is missing."
                )
            self._sums[index] = hashlib.sha256(path.read_bytes()).hexdigest()
        return f"{self._sums[index]} {self._width_px} {self._quality} {WAY}"


def thumbnail(rgb: UInt8, width_px: int, quality: int) -> bytes:
    """Return a photograph (H, W, 3) as a small JPEG.

    Args:
        rgb: the photograph.
        width_px: width of the JPEG [px].
        quality: of the JPEG [%].
    """
    return jpeg_bytes(resized(rgb, width_px), quality)


def _line(jpeg: bytes, origin: str) -> bytes:
    """Return what stands after the JPEG."""
    said = {"of": origin, "sha256": hashlib.sha256(jpeg).hexdigest()}
    return MARK + json.dumps(said).encode() + b"\n"


def _read(path: Path, origin: str) -> bytes | None:
    """Return a kept JPEG; None = there is none, or it is not what it should be."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    end = data.rfind(MARK)
    if end < 0 or not data[:end].endswith(JPEG_END):
        return None
    jpeg = data[:end]
    return jpeg if data[end:] == _line(jpeg, origin) else None
