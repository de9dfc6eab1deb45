"""Stand in for libraries of the system that a wheel is linked against and realsim never calls.

Open3D's wheel asks for libEGL, libGL and libX11 when it is loaded, for windows that realsim does
not open; a bare Debian has none of them. The loader takes a library for another that is loaded
already if their names (DT_SONAME) agree. So an empty library of that name is put into memory first.
What it has to define stands in a second one: every such function that the wheel asks for returns 0.

The format: System V ABI, AMD64 supplement, chapters 4 and 5.
"""

import ctypes
import os
import re
import struct
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

NEVER_CALLED = {
    "libEGL.so.1": "egl[A-Z]", "libGL.so.1": "gl[A-Z]", "libX11.so.6": "X[A-Z]",
    "libudev.so.1": "udev_", "libidn2.so.0": "idn2_",
}  # fmt: skip
"""Library -> how the names of its functions begin."""
RETURN_0 = bytes.fromhex("31c0c3")  # xor eax, eax; ret
PAGE, HEADER, FUNCTION = 4096, 64 + 4 * 56, 0x12  # FUNCTION: global, a function
DYNSYM = 11  # kind of the section with the names that the loader sees
SYMBOL = np.dtype("<u4,u1,u1,<u2,<u8,<u8")  # name, kind, visibility, section, value, size


def for_windows(wheel_libraries: Iterable[Path]) -> list[str]:
    """Load an empty library for each of `NEVER_CALLED` that is missing; return their names.

    Args:
        wheel_libraries: ELF files that ask for them.
    """
    missing = [name for name in NEVER_CALLED if not is_there(name)]
    if missing:
        begins = re.compile("|".join(NEVER_CALLED[name] for name in missing).encode())
        asked = set[bytes]().union(*map(undefined, wheel_libraries))
        load(library(b"realsim-stand-in", (), sorted(n for n in asked if begins.match(n))))
    for name in missing:
        load(library(name.encode(), [b"realsim-stand-in"], ()))
    return missing


def lend(name: str, others: Iterable[Path]) -> None:
    """Let the first of other libraries be found by a name that the system has no library of."""
    if not is_there(name):
        for other in others:
            return load(library(name.encode(), [os.fsencode(other)], ()))


def is_there(name: str) -> bool:
    """Return whether the loader finds a library; it is loaded then."""
    with suppress(OSError):
        ctypes.CDLL(name)
        return True
    return False


def load(content: bytes) -> None:
    """Load a library that lies in memory, which works where no disk may hold programs.

    Raises:
        OSError: the loader refuses it.
    """
    file = os.memfd_create("library")  # stays open: the loader takes equal paths for equal files
    os.write(file, content)
    ctypes.CDLL(f"/proc/self/fd/{file}")


def undefined(path: Path) -> set[bytes]:
    """Return the names that a library asks others for."""
    data = np.memmap(path, mode="r")
    (at,), (size, count) = (
        struct.unpack("<Q", bytes(data[40:48])),
        struct.unpack("<HH", bytes(data[58:62])),
    )
    sections = [
        struct.unpack("<IIQQQQIIQQ", bytes(data[n : n + 64]))
        for n in range(at, at + size * count, size)
    ]
    symbols = next(s for s in sections if s[1] == DYNSYM)
    table = data[symbols[4] : symbols[4] + symbols[5]].view(SYMBOL)
    text = sections[symbols[6]]
    names = bytes(data[text[4] : text[4] + text[5]])
    starts = table["f0"][table["f3"] == 0]
    return {names[n : names.index(b"\0", n)] for n in starts.tolist()}


def library(name: bytes, needed: Sequence[bytes], functions: Sequence[bytes]) -> bytes:
    """Return an ELF library for x86-64.

    Args:
        name: DT_SONAME.
        needed: DT_NEEDED: names or paths of libraries that are loaded with it.
        functions: names of functions; each returns 0.
    """
    texts = [name, *needed, *functions]
    starts = np.cumsum([1, *(len(t) + 1 for t in texts)]).tolist()
    strings = b"\0" + b"".join(t + b"\0" for t in texts)
    symbols = np.zeros(1 + len(functions), SYMBOL)
    symbols[1:]["f0"] = starts[1 + len(needed) : -1]
    symbols[1:]["f1"], symbols[1:]["f3"], symbols[1:]["f4"] = FUNCTION, 1, HEADER
    one_bucket = np.array([1, len(symbols), len(functions), 0, *range(len(functions))], "<u4")
    parts = [RETURN_0.ljust(8, b"\0"), symbols.tobytes(), one_bucket.tobytes(), strings]
    ends = np.cumsum([HEADER, *map(len, parts)]).tolist()
    dynamic = [(14, starts[0]), *((1, s) for s in starts[1 : 1 + len(needed)])]
    dynamic += [(4, ends[2]), (5, ends[3]), (6, ends[1]), (10, len(strings)), (11, 24), (0, 0)]
    at = -(-ends[-1] // PAGE) * PAGE
    size = 16 * len(dynamic)
    segments = [  # kind, flags (1 run, 2 write, 4 read), offset, bytes
        (1, 5, 0, ends[-1]), (1, 6, at, size), (2, 6, at, size), (0x6474E551, 6, 0, 0),
    ]  # fmt: skip
    header = b"\x7fELF\2\1\1".ljust(16, b"\0")
    header += struct.pack("<HHIQQQIHHHHHH", 3, 62, 1, 0, 64, 0, 0, 64, 56, len(segments), 64, 0, 0)
    header += b"".join(
        struct.pack("<IIQQQQQQ", kind, flags, offset, offset, offset, n, n, PAGE)
        for kind, flags, offset, n in segments
    )
    body = (header + b"".join(parts)).ljust(at, b"\0")
    return body + b"".join(struct.pack("<QQ", *entry) for entry in dynamic)
