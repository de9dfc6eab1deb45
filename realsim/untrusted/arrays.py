"""Arrays in .npy and .npz: numbers, texts if wanted; what a header claims has to be there.

Layout of .npy: numpy.lib.format. A header of 80 bytes can claim terabytes, name a dtype that
unpickles objects, or be a text that takes Python's parser down; an .npz is a zip, which can unfold
a thousandfold. So the header is read on its own, and compared with the bytes that follow it.
"""

import math
import warnings
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.untrusted.archives import opened_zip
from realsim.untrusted.files import file_bytes

MOST_BYTES = 1e9
"""Largest array, and the sum of the arrays of one archive [bytes, unpacked]."""
MOST_HEADER = 4096
"""Bytes of one .npy header; plain numbers need 128."""
MOST_LETTERS = 10_000
"""Characters of the texts of one array."""
MOST_AXES, MOST_NUMBERS = 32, 1 << 48
CHUNK = 1 << 22
"""Bytes unpacked at a time."""


def read_npy(path: Path | str, *, most_bytes: float = MOST_BYTES) -> NDArray[Any]:
    """Return the array of a .npy file: booleans, whole numbers or floats of native byte order.

    Args:
        path: the file.
        most_bytes: largest file that is read [bytes].

    Raises:
        InputError: it is missing, too large, no .npy, of texts or objects, or of another length
            than its header says.
    """
    path = Path(path)
    size = file_bytes(path, most_bytes)
    try:
        with path.open("rb") as file:
            return _array(file, size, str(path))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error}).") from error


def read_npz(
    path: Path | str,
    names: Collection[str] | None = None,
    *,
    most_bytes: float = MOST_BYTES,
    texts: bool = False,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a .npz file by name.

    Args:
        path: the file.
        names: the arrays that are read, others are not even unpacked; None = all.
        most_bytes: largest sum of the arrays [bytes, unpacked].
        texts: whether arrays of texts are read as well.

    Raises:
        InputError: it is missing, no zip, an array is missing, too large or damaged, or as
            `read_npy`.
    """
    path = Path(path)
    with opened_zip(path, most_bytes) as (archive, members):
        there = {name.removesuffix(".npy"): info for name, info in members.items()}
        if len(there) < len(members):
            raise InputError(f"{path} holds two arrays of one name.")
        lacking = sorted(set(names or ()) - set(there))
        if lacking:
            raise InputError(
                f"{path} has no array '{lacking[0]}'; it holds {', '.join(there) or 'nothing'}."
            )
        wanted = [name for name in there if names is None or name in names]
        total = sum(there[name].file_size for name in wanted)
        if total > most_bytes:
            raise InputError(
                f"{path} unpacks to {total / 1e6:.1f} MB; at most {most_bytes / 1e6:g} MB are read."
            )
        found: dict[str, NDArray[Any]] = {}
        for name in wanted:
            where = f"'{name}' of {path}"
            try:
                with archive.open(there[name]) as file:
                    found[name] = _array(file, there[name].file_size, where, texts)
            except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError) as e:
                raise InputError(f"{where} is damaged ({e}). Copy the file again.") from e
            except (RuntimeError, ValueError) as e:
                raise InputError(f"{where} cannot be unpacked ({e}).") from e
        return found


def _array(file: IO[bytes], size: int, where: str, texts: bool = False) -> NDArray[Any]:
    """Return the array of an open file of `size` bytes."""
    shape, fortran, dtype = read_header(file, where, texts)
    count = math.prod(shape)
    expected = count * dtype.itemsize
    left = size - file.tell()
    if expected != left:
        raise InputError(
            f"{where}: the header says {'x'.join(map(str, shape)) or 'one'} {dtype} = {expected} "
            f"bytes, {left} are there. The file is damaged or was cut off; copy it again."
        )
    try:
        data = np.empty(expected, dtype=np.uint8)
    except (MemoryError, ValueError) as error:
        raise InputError(f"{where} has {expected / 1e6:.0f} MB; there is no memory.") from error
    view, at = memoryview(cast("Any", data)), 0
    while at < expected:
        piece = file.read(min(CHUNK, expected - at))
        if not piece:
            raise InputError(f"{where} ends after {at} of {expected} bytes; copy it again.")
        view[at : at + len(piece)] = piece
        at += len(piece)
    if file.read(1):  # the end of a member of an archive is where its checksum is looked at
        raise InputError(f"{where} has more bytes than its header says.")
    array = data.view(dtype) if expected else np.empty(count, dtype=dtype)
    native = array.astype(dtype.newbyteorder("="), copy=False)
    return native.reshape(shape, order="F" if fortran else "C")


def read_header(
    file: IO[bytes], where: str, texts: bool = False
) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order and type of the array.

    Raises:
        InputError: it is no header, or one of something else than numbers.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of strange types, and of headers of Python 2
            version = npy.read_magic(file)
            read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
            if version not in read:
                raise ValueError(f"version {version[0]}.{version[1]} is not known")
            _require_short(file, 2 if version == (1, 0) else 4)
            shape, fortran, dtype = read[version](file, max_header_size=MOST_HEADER)
    except Exception as error:  # numpy passes on whatever Python's parser trips over
        raise InputError(
            f"{where} is not a numpy array ({type(error).__name__}: {str(error)[:200]})."
        ) from error
    is_text = texts and dtype.kind == "U" and dtype.itemsize <= 4 * MOST_LETTERS
    is_number = dtype.kind in "biuf" and dtype.itemsize <= 8
    if not (is_number or is_text) or dtype.subdtype is not None:
        raise InputError(
            f"{where} is an array of '{dtype}'; only numbers of up to 64 bits are read, never "
            "objects: they would run a program that the file brings."
        )
    is_odd = any(isinstance(n, bool) or n < 0 for n in shape)
    # Also of an array without numbers: numpy multiplies the other axes all the same.
    if is_odd or len(shape) > MOST_AXES or math.prod(max(n, 1) for n in shape) > MOST_NUMBERS:
        raise InputError(f"{where} claims the shape {str(shape)[:80]}; no array has it.")
    return shape, fortran, dtype


def _require_short(file: IO[bytes], width: int) -> None:
    """Refuse a header that claims gigabytes, and go back to its beginning."""
    at = file.tell()
    length = int.from_bytes(file.read(width), "little")
    if length > MOST_HEADER:
        raise ValueError(f"its header claims {length} bytes")
    file.seek(at)
