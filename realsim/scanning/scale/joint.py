"""Everything fitted together: object, table, cameras, depth bias, outlines and shape error.

The joint fit minimises, over object (7), table (3), depth bias, outline offset, hand-eye (6), one
twist per view (6 each) and an offset delta_k of the real surface per patch of the mesh,
    sum of surface points   (r - delta_k)^2 / var   (data to model, at the side the camera saw)
  + sum of outline points   (r + delta_k)^2 / var   (model to data: keeps the model from growing)
  + sum of table points     r^2 / var
  + contact of the lowest point with the table
  + priors of hand-eye, arm, bias, outline offset and of the shape's error (see `shape_error`).
The table makes the cameras' height and tilt visible, which would otherwise pass for a change of
size. The inverse of the normal matrix is the covariance of the result.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.equations import (
    Rims,
    Surface,
    System,
    coarser,
    linearised,
    local_points,
    outlines_of,
    pivot_of,
    surface_of,
)
from realsim.scanning.scale.evidence import ScanEvidence
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.shape_error import (
    ShapeModel,
    posterior,
    shape_models,
    within_share,
)
from realsim.scanning.scale.state import (
    BIAS,
    HAND_EYE,
    RIM,
    TABLE,
    VIEWS,
    State,
    moved_all,
)

Array = NDArray[np.float64]
CUTS = (6.0, 4.5, 4.0, 4.0)
"""Tukey's cut-offs of the rounds [sigma of noise and shape]."""
STEPS = 3
"""Gauss-Newton steps between two assignments of patches and outlines."""
FIRST_SHAPE = 0.015
"""The shape's 1-sigma before it has been measured, as a share of the size."""
LEAST_PROBABILITY = 1e-3
"""Assumptions about the shape less probable than this are left out of the mean."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Outlook:
    """What the last step of the joint fit saw."""

    covariance: Array
    """(18, 18) of object, table, biases and hand-eye; all assumptions about the shape averaged."""
    without: dict[str, float]
    """Variance of the log scale if one source of error were gone: 'shape', 'hand-eye', 'arm',
    'bias', 'noise'."""
    residuals: Array
    """(N,) of the surface points [m]; NaN = the camera cannot have seen that surface."""
    kernels: Array
    """(N,) Tukey's weights; 0 = not used."""
    view_of: NDArray[np.int64]
    """(N,) which view (its place in the list) a surface point belongs to."""
    local: Array
    """(N, 3) the surface points in the inner mesh's axes."""
    offsets: Array
    """(K,) by how much the real surface lies outside of the mesh, per patch [m]."""
    offset_sigmas: Array
    """(K,) 1-sigma of that [m]."""
    shape: ShapeModel
    """The most probable assumption about the shape's error."""
    history: tuple[dict[str, float], ...] = ()


def joint_fit(
    shape: ScanShape, evidence: ScanEvidence, start: State, config: ScaleConfig
) -> tuple[State, Outlook]:
    """Return everything fitted together from a start that is right to some millimetres."""
    state, size = start, evidence.size_m
    offsets = np.zeros(len(shape.patches.areas))
    width = FIRST_SHAPE * size
    models: list[ShapeModel] = []
    seen: tuple[Array, Array] = (np.zeros(0), np.zeros(0))
    history: list[dict[str, float]] = []
    surface, rims = surface_of(shape, evidence, state, config), Rims([], [], [])
    for cut in CUTS:
        surface = surface_of(shape, evidence, state, config)
        rims = outlines_of(shape, evidence, state, config)
        within = 0.0
        if models:
            inner = within_share(shape.patches, models[0].length_m / state.s)
            within = models[0].sigma_m * inner
        surface = coarser(surface, within, config)
        for step in range(STEPS):
            system, seen = linearised(
                shape, evidence, state, (surface, rims), (offsets, cut, width), config
            )
            information, offered = system.of_offsets()
            if step == 0 or not models:
                models = shape_models(
                    shape.patches, information, offered, (state.s, size), config.shape
                )
            offsets, _ = posterior(information, offered, models[0].covariance)
            pivot = pivot_of(evidence, state)
            state = moved_all(state, system.rest(offsets), pivot)
        width = max(models[0].sigma_m, config.shape.floor_m)
        history.append({
            "scale": state.s * shape.unit, "shape_mm": 1e3 * models[0].sigma_m,
            "length_mm": 1e3 * models[0].length_m, "rim_px": state.rim, "bias_per_m": state.bias,
            "outline_points": float(sum(len(r) for r in rims.points)),
        })  # fmt: skip
    system, seen = linearised(
        shape, evidence, state, (surface, rims), (offsets, CUTS[-1], width), config
    )
    look = _outlook(shape, evidence, state, (surface, system, seen), config)
    # The mean over all assumptions about the shape, of which the last step took the best.
    state = moved_all(state, look[1], pivot_of(evidence, state))
    return state, replace(look[0], history=tuple(history), local=local_points(state, evidence))


def _outlook(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: State,
    last: tuple[Surface, System, tuple[Array, Array]],
    config: ScaleConfig,
) -> tuple[Outlook, Array]:
    """Return what was seen, and the step to the mean over all assumptions about the shape."""
    surface, system, (residuals, kernels) = last
    information, offered = system.of_offsets()
    models = shape_models(
        shape.patches, information, offered, (state.s, evidence.size_m), config.shape
    )
    likely = [m for m in models if m.probability > LEAST_PROBABILITY]
    total = sum(m.probability for m in likely)
    n = len(system.g)
    mean, second, within = np.zeros(n), np.zeros((n, n)), np.zeros((n, n))
    offsets, spread = np.zeros(len(offered)), np.zeros(len(offered))
    for m in likely:
        p = m.probability / total
        d, C = posterior(information, offered, m.covariance)
        x = system.rest(d)
        mean += p * x
        second += p * np.outer(x, x)
        within += p * system.covariance(C)
        offsets += p * d
        spread += p * np.diag(C)
    covariance = within + second - np.outer(mean, mean)
    best = posterior(information, offered, models[0].covariance)[1]
    look = Outlook(
        covariance=covariance[:VIEWS, :VIEWS],
        without=_without(system, best),
        residuals=residuals, kernels=kernels, view_of=surface.view_of, local=np.zeros((0, 3)),
        offsets=offsets, offset_sigmas=np.sqrt(spread), shape=models[0],
    )  # fmt: skip
    return look, mean


def _without(system: System, offset_covariance: Array) -> dict[str, float]:
    """Return the variance of the log scale if each source of error were known exactly."""
    # Noise alone: nothing but the object unknown.
    out = {
        "shape": float(np.linalg.inv(system.G)[6, 6]),
        "all": float(np.linalg.inv(system.G[:7, :7])[6, 6]),
    }
    full = np.linalg.inv(system.covariance(offset_covariance))
    n = len(system.g)
    sources = {
        "bias": [BIAS], "outline": [RIM], "hand-eye": list(range(HAND_EYE, VIEWS)),
        "arm": list(range(VIEWS, n)), "table": list(range(TABLE, TABLE + 3)),
    }  # fmt: skip
    for name, known in sources.items():
        free = np.setdiff1d(np.arange(n), known)
        out[name] = float(np.linalg.inv(full[np.ix_(free, free)])[6, 6])
    return out
