"""The arrays of an npz file row by row: GraspNet's labels are larger unpacked than memory allows.

What a header claims is compared with what the archive says it has, before anything is read. Only
plain numbers in C order are read, never a pickle.
"""

import math
import struct
import zipfile
import zlib
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.store import atomic
from realsim.untrusted.archives import opened_zip
from realsim.untrusted.arrays import read_header

_DAMAGE = (
    OSError, EOFError, ValueError, RuntimeError, KeyError, TypeError, IndexError, OverflowError,
    MemoryError, struct.error, zlib.error, zipfile.BadZipFile,
)  # fmt: skip
"""What zipfile and zlib raise on damaged files."""
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Written as every member's time, so that the same arrays are the same bytes."""
MOST_BYTES = 4e9
"""Largest archive [bytes, packed]; it is never in memory as a whole."""


class NpzArray:
    """One array of an archive, read from its first row to its last."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, name: str, kinds: str) -> None:
        """Open an array.

        Args:
            path: of the archive, for messages.
            archive: opened.
            name: of the array.
            kinds: accepted kinds of numpy types, such as "f" or "bu".

        Raises:
            InputError: there is none of this name, or it is not what its header says.
        """
        self.name, self._path = name, path
        names = [i.filename.removesuffix(".npy") for i in archive.infolist()]
        if name not in names:
            raise InputError(
                f"{path} has no array '{name}'; it has: {', '.join(names[:12]) or 'none'}."
            )
        info = archive.getinfo(f"{name}.npy")
        self._file: IO[bytes] = archive.open(info)
        shape, fortran, dtype = read_header(self._file, f"'{name}' of {path}")
        self.shape: tuple[int, ...] = shape
        self.dtype: np.dtype[Any] = dtype
        if dtype.kind not in kinds or dtype.itemsize > 8 or (fortran and len(self.shape) > 1):
            raise InputError(
                f"{path}: '{name}' is of type {dtype.str}{' in column order' if fortran else ''}; "
                f"plain numbers of kind {' or '.join(kinds)} in row order are expected."
            )
        size, there = dtype.itemsize * math.prod(shape), info.file_size - self._file.tell()
        if size != there:
            raise InputError(
                f"{path}: '{name}' claims the shape {self.shape} of {dtype.str}, {size} bytes, and "
                f"the archive has {there}."
            )
        self._row_bytes = size // max(self.shape[0], 1) if self.shape else size

    def require(self, shape: tuple[int | None, ...]) -> None:
        """Check the shape; None = any length.

        Raises:
            InputError: it is another.
        """
        if len(shape) != len(self.shape) or any(
            n is not None and n != m for n, m in zip(shape, self.shape, strict=True)
        ):
            wanted = ", ".join("N" if n is None else str(n) for n in shape)
            raise InputError(
                f"{self._path}: '{self.name}' has the shape {self.shape}; ({wanted}) is expected."
            )

    def rows(self, count: int) -> NDArray[Any]:
        """Return the next `count` rows.

        Raises:
            InputError: the file ends before.
        """
        wanted = count * self._row_bytes
        data = self._file.read(wanted)
        if len(data) != wanted:
            raise InputError(f"{self._path}: '{self.name}' ends too early; the file is truncated.")
        values = np.frombuffer(data, dtype=self.dtype).reshape(count, *self.shape[1:])
        return values.astype(self.dtype.newbyteorder("="), copy=False)

    def finish(self) -> None:
        """Look at the checksum, which is at the end; all rows have been read.

        Raises:
            InputError: it is another.
        """
        if self._file.read(1):
            raise InputError(f"{self._path}: '{self.name}' has more bytes than its header says.")


@contextmanager
def opened(path: Path | str) -> Generator[zipfile.ZipFile]:
    """Open an npz archive.

    Raises:
        InputError: it does not exist, or is damaged where it is read.
    """
    path = Path(path)
    with opened_zip(path, MOST_BYTES) as (archive, _):
        try:
            yield archive
        except InputError:
            raise
        except _DAMAGE as error:
            raise InputError(
                f"{path} is no npz archive of plain arrays, or is damaged "
                f"({type(error).__name__}: {str(error)[:120]})."
            ) from error


def write_blocks(
    path: Path | str, arrays: Mapping[str, tuple[tuple[int, ...], Any, Iterator[NDArray[Any]]]]
) -> Path:
    """Write an npz archive out of blocks of rows, whole or not at all.

    Args:
        path: the npz file.
        arrays: name -> (shape, type, blocks of rows in order).

    Raises:
        StorageError: the disk is full, or refuses.
    """
    path = Path(path)
    with atomic.storing(path.parent, path.name), atomic.replacing(path, flush=True) as file:
        # Level 1: the arrays are nearly all zeros, higher levels only take longer.
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, (shape, dtype, blocks) in arrays.items():
                _write_array(archive, name, shape, np.dtype(dtype), blocks)
    return path


def _write_array(
    archive: zipfile.ZipFile,
    name: str,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    blocks: Iterator[NDArray[Any]],
) -> None:
    info = zipfile.ZipInfo(f"{name}.npy", _EPOCH)
    info.compress_type = zipfile.ZIP_DEFLATED
    with archive.open(info, "w", force_zip64=True) as member:
        header = {"descr": dtype.str, "fortran_order": False, "shape": shape}
        npy.write_array_header_1_0(member, header)
        for block in blocks:
            member.write(np.ascontiguousarray(block, dtype=dtype).tobytes())
