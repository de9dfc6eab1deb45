"""Parquet files of others, read with suspicion: sizes and types are looked at before anything."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.untrusted.json_text import parsed_json
from realsim.untrusted.values import mapping

MOST_BYTES = 8 << 30
"""Largest table that is read [bytes, unpacked]: more does not fit into a desktop's memory."""
MOST_ROWS = 100_000_000
"""Run lengths unfold into any number of rows; the largest data set of grasps has 57 million."""


class CheckedTable:
    """A Parquet file; whatever is taken from it is checked.

    Raises:
        InputError: it is missing, no Parquet file, damaged or too large.
    """

    def __init__(self, path: Path) -> None:
        """Read the table."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        self._path = path
        if not path.is_file():
            raise InputError(f"{path} does not exist; give the folder of an export to Parquet.")
        try:
            with pq.ParquetFile(path, page_checksum_verification=True) as file:
                meta = file.metadata
                size = sum(meta.row_group(k).total_byte_size for k in range(meta.num_row_groups))
                if size > MOST_BYTES or meta.num_rows > MOST_ROWS:
                    raise self.wrong(
                        f"{meta.num_rows} rows of {size / 1e9:.1f} GB; at most {MOST_ROWS} of "
                        f"{MOST_BYTES / 1e9:.1f} GB are read at a time."
                    )
                self._table: Any = file.read()
        except (OSError, pa.ArrowException) as error:
            raise InputError(
                f"{path} is no Parquet file, or a damaged one ({error}). Write it again."
            ) from error
        self.rows: int = self._table.num_rows

    def wrong(self, what: str) -> InputError:
        """Return the error that names the file."""
        return InputError(f"{self._path}: {what}")

    def head(self, key: bytes) -> dict[str, Any]:
        """Return the file's metadata under a key, a JSON object."""
        where = f"the metadata '{key.decode()}' of {self._path}"
        try:
            text = (self._table.schema.metadata or {})[key].decode("utf-8")
        except (KeyError, UnicodeDecodeError) as error:
            raise self.wrong(f"there is no metadata '{key.decode()}' in JSON.") from error
        return mapping(parsed_json(text, where), where)

    def numbers(self, name: str, rows: slice) -> Array:
        """Return rows of a column of float64."""
        return self._filled(name, "double", rows).to_numpy(zero_copy_only=False)

    def integers(self, name: str, rows: slice) -> Int64:
        """Return rows of a column of int64."""
        return self._filled(name, "int64", rows).to_numpy(zero_copy_only=False)

    def booleans(self, name: str, rows: slice) -> Mask:
        """Return rows of a column of yes and no."""
        return self._filled(name, "bool", rows).to_numpy(zero_copy_only=False)

    def texts(self, name: str, rows: slice) -> tuple[str, ...]:
        """Return rows of a column of texts."""
        return tuple(self._filled(name, "string", rows).to_pylist())

    def lists(self, name: str, length: int, rows: slice) -> Array:
        """Return rows of a column of fixed lists, (rows, length)."""
        kind = f"fixed_size_list<element: double>[{length}]"
        flat = self._filled(name, kind, rows).flatten()
        self._require_full(name, flat)
        return flat.to_numpy(zero_copy_only=False).reshape(-1, length)

    def ragged(self, name: str, rows: slice) -> tuple[Int64, NDArray[Any]]:
        """Return (starts, values) of rows of a column of lists."""
        column = self._filled(name, "list<element: ", rows)
        flat = column.flatten()
        self._require_full(name, flat)
        return _starts(column), flat.to_numpy(zero_copy_only=False)

    def inner(self, name: str, rows: slice, length: int) -> Array:
        """Return all inner lists (samples, length) of rows of a column of lists of lists."""
        column = self._filled(name, "list<element: list<element: double>>", rows)
        samples = column.flatten()
        self._require_full(name, samples)
        if np.any(np.diff(_starts(samples)) != length):
            raise self.wrong(f"a sample of '{name}' does not have {length} numbers.")
        flat = samples.flatten()
        self._require_full(name, flat)
        return flat.to_numpy(zero_copy_only=False).reshape(-1, length)

    def _filled(self, name: str, kind: str, rows: slice) -> Any:
        """Return rows of a column of one kind, in one piece, none of them null."""
        if self._table.schema.names.count(name) != 1:
            there = ", ".join(self._table.schema.names)
            raise self.wrong(f"the column '{name}' is missing or there twice; there are: {there}.")
        column = self._table.column(name)
        found = str(column.type).replace("item:", "element:")
        if not found.startswith(kind):
            raise self.wrong(f"the column '{name}' is {found}; {kind} is expected.")
        if rows.stop > self.rows or rows.start < 0 or rows.stop < rows.start:
            raise self.wrong(f"rows {rows.start} to {rows.stop} of {self.rows} are asked for.")
        piece = column.slice(rows.start, rows.stop - rows.start).combine_chunks()
        self._require_full(name, piece)
        return piece

    def _require_full(self, name: str, array: Any) -> None:
        if array.null_count:
            raise self.wrong(
                f"the column '{name}' has {array.null_count} nulls where values belong."
            )


def _starts(column: Any) -> Int64:
    """Return where each list begins, and the end, counted from the first."""
    # A slice keeps the offsets of the whole.
    offsets = column.offsets.to_numpy(zero_copy_only=False).astype(np.int64)
    return offsets - offsets[0]
