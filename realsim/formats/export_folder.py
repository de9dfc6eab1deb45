"""A folder that an export fills piece by piece, in bounded memory; gone on with after a kill.

    OUT/
      .export/asked.json       what is being written; another request is refused, not mixed in
      .export/pieces.jsonl     one line per finished piece: its files, sizes and checksums
      .export/rows/...         rows of large JSON documents, until the document is put together

A piece (a frame, a model) counts when its line is whole; its files are then on the disk under their
names. `finish` writes SHA256SUMS out of the lines and takes .export away.
"""

import contextlib
import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from realsim.errors import InputError
from realsim.store import atomic
from realsim.untrusted.own_json import read_object

STATE = ".export"
FINISHED = ".export.json"
"""The request of an export that is whole, so that asking for it again is known."""
ASKED, PIECES, ROWS = f"{STATE}/asked.json", f"{STATE}/pieces.jsonl", f"{STATE}/rows"
SUMS_FILE = "SHA256SUMS"
CONTENT = "content"
"""Key of a request: a digest of the sources, which must not change while they are exported."""
CHUNK = 1 << 20
"""[bytes] read at a time when a file is copied."""

Content = bytes | Path
"""What a file holds: its bytes, or another file to copy."""


class ExportFolder:
    """A folder being filled; made by `begin`."""

    def __init__(
        self, folder: Path, asked: Mapping[str, Any], done: set[str], resumed: bool
    ) -> None:
        """Take over a folder; see `begin`."""
        self.folder = folder
        self.asked = dict(asked)
        self.resumed = resumed
        """Whether an interrupted export is gone on with."""
        self._done = done
        self._prefix = ""
        self._mended: set[Path] = set()

    @staticmethod
    def is_finished(folder: Path | str, asked: Mapping[str, Any]) -> bool:
        """Return whether a folder holds the finished export of this very request."""
        try:
            return ExportFolder.is_whole(folder) and (
                read_object(Path(folder) / FINISHED) == _request(asked)
            )
        except InputError:
            return False

    @staticmethod
    def is_whole(folder: Path | str) -> bool:
        """Return whether a folder holds a finished export."""
        return (Path(folder) / FINISHED).is_file() and not (Path(folder) / ASKED).is_file()

    def below(self, relative: str) -> "ExportFolder":
        """Return a folder of this export as a writer sees it that fills a folder of its own."""
        inner = ExportFolder(self.folder, self.asked, self._done, resumed=self.resumed)
        inner._prefix, inner._mended = f"{self._prefix}{_inside(relative)}/", self._mended
        return inner

    @classmethod
    def begin(cls, folder: Path | str, asked: Mapping[str, Any]) -> "ExportFolder":
        """Begin an export, or go on with one of the same request.

        Args:
            folder: a new or empty folder, or one that the same request has begun to fill.
            asked: plain JSON values that say what is exported and how, without `folder` itself.

        Raises:
            InputError: the folder is a file, holds something else, or another export.
        """
        folder = Path(folder)
        if folder.exists() and not folder.is_dir():
            raise InputError(f"'{folder}' is a file; give a folder that may be made or filled.")
        path = folder / ASKED
        if path.is_file():
            _require_same(read_object(path), asked, folder)
            atomic.repair_lines(folder / PIECES)
            for left, _ in atomic.leftovers(folder):
                left.unlink()
            done = {str(json.loads(line)["piece"]) for line in _lines(folder / PIECES)}
            return cls(folder, asked, done, resumed=True)
        if (folder / FINISHED).is_file():
            raise InputError(
                f"'{folder}' holds a finished export, of another request or of sources as they "
                "were before they changed. It is not mixed with this one: give a new folder, or "
                "delete that one first."
            )
        if folder.is_dir() and any(p.name != STATE for p in folder.iterdir()):
            raise InputError(
                f"'{folder}' is not empty; what is there would be mixed with the export. Give a "
                "new folder."
            )
        atomic.write_json(path, dict(asked))
        return cls(folder, asked, set(), resumed=False)

    @property
    def place(self) -> Path:
        """The folder that a writer fills."""
        return self.folder / self._prefix

    def has(self, piece: str) -> bool:
        """Return whether a piece is there."""
        return f"{self._prefix}{piece}" in self._done

    def write_piece(
        self,
        piece: str,
        files: Mapping[str, Content],
        rows: Mapping[str, tuple[str, Any]] | None = None,
    ) -> None:
        """Write the files of a piece, then its line.

        Args:
            piece: name of the piece; one that is there is not written again.
            files: path in the folder -> bytes, or a file to copy.
            rows: document -> (key, value) to be added to it; see `rows`.

        Raises:
            InputError: a path leads out of the folder.
            StorageError: the disk is full, or refuses; earlier pieces are as they were.
        """
        if self.has(piece):
            return
        piece = self._prefix + piece
        listed: dict[str, list[Any]] = {}
        with atomic.storing(self.folder, piece):
            for relative, content in files.items():
                path = self._path(relative)
                listed[path] = self._write(path, content)
            for document, (key, value) in (rows or {}).items():
                self._append_row(document, [piece, key, value])
            self._append({"piece": piece, "files": listed})
        self._done.add(piece)

    def _path(self, relative: str) -> str:
        return self._prefix + _inside(relative)

    def _append_row(self, document: str, row: list[Any]) -> None:
        path = self.folder / ROWS / f"{self._path(document)}l"
        path.parent.mkdir(parents=True, exist_ok=True)
        # A kill may have torn the last line: the next one must not be glued to it.
        if self.resumed and path not in self._mended:
            atomic.repair_lines(path)
            self._mended.add(path)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row, allow_nan=False) + "\n")

    def rows(self, document: str) -> Iterator[tuple[str, Any]]:
        """Yield (key, value) of the rows of a document, in the order they were written.

        Rows of a piece that was interrupted, and was written again, come once.
        """
        path = self.folder / ROWS / f"{self._path(document)}l"
        seen: set[str] = set()
        for line in _lines(path):
            try:
                piece, key, value = json.loads(line)
            except ValueError:  # torn by a kill: its piece was written again
                continue
            if piece in self._done and f"{piece}\0{key}" not in seen:
                seen.add(f"{piece}\0{key}")
                yield str(key), value

    def write_document(self, relative: str, parts: Iterable[str]) -> None:
        """Write a text file of any size out of its parts, whole or not at all."""
        if self.has(f"document {relative}"):
            return
        piece, relative = f"{self._prefix}document {relative}", self._path(relative)
        with atomic.storing(self.folder, relative):
            entry = self._stream(relative, (p.encode("utf-8") for p in parts))
            self._append({"piece": piece, "files": {relative: entry}})
        self._done.add(piece)

    def write_json_object(self, relative: str) -> None:
        """Write the rows of a document as one JSON object, a line a row."""
        self.write_document(relative, _object_text(self.rows(relative)))

    def abandon(self) -> None:
        """Take away what this run wrote into a new folder: a refusal leaves no trace.

        What an earlier run wrote stays; it may be gone on with.
        """
        if self.resumed:
            return
        for line in _lines(self.folder / PIECES):
            for relative in json.loads(line)["files"]:
                (self.folder / relative).unlink(missing_ok=True)
        shutil.rmtree(self.folder / STATE, ignore_errors=True)
        for path in sorted((p for p in self.folder.rglob("*") if p.is_dir()), reverse=True):
            with contextlib.suppress(OSError):  # not empty: something that is not ours
                path.rmdir()
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def finish(self, files: Mapping[str, bytes]) -> None:
        """Write the last files (the card) and SHA256SUMS, and take the export's own notes away."""
        with atomic.storing(self.folder, "the end of the export"):
            for relative, data in files.items():
                atomic.write_bytes(self.folder / _inside(relative), data)
            self._stream(SUMS_FILE, self._sums(files))
            atomic.write_json(self.folder / FINISHED, _request(self.asked))
            (
                self.folder / ASKED
            ).unlink()  # first: with it, and without the rest, it looks unfinished
            shutil.rmtree(self.folder / STATE)

    def written(self) -> Iterator[tuple[str, int, str]]:
        """Yield path, size [bytes] and SHA-256 of every file of the pieces that are there."""
        for line in _lines(self.folder / PIECES):
            for relative, (size, digest) in json.loads(line)["files"].items():
                yield relative, size, digest

    def _sums(self, files: Mapping[str, bytes]) -> Iterator[bytes]:
        for relative, data in files.items():
            yield f"{hashlib.sha256(data).hexdigest()}  {relative}\n".encode()
        for relative, _, digest in self.written():
            yield f"{digest}  {relative}\n".encode()

    def _append(self, entry: dict[str, Any]) -> None:
        with (self.folder / PIECES).open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def _write(self, relative: str, content: Content) -> list[Any]:
        if isinstance(content, bytes):
            atomic.write_bytes(self.folder / relative, content, flush=False)
            return [len(content), hashlib.sha256(content).hexdigest()]
        with content.open("rb") as file:
            return self._stream(relative, iter(lambda: file.read(CHUNK), b""))

    def _stream(self, relative: str, chunks: Iterable[bytes]) -> list[Any]:
        """Write a file in chunks, whole or not at all; return its size and checksum."""
        digest, size = hashlib.sha256(), 0
        with atomic.replacing(self.folder / relative, flush=False) as file:
            for chunk in chunks:
                file.write(chunk)
                digest.update(chunk)
                size += len(chunk)
        return [size, digest.hexdigest()]


