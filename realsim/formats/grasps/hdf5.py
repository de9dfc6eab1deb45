"""All tried grasps of a scene as one HDF5 file, and back.

    /                         format, format_version, realsim, scene, frames, stages (attributes)
    /T_world_table            (4, 4), where it is known
    /sets/000002_obj000007/   obj_id, instance, name (attributes)
        T_obj_grasp           (N, 4, 4) grasp in object
        T_world_grasp         (N, 4, 4) where the object's pose is known, with T_world_obj (4, 4)
        T_table_grasp         (N, 4, 4) where the table's is known, too
        width_m score base_score reachable failure       (N,)
        slip_m slip_rad       (N, 4), one column a stage
        measures/NAME         (N,) or (N, 4)
        parameters            JSON
        trajectories/         rows starts time_s joints_rad opening_m phase

Every dataset has the attributes `unit` and `meaning`. Attempt a of the trajectories belongs to
grasp rows[a]; its samples are starts[a] to starts[a + 1]. The world and table poses are for the
reader's convenience: T_obj_grasp and T_world_obj are what is read back.
"""

import io
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int64
from realsim.formats.grasps.scene_grasps import SceneGrasps, parameters_json
from realsim.formats.hdf5_checked import CheckedGroup, opened
from realsim.records import STAGES, GraspSet
from realsim.records.grasps import MEASURES, PHASES, GraspTrajectories
from realsim.store import atomic

FORMAT = "realsim grasps"
FORMAT_VERSION = 1
FRAMES = (
    "T_a_b maps b to a: p_a = T_a_b p_b. grasp: origin between the fingertips (Franka's tool "
    "centre point), z = approach, y = closing axis. Metres."
)
COMPRESSED_FROM = 256
"""Numbers from which an array is packed: a chunk costs more than it saves below."""
COLUMNS: dict[str, tuple[str, str, str]] = {
    "width_m": (
        "widths_m",
        "m",
        "distance of the contacts along the closing axis; NaN = not known",
    ),
    "score": ("scores", "1", "0 to 1, the slips' penalties included; NaN = not tried"),
    "base_score": ("base_scores", "1", "a quarter for every stage passed; NaN = not tried"),
    "slip_m": ("slip_m", "m", "slip in the hand by stage; NaN = not executed, inf = lost"),
    "slip_rad": ("slip_rad", "rad", "turn in the hand by stage; NaN = not executed, inf = lost"),
}
"""Dataset -> field of the GraspSet, unit, meaning."""
SAMPLES: dict[str, tuple[str, str]] = {
    "rows": ("1", "grasp of each attempt"),
    "starts": ("1", "first sample of each attempt, and the number of samples"),
    "time_s": ("s", "since the attempt's start"),
    "joints_rad": ("rad", "angles of the arm's joints"),
    "opening_m": ("m", "commanded distance of the finger faces"),
    "phase": ("1", "number in " + ", ".join(PHASES)),
}


def write_grasps_hdf5(path: Path | str, scene: SceneGrasps) -> Path:
    """Write the grasps of a scene, whole or not at all; the same grasps give the same bytes."""
    path = Path(path)
    atomic.write_bytes(path, grasps_hdf5_bytes(scene))
    return path


