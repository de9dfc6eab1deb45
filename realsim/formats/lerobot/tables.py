"""The tables of a LeRobot data set, and the statistics that they hold.

Statistics are min, max, mean, sd and count. Those of a data set are put together from those of its
episodes: extremes of extremes, and mean and variance weighted by the counts (Chan, Golub & LeVeque
1979).
"""

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32, UInt8
from realsim.formats.lerobot.episodes import LeRobotFeature

Stats = dict[str, dict[str, Any]]
"""Feature -> 'min', 'max', 'mean', 'std', 'count' -> nested lists of numbers."""


def column_stats(columns: Mapping[str, NDArray[Any]]) -> Stats:
    """Return the statistics of columns (S,) or (S, n)."""
    out: Stats = {}
    for key, column in columns.items():
        values = np.asarray(column, dtype=np.float64).reshape(len(column), -1)
        out[key] = {
            "min": values.min(axis=0).tolist(),
            "max": values.max(axis=0).tolist(),
            "mean": values.mean(axis=0).tolist(),
            "std": values.std(axis=0).tolist(),
            "count": [len(values)],
        }
    return out


class PictureStats:
    """Statistics of one camera's pictures: channels from 0 to 1, or what depth is seen [m]."""

    def __init__(self, *, depth: bool = False) -> None:
        """Begin with none."""
        n, self._scale = (1, 1.0) if depth else (3, 255.0)
        self._count = self._pixels = 0
        self._low, self._high = np.full(n, np.inf), np.full(n, -np.inf)
        self._sum, self._squares = np.zeros(n), np.zeros(n)

    def add(self, picture: UInt8 | Array32) -> None:
        """Add colours (H, W, 3), or depth (H, W) [m], 0 = nothing."""
        import cv2

        self._count += 1
        if len(self._low) == 1:
            seen = picture[picture > 0].astype(np.float64)
            self._take(0, seen, np.ones(len(seen)))
            self._pixels += len(seen)
            return
        for c in range(3):
            counted = cv2.calcHist([picture], [c], None, [256], [0.0, 256.0])
            self._take(c, np.arange(256.0), counted.ravel().astype(np.float64))
        self._pixels += picture.shape[0] * picture.shape[1]

    def _take(self, c: int, values: Array, counts: Array) -> None:
        """Add values that occur so often."""
        there = values[counts > 0]
        self._low[c] = min(self._low[c], there.min(initial=np.inf))
        self._high[c] = max(self._high[c], there.max(initial=-np.inf))
        self._sum[c] += counts @ values
        self._squares[c] += counts @ values**2

    def result(self) -> dict[str, Any]:
        """Return the statistics, (C, 1, 1) each; count is that of the pictures."""
        n, seen = len(self._low), max(self._pixels, 1)
        mean = self._sum / seen
        sd = np.sqrt(np.maximum(self._squares / seen - mean**2, 0.0))
        values = {"min": self._low, "max": self._high, "mean": mean, "std": sd}
        return {
            **{
                name: (np.nan_to_num(v, posinf=0.0, neginf=0.0) / self._scale)
                .reshape(n, 1, 1)
                .tolist()
                for name, v in values.items()
            },
            "count": [self._count],
        }


def together(parts: Iterable[Stats]) -> Stats:
    """Return the statistics of all episodes, one after the other: none is kept."""
    total: dict[str, dict[str, Array]] = {}
    for stats in parts:
        for key, given in stats.items():
            new = {name: np.asarray(value, dtype=np.float64) for name, value in given.items()}
            total[key] = _merged(total[key], new) if key in total else new
    return {
        key: {
            name: [int(value[0])] if name == "count" else value.tolist()
            for name, value in stats.items()
        }
        for key, stats in total.items()
    }


def _merged(a: dict[str, Array], b: dict[str, Array]) -> dict[str, Array]:
    n_a, n_b = float(a["count"][0]), float(b["count"][0])
    n = n_a + n_b
    apart = b["mean"] - a["mean"]
    variance = (n_a * a["std"] ** 2 + n_b * b["std"] ** 2) / n + apart**2 * n_a * n_b / n**2
    return {
        "min": np.minimum(a["min"], b["min"]),
        "max": np.maximum(a["max"], b["max"]),
        "mean": a["mean"] + apart * n_b / n,
        "std": np.sqrt(variance),
        "count": np.array([n]),
    }


COMPRESSION = "snappy"
"""LeRobot's own."""
ARROW = {"float32": "float", "int64": "int64", "bool": "bool"}
"""Arrow's names of the types."""


def data_bytes(
    features: Mapping[str, LeRobotFeature], episodes: Sequence[Mapping[str, NDArray[Any]]]
) -> bytes:
    """Return the table of steps, one row group an episode.

    Args:
        features: the columns in order.
        episodes: (S,) or (S, width) of every column.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {key: pa.type_for_alias(ARROW[f.dtype]) for key, f in features.items()}
    schema = pa.schema(
        [
            (key, pa.list_(kinds[key], f.width) if f.width > 1 else kinds[key])
            for key, f in features.items()
        ]
    )
    out = io.BytesIO()
    with pq.ParquetWriter(out, schema, compression=COMPRESSION) as writer:
        for columns in episodes:
            arrays: list[Any] = []
            for key, f in features.items():
                flat = pa.array(columns[key].reshape(-1), type=kinds[key])
                if f.width > 1:
                    flat = pa.FixedSizeListArray.from_arrays(flat, type=schema.field(key).type)
                arrays.append(flat)
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
    return out.getvalue()


def episodes_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Return the table of episodes: whole numbers, times, words and nested lists of numbers."""
    import pyarrow as pa

    columns = {
        key: pa.array([row[key] for row in rows], type=_kind(value))
        for key, value in rows[0].items()
    }
    return _parquet(pa.table(columns))


def _kind(value: Any) -> Any:
    """Return Arrow's type of a cell: the same in all files, whatever their rows hold."""
    import pyarrow as pa

    if isinstance(value, list):
        first: Any = value[0]  # pyright: ignore[reportUnknownVariableType]
        return pa.list_(_kind(first))
    kinds = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}
    return kinds[type(value)]


def tasks_bytes(tasks: Sequence[str]) -> bytes:
    """Return the table of tasks, as pandas writes a frame whose index is the task in words."""
    import pyarrow as pa

    column = {"field_name": "task_index", "metadata": None, "name": "task_index",
              "numpy_type": "int64", "pandas_type": "int64"}  # fmt: skip
    index = {"field_name": "task", "metadata": None, "name": "task", "numpy_type": "object",
             "pandas_type": "unicode"}  # fmt: skip
    names = {"field_name": None, "metadata": {"encoding": "UTF-8"}, "name": None,
             "numpy_type": "object", "pandas_type": "unicode"}  # fmt: skip
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [names],
        "columns": [column, index],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.3",
    }
    table = pa.table(
        {"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(list(tasks))}
    )
    return _parquet(table.replace_schema_metadata({"pandas": json.dumps(pandas)}))


def _parquet(table: Any) -> bytes:
    import pyarrow.parquet as pq

    out = io.BytesIO()
    pq.write_table(table, out, compression=COMPRESSION)
    return out.getvalue()
