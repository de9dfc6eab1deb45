"""The second job of an object in the school: its grasps in the slip test, and the scored set."""

import json
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.records import STAGES, GraspSet
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.school.object_task import ObjectTask, Prepared
from realsim_sim_bridge.slip.score import score_stages
from realsim_sim_bridge.slip.slip_test import Slips, SlipTrial, run_slip_test

Rows = NDArray[np.int64]


def trial_of(task: ObjectTask, prepared: Prepared, rows: Rows) -> SlipTrial:
    """Return some rows of the candidates, ready for the slip test."""
    assert prepared.body is not None, "rows are tested only of objects with a body"
    lifted = prepared.joints_lifted[rows]
    axes, points = panda.joint5_in_grasp(lifted)
    Ts = prepared.Ts_obj_grasp[rows]
    return SlipTrial(
        body=prepared.body,
        Ts_obj_grasp=Ts,
        Ts_table_grasp=task.T_table_obj @ Ts,
        openings_m=prepared.openings_m[rows],
        joint5_axes=axes,
        joint5_points=points,
        joint5_ranges=np.stack(
            [panda.LOWER[4] - lifted[:, 4], panda.UPPER[4] - lifted[:, 4]], axis=-1
        ),
    )


def rows_path(task: ObjectTask, rows: Rows) -> Path | None:
    """Return where the slips of these rows are kept."""
    return task.path(f"rows_{int(rows[0]):05d}")


def slips_of_rows(task: ObjectTask, prepared: Prepared, rows: Rows) -> Slips:
    """Return the slips of some rows of the candidates, all tested in one world."""
    path = rows_path(task, rows)
    if path is not None and is_whole(path):
        arrays, notes = read_arrays(path)
        return Slips(
            slip_m=arrays["slip_m"],
            slip_rad=arrays["slip_rad"],
            failures=tuple(notes["failures"]),
        )
    config = task.config
    slips = run_slip_test(trial_of(task, prepared, rows), config.slip, config.score, config.hand)
    if path is not None:
        arrays = {"slip_m": slips.slip_m, "slip_rad": slips.slip_rad}
        write_arrays(path, arrays, {"failures": slips.failures})
    return slips


def grasp_set_of(
    task: ObjectTask, prepared: Prepared, tested: list[tuple[Rows, Slips]]
) -> GraspSet:
    """Return the scored set of an object from all its parts."""
    n = len(prepared.widths_m)
    slip_m, slip_rad = np.full((n, len(STAGES)), np.nan), np.full((n, len(STAGES)), np.nan)
    failures = list(prepared.reasons)
    for rows, slips in tested:
        slip_m[rows], slip_rad[rows] = slips.slip_m, slips.slip_rad
        for row, failure in zip(rows.tolist(), slips.failures, strict=True):
            failures[row] = failure
    tried = np.full(n, prepared.body is not None)
    base, scores = score_stages(slip_m, slip_rad, tried, task.config.score)
    nothing = [None] * panda.JOINTS
    parameters: dict[str, Any] = {
        "config": asdict(task.config),
        "inputs": task.key(),
        "versions": {name: version(name) for name in ("realsim", "pybullet", "coacd", "eaik")},
        "density": task.density,
        "middle_xy_m": list(task.middle_xy),
        "openings_m": prepared.openings_m.tolist(),
        "joints_rad": [q if q[0] == q[0] else nothing for q in prepared.joints.tolist()],
        **prepared.notes,
    }
    return GraspSet(
        obj_id=task.obj_id,
        instance=task.instance,
        Ts_obj_grasp=prepared.Ts_obj_grasp,
        widths_m=prepared.widths_m,
        scores=scores,
        base_scores=base,
        slip_m=slip_m,
        slip_rad=slip_rad,
        reachable=prepared.reachable,
        failures=tuple(failures),
        # Through JSON: what is kept is what is returned (tuples become lists).
        parameters=json.loads(json.dumps(parameters)),
    )