def grasps_hdf5_bytes(scene: SceneGrasps) -> bytes:
    """Return the grasps of a scene as the content of an HDF5 file."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["realsim"] = version("realsim")
        file.attrs["scene"] = scene.name
        file.attrs["frames"] = FRAMES
        file.attrs["stages"] = ", ".join(STAGES)
        if scene.T_world_table is not None:
            _put(file, "T_world_table", scene.T_world_table, "m", "table in world")
        sets = file.create_group("sets")
        for s in scene.sets:
            group = sets.create_group(f"{s.instance:06d}_obj{s.obj_id:06d}")
            group.attrs["name"] = scene.names.get(s.obj_id, "")
            _put(group, "T_obj_grasp", s.Ts_obj_grasp, "m", "grasp in object")
            put_set(group, s, np.arange(len(s)))
            _put_poses(group, scene, s)
            if s.instance in scene.trajectories:
                attempts = group.create_group("trajectories")
                for name, (unit, meaning) in SAMPLES.items():
                    values = getattr(scene.trajectories[s.instance], name)
                    _put(attempts, name, values, unit, meaning)
    return buffer.getvalue()


def read_grasps_hdf5(path: Path | str) -> SceneGrasps:
    """Return the grasps of a file of `write_grasps_hdf5`.

    Raises:
        InputError: it is none, of a newer format, damaged, points into other files, or holds
            numbers that no grasp has.
    """
    with opened(path) as file:
        if file.attribute("format", str) != FORMAT:
            raise file.wrong(f"the format is not '{FORMAT}'; another program wrote it.")
        found = file.attribute("format_version", int)
        if found != FORMAT_VERSION:
            raise file.wrong(
                f"the format version is {found}; this realsim reads {FORMAT_VERSION}. Read it with "
                "the version that wrote it, or a newer one."
            )
        table = file.numbers("T_world_table", (4, 4)) if file.has("T_world_table") else None
        sets: list[GraspSet] = []
        names: dict[int, str] = {}
        poses: dict[int, Array] = {}
        trajectories: dict[int, GraspTrajectories] = {}
        groups = file.group("sets")
        for name in groups.names():
            group = groups.group(name)
            s = get_set(group, group.numbers("T_obj_grasp", (None, 4, 4)))
            sets.append(s)
            called = group.attribute("name", str)
            if called:
                names[s.obj_id] = called
            if group.has("T_world_obj"):
                poses[s.instance] = group.numbers("T_world_obj", (4, 4))
            if group.has("trajectories"):
                trajectories[s.instance] = _get_attempts(group.group("trajectories"))
        return SceneGrasps(
            sets=tuple(sets), name=file.attribute("scene", str), names=names,
            trajectories=trajectories, Ts_world_obj=poses, T_world_table=table,
        )  # fmt: skip


# --- one set ----------------------------------------------------------------------------------


def put_set(group: Any, s: GraspSet, rows: Int64) -> None:
    """Write some rows of a set into a group, all but the poses."""
    group.attrs["obj_id"] = s.obj_id
    group.attrs["instance"] = s.instance
    for name, (field, unit, meaning) in COLUMNS.items():
        _put(group, name, getattr(s, field)[rows], unit, meaning)
    reachable = s.reachable[rows]
    _put(group, "reachable", reachable, "1", "whether the arm has a path free of collisions")
    texts = [s.failures[row].encode() for row in rows.tolist()]
    length = max([1, *(len(t) for t in texts)])
    _put(
        group, "failure", np.array(texts, dtype=f"S{length}"), "", "why it stopped; '' = passed all"
    )
    measures = group.create_group("measures")
    for name, values in s.measures.items():
        _put(measures, name, values[rows], MEASURES[name].unit, MEASURES[name].meaning)
    _put(
        group, "parameters", _text(parameters_json(s)), "", "all that the scores depend on, as JSON"
    )


def _put_poses(group: Any, scene: SceneGrasps, s: GraspSet) -> None:
    """Write where the object stood and the grasps from there, as far as it is known."""
    world, table = scene.Ts_world_grasp(s), scene.Ts_table_grasp(s)
    if world is not None:
        _put(group, "T_world_obj", scene.Ts_world_obj[s.instance], "m", "object in world")
        _put(group, "T_world_grasp", world, "m", "grasp in world")
    if table is not None:
        _put(group, "T_table_grasp", table, "m", "grasp in the table's frame, z up")


def _put(group: Any, name: str, values: NDArray[Any], unit: str, meaning: str) -> None:
    packed: dict[str, Any] = {}
    if values.size >= COMPRESSED_FROM:
        packed = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    if values.dtype.kind == "S":
        import h5py

        values = values.astype(h5py.string_dtype("utf-8", values.dtype.itemsize))
    dataset = group.create_dataset(name, data=values, track_times=False, **packed)
    dataset.attrs["unit"] = unit
    dataset.attrs["meaning"] = meaning


def _text(text: str) -> NDArray[np.bytes_]:
    data = text.encode()
    return np.array(data, dtype=f"S{max(1, len(data))}")


def get_set(group: CheckedGroup, Ts: Array) -> GraspSet:
    """Return the set of these poses (N, 4, 4) [m] that `put_set` wrote."""
    n, stages = len(Ts), len(STAGES)
    columns = {
        field: group.numbers(name, (n, stages) if field.startswith("slip") else (n,))
        for name, (field, _, _) in COLUMNS.items()
    }
    measured = group.group("measures")
    measures = {
        name: measured.numbers(name, (n, stages) if MEASURES[name].by_stage else (n,))
        for name in _known_measures(measured.names(), measured)
    }
    parameters = group.json("parameters")
    if not isinstance(parameters, dict):
        raise group.wrong("the parameters are no JSON object.")
    return GraspSet(
        obj_id=group.attribute("obj_id", int),
        instance=group.attribute("instance", int),
        Ts_obj_grasp=Ts,
        reachable=group.booleans("reachable", (n,)),
        failures=group.texts("failure", n),
        measures=measures,
        parameters=parameters,
        **columns,
    )


def _known_measures(names: list[str], group: CheckedGroup) -> list[str]:
    """Return the names in the order of MEASURES.

    Raises:
        InputError: one of them is no measure.
    """
    unknown = [name for name in names if name not in MEASURES]
    if unknown:
        raise group.wrong(
            f"'{unknown[0]}' is no measure of a grasp; there are: {', '.join(MEASURES)}."
        )
    return [name for name in MEASURES if name in names]


def _get_attempts(group: CheckedGroup) -> GraspTrajectories:
    samples = group.numbers("time_s", (None,))
    return GraspTrajectories(
        rows=group.integers("rows", (None,)),
        starts=group.integers("starts", (None,)),
        time_s=samples,
        joints_rad=group.numbers("joints_rad", (len(samples), None)),
        opening_m=group.numbers("opening_m", (len(samples),)),
        phase=group.integers("phase", (len(samples),)),
    )
