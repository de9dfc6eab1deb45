"""HDF5 files of others, read with suspicion: every link, type, size and number is looked at first.

An HDF5 file can point into other files (external and soft links, external and virtual storage), ask
for plugins to be loaded (filters), and unfold a kilobyte into a terabyte. None of that is needed to
hold grasps, so none of it is followed.
"""

import mmap
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.untrusted.json_text import parsed_json

MOST_ARRAY_BYTES = 4 << 30
"""Largest array that is read [bytes]: 30 million grasps, or 70 million samples of an arm."""
KNOWN_FILTERS = (1, 2, 3)
"""Deflate, shuffle and checksum, which the library itself has (H5Z_FILTER_*)."""
HEAP = b"GCOL\x01\0\0\0"
"""How a global heap begins: signature, version 1, reserved."""
HEAP_HEAD = 16
"""Bytes of the head of a heap, and of each object in it."""
Shape = tuple[int | None, ...]


class CheckedGroup:
    """A group of an HDF5 file; whatever is taken from it is checked."""

    def __init__(self, group: Any, path: Path) -> None:
        """Take an open h5py group."""
        self._group, self._path = group, path

    def wrong(self, what: str) -> InputError:
        """Return the error that names the file and the place."""
        return InputError(f"{self._path}, {self._group.name}: {what}")

    def names(self) -> list[str]:
        """Return the names of the members, each a hard link."""
        names = [str(name) for name in self._group]
        for name in names:
            self._require_hard(name)
        return names

    def has(self, name: str) -> bool:
        """Return whether there is a member of this name."""
        return self._group.get(name, getlink=True, default=None) is not None

    def group(self, name: str) -> "CheckedGroup":
        """Return a group in this one."""
        import h5py

        self._require_hard(name)
        found = self._group[name]
        if not isinstance(found, h5py.Group):
            raise self.wrong(f"'{name}' is no group.")
        return CheckedGroup(found, self._path)

    def numbers(self, name: str, shape: Shape) -> Array:
        """Return an array of numbers as float64; None in the shape = any length."""
        dataset = self._dataset(name, "fiu", shape)
        return np.asarray(self._read(name, dataset), dtype=np.float64)

    def integers(self, name: str, shape: Shape) -> Int64:
        """Return an array of whole numbers."""
        dataset = self._dataset(name, "iu", shape)
        if dataset.dtype == np.uint64:
            raise self.wrong(f"'{name}' is uint64; numbers of up to 63 bits are expected.")
        return np.asarray(self._read(name, dataset), dtype=np.int64)

    def booleans(self, name: str, shape: Shape) -> Mask:
        """Return an array of yes and no."""
        dataset = self._dataset(name, "b", shape)
        return np.asarray(self._read(name, dataset)).view(np.uint8) != 0

    def text(self, name: str) -> str:
        """Return one text."""
        dataset = self._dataset(name, "SO", ())
        return self._decoded(name, self._read(name, dataset))

    def json(self, name: str) -> Any:
        """Return the values of a text that is JSON."""
        try:
            return parsed_json(self.text(name), f"'{name}'")
        except InputError as error:
            raise self.wrong(f"'{name}' is not JSON: {error}") from error

    def texts(self, name: str, count: int) -> tuple[str, ...]:
        """Return texts of fixed length; their size is known before they are read."""
        dataset = self._dataset(name, "S", (count,))
        return tuple(self._decoded(name, t) for t in self._read(name, dataset).tolist())

    def attribute(self, name: str, kind: type[int] | type[str]) -> Any:
        """Return an attribute, a whole number or a text."""
        try:
            value: Any = self._group.attrs[name]
        except KeyError:
            raise self.wrong(f"the attribute '{name}' is missing.") from None
        except (OSError, TypeError, ValueError) as error:
            raise self.wrong(f"the attribute '{name}' cannot be read ({error}).") from error
        if kind is int and isinstance(value, np.integer):
            return int(value)
        if kind is str and isinstance(value, str):
            return value
        raise self.wrong(f"the attribute '{name}' is {value!r:.40}; {kind.__name__} is expected.")

    def _require_hard(self, name: str) -> None:
        import h5py

        if "/" in name or name in ("", ".", ".."):
            raise self.wrong(f"'{name}' is no name of a member.")
        link = self._group.get(name, getlink=True, default=None)
        if link is None:
            there = ", ".join(map(str, self._group)) or "nothing"
            raise self.wrong(f"'{name}' is missing; there is: {there}.")
        if not isinstance(link, h5py.HardLink):
            raise self.wrong(
                f"'{name}' is a {type(link).__name__}: it points elsewhere. Only files that hold "
                "everything themselves are read; copy it with `h5repack` or h5py into one."
            )

    def _dataset(self, name: str, kinds: str, shape: Shape) -> Any:
        """Return an open dataset whose type, shape, size and storage are accepted."""
        import h5py

        self._require_hard(name)
        dataset = self._group[name]
        if not isinstance(dataset, h5py.Dataset):
            raise self.wrong(f"'{name}' is no dataset.")
        if dataset.is_virtual or dataset.external:
            raise self.wrong(f"'{name}' keeps its numbers in another file; that is not followed.")
        listed = dataset.id.get_create_plist()
        filters = [listed.get_filter(k)[0] for k in range(listed.get_nfilters())]
        unknown = [f for f in filters if f not in KNOWN_FILTERS]
        if unknown:
            raise self.wrong(
                f"'{name}' is packed with the HDF5 filter {unknown[0]}; gzip, shuffle and none are "
                "accepted. Repack it with `h5repack -f GZIP=4`."
            )
        kind = dataset.dtype.kind
        if kind not in kinds or (kind == "f" and dataset.dtype.itemsize > 8):
            raise self.wrong(f"'{name}' is {dataset.dtype}; the kinds {kinds} are accepted.")
        found = dataset.shape
        if (
            found is None
            or len(found) != len(shape)
            or any(n is not None and n != m for n, m in zip(shape, found, strict=True))
        ):
            wanted = tuple("N" if n is None else n for n in shape)
            raise self.wrong(f"'{name}' has the shape {found}; {wanted} is expected.")
        if dataset.nbytes > MOST_ARRAY_BYTES:
            raise self.wrong(
                f"'{name}' has {dataset.nbytes / 1e9:.1f} GB; at most "
                f"{MOST_ARRAY_BYTES / 1e9:.1f} GB are read at a time."
            )
        return dataset

    def _read(self, name: str, dataset: Any) -> Any:
        try:
            return dataset[()]
        except (OSError, ValueError, MemoryError) as error:
            raise self.wrong(f"'{name}' is damaged ({error}).") from error

    def _decoded(self, name: str, value: Any) -> str:
        try:
            return value.decode("utf-8") if isinstance(value, bytes) else str(value)
        except UnicodeDecodeError as error:
            raise self.wrong(f"'{name}' is no UTF-8 text ({error}).") from error


