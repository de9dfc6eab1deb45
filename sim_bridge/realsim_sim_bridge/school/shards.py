"""A shard: some grasps of one object that one worker tests in one go, and its file."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from realsim.arrays import Array, Rows
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.cross_check import cross_check
from realsim_sim_bridge.school.kept_sets import MEASURE, named, of_name
from realsim_sim_bridge.school.sweep import run_sweep
from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings, make_engine
from realsim_sim_bridge.slip.slip_test import Slips, SlipTrial, run_slip_test
from realsim_sim_bridge.slip.world import Engine

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
