"""A zip file of others, opened: each member once, plainly packed, of a size that can be true."""

import os
import struct
import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from realsim.errors import InputError
from realsim.untrusted.files import file_bytes

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