def _require_sound_heaps(path: Path) -> None:
    """Refuse heaps of texts in which the HDF5 library would go round for ever.

    A global heap is a row of objects; the one with the index 0 is free space, and its size says
    where the next one is. At a size of 0 the library (2.0) reads the same one again and again.
    Layout: HDF5 File Format Specification, III.E.
    """
    if path.stat().st_size == 0:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(HEAP)
        while at >= 0:
            end = min(at + int.from_bytes(data[at + 8 : at + 16], "little"), len(data))
            place = at + HEAP_HEAD
            while place + HEAP_HEAD <= end:
                index = int.from_bytes(data[place : place + 2], "little")
                size = int.from_bytes(data[place + 8 : place + 16], "little")
                if index == 0 and size < HEAP_HEAD:
                    raise InputError(
                        f"{path} is damaged: a heap of texts at byte {at} has free space of {size} "
                        "bytes. Copy the file again, or write it again from the session."
                    )
                place += size if index == 0 else HEAP_HEAD + size + -size % 8
            at = data.find(HEAP, at + 1)


@contextmanager
def opened(path: Path | str) -> Generator[CheckedGroup]:
    """Open an HDF5 file for reading.

    Raises:
        InputError: it is missing, or no HDF5 file, or damaged.
    """
    import h5py

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; give an HDF5 file.")
    _require_sound_heaps(path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise InputError(
            f"{path} is no HDF5 file, or a damaged one ({error}). Write it again from the session."
        ) from error
    try:
        yield CheckedGroup(file, path)
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error  # of a record, which knows no file
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        # What h5py raises where the file's own structure is broken.
        raise InputError(
            f"{path} is damaged ({error}). Write it again from the session."
        ) from error
    finally:
        file.close()
