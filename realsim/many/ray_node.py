"""What runs on a machine of a cluster: a job, its files by hash, and what it changed going back."""

import errno
import hashlib
import os
import pickle
import shutil
import socket
import tempfile
from collections.abc import Callable, Generator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim.many.carried import Piece, WireFile, WireFolder, files_in, loaded, replaced
from realsim.store import atomic
from realsim.store.atomic import StorageError

PIECE_BYTES = 8_000_000
"""Size of a returned file's pieces [bytes]: a machine never holds more of it in memory."""
KEPT_PREFIX = "realsim_many_"

Fetch = Callable[[str], bytes]
"""Returns a file's bytes by its address."""


@dataclass(frozen=True, slots=True)
class Ended:
    """How a job ended."""

    value: Any = None
    error: Exception | None = None
    full: str = ""
    """Why this machine cannot do jobs now: its disk is full."""
    removed: tuple[str, ...] = ()
    """Files that the job removed from the folder that it changed."""


def work(run: str, job: bytes, fetch: Fetch) -> Generator[bytes]:
    """Do a job and yield, pickled, the pieces of what it changed, and then how it ended.

    Args:
        run: names the folder where files of this run are kept on this machine.
        job: the pickled function and its arguments.
        fetch: gets a file that is not there yet.
    """
    from threadpoolctl import threadpool_limits

    try:
        fn, args = pickle.loads(job)
        kept = _Kept(kept_folder(run), fetch)
        with tempfile.TemporaryDirectory(prefix="job_", dir=kept.folder) as own:
            args, worked = kept.placed(args, Path(own))
            before = {} if worked is None else _state(worked)
            with threadpool_limits(1):
                value = fn(*args)
            removed: tuple[str, ...] = ()
            if worked is not None:
                after = _state(worked)
                removed = tuple(sorted(set(before) - set(after)))
                yield from _changed(worked, before, after)
        yield _pickled(Ended(value=value, removed=removed))
    except (OSError, StorageError) as error:
        cause = error.__cause__ if isinstance(error, StorageError) else error
        if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
            yield _pickled(Ended(full=f"the disk of {socket.gethostname()} is full: {error}"))
        else:
            yield _pickled(Ended(error=error))
    except Exception as error:
        yield _pickled(Ended(error=error))


def _pickled(ended: Ended) -> bytes:
    """Return how a job ended as bytes; an error that cannot travel goes as its text."""
    try:
        data = pickle.dumps(ended)
        if ended.error is not None:
            pickle.loads(data)  # some errors can be pickled, but not read again
    except Exception as error:
        told = ended.error or error
        data = pickle.dumps(Ended(error=RuntimeError(f"{type(told).__name__}: {told}")))
    return data


def kept_folder(run: str) -> Path:
    """Return the folder of a run's files on this machine, which is this user's alone.

    Raises:
        PermissionError: somebody else has made it.
    """
    folder = Path(tempfile.gettempdir()) / f"{KEPT_PREFIX}{os.getuid()}_{run}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise PermissionError(errno.EPERM, "somebody else has made it", str(folder))
    return folder


def forget(run: str) -> None:
    """Remove the files of a run from this machine."""
    shutil.rmtree(kept_folder(run), ignore_errors=True)


class _Kept:
    """Files on this machine, by hash."""

    def __init__(self, folder: Path, fetch: Fetch) -> None:
        self.folder, self._fetch = folder, fetch

    def file(self, digest: str) -> Path:
        """Return the file of an address; it is got where it is not there.

        Raises:
            OSError: what came is not what was named.
        """
        path = self.folder / digest
        if not path.is_file():
            data = self._fetch(digest)
            if hashlib.sha256(data).hexdigest() != digest:
                raise OSError(errno.EIO, "a file changed while it was sent; run it again", digest)
            atomic.write_bytes(path, data, flush=False)
        return path

    def placed(self, args: tuple[Any, ...], own: Path) -> tuple[tuple[Any, ...], Path | None]:
        """Return arguments with paths, and the folder that is changed, if there is one."""
        worked: list[Path] = []

        def path(item: WireFile | WireFolder) -> Any:
            if isinstance(item, WireFile):
                if item.is_value:
                    return loaded(self.file(item.digest))
                return self._linked(self.folder / "named" / item.digest, item.name, item.digest)
            if item.is_worked:
                worked.append(self._copied(item, own / item.name))
                return worked[-1]
            # Named by what is in it: the next job finds it again.
            listing = hashlib.sha256(repr(item.files).encode()).hexdigest()
            folder = self.folder / "folders" / listing / item.name
            folder.mkdir(parents=True, exist_ok=True)
            for name, digest in item.files:
                self._linked((folder / name).parent, Path(name).name, digest)
            return folder

        return replaced(args, path), (worked or [None])[0]

    def _linked(self, folder: Path, name: str, digest: str) -> Path:
        """Return a second name of a file that is only read."""
        path = folder / name
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            source = self.file(digest)
            with suppress(FileExistsError):  # another worker of this machine was quicker
                os.link(source, path)
        return path

    def _copied(self, item: WireFolder, folder: Path) -> Path:
        """Return a copy that the job may change."""
        folder.mkdir(parents=True)
        for name, digest in item.files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.file(digest), folder / name)
        return folder


State = Mapping[str, tuple[int, int, int]]
"""Size, time of the last change [ns] and inode of every file in a folder, by path."""


def _state(folder: Path) -> State:
    """Return what tells a changed file."""
    found = ((path.relative_to(folder).as_posix(), path.stat()) for path in files_in(folder))
    return {name: (s.st_size, s.st_mtime_ns, s.st_ino) for name, s in found}


def _changed(folder: Path, before: State, after: State) -> Generator[bytes]:
    """Yield the files that a job wrote, in the order in which it did, in pieces."""
    changed = [name for name in after if after[name] != before.get(name)]
    for name in sorted(changed, key=lambda n: after[n][1]):
        with (folder / name).open("rb") as file:
            data, is_first, is_last = file.read(PIECE_BYTES), True, False
            while not is_last:
                following = file.read(PIECE_BYTES)
                is_last = not following
                yield pickle.dumps(Piece(name, data, is_first, is_last))
                data, is_first = following, False
