"""A shard: some grasps of one object that one worker tests in one go, and its file.

An object's grasps on their way into the slip test, and the scored set out of what it said.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Rows
from realsim.geometry import se3
from realsim.records import STAGES, GraspSet
from realsim.records.grasps import MEASURES
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays
from realsim_sim_bridge.hold.calibration import p_hold_columns
from realsim_sim_bridge.school.cache_folder import MEASURE, SchoolResult, named, of_name, versions
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.cross_check import cross_check
from realsim_sim_bridge.school.object_task import ObjectTask, Prepared
from realsim_sim_bridge.school.sweep import run_sweep
from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings, make_engine
from realsim_sim_bridge.slip.score import score_paper, score_stages
from realsim_sim_bridge.slip.slip_test import SlipConfig, Slips, SlipTrial, run_slip_test
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import Engine, SlipBody

# --- What else is measured of the grasps of a shard besides their slips --------------------------


def shard_measures(
    trial: SlipTrial, slips: Slips, config: SchoolConfig, engine: Engine
) -> dict[str, Array]:
    """Return columns by the names of `realsim.records.grasps.MEASURES`.

    Args:
        trial: N grasps of an object.
        slips: what the slip test found of them.
        config: says what is wanted.
        engine: that of the slip test.

    Returns:
        arrays (N,) or (N, 4), as each measure's unit of account is.

    Raises:
        InputError: the second engine is not installed.
    """
    found = {"force_n": slips.force_n, "duration_s": slips.duration_s, "safety": slips.safety}
    slip, limits, hand = config.slip, config.score, config.hand
    if config.sweep is not None:
        swept = run_sweep(trial, slips, slip, limits, hand, engine, config.sweep)
        found |= swept.measures()
    if config.second_engine is not None:
        second = make_engine(config.second_engine)
        found |= cross_check(trial, slips, slip, limits, hand, second)
    return found


SHARD_S = 7.0
"""Work in a shard [s]: what a dead worker loses; handing out a job takes some ms."""
BULLET_S, MUJOCO_S = 0.4, 0.035
"""A grasp's four stages with the default settings on one core [s]; only the size of a shard depends
on it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Tested:
    """What the slip test said of some rows of an object's candidates."""

    rows: Rows
    """(n,)"""
    slip_m: Array
    """(n, 4) [m]."""
    slip_rad: Array
    """(n, 4) [rad]."""
    failures: tuple[str, ...]
    """(n,)"""
    measures: dict[str, Array]
    """(n,) or (n, 4) each."""


SWEPT = 11
"""Slip tests that a sweep adds to each grasp, about: four levels each of friction and force, and
three of the pads' stiffness."""


def default_shard_grasps(config: SchoolConfig) -> int:
    """Return the grasps of a shard: about `SHARD_S` of work in whole worlds of the engine."""
    grasp_s = _grasp_s(config.slip.engine) * (1 if config.sweep is None else 1 + SWEPT)
    if config.second_engine is not None:
        grasp_s += _grasp_s(config.second_engine)
    pairs = config.slip.engine.pairs_per_world
    return max(1, round(SHARD_S / grasp_s / pairs)) * pairs


def _grasp_s(settings: BulletSettings | MujocoSettings) -> float:
    """Return about how long a slip test takes [s]."""
    return MUJOCO_S if isinstance(settings, MujocoSettings) else BULLET_S


def shards_of(tested: Rows, size: int) -> list[Rows]:
    """Return rows in shards of at most `size`."""
    return [tested[i : i + size] for i in range(0, len(tested), size)]


def run_shard(trial: SlipTrial, rows: Rows, config: SchoolConfig) -> Tested:
    """Return what the slip test says of a shard; it depends on nothing but the arguments.

    Args:
        trial: the shard's grasps.
        rows: which of the object's candidates they are (n,).
        config: the school's.
    """
    engine = _engine(config.slip.engine)
    if config.second_engine is not None:  # which judges the engine, so there is to be one
        config = replace(config, slip=replace(config.slip, sure=None))
    slips = run_slip_test(trial, config.slip, config.score, config.hand, engine)
    return Tested(
        rows=rows,
        slip_m=slips.slip_m,
        slip_rad=slips.slip_rad,
        failures=slips.failures,
        measures=shard_measures(trial, slips, config, engine),
    )


@lru_cache(maxsize=1)
def _engine(settings: BulletSettings | MujocoSettings) -> Engine:
    """Return this worker's engine: it may keep what it has compiled of an object."""
    return make_engine(settings)


def write_tested(path: Path, tested: Tested) -> None:
    """Keep a shard's result; a reader finds all of it or nothing."""
    arrays = {"rows": tested.rows, "slip_m": tested.slip_m, "slip_rad": tested.slip_rad}
    write_arrays(path, arrays | named(MEASURE, tested.measures), {"failures": tested.failures})


