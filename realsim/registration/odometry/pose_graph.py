"""Poses that agree best with all measured pairs and with the table (GTSAM)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.interop import T_from_pose3, pose3_from_T
from realsim.registration.odometry.pairs import Edge

Array = NDArray[np.float64]
FREE = 1.0
"""Sigma of what the table does not tell (place on it [m] and turn about its normal [rad])."""
FIXED = 1e-6
"""Likewise of the first view, which is where it is: the table fixes the rest of it as well."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GraphConfig:
    """How much the measurements are believed."""

    pair_mm: float = 0.3
    """Sigma of a pair's shift along each axis at 0 degrees [mm]; in simulation a pair of 6 to 12
    degrees is wrong by 0.3 mm in all, one of 20 to 35 by 0.6."""
    pair_deg: float = 0.04
    """Sigma of its turn about each axis [deg]."""
    per_deg: float = 0.05
    """Both grow by this part for each degree between the views."""
    table_mm: float = 0.4
    """Sigma of the height of a view over its own table plane [mm]."""
    table_deg: float = 0.06
    """Sigma of its roll and pitch against it [deg]."""
    cauchy: float = 2.0
    """Whitened length from which a pair counts less: a wrong loop must not bend the path."""
    inflation: float = 2.0
    """Sigmas are enlarged by this: pairs of one view share its depth errors."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Graph:
    """The optimised poses."""

    Ts_world_cam: Array
    """(F, 4, 4) [m]."""
    covariances: Array
    """(F, 6, 6) of the right twists [rad, m]."""
    residuals: Array
    """(E, 6) what is left of each pair's twist [rad, m]."""


def optimised(
    Ts_world_cam: Array, edges: Sequence[Edge], levelled: Sequence[bool], angles: Array,
    config: GraphConfig,
) -> Graph:  # fmt: skip
    """Return the poses that fit all pairs and the table best, with their covariances.

    Args:
        Ts_world_cam: (F, 4, 4) a first estimate in a world whose z = 0 is the table; the first
            view saw it and stays where it is on it.
        edges: measured pairs.
        levelled: (F,) whether the view saw the table, so that its height, roll and pitch are good.
        angles: (F, F) how different the views are [deg].
        config: see there.
    """
    import gtsam

    graph: Any = gtsam.NonlinearFactorGraph()
    values: Any = gtsam.Values()
    noise: Any = gtsam.noiseModel
    for k, T in enumerate(Ts_world_cam):
        values.insert(k, pose3_from_T(T))
        if not levelled[k]:
            continue
        model = noise.Gaussian.Covariance(_of_table(T, FIXED if k == 0 else FREE, config))
        graph.add(gtsam.PriorFactorPose3(k, pose3_from_T(T), model))
    for e in edges:
        grown = 1.0 + config.per_deg * float(angles[e.first, e.second])
        sigmas = grown * np.repeat([np.radians(config.pair_deg), 1e-3 * config.pair_mm], 3)
        model = noise.Robust.Create(
            noise.mEstimator.Cauchy.Create(config.cauchy), noise.Diagonal.Sigmas(sigmas)
        )
        graph.add(
            gtsam.BetweenFactorPose3(e.first, e.second, pose3_from_T(e.T_first_second), model)
        )
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    Ts = np.stack([T_from_pose3(result.atPose3(k)) for k in range(len(Ts_world_cam))])
    marginals: Any = gtsam.Marginals(graph, result)
    C = np.stack([np.asarray(marginals.marginalCovariance(k)) for k in range(len(Ts))])
    r = [
        se3.log(se3.invert(Ts[e.second]) @ Ts[e.first] @ e.T_first_second) for e in edges
    ]  # fmt: skip
    return Graph(
        Ts_world_cam=Ts,
        covariances=config.inflation**2 * C,
        residuals=np.stack(r) if r else np.zeros((0, 6)),
    )


def _of_table(T_world_cam: Array, free: float, config: GraphConfig) -> Array:
    """Return the covariance (6, 6) of the camera's right twist that its table plane leaves.

    In the world's twist it is diagonal; T exp(xi) = exp(Ad xi) T maps it to the camera's. `free` is
    the sigma of the place on the table and of the turn about its normal.
    """
    tilt, height = np.radians(config.table_deg), 1e-3 * config.table_mm
    # Turned under the camera, so that a tilt does not count as a change of height as well.
    below = se3.from_translation([*T_world_cam[:2, 3], 0.0])
    sigmas = np.array([tilt, tilt, free, free, free, height])
    A = se3.adjoint(se3.invert(T_world_cam) @ below)
    return A @ np.diag(np.square(sigmas)) @ A.T
