"""Everything fitted together: object, table, cameras, depth bias, outlines and shape error.

The joint fit is registration's (see `registration.refinement`), with three kinds of unknowns more:
the size, the outlines' offset, and an offset delta_k of the real surface per patch of the mesh,
whose prior is that of the shape's error (see `shape_error`); `equations` says what is minimised.
The table makes the cameras' height and tilt visible, which would otherwise pass for a change of
size. The inverse of the normal matrix is the covariance of the result.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int32
from realsim.geometry.normal_equations import System, inverse, view_steps
from realsim.records import Mesh
from realsim.registration.refinement.equations import BIAS_AT, HAND_EYE_AT, TABLE_AT
from realsim.scanning.scale import equations
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence
from realsim.scanning.scale.shape import (
    INNER_EXTENT,
    ScanShape,
    ShapeModel,
    posterior,
    shape_models,
    within_share,
)
from realsim.scanning.scale.state import (
    PATCHES,
    RIM,
    SIMILARITY,
    SIZE,
    ScaleState,
    claimed_cameras,
    moved_state,
)

CUTS = (6.0, 4.5, 4.0, 4.0)
"""Tukey's cut-offs of the rounds [sigma of noise and shape]."""
STEPS = 3
"""Gauss-Newton steps between two assignments of patches and outlines."""
FIRST_SHAPE = 0.015
"""The shape's 1-sigma before it has been measured, as a share of the size."""
LEAST_PROBABILITY = 1e-3
"""Assumptions about the shape less probable than this are left out of the mean."""
REACH = 0.03
"""Points within this share of the size speak for a vertex of the residual map."""
NEIGHBOURS = 12
"""At most so many of them."""
FEWEST = 3
"""Fewer do not make a median."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Outlook:
    """What the last step of the joint fit saw."""

    covariance: Array
    """(19, 19) of the shared unknowns (see `state`); all assumptions about the shape averaged."""
    without: dict[str, float]
    """Variance of the log scale if one source of error were gone: 'shape', 'hand-eye', 'arm',
    'bias', 'noise'."""
    residuals: Array
    """(N,) of the surface points [m]; NaN = the camera cannot have seen that surface."""
    kernels: Array
    """(N,) Tukey's weights; 0 = not used."""
    view_of: Int32
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
    shape: ScanShape, evidence: ScanEvidence, start: ScaleState, config: ScaleConfig
) -> tuple[ScaleState, Outlook]:
    """Return everything fitted together from a start that is right to some millimetres."""
    state, size = start, evidence.size_m
    offsets = np.zeros(len(shape.patches.areas))
    width = FIRST_SHAPE * size
    models: list[ShapeModel] = []
    history: list[dict[str, float]] = []
    held: equations.Round | None = None
    for cut in CUTS:
        within = 0.0
        if models:
            inner = within_share(shape.patches, models[0].length_m / state.s)
            within = models[0].sigma_m * inner
        held = equations.new_round(shape, evidence, state, within, config)
        for step in range(STEPS):
            system, *_ = equations.linearised(
                shape, evidence, state, held, (offsets, cut, width), config
            )
            shared = equations.reduced(system)
            information, offered = shared.of_offsets()
            if step == 0 or not models:
                models = shape_models(
                    shape.patches, information, offered, (state.s, size), config.shape
                )
            offsets, _ = posterior(information, offered, models[0].covariance)
            state = _moved(state, system, shared.rest(offsets), offsets)
        width = max(models[0].sigma_m, config.shape.floor_m)
        history.append({
            "scale": state.s * shape.unit, "shape_mm": 1e3 * models[0].sigma_m,
            "length_mm": 1e3 * models[0].length_m, "rim_px": state.rim,
            "bias_per_m": state.bias_per_m,
            "outline_points": float(sum(len(r) for r in held.rims.points)),
        })  # fmt: skip
    assert held is not None, "there is at least one round"
    system, residuals, kernels = equations.linearised(
        shape, evidence, state, held, (offsets, CUTS[-1], width), config
    )
    look, (mean, offsets) = _outlook(shape, evidence, state, (system, residuals, kernels), config)
    # The mean over all assumptions about the shape, of which the last step took the best.
    state = _moved(state, system, mean, offsets)
    cameras = state.cameras(claimed_cameras(evidence.views))
    (places, *_), _ = equations.object_distances(shape, state, cameras, held.points, held.views)
    local = places / state.s
    return state, replace(look, history=tuple(history), local=local, view_of=held.views)


