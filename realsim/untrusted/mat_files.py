"""MATLAB's .mat files of others, version 5 (also '7'): real arrays of numbers, nothing else.

scipy reads them. It allocates what a compressed variable unfolds to, so each is unpacked here
first, up to a limit; then no claim can be larger than the bytes that are there. The layout of the
elements is of "MAT-File Format" (The MathWorks), chapter 1.
"""

import io
import struct
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.untrusted.files import checked_bytes

MOST_BYTES = 100e6
"""Largest file, and the sum of what its variables unpack to [bytes]; GraspNet's have 1 kB."""
HEADER_BYTES, VERSION_AT, VERSION = 128, 124, 0x0100
HDF5_AT, HDF5 = (0, 512), b"\x89HDF"
MI_MATRIX, MI_COMPRESSED = 14, 15
KINDS = {"double": "f8", "single": "f4", "logical": "b1"} | {
    f"{sign}int{bits}": f"{sign or 'i'}{bits // 8}"
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
}
"""scipy's name of a variable's class -> its numbers, however small they are stored."""
MOST_VARIABLES = 10_000


def read_mat(
    path: Path | str, names: Collection[str], *, most_bytes: float = MOST_BYTES
) -> dict[str, NDArray[Any]]:
    """Return arrays of a .mat file by name, of native byte order, with MATLAB's shapes (>= 2 axes).

    Args:
        path: the file.
        names: the variables that are read; others may be anything.
        most_bytes: largest file, and sum of what its variables unpack to [bytes].

    Raises:
        InputError: it is missing, too large, of another version, damaged, a variable is missing,
            is there twice, or is no real array of numbers.
    """
    from scipy.io import loadmat, whosmat

    path = Path(path)
    data = checked_bytes(path, most_bytes)
    order = _byte_order(data, path)
    try:
        plain = _unpacked(data, order, int(most_bytes))
        there: list[tuple[str, tuple[int, ...], str]] = whosmat(io.BytesIO(plain))
        kinds = {name: kind for name, _, kind in there}
        for name in sorted(names):
            if name not in kinds:
                held = ", ".join(map(repr, kinds)) or "nothing"
                raise InputError(f"{path} has no variable '{name}'; it holds {held:.500}.")
            if [known for known, _, _ in there].count(name) > 1:
                raise ValueError(f"the variable '{name:.60}' is there twice")
            if kinds[name] not in KINDS:
                raise ValueError(f"the variable '{name:.60}' is {kinds[name]}, not numbers")
        found = loadmat(io.BytesIO(plain), variable_names=list(names))
        for name in names:
            if np.iscomplexobj(found[name]):
                raise ValueError(f"the variable '{name:.60}' is complex")
        return {name: np.asarray(found[name]).astype(KINDS[kinds[name]]) for name in names}
    except InputError:
        raise
    except Exception as error:  # scipy passes on whatever a damaged file trips it over
        raise InputError(
            f"{path} is not a .mat file of version 5 that can be read ({error}). Copy it again, or "
            "save it again with scipy.io.savemat."
        ) from error


def _byte_order(data: bytes, path: Path) -> str:
    """Return '<' or '>'."""
    if any(data[at : at + 4] == HDF5 for at in HDF5_AT):
        raise InputError(f"{path} is a .mat file of version 7.3 (HDF5); save it with -v7.")
    mark = data[126:128]
    if len(data) < HEADER_BYTES or mark not in (b"IM", b"MI"):
        raise InputError(
            f"{path} is no .mat file of version 5 ({len(data)} bytes). Save it with -v7 in MATLAB, "
            "or with scipy.io.savemat."
        )
    order = "<" if mark == b"IM" else ">"
    (version,) = struct.unpack_from(f"{order}H", data, VERSION_AT)
    if version != VERSION:
        raise InputError(f"{path} is a .mat file of version {version:#x}; {VERSION:#x} is read.")
    return order


def _unpacked(data: bytes, order: str, most: int) -> bytes:
    """Return the file with every variable unpacked and whole.

    Raises:
        ValueError: one is cut off, no variable, or they unpack to more than `most` bytes.
    """
    parts = [data[:HEADER_BYTES]]
    at, total = HEADER_BYTES, 0
    while at < len(data):
        kind, length = struct.unpack_from(f"{order}II", data, at)
        body = data[at + 8 : at + 8 + length]
        if len(body) < length:
            raise ValueError(f"a variable of {length} bytes is cut off after {len(body)}")
        element = data[at : at + 8 + length]
        if kind == MI_COMPRESSED:
            unpack = zlib.decompressobj()
            element = unpack.decompress(body, most - total + 9)
            if len(element) > most - total + 8:
                raise ValueError("a variable unpacks to more than is read")
            kind, inner = struct.unpack_from(f"{order}II", element, 0)
            if not unpack.eof or inner != len(element) - 8:
                raise ValueError("a compressed variable is cut off")
        if kind != MI_MATRIX:
            raise ValueError(f"an element of the kind {kind} where a variable should be")
        parts.append(element)
        at, total = at + 8 + length, total + len(element)
        if len(parts) > MOST_VARIABLES:
            raise ValueError(f"more than {MOST_VARIABLES} variables")
    return b"".join(parts)
