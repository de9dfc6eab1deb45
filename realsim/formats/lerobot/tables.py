"""The Parquet tables of a LeRobot data set."""

import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from realsim.formats.lerobot.episodes import LeRobotFeature

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
    import pyarrow.parquet as pq

    columns = {
        key: pa.array([row[key] for row in rows], type=_kind(value))
        for key, value in rows[0].items()
    }
    out = io.BytesIO()
    pq.write_table(pa.table(columns), out, compression=COMPRESSION)
    return out.getvalue()


def _kind(value: Any) -> Any:
    """Return Arrow's type of a cell: the same in all files, whatever their rows hold."""
    import pyarrow as pa

    if isinstance(value, list):
        first: Any = value[0]  # pyright: ignore[reportUnknownVariableType]
        return pa.list_(_kind(first))
    return {int: pa.int64(), float: pa.float64(), str: pa.string()}[type(value)]


def tasks_bytes(tasks: Sequence[str]) -> bytes:
    """Return the table of tasks, as pandas writes a frame whose index is the task in words."""
    import pyarrow as pa
    import pyarrow.parquet as pq

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
    ).replace_schema_metadata({"pandas": json.dumps(pandas)})
    out = io.BytesIO()
    pq.write_table(table, out, compression=COMPRESSION)
    return out.getvalue()