def _moved(state: ScaleState, system: System, rest: Array, offsets: Array) -> ScaleState:
    """Return the state after the step of everything but the offsets, which are as given."""
    shared = np.concatenate([rest, offsets])
    return moved_state(state, shared, view_steps(system, shared))


def _outlook(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: ScaleState,
    last: tuple[System, Array, Array],
    config: ScaleConfig,
) -> tuple[Outlook, tuple[Array, Array]]:
    """Return what was seen, and step and offsets in the mean over all assumptions."""
    system, residuals, kernels = last
    shared = equations.reduced(system)
    information, offered = shared.of_offsets()
    models = shape_models(
        shape.patches, information, offered, (state.s, evidence.size_m), config.shape
    )
    likely = [m for m in models if m.probability > LEAST_PROBABILITY]
    total = sum(m.probability for m in likely)
    mean, second, within = np.zeros(PATCHES), np.zeros((PATCHES,) * 2), np.zeros((PATCHES,) * 2)
    offsets, spread = np.zeros(len(offered)), np.zeros(len(offered))
    for m in likely:
        p = m.probability / total
        d, C = posterior(information, offered, m.covariance)
        x = shared.rest(d)
        mean += p * x
        second += p * np.outer(x, x)
        within += p * shared.covariance(C)
        offsets += p * d
        spread += p * np.diag(C)
    look = Outlook(
        covariance=within + second - np.outer(mean, mean),
        without=_without(system, models[0].covariance),
        residuals=residuals, kernels=kernels, view_of=np.zeros(0, np.int32),
        local=np.zeros((0, 3)), offsets=offsets, offset_sigmas=np.sqrt(spread), shape=models[0],
    )  # fmt: skip
    return look, (mean, offsets)


def _without(system: System, shape_covariance: Array) -> dict[str, float]:
    """Return the variance of the log scale if each source of error were known exactly."""

    def covariance(shared: equations.Reduced) -> Array:
        return shared.covariance(posterior(*shared.of_offsets(), shape_covariance)[1])

    shared, held = equations.reduced(system), equations.Reduced(system.A, system.a)
    alone = system.A[np.ix_(SIMILARITY, SIMILARITY)]
    out = {
        "shape": float(inverse(shared.A[:PATCHES, :PATCHES])[SIZE, SIZE]),
        # Noise alone: nothing but the object unknown.
        "all": float(inverse(alone)[-1, -1]),
        "arm": float(covariance(held)[SIZE, SIZE]),
    }
    full = inverse(covariance(shared))
    sources = {"bias": BIAS_AT, "outline": [RIM], "hand-eye": HAND_EYE_AT, "table": TABLE_AT}
    for name, known in sources.items():
        free = np.setdiff1d(np.arange(PATCHES), known)
        place = int(np.searchsorted(free, SIZE))
        out[name] = float(inverse(full[np.ix_(free, free)])[place, place])
    return out


def residual_per_vertex(mesh: Mesh, shape: ScanShape, look: Outlook) -> Array:
    """Return the signed distance (V,) of the real surface at each vertex of the given mesh [mm].

    The median of the measured points around the vertex, positive outside; NaN where fewer than
    three were measured.
    """
    from scipy.spatial import KDTree

    vertices = (mesh.vertices - shape.center) * shape.unit
    # Points far off are not fitted to, but they are there to be seen.
    known = np.isfinite(look.residuals)
    out = np.full(len(vertices), np.nan)
    if np.count_nonzero(known) < FEWEST:
        return out
    distance, gradient = shape.field.distance_gradient(look.local[known])
    # A point speaks for the place of the surface that it is nearest to.
    tree: Any = KDTree(look.local[known] - distance[:, None] * gradient)
    residuals = np.append(look.residuals[known], np.nan)
    distance, index = tree.query(vertices, k=NEIGHBOURS, distance_upper_bound=REACH * INNER_EXTENT)
    near = np.isfinite(distance)
    enough = near.sum(axis=1) >= FEWEST
    values = np.where(near, residuals[np.minimum(index, len(residuals) - 1)], np.nan)
    out[enough] = 1e3 * np.nanmedian(values[enough], axis=1)
    return out
