"""A finished grasp set in the school's cache."""

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from realsim.records import GraspSet
from realsim.store.arrays_on_disk import read_arrays, write_arrays

_ARRAYS = (
    "Ts_obj_grasp",
    "widths_m",
    "scores",
    "base_scores",
    "slip_m",
    "slip_rad",
    "reachable",
)


def write_grasp_set(path: Path, grasp_set: GraspSet) -> None:
    """Keep a set; a reader finds all of it or nothing."""
    notes = {
        "obj_id": grasp_set.obj_id,
        "instance": grasp_set.instance,
        "failures": grasp_set.failures,
        "parameters": grasp_set.parameters,
    }
    write_arrays(path, {name: getattr(grasp_set, name) for name in _ARRAYS}, notes)


def read_grasp_set(path: Path) -> GraspSet:
    """Return a set kept before."""
    arrays, notes = read_arrays(path)
    rows: dict[str, NDArray[Any]] = {name: arrays[name] for name in _ARRAYS}
    return GraspSet(
        obj_id=int(notes["obj_id"]),
        instance=int(notes["instance"]),
        failures=tuple(notes["failures"]),
        parameters=notes["parameters"],
        **rows,
    )
