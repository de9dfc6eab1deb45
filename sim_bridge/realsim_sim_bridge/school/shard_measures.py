"""What else is measured of the grasps of a shard besides their slips."""

import numpy as np
from numpy.typing import NDArray

from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.cross_check import cross_check
from realsim_sim_bridge.school.sweep import sweep_margins
from realsim_sim_bridge.slip.engines import make_engine
from realsim_sim_bridge.slip.slip_test import Slips, SlipTrial
from realsim_sim_bridge.slip.world import Engine

Array = NDArray[np.float64]


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
    found = {"force_n": slips.force_n, "duration_s": slips.duration_s}
    slip, limits, hand = config.slip, config.score, config.hand
    if config.sweep is not None:
        found |= sweep_margins(trial, slips, slip, limits, hand, engine, config.sweep)
    if config.second_engine is not None:
        second = make_engine(config.second_engine)
        found |= cross_check(trial, slips, slip, limits, hand, second)
    return found
