"""MATLAB's .mat files of others, version 5 (also '7'): real arrays of numbers, nothing else.

The layout is of "MAT-File Format" (The MathWorks), chapter 1, and read here: scipy's reader, which
the tests compare with, allocates what a header claims and raises whatever it trips over.
"""

import math
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
MI_INT8, MI_INT32, MI_UINT32, MI_MATRIX, MI_COMPRESSED = 1, 5, 6, 14, 15
STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
"""How the numbers of a variable are stored; MATLAB picks the smallest type that holds them."""
CLASSES = dict(
    zip(range(6, 16), ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), strict=True)
)
"""What the variable is."""
OTHER_CLASSES = {1: "cells", 2: "a struct", 3: "an object", 4: "text", 5: "sparse"}
IS_COMPLEX, IS_LOGICAL = 0x0800, 0x0200
MOST_VARIABLES = 10_000
MOST_AXES = 32


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
    path = Path(path)
    data = checked_bytes(path, most_bytes)
    order = _byte_order(data, path)
    try:
        variables = _variables(memoryview(data), order, most_bytes)
        there: dict[str, memoryview] = {}
        for body in variables:
            name = _Body(body, order).name
            if name in there and name in names:
                raise ValueError(f"the variable '{name:.60}' is there twice")
            there[name] = body
        lacking = sorted(set(names) - set(there))
        if lacking:
            held = ", ".join(map(repr, there)) or "nothing"
            raise InputError(f"{path} has no variable '{lacking[0]}'; it holds {held:.500}.")
        return {name: _Body(there[name], order).array() for name in names}
    except (ValueError, struct.error, zlib.error, IndexError, MemoryError) as error:
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


def _variables(data: memoryview, order: str, most_bytes: float) -> list[memoryview]:
    """Return the bodies of all variables, unpacked."""
    found: list[memoryview] = []
    at, total = HEADER_BYTES, 0
    while at < len(data):
        kind, length = struct.unpack_from(f"{order}II", data, at)
        body = data[at + 8 : at + 8 + length]
        if len(body) < length:
            raise ValueError(f"a variable of {length} bytes is cut off after {len(body)}")
        at += 8 + length
        if kind == MI_COMPRESSED:
            body = _unpacked(body, order, int(most_bytes) - total)
        elif kind != MI_MATRIX:
            raise ValueError(f"an element of the kind {kind} where a variable should be")
        total += len(body)
        found.append(body)
        if len(found) > MOST_VARIABLES:
            raise ValueError(f"more than {MOST_VARIABLES} variables")
    return found


def _unpacked(packed: memoryview, order: str, most: int) -> memoryview:
    """Return the body of a compressed variable."""
    unpack = zlib.decompressobj()
    data = unpack.decompress(packed, most + 9)
    if len(data) > most + 8:
        raise ValueError("a variable unpacks to more than is read")
    if not unpack.eof:
        raise ValueError("a compressed variable is cut off")
    kind, length = struct.unpack_from(f"{order}II", data, 0)
    if kind != MI_MATRIX or length != len(data) - 8:
        raise ValueError(f"a compressed element of the kind {kind} and {length} bytes")
    return memoryview(data)[8:]


class _Body:
    """The body of one variable: flags, shape, name, and then its numbers."""

    def __init__(self, body: memoryview, order: str) -> None:
        self._body, self._order, self._at = body, order, 0
        flags = self._element(MI_UINT32)
        if len(flags) != 8:
            raise ValueError("a variable without flags")
        (bits,) = struct.unpack_from(f"{order}I", flags)
        self._class, self._flags = bits & 0xFF, bits & 0xFF00
        self._shape = np.frombuffer(self._element(MI_INT32), dtype=f"{order}i4").tolist()
        self.name = bytes(self._element(MI_INT8)).decode("ascii", "replace")

    def array(self) -> NDArray[Any]:
        """Return the numbers, in the type that the variable has."""
        shape, name = self._shape, f"the variable '{self.name:.60}'"
        if self._class not in CLASSES:
            kind = OTHER_CLASSES.get(self._class, f"of the class {self._class}")
            raise ValueError(f"{name} is {kind}; arrays of numbers are read")
        if self._flags & IS_COMPLEX:
            raise ValueError(f"{name} is complex")
        if not 2 <= len(shape) <= MOST_AXES or min(shape) < 0:
            raise ValueError(f"{name} has the shape {str(shape)[:80]}")
        kind, data = self._next()
        if kind not in STORED:
            raise ValueError(f"{name} has numbers of the kind {kind}")
        dtype = np.dtype(self._order + STORED[kind])
        expected = math.prod(shape) * dtype.itemsize
        if len(data) != expected:
            raise ValueError(f"{name} should have {expected} bytes and has {len(data)}")
        numbers = np.frombuffer(data, dtype=dtype).astype(STORED[kind])
        wanted = np.dtype(bool if self._flags & IS_LOGICAL else CLASSES[self._class])
        with np.errstate(all="ignore"):
            array = numbers.astype(wanted)
            if wanted.kind != "f" and not np.array_equal(array.astype(numbers.dtype), numbers):
                raise ValueError(f"{name} has numbers that its own type does not hold")
        return array.reshape(shape, order="F")

    def _element(self, kind: int) -> memoryview:
        found, data = self._next()
        if found != kind:
            raise ValueError(f"a part of the kind {found} where {kind} is expected")
        return data

    def _next(self) -> tuple[int, memoryview]:
        """Return kind and bytes of the next part, which may have the short form of 4 bytes."""
        (kind,) = struct.unpack_from(f"{self._order}I", self._body, self._at)
        if kind >> 16:
            length, kind, start = kind >> 16, kind & 0xFFFF, self._at + 4
            end = self._at + 8
            if length > 4:
                raise ValueError(f"a short part of {length} bytes")
        else:
            (length,) = struct.unpack_from(f"{self._order}I", self._body, self._at + 4)
            start = self._at + 8
            end = start + length + -length % 8
        data = self._body[start : start + length]
        if len(data) < length:
            raise ValueError(f"a part of {length} bytes is cut off after {len(data)}")
        self._at = end
        return kind, data
