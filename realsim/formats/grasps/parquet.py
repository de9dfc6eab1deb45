"""All tried grasps of a scene as two Parquet tables, and back.

    FOLDER/grasps.parquet         one row a grasp
    FOLDER/trajectories.parquet   one row an attempt, its samples in lists; where there are any

A row is told by (instance, grasp). Poses are 16 numbers, row by row. What comes by stage has one
column a stage, such as slip_m_lift. A measure that was not taken of a set is null in its rows; NaN
keeps the meaning it has in the set. The file's metadata `realsim` holds, as JSON, what belongs to a
set as a whole: parameters, object pose, which measures it has. Units and meanings are metadata of
the columns.

The table of grasps is written last and names the other one by its digest: two tables of different
runs are not taken for one.
"""

import hashlib
import io
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.formats.grasps.hdf5 import COLUMNS, FORMAT, FORMAT_VERSION, FRAMES, SAMPLES
from realsim.formats.grasps.scene_grasps import SceneGrasps, parameters_json
from realsim.interop import import_extra
from realsim.records import STAGES, GraspSet
from realsim.records.grasps import MEASURES
from realsim.store import atomic

GRASPS_FILE = "grasps.parquet"
TRAJECTORIES_FILE = "trajectories.parquet"
HEAD = b"realsim"
"""Key of the file's metadata."""
POSES = {
    "T_obj_grasp": "grasp in object",
    "T_world_grasp": "grasp in world; null = the object's pose is not known",
    "T_table_grasp": "grasp in the table's frame; null = the table is not known",
}


def write_grasps_parquet(folder: Path | str, scene: SceneGrasps) -> Path:
    """Write the grasps of a scene and return the table of grasps.

    Each table is whole or not there; the same grasps give the same bytes.

    Raises:
        MissingLibraryError: pyarrow is not installed.
    """
    import_extra("pyarrow", "parquet", "a Parquet table")
    folder = Path(folder)
    attempts = _attempts_bytes(scene) if scene.trajectories else None
    if attempts is not None:
        atomic.write_bytes(folder / TRAJECTORIES_FILE, attempts)
    atomic.write_bytes(folder / GRASPS_FILE, _grasps_bytes(scene, attempts))
    if attempts is None:
        (folder / TRAJECTORIES_FILE).unlink(missing_ok=True)  # of an earlier run
    return folder / GRASPS_FILE


# --- the table of grasps ----------------------------------------------------------------------


def _grasps_bytes(scene: SceneGrasps, attempts: bytes | None) -> bytes:
    import pyarrow as pa

    counts = [len(s) for s in scene.sets]
    columns: list[tuple[Any, Any]] = []

    def add(name: str, values: Any, unit: str, meaning: str) -> None:
        notes = {"unit": unit, "meaning": meaning}
        columns.append((pa.field(name, values.type, metadata=notes), values))

    for name in ("instance", "obj_id"):
        numbers = np.array([getattr(s, name) for s in scene.sets], dtype=np.int64)
        add(name, pa.array(np.repeat(numbers, counts)), "", "which object")
    labels = [scene.names.get(s.obj_id, "") for s in scene.sets for _ in range(len(s))]
    add("name", pa.array(labels, pa.string()), "", "name of the object")
    rows = [np.arange(n, dtype=np.int64) for n in counts]
    add("grasp", pa.array(np.concatenate([np.zeros(0, np.int64), *rows])), "", "row of the set")
    for name, meaning in POSES.items():
        add(name, _poses_column([_poses(scene, s, name) for s in scene.sets], counts), "m", meaning)
    for name, (field, unit, meaning) in COLUMNS.items():
        by_stage = field.startswith("slip")
        for column, k in _stage_columns(name, by_stage):
            parts = [getattr(s, field)[:, k] if by_stage else getattr(s, field) for s in scene.sets]
            add(column, _column(parts, counts), unit, meaning)
    reachable = np.concatenate([np.zeros(0, np.bool_), *(s.reachable for s in scene.sets)])
    add("reachable", pa.array(reachable), "", "whether the arm has a path free of collisions")
    reasons = [text for s in scene.sets for text in s.failures]
    add("failure", pa.array(reasons, pa.string()), "", "why it stopped; '' = passed all")
    for name, measure in MEASURES.items():
        if any(name in s.measures for s in scene.sets):
            for column, k in _stage_columns(name, measure.by_stage):
                taken = [s.measures.get(name) for s in scene.sets]
                parts = [v[:, k] if v is not None and v.ndim == 2 else v for v in taken]
                add(column, _column(parts, counts), measure.unit, measure.meaning)
    schema = pa.schema([f for f, _ in columns], metadata={HEAD: _head_json(scene, attempts)})
    return _bytes_of(pa.Table.from_arrays([v for _, v in columns], schema=schema))