def read_tested(path: Path) -> Tested | None:
    """Return a shard's result, or None if there is none; a damaged file is deleted."""
    if not is_whole(path):
        return None
    arrays, notes = read_arrays(path)
    return Tested(
        rows=arrays["rows"],
        slip_m=arrays["slip_m"],
        slip_rad=arrays["slip_rad"],
        failures=tuple(notes["failures"]),
        measures=of_name(MEASURE, arrays),
    )


def stand_of(
    config: SlipConfig, T_table_obj: Array, body: SlipBody | None, neighbours: Iterable[Array]
) -> Stand | None:
    """Return what an object stands on while the fingers close; None = nothing, by the config.

    Args:
        config: of the slip test.
        T_table_obj: (4, 4) where it stands [m].
        body: its parts; None = it is not tried.
        neighbours: vertices (V, 3) of the neighbours' convex parts, table frame [m].
    """
    friction = config.closing.table_friction
    if body is None or friction is None:
        return None
    parts = [se3.transform(T_table_obj, part) for part in body.parts]
    return Stand.around(parts, list(neighbours), friction, config.motion.gravity)


def result_of(
    task: ObjectTask,
    prepared: Prepared,
    tested: list[Tested],
    given_up: list[tuple[Rows, str]],
    standing: dict[str, Any] | None = None,
) -> SchoolResult:
    """Return what the school made of an object.

    Args:
        task: the object.
        prepared: its candidates.
        tested: what the slip test said of its shards, in any order.
        given_up: rows that could not be tested, and why; they have no score.
        standing: what is noted of the stand on which the fingers closed.
    """
    n = len(prepared.widths_m)
    slip_m, slip_rad = np.full((n, len(STAGES)), np.nan), np.full((n, len(STAGES)), np.nan)
    failures = list(prepared.reasons)
    tried = np.full(n, prepared.body is not None)
    for shard in tested:
        slip_m[shard.rows], slip_rad[shard.rows] = shard.slip_m, shard.slip_rad
        for row, failure in zip(shard.rows.tolist(), shard.failures, strict=True):
            failures[row] = failure
    for rows, why in given_up:
        tried[rows] = False
        for row in rows.tolist():
            failures[row] = f"not tested: {why}"
    base, scores = score_stages(slip_m, slip_rad, tried, task.config.score)
    known = prepared.measures | {"score_paper": score_paper(slip_m, slip_rad, tried)}
    if task.config.hold is not None and "p_hold_error" in known:
        attempted = np.where(prepared.reachable, scores, np.nan)
        known |= p_hold_columns(known, attempted, task.config.hold.draws, task.config.calibration)
    grasp_set = GraspSet(
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
        measures=_measures(known, tested, n),
        parameters=_parameters(task, prepared) | {"stand": standing},
    )
    return SchoolResult(
        grasp_set=grasp_set,
        trajectories=prepared.trajectories,
        unfinished=tuple(f"{in_words(rows)}: {why}" for rows, why in given_up),
    )


def in_words(rows: Rows) -> str:
    """Return the numbers of some grasps in words: 'grasps 3, 5 to 9 and 12'."""
    if len(rows) == 0:
        return "all grasps"
    breaks = np.nonzero(np.diff(rows) != 1)[0] + 1
    runs = [(int(run[0]), int(run[-1])) for run in np.split(rows, breaks) if len(run)]
    words = [f"{first}" if first == last else f"{first} to {last}" for first, last in runs]
    told = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    return f"{'grasp' if len(rows) == 1 else 'grasps'} {told}"


def _measures(known: dict[str, Array], tested: list[Tested], n: int) -> dict[str, Array]:
    """Return all measures as columns of n candidates; NaN where a shard was not tested."""
    columns: dict[str, Array] = {}
    for name in MEASURES:  # in the table's order, whichever shard came first
        shards = [shard for shard in tested if name in shard.measures]
        if name in known:
            columns[name] = known[name]
        elif shards:
            shape = (n, len(STAGES)) if MEASURES[name].by_stage else (n,)
            columns[name] = np.full(shape, np.nan)
            for shard in shards:
                columns[name][shard.rows] = shard.measures[name]
    return columns


def _parameters(task: ObjectTask, prepared: Prepared) -> dict[str, Any]:
    """Return everything the scores depend on, as plain JSON values."""
    nothing = [None] * prepared.joints.shape[1]
    parameters: dict[str, Any] = {
        "config": asdict(task.config),
        "inputs": task.inputs(),
        "versions": versions(task.config),
        "density": task.density,
        "score_rule": task.config.score.rule(),
        "middle_xy_m": list(task.middle_xy),
        "openings_m": prepared.openings_m.tolist(),
        "joints_rad": [q if q[0] == q[0] else nothing for q in prepared.joints.tolist()],
        **prepared.notes,
    }
    hand = task.config.hand
    if hand.arc_radius_m:
        parameters["pad_heights_m"] = hand.z_pad(prepared.widths_m).tolist()
    # Through JSON: what is kept is what is returned (tuples become lists).
    return json.loads(json.dumps(parameters))
