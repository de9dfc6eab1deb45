"""A finished object in the school's cache: its scored set and the arm's trajectories.

What a run in a cache folder was started with: whoever goes on with it must want the same.

The folder's `run.json` holds the whole config, the versions of what computes, and of every object
hashes of its mesh and surroundings. Another run in the same folder is refused, field by field: old
and new grasps side by side look alike and mean different things.
"""

import json
import re
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.records import GraspSet
from realsim.records.grasps import GraspTrajectories
from realsim.store import atomic, provenance
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays
from realsim.store.atomic import only_run_in
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.object_task import ObjectTask, Prepared
from realsim_sim_bridge.slip.engines import MujocoSettings
from realsim_sim_bridge.slip.world import SlipBody

# --- A prepared object in the school's cache -----------------------------------------------------


_ROW_ARRAYS = ("Ts_obj_grasp", "widths_m", "openings_m", "reachable", "joints", "joints_lifted")


def write_prepared(path: Path, prepared: Prepared) -> None:
    """Keep what was prepared; a reader finds all of it or nothing."""
    arrays: dict[str, NDArray[Any]] = {name: getattr(prepared, name) for name in _ROW_ARRAYS}
    arrays |= named(MEASURE, prepared.measures) | trajectory_arrays(prepared.trajectories)
    if prepared.body is not None:
        arrays |= {
            "body_mass": np.array(prepared.body.mass_kg),
            "body_center": prepared.body.center_of_mass,
            "body_inertia": prepared.body.inertia,
            "part_vertices": np.concatenate(prepared.body.parts),
            "part_counts": np.array([len(part) for part in prepared.body.parts]),
        }
    write_arrays(path, arrays, {"reasons": prepared.reasons, "notes": prepared.notes})


def read_prepared(path: Path) -> Prepared | None:
    """Return what was prepared before, or None if nothing was; a damaged file is deleted."""
    if not is_whole(path):
        return None
    arrays, notes = read_arrays(path)
    body = None
    if "body_mass" in arrays:
        ends = np.cumsum(arrays["part_counts"])[:-1]
        body = SlipBody(
            parts=tuple(np.split(arrays["part_vertices"], ends)),
            mass_kg=float(arrays["body_mass"]),
            center_of_mass=arrays["body_center"],
            inertia=arrays["body_inertia"],
        )
    rows: dict[str, NDArray[Any]] = {name: arrays[name] for name in _ROW_ARRAYS}
    return Prepared(
        **rows,
        reasons=tuple(notes["reasons"]),
        trajectories=trajectories_in(arrays),
        measures=of_name(MEASURE, arrays),
        body=body,
        notes=notes["notes"],
    )


_ARRAYS = ("Ts_obj_grasp", "widths_m", "scores", "base_scores", "slip_m", "slip_rad", "reachable")
_TRAJECTORY_ARRAYS = ("rows", "starts", "time_s", "joints_rad", "opening_m", "phase")
MEASURE, TRAJECTORY = "measure.", "trajectory."
"""Before the names of measures and trajectory arrays in a file."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SchoolResult:
    """What the school made of one object."""

    grasp_set: GraspSet
    trajectories: GraspTrajectories | None
    """What the arm did in each attempt, by rows of the set; None = there was none."""
    unfinished: tuple[str, ...] = ()
    """Work that was given up because it ended its worker again and again; the grasps concerned
    have no score, and the next run in the same cache tries them again."""


def write_result(path: Path, result: SchoolResult) -> None:
    """Keep a result; a reader finds all of it or nothing."""
    grasp_set = result.grasp_set
    arrays: dict[str, NDArray[Any]] = {name: getattr(grasp_set, name) for name in _ARRAYS}
    arrays |= named(MEASURE, grasp_set.measures) | trajectory_arrays(result.trajectories)
    notes = {
        "obj_id": grasp_set.obj_id,
        "instance": grasp_set.instance,
        "failures": grasp_set.failures,
        "parameters": grasp_set.parameters,
    }
    write_arrays(path, arrays, notes)


def read_result(path: Path) -> SchoolResult | None:
    """Return a result kept before, or None if there is none; a damaged file is deleted."""
    if not is_whole(path):
        return None
    arrays, notes = read_arrays(path)
    rows: dict[str, NDArray[Any]] = {name: arrays[name] for name in _ARRAYS}
    grasp_set = GraspSet(
        obj_id=int(notes["obj_id"]),
        instance=int(notes["instance"]),
        failures=tuple(notes["failures"]),
        parameters=notes["parameters"],
        measures=of_name(MEASURE, arrays),
        **rows,
    )
    return SchoolResult(grasp_set=grasp_set, trajectories=trajectories_in(arrays))


def trajectory_arrays(trajectories: GraspTrajectories | None) -> dict[str, NDArray[Any]]:
    """Return trajectories as arrays for a file."""
    if trajectories is None:
        return {}
    return named(TRAJECTORY, {name: getattr(trajectories, name) for name in _TRAJECTORY_ARRAYS})


def trajectories_in(arrays: dict[str, NDArray[Any]]) -> GraspTrajectories | None:
    """Return the trajectories among a file's arrays."""
    found = of_name(TRAJECTORY, arrays)
    return GraspTrajectories(**found) if found else None