def _request(asked: Mapping[str, Any]) -> dict[str, str]:
    """Return what a request is known by without telling its paths to whoever gets the export."""
    return {"request": hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()}


def _inside(relative: str) -> str:
    """Return a path that does not lead out of the folder."""
    pure = PurePosixPath(relative)
    if pure.is_absolute() or ".." in pure.parts or not pure.parts:
        raise InputError(f"'{relative}' is not a path inside the export.")
    return pure.as_posix()


def _lines(path: Path) -> Iterator[str]:
    """Yield the whole lines of a file; a torn last one is not among them."""
    if path.is_file():
        with path.open(encoding="utf-8", errors="replace") as file:
            yield from (line for line in file if line.endswith("\n"))


def _object_text(rows: Iterable[tuple[str, Any]]) -> Iterator[str]:
    yield "{\n"
    for k, (key, value) in enumerate(rows):
        yield (",\n" if k else "") + f"{json.dumps(key)}: {json.dumps(value)}"
    yield "\n}\n"


def _require_same(before: Mapping[str, Any], asked: Mapping[str, Any], folder: Path) -> None:
    now = json.loads(json.dumps(asked))
    differing = [k for k in {**before, **now} if before.get(k) != now.get(k)]
    if differing:
        k = differing[0]
        if differing == [CONTENT]:
            raise InputError(
                f"'{folder}' holds an unfinished export, and its sources have changed since it was "
                "begun: old and new frames would be mixed. Give a new folder."
            )
        raise InputError(
            f"'{folder}' holds an unfinished export of another request ({k}: {before.get(k)!r} "
            f"there, {now.get(k)!r} asked for). Run the same command again to finish it, or give a "
            "new folder."
        )