def _poses(scene: SceneGrasps, s: GraspSet, name: str) -> Array | None:
    if name == "T_obj_grasp":
        return s.Ts_obj_grasp
    return scene.Ts_world_grasp(s) if name == "T_world_grasp" else scene.Ts_table_grasp(s)


def _stage_columns(name: str, by_stage: bool) -> list[tuple[str, int]]:
    """Return (column, stage) of what comes by stage, or the name alone."""
    return [(f"{name}_{stage}", k) for k, stage in enumerate(STAGES)] if by_stage else [(name, 0)]


def _column(parts: list[Array | None], counts: list[int]) -> Any:
    """Return a column of float64; a part that is None is null."""
    import pyarrow as pa

    values = [np.zeros(n) if p is None else p for p, n in zip(parts, counts, strict=True)]
    absent = [np.full(n, p is None) for p, n in zip(parts, counts, strict=True)]
    nothing, no_mask = np.zeros(0), np.zeros(0, np.bool_)
    return pa.array(
        np.concatenate([nothing, *values]), mask=np.concatenate([no_mask, *absent]),
        from_pandas=False,
    )  # fmt: skip


def _poses_column(parts: list[Array | None], counts: list[int]) -> Any:
    """Return a column of 16 numbers a row; a part that is None is null."""
    import pyarrow as pa

    numbers = [
        np.zeros((n, 16)) if p is None else p.reshape(n, 16)
        for p, n in zip(parts, counts, strict=True)
    ]
    absent = [np.full(n, p is None) for p, n in zip(parts, counts, strict=True)]
    flat = pa.array(np.concatenate([np.zeros((0, 16)), *numbers]).ravel())
    mask = pa.array(np.concatenate([np.zeros(0, np.bool_), *absent]))
    return pa.FixedSizeListArray.from_arrays(flat, 16, mask=mask)


def _head_json(scene: SceneGrasps, attempts: bytes | None) -> bytes:
    def numbers(T: Array | None) -> Any:
        return None if T is None else T.tolist()

    trajectories = None
    if attempts is not None:
        trajectories = {
            "sha256": hashlib.sha256(attempts).hexdigest(),
            "joints": {str(i): t.joints_rad.shape[1] for i, t in scene.trajectories.items()},
        }
    head = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "realsim": version("realsim"),
        "scene": scene.name,
        "frames": FRAMES,
        "names": {str(i): name for i, name in scene.names.items()},
        "T_world_table": numbers(scene.T_world_table),
        "trajectories": trajectories,
        "sets": [
            {
                "obj_id": s.obj_id,
                "instance": s.instance,
                "grasps": len(s),
                "measures": [name for name in MEASURES if name in s.measures],
                "T_world_obj": numbers(scene.Ts_world_obj.get(s.instance)),
                "parameters": json.loads(parameters_json(s)),
            }
            for s in scene.sets
        ],
    }
    return json.dumps(head, allow_nan=False).encode()


def _bytes_of(table: Any) -> bytes:
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


# --- the table of attempts --------------------------------------------------------------------


def _attempts_bytes(scene: SceneGrasps) -> bytes:
    """Return the table of attempts: samples as lists, joint angles as lists of lists."""
    import pyarrow as pa

    tables: list[Any] = []
    listed = {"time_s": pa.float64(), "opening_m": pa.float64(), "phase": pa.int8()}
    types = {
        "instance": pa.int64(), "grasp": pa.int64(), "joints_rad": pa.list_(pa.list_(pa.float64())),
        **{name: pa.list_(kind) for name, kind in listed.items()},
    }  # fmt: skip
    notes = {name: SAMPLES.get(name, ("", "which grasp")) for name in types}
    schema = pa.schema(
        [pa.field(n, t, metadata=dict(zip(("unit", "meaning"), notes[n], strict=True)))
         for n, t in types.items()]
    )  # fmt: skip
    for instance, t in sorted(scene.trajectories.items()):
        starts = pa.array(t.starts.astype(np.int32))
        samples, joints = t.joints_rad.shape
        inner = pa.array(np.arange(samples + 1, dtype=np.int32) * joints)
        angles = pa.ListArray.from_arrays(inner, pa.array(t.joints_rad.ravel()))
        columns = {
            "instance": pa.array(np.full(len(t), instance, dtype=np.int64)),
            "grasp": pa.array(t.rows.astype(np.int64)),
            "joints_rad": pa.ListArray.from_arrays(starts, angles),
        }
        for name, kind in listed.items():
            flat = pa.array(np.asarray(getattr(t, name)), kind)
            columns[name] = pa.ListArray.from_arrays(starts, flat)
        tables.append(pa.Table.from_arrays([columns[n] for n in types], schema=schema))
    return _bytes_of(pa.concat_tables(tables))
