"""Files that travel with a job: named by what they hold, sent once to a machine, brought back.

A job's arguments hold `Sent` and `Worked`; its function gets a Path in their place, and for a
`Shared` its value. On this machine the path is that of the file itself. On another, files are
addressed by the SHA-256 of their bytes, so that a machine that has one is not sent it again, and a
folder is a list of names and addresses.
"""

import hashlib
import os
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.store import atomic


class Sent:
    """A file, a folder, or bytes that become a file: only read where the job runs."""

    only: tuple[str, ...] = ()

    def __init__(
        self, source: Path | bytes, *, name: str = "sent", only: tuple[str, ...] = ()
    ) -> None:
        """Take what is sent.

        Args:
            source: what is there; a folder goes with what is in it.
            name: of the file that bytes become.
            only: patterns of the paths in a folder that are sent, such as `scene_000001/*`; none =
                everything.
        """
        self.source, self.name, self.only = source, name, only

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the bytes."""
        assert isinstance(self.source, bytes), "a file's is asked for when it is sent"
        return hashlib.sha256(self.source).hexdigest()


class Shared(Sent):
    """A value that many jobs are given: it goes to each worker once, and not with every job."""

    def __init__(self, value: Any) -> None:  # pyright: ignore[reportMissingSuperCall]
        """Take the value, which can be pickled."""
        self.value, self.name = value, "shared"

    @cached_property
    def source(self) -> bytes:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The value's bytes."""
        return pickle.dumps(self.value)


@dataclass(frozen=True, slots=True)
class Worked:
    """A folder that the job changes: here in its place, elsewhere a copy whose changes come back.

    They come back when the job has succeeded, file by file in the order in which they were written:
    what a job writes last, to say that it is done, is again the last. A job that fails or is lost
    on another machine changes nothing here.
    """

    folder: Path
    only: tuple[str, ...] = ()
    """Patterns of the paths in it that are the job's, such as `scene_000001/*`, where several jobs
    share a folder that the caller holds; none = all of it, and it is locked."""


@dataclass(frozen=True, slots=True)
class WireFile:
    """A file in a job that travels."""

    digest: str
    name: str
    is_value: bool = False
    """Whether the job is given what is pickled in it."""


@dataclass(frozen=True, slots=True)
class WireFolder:
    """A folder in a job that travels: (path in it, address) of every file."""

    name: str
    files: tuple[tuple[str, str], ...]
    is_worked: bool = False


@dataclass(frozen=True, slots=True)
class Kept:
    """A value that is kept in a file of this machine."""

    path: Path


@lru_cache(maxsize=1)
def loaded(path: Path) -> Any:
    """Return the value that is kept in a file; a worker reads it once."""
    return pickle.loads(path.read_bytes())


def replaced(value: Any, found: Callable[[Any], Any]) -> Any:
    """Return a value with whatever travels in it, in tuples, lists and dicts too, replaced."""
    if isinstance(value, Sent | Worked | WireFile | WireFolder | Kept):
        return found(value)
    if type(value) in (tuple, list):
        return type(value)(replaced(v, found) for v in value)
    if type(value) is dict:
        return {k: replaced(v, found) for k, v in value.items()}  # pyright: ignore[reportUnknownVariableType]
    return value


def here(args: tuple[Any, ...], kept: Path, *, apart: bool) -> tuple[Any, ...]:
    """Return arguments for a job on this machine: paths as they are, bytes as files in `kept`.

    Args:
        args: of the function.
        kept: folder for bytes.
        apart: whether the job runs in another process, which calls it by `called`.
    """

    def path(item: Any) -> Any:
        if isinstance(item, Shared):
            return Kept(_as_file(item, kept)) if apart else item.value
        if isinstance(item, Worked):
            return item.folder
        if not isinstance(item.source, bytes):
            return item.source
        return _as_file(item, kept)

    return replaced(args, path)


