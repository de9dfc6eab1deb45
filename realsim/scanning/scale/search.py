"""From no start, or a rough one, to the few scales and poses that explain the measurements best."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.scanning.scale.agreement import explain
from realsim.scanning.scale.coarse import coarse_fit
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence
from realsim.scanning.scale.result import Similarity
from realsim.scanning.scale.shape import INNER_EXTENT, ScanShape, mirrored
from realsim.scanning.scale.starts import StartsConfig, find_starts, starts_near
from realsim.scanning.scale.state import State, first_state

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Hypothesis:
    """A scale and pose after the coarse fit, and how well it explains the measurements."""

    state: State
    gain: float
    source: str


def from_given(shape: ScanShape, start: Similarity) -> Similarity:
    """Return a similarity of the given mesh as one of the inner mesh."""
    T = start.T_world_obj.copy()
    T[:3, 3] += T[:3, :3] @ (start.scale * shape.center)
    return Similarity(
        scale=start.scale / shape.unit, T_world_obj=T, score=start.score, source=start.source
    )


def to_given(shape: ScanShape, state: State, score: float, source: str) -> Similarity:
    """Return a state as a similarity of the given mesh."""
    scale = state.s * shape.unit
    T = np.eye(4)
    T[:3, :3] = state.R
    T[:3, 3] = state.t - state.R @ (scale * shape.center)
    return Similarity(scale=scale, T_world_obj=T, score=score, source=source)


def hypotheses(
    shape: ScanShape,
    evidence: ScanEvidence,
    start: Similarity | None,
    config: ScaleConfig,
    size_m: float | None = None,
) -> list[Hypothesis]:
    """Return distinct scales and poses after the coarse fit, best first.

    A given start is tried first, with its scale varied; where that explains too little, or nothing
    was given, all resting poses and attitudes of the mesh are searched. Of a rough longest side
    [m] only starts of about that size are taken, where there are any.
    """
    rng = np.random.default_rng(config.seed)
    found: list[Hypothesis] = []
    if start is not None:
        inner = from_given(shape, start)
        near = starts_near(inner, StartsConfig(), rng)
        few, half = config.search.near_first, config.search.half_turns
        # Half turns always: a mug with its handle on the wrong side explains much. But a box stays
        # as it was given, and does not turn over for a little noise.
        found = _fitted(shape, evidence, near[:few], config)
        turned = _fitted(shape, evidence, near[-half:], config)
        least = found[0].gain + config.search.turn_gain
        better = [h for h in turned if h.gain > least]
        found = [*better, *found, *(h for h in turned if h.gain <= least)]
        if not found or found[0].gain < config.search.enough_gain:
            more = _fitted(shape, evidence, near[few:-half], config)
            found = _distinct([*found, *more], shape, config)
    if not found or found[0].gain < config.search.least_gain:
        anew = find_starts(shape, evidence.cloud, evidence.plane, StartsConfig())
        if size_m is not None:
            reach = np.log(config.search.size_factor)
            like = [a for a in anew if abs(np.log(a.scale * INNER_EXTENT / size_m)) < reach]
            anew = like or anew
        anew = anew[: config.search.starts]
        if len(anew) < config.search.few_starts:
            anew += [s for a in anew for s in starts_near(a, StartsConfig(), rng)[1:3]]
        found = _distinct([*found, *_fitted(shape, evidence, anew, config)], shape, config)
    return found


def mirror_gain(
    shape: ScanShape, evidence: ScanEvidence, state: State, config: ScaleConfig
) -> float:
    """Return how much the mirror image of the mesh explains, placed as the mesh is.

    A mirror image placed at a pose is the mesh reflected in a plane there: m -> (I - 2 a a^T) m =
    (I - 2 a a^T) D (D m), D the mirror; the three planes of the mesh's box are tried.
    """
    other = mirrored(shape)
    D = np.diag([-1.0, 1.0, 1.0])
    c = config.search
    best = -np.inf
    for axis in np.eye(3):
        R = state.R @ (np.eye(3) - 2.0 * np.outer(axis, axis)) @ D
        start = first_state(evidence, state.s, R, state.t)
        placed = coarse_fit(other, evidence, start)
        seen = explain(other, evidence, placed, views=c.rough_views, every=c.rough_every)
        if seen.gain > best - 0.05:
            seen = explain(other, evidence, placed, every=2)
            best = max(best, seen.gain)
    return float(best)


def _fitted(
    shape: ScanShape,
    evidence: ScanEvidence,
    starts: Sequence[Similarity],
    config: ScaleConfig,
) -> list[Hypothesis]:
    """Return the starts after the coarse fit with their gain, the best ones compared finely."""
    c = config.search
    rough: list[Hypothesis] = []
    for start in starts:
        T = start.T_world_obj
        first = first_state(evidence, start.scale, T[:3, :3], T[:3, 3])
        state = coarse_fit(shape, evidence, first)
        gain = explain(shape, evidence, state, views=c.rough_views, every=c.rough_every).gain
        rough.append(Hypothesis(state=state, gain=gain, source=start.source))
    best = _distinct(rough, shape, config)[: c.compared]
    fine = [
        Hypothesis(
            state=h.state, gain=explain(shape, evidence, h.state, every=2).gain, source=h.source
        )
        for h in best
    ]
    return sorted(fine, key=lambda h: -h.gain)


def _distinct(
    found: Sequence[Hypothesis], shape: ScanShape, config: ScaleConfig
) -> list[Hypothesis]:
    """Return the hypotheses, best first, of which none puts the surface where a better one does."""
    kept: list[Hypothesis] = []
    placed: list[Array] = []
    some = shape.samples[:: max(1, len(shape.samples) // config.search.compared_points)]
    for h in sorted(found, key=lambda h: -h.gain):
        points = h.state.s * some @ h.state.R.T + h.state.t
        size = 2.0 * h.state.s * shape.radius
        # The same place point by point: near-symmetric poses are kept, their scale may differ.
        if all(np.max(np.abs(points - p)) > config.search.same_share * size for p in placed):
            kept.append(h)
            placed.append(points)
    return kept
