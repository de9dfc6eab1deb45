"""A prepared object in the school's cache."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays
from realsim_sim_bridge.school.kept_sets import (
    MEASURE,
    named,
    of_name,
    trajectories_in,
    trajectory_arrays,
)
from realsim_sim_bridge.school.object_task import Prepared
from realsim_sim_bridge.slip.body import SlipBody

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
