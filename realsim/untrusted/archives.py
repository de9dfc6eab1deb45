"""Archives of others (.zip, .tar, .tar.gz): unpacked whole or not at all, and only inside a folder.

A name can lead out of the folder ('../x', '/etc/x'), a link can make the next name lead out, and a
megabyte can unfold into terabytes. Only files and folders with plain names are unpacked.

A zip file of others, opened: each member once, plainly packed, of a size that can be true.
"""

import gzip
import os
import shutil
import stat
import struct
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Any, NamedTuple, Self

from realsim.errors import InputError
from realsim.untrusted.files import file_bytes
from realsim.untrusted.values import LONGEST_PART

MOST_DIRECTORY = 64_000_000
"""Bytes of the table of contents: 600,000 files with names of 60 letters."""
MOST_RATIO = 1033
"""What deflate packs at best: 1032 bytes into one."""
END, END_BYTES, LONGEST_REMARK = b"PK\x05\x06", 22, 65535
END_64, LOCATOR_64 = b"PK\x06\x06", b"PK\x06\x07"
IS_ENCRYPTED = 1


@contextmanager
def opened_zip(
    path: Path, most_bytes: float
) -> Generator[tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]]:
    """Open a zip file; gives it and its members by name.

    Args:
        path: the file.
        most_bytes: largest file [bytes, packed].

    Raises:
        InputError: it is missing, too large, no zip, a member is there twice, encrypted, packed
            with something rare, or claims a size that deflate cannot reach.
    """
    _require_small_directory(path, file_bytes(path, most_bytes))
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError, ValueError, EOFError, struct.error,
            NotImplementedError, OverflowError) as error:  # fmt: skip
        raise InputError(f"{path} is no zip file, or a damaged one ({error}).") from error
    with archive:
        members: dict[str, zipfile.ZipInfo] = {}
        for info in archive.infolist():
            if info.filename in members:
                raise InputError(f"{path} holds '{info.filename:.80}' twice: which one holds?")
            members[info.filename] = info
            _require_plain(info, path)
        yield archive, members


def _require_plain(info: zipfile.ZipInfo, path: Path) -> None:
    name = f"'{info.filename:.80}' of {path}"
    if info.flag_bits & IS_ENCRYPTED:
        raise InputError(f"{name} is encrypted; unpack it first.")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(
            f"{name} is packed by method {info.compress_type}; stored and deflated files are read."
        )
    packed = info.compress_size
    most = packed if info.compress_type == zipfile.ZIP_STORED else packed * MOST_RATIO
    if info.file_size > most:
        raise InputError(
            f"{name} claims {info.file_size} bytes out of {packed}; that cannot be true."
        )