def called(fn: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """Do a job in another process of this machine."""
    return fn(*replaced(args, lambda item: loaded(item.path)))


def _as_file(item: Sent, kept: Path) -> Path:
    """Return a file of bytes that are sent; it is written once."""
    assert isinstance(item.source, bytes), "of a path there is one"
    file = kept / item.digest / item.name
    if not file.is_file():
        atomic.write_bytes(file, item.source, flush=False)
    return file


def packed(
    args: tuple[Any, ...], kept: Path
) -> tuple[tuple[Any, ...], dict[str, Path], list[Worked]]:
    """Return arguments that travel, every file that they need by address, and what comes back.

    Args:
        args: of the function.
        kept: where bytes become files.

    Raises:
        InputError: a file is not there, or two folders would come back.
    """
    needed: dict[str, Path] = {}
    worked: list[Worked] = []

    def wire(item: Any) -> WireFile | WireFolder:
        if isinstance(item, Worked):
            worked.append(item)
            return _listed(item.folder, item.only, needed, is_worked=True)
        source = item.source
        if isinstance(source, bytes):
            needed[item.digest] = _as_file(item, kept)
            return WireFile(item.digest, item.name, isinstance(item, Shared))
        if source.is_dir():
            return _listed(source, item.only, needed, is_worked=False)
        if not source.is_file():
            raise InputError(f"'{source}' is not there, and a job needs it.")
        digest = digest_of(source)
        needed[digest] = source
        return WireFile(digest, source.name)

    args = replaced(args, wire)
    if len(worked) > 1:
        raise InputError(f"a job changes one folder at most; it names {len(worked)}.")
    return args, needed, worked


def _listed(
    folder: Path, only: tuple[str, ...], needed: dict[str, Path], *, is_worked: bool
) -> WireFolder:
    """Return a folder as it travels, and add its files to those needed."""
    files: list[tuple[str, str]] = []
    for path in files_in(folder):
        inside = path.relative_to(folder).as_posix()
        if not only or any(fnmatch(inside, pattern) for pattern in only):
            digest = digest_of(path)
            needed[digest] = path
            files.append((inside, digest))
    return WireFolder(folder.resolve().name, tuple(files), is_worked)


def files_in(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder, sorted; what a killed process left half written is not among."""
    for at, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            if not name.endswith(atomic.TEMPORARY_SUFFIX):
                yield Path(at) / name


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file; of one that has not changed it is computed once."""
    status = path.stat()
    return _digest(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=100_000)
def _digest(path: Path, size: int, changed_ns: int) -> str:
    """Return the SHA-256 of a file of this size and time."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# --- what comes back ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Piece:
    """Some bytes of a file that comes back."""

    path: str
    data: bytes
    is_first: bool
    is_last: bool


class Incoming:
    """Files that come back into a folder: none is there before all have come."""

    def __init__(self, folder: Path) -> None:
        """Take the folder."""
        self._folder = folder
        self._come: list[tuple[Path, Path]] = []

    def take(self, piece: Piece) -> None:
        """Keep some bytes under a temporary name.

        Raises:
            StorageError: the disk is full, or refuses.
            InputError: the path leads out of the folder.
        """
        path = self._inside(piece.path)
        temporary = atomic.temporary(path)
        with atomic.storing(self._folder, f"'{piece.path}'"):
            if piece.is_first:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._come.append((temporary, path))
            with temporary.open("wb" if piece.is_first else "ab") as file:
                file.write(piece.data)
                if piece.is_last:
                    file.flush()
                    os.fsync(file.fileno())

    def commit(self, removed: tuple[str, ...]) -> None:
        """Give the files their names, in the order in which they came, and remove what is gone."""
        gone = [self._inside(name) for name in removed]
        with atomic.storing(self._folder, "what a job brought back"):
            for temporary, path in self._come:
                os.replace(temporary, path)
            self._come.clear()
            for path in gone:
                path.unlink(missing_ok=True)

    def drop(self) -> None:
        """Remove what has come."""
        for temporary, _ in self._come:
            temporary.unlink(missing_ok=True)
        self._come.clear()

    def _inside(self, name: str) -> Path:
        """Return a path of the folder."""
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise InputError(f"a job's result is named '{name}', which leads out of its folder.")
        return self._folder / name
