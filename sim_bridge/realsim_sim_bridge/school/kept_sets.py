"""A finished object in the school's cache: its scored set and the arm's trajectories."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.records import GraspSet
from realsim.records.trajectories import GraspTrajectories
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays
from realsim_sim_bridge.school.object_task import Prepared
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