def _require_small_directory(path: Path, size: int) -> None:
    """Refuse a table of contents that alone would take minutes to read."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, size - END_BYTES - LONGEST_REMARK - 20))
            tail = file.read()
            at = tail.rfind(END)
            if at < 0 or len(tail) < at + END_BYTES:
                raise InputError(f"{path} is no zip file, or it was cut off. Copy it again.")
            (length,) = struct.unpack_from("<I", tail, at + 12)
            if at >= 20 and tail[at - 20 : at - 16] == LOCATOR_64:
                (where,) = struct.unpack_from("<Q", tail, at - 20 + 8)
                if where < size:
                    file.seek(where, os.SEEK_SET)
                    record = file.read(56)
                    if len(record) == 56 and record.startswith(END_64):
                        (length,) = struct.unpack_from("<Q", record, 40)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error}).") from error
    if length > MOST_DIRECTORY:
        raise InputError(
            f"{path} has a table of contents of {length / 1e6:.0f} MB; at most "
            f"{MOST_DIRECTORY / 1e6:g} MB are read. Unpack it by hand."
        )


MOST_PACKED = 1e12
"""Largest archive [bytes]; what it unpacks to is limited by the caller."""
MOST_UNFOLDED, ALWAYS_UNFOLDED = 100, 1e8
"""Bytes out of one packed byte, and bytes that any archive may unpack to: data sets shrink by less
than ten, zeros by a thousand."""
MOST_MEMBERS = 2_000_000
MOST_HEADER_READ = 1 << 20
"""Bytes of a header that extends the next one, such as a long name; it can claim terabytes."""
DEEPEST, LONGEST_NAME = 32, 1000
CHUNK = 1 << 20
GZIP, ZIP = b"\x1f\x8b", b"PK"
TAR_MARK, TAR_MARK_AT = b"ustar", 257


class Member(NamedTuple):
    """One file of an archive."""

    name: str
    """Its path inside the archive, such as train/000001/scene_gt.json."""
    size: int
    """Bytes, unpacked."""


class _Entry(NamedTuple):
    name: str
    size: int
    is_folder: bool
    data: IO[bytes] | None


def members(path: Path | str) -> tuple[Member, ...]:
    """Return the files of an archive, in its order, without unpacking it.

    Raises:
        InputError: it is missing, no archive, damaged, or holds links or names that lead out.
    """
    path = Path(path)
    with _failures_named(path):
        return tuple(Member(e.name, e.size) for e in _entries(path, MOST_PACKED) if not e.is_folder)


def extract(path: Path | str, folder: Path | str, *, most_bytes: float) -> tuple[Path, ...]:
    """Unpack an archive into a new folder; return the files.

    The folder appears when all of it is there.

    Args:
        path: the archive.
        folder: where to; it does not exist, or is empty.
        most_bytes: largest sum of the files [bytes, unpacked].

    Raises:
        InputError: as `members`, it unpacks to more, or the folder holds something.
    """
    path, folder = Path(path), Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} is there and holds something; name a folder that is new.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    begun = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        with _failures_named(path):
            names = _unpacked(path, begun, most_bytes)
        begun.chmod(0o755)
        os.replace(begun, folder)  # an empty folder gives way
    except BaseException:
        shutil.rmtree(begun, ignore_errors=True)
        raise
    return tuple(folder / name for name in names)


def _unpacked(path: Path, folder: Path, most_bytes: float) -> list[str]:
    names: list[str] = []
    left = min(most_bytes, MOST_UNFOLDED * path.stat().st_size + ALWAYS_UNFOLDED)
    if zipfile.is_zipfile(path) and sum(m.size for m in members(path)) > left:
        raise InputError(f"{path} unpacks to more than is allowed, by its table of contents.")
    for entry in _entries(path, left):
        target = folder / entry.name
        if entry.is_folder:
            target.mkdir(parents=True, exist_ok=True)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        left -= _written(entry, target, left, path)
        names.append(entry.name)
    return names


def _written(entry: _Entry, target: Path, most: float, path: Path) -> int:
    """Write one file; return its size [bytes], which has to be the one that was claimed."""
    if entry.data is None or entry.size > most:
        raise InputError(f"{path} unpacks to more than is allowed ('{entry.name:.80}').")
    written = 0
    with target.open("xb") as out:
        while piece := entry.data.read(CHUNK):
            written += len(piece)
            if written > entry.size:
                break
            out.write(piece)
    if written != entry.size:
        raise InputError(f"'{entry.name:.80}' of {path} is not as long as the archive says.")
    return written


def _entries(path: Path, most_bytes: float) -> Iterator[_Entry]:
    """Yield what an archive holds; the data of an entry is read before the next one."""
    file_bytes(path, MOST_PACKED)
    with path.open("rb") as file:
        head = file.read(TAR_MARK_AT + len(TAR_MARK))
    if head.startswith(ZIP):
        entries = _zip_entries(path)
    elif head.startswith(GZIP) or head[TAR_MARK_AT:] == TAR_MARK:
        entries = _tar_entries(path, head.startswith(GZIP), most_bytes)
    else:
        raise InputError(
            f"{path} is no archive that is read: .zip, .tar and .tar.gz are. Unpack it by hand."
        )
    seen: set[str] = set()
    for entry in entries:
        name = _plain_name(entry.name, path)
        if not entry.is_folder:
            if name in seen:
                raise InputError(f"{path} holds '{name:.80}' twice: which one holds?")
            seen.add(name)
        if len(seen) > MOST_MEMBERS:
            raise InputError(f"{path} holds more than {MOST_MEMBERS} files.")
        yield entry._replace(name=name)


def _plain_name(name: str, path: Path) -> str:
    """Return a name that stays inside."""
    parts = PurePosixPath(name)
    wrong = (
        parts.is_absolute() or ".." in parts.parts or "\\" in name or not name.isprintable()
        or name[1:2] == ":" or len(parts.parts) > DEEPEST or len(name) > LONGEST_NAME
        or any(len(os.fsencode(part)) > LONGEST_PART for part in parts.parts) or not name
    )  # fmt: skip
    if wrong:
        raise InputError(
            f"{path} holds a file named {name[:80]!r}: absolute names, '..' and characters that "
            "cannot be printed are not unpacked. It was not made by a program that means well."
        )
    return parts.as_posix()


def _zip_entries(path: Path) -> Iterator[_Entry]:
    with opened_zip(path, MOST_PACKED) as (archive, infos):
        for name, info in infos.items():
            mode = info.external_attr >> 16
            if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise InputError(f"{path} holds '{name:.80}', a link or a device; files are read.")
            if info.is_dir():
                yield _Entry(name, 0, True, None)
                continue
            with archive.open(info) as data:
                yield _Entry(name, info.file_size, False, data)


def _tar_entries(path: Path, is_packed: bool, most_bytes: float) -> Iterator[_Entry]:
    # As a stream: a header can say that the next one lies before it, and then it never ends.
    with path.open("rb") as raw:
        source: Any = gzip.GzipFile(fileobj=raw) if is_packed else raw
        room = most_bytes if is_packed else MOST_PACKED
        bounded: Any = _Bounded(source, 2 * room + 1e8, path)
        with tarfile.open(
            fileobj=bounded, mode="r|", errorlevel=2, tarinfo=_BoundedHeader
        ) as archive:
            listed: Any = archive
            while (info := archive.next()) is not None:
                if info.isdir():
                    yield _Entry(info.name, 0, True, None)
                elif info.isreg() and not info.issparse():
                    yield _Entry(info.name, info.size, False, archive.extractfile(info))
                else:
                    raise InputError(
                        f"{path} holds '{info.name:.80}', a link, a device or a file with holes; "
                        "plain files are read."
                    )
                # tarfile keeps every header; a million of them is a gigabyte.
                listed.members.clear()


class _BoundedHeader(tarfile.TarInfo):
    """A header of a tar file; those that extend the next one are read into memory as a whole."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str | None, errors: str) -> Self:
        header = super().frombuf(buf, encoding, errors)  # pyright: ignore[reportArgumentType]
        if header.type not in tarfile.REGULAR_TYPES and header.size > MOST_HEADER_READ:
            raise InputError(f"a header of the archive claims {header.size} bytes.")
        return header


class _Bounded:
    """A stream that ends with an error where it gives more than can be meant."""

    def __init__(self, source: Any, most: float, path: Path) -> None:
        self._source, self._left, self._path = source, most, path

    def read(self, count: int = -1) -> bytes:
        data = self._source.read(count)
        self._left -= len(data)
        if self._left < 0:
            raise InputError(f"{self._path} unpacks to more than is allowed.")
        return data


@contextmanager
def _failures_named(path: Path) -> Generator[None]:
    """Turn what the archive libraries raise into the error that names the archive."""
    try:
        yield
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error
    except (
        tarfile.TarError, zipfile.BadZipFile, zlib.error, EOFError, ValueError, OSError,
        RuntimeError, NotImplementedError, LookupError, MemoryError, OverflowError,
    ) as error:  # fmt: skip
        raise InputError(
            f"{path} is damaged or cannot be unpacked ({type(error).__name__}: {str(error)[:200]})."
        ) from error
