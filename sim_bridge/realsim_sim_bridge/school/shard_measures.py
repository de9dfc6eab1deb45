"""What else is measured of the grasps of a shard besides their slips."""

import numpy as np
from numpy.typing import NDArray

from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.slip.slip_test import Slips, SlipTrial

Array = NDArray[np.float64]


def shard_measures(trial: SlipTrial, slips: Slips, config: SchoolConfig) -> dict[str, Array]:
    """Return columns by the names of `realsim.records.grasps.MEASURES`.

    Args:
        trial: N grasps of an object.
        slips: what the slip test found of them.
        config: says what is wanted.

    Returns:
        arrays (N,) or (N, 4), as each measure's unit of account is.
    """
    del trial, config
    return {"force_n": slips.force_n, "duration_s": slips.duration_s}