def named(prefix: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return arrays under names with a prefix."""
    return {prefix + name: values for name, values in arrays.items()}


def of_name(prefix: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return those of a file's arrays whose names have a prefix, without it."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


RUN_FILE = "run.json"
RESULTS = "instance_*.npz"
"""The run's own files; those of the convex parts carry a hash of all they depend on."""
FINISHED_FILE = "finished"
"""Empty; there when the run has been finished."""
Restart = bool | Literal["finished"]
RESULTS_VERSION = 4
"""Raised whenever the same inputs give other results with the same versions of all packages."""
PACKAGES = ("realsim", "numpy", "numba", "scipy", "coacd", "eaik", "coal", "pin", "ompl", "toppra")
"""Besides the engines: what the grasps and trajectories come from."""
OBJECT_FIELD = r"objects\.instance_(\d+)\."
MOST_TOLD = 8
"""Changed fields that a refusal names; another engine changes them all."""


def versions(config: SchoolConfig) -> dict[str, str]:
    """Return the versions of everything that computes; "not installed" where it is not."""
    settings = (config.slip.engine, config.second_engine)
    engines = {
        "mujoco" if isinstance(engine, MujocoSettings) else "pybullet"
        for engine in settings
        if engine is not None
    }
    found = {"results": str(RESULTS_VERSION)}
    return found | provenance.versions((*PACKAGES, *sorted(engines)))


def run_record(tasks: list[ObjectTask], config: SchoolConfig, shard_grasps: int) -> dict[str, Any]:
    """Return what a run is told by, as plain JSON values."""
    record = {
        "config": asdict(config),
        "versions": versions(config),
        "shard_grasps": shard_grasps,
        "objects": {f"instance_{task.instance:06d}": task.inputs() for task in tasks},
    }
    return json.loads(json.dumps(record))


@contextmanager
def folder_of_run(folder: Path, record: dict[str, Any], *, restart: Restart) -> Generator[None]:
    """Hold a folder for this run while the context lasts.

    Args:
        folder: made if it is not there.
        record: what `run_record` says of this run.
        restart: whether to discard another run's results instead of refusing; "finished" =
            those of a run that was finished.

    Raises:
        InputError: another process is at work there, or its results are of another run.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with only_run_in(folder):
        for leftover in folder.glob(f".{RESULTS}.*"):  # of a process killed while it wrote
            leftover.unlink()
        path, finished = folder / RUN_FILE, folder / FINISHED_FILE
        if restart and (restart is True or finished.is_file()) and _is_of_another(path, record):
            finished.unlink(missing_ok=True)
            # The record goes last: killed in between, the folder still says whose results remain.
            for result in folder.glob(RESULTS):
                result.unlink()
        else:
            _refuse_others(folder, path, record)
            finished.unlink(missing_ok=True)
        # Not strict JSON: a config may hold infinity.
        atomic.write_text(path, json.dumps(record, indent=1) + "\n")
        yield


def _is_of_another(path: Path, record: dict[str, Any]) -> bool:
    """Return whether results beside a record are not known to be of this run."""
    try:
        old = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return True
    return any(True for _ in provenance.differences(old, record))


def mark_finished(folder: Path) -> None:
    """Note that the run in this folder has been finished."""
    atomic.write_text(folder / FINISHED_FILE, "")


def _refuse_others(folder: Path, path: Path, record: dict[str, Any]) -> None:
    """Raise if the folder holds results of another run than this one."""
    remedy = (
        "Results are not mixed: restart discards the old ones (`--restart`, restart=True), or "
        "choose another folder."
    )
    if not path.is_file():
        if next(folder.glob(RESULTS), None) is not None:
            raise InputError(
                f"{folder} holds grasps of a Robot School but no {RUN_FILE}, so it is not known "
                f"what they were made with. {remedy}"
            )
        return
    try:
        old = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        raise InputError(
            f"{path} is damaged, so it is not known what the grasps beside it were made with. "
            f"{remedy}"
        ) from None
    changed = [(f, *map(provenance.in_short, v)) for f, *v in provenance.differences(old, record)]
    if changed:
        # Another hand or arm has other values in many fields.
        told = [c for c in changed if c[0].endswith(("hand.name", "arm.name"))]
        told = told or changed[:MOST_TOLD]
        listed = "".join(f"\n  {field}: {was} -> {now}" for field, was, now in told)
        if len(changed) > len(told):
            listed += f"\n  and {len(changed) - len(told)} more"
        numbers = {m[1] for field, *_ in changed if (m := re.match(OBJECT_FIELD, field))}
        moved = ""
        if numbers:
            which = ", ".join(str(int(n)) for n in sorted(numbers))
            moved = f" Objects, or what is around them, were moved or exchanged (instance {which})."
        raise InputError(
            f"{folder} holds a run that was started with something else.{moved}{listed}\n{remedy}"
        )
