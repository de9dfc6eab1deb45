"""From no start, or a rough one, to the few scales and poses that explain the measurements best.

Every start is fitted by Gauss-Newton of scale and pose alone: points of all views are drawn to the
model's surface (data to model), and samples of the model that lie outside of the measured outline
are drawn back into it: the camera looked through there. The first alone lets a model grow, for a
huge one has a surface near every point.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.normal_equations import symmetric
from realsim.registration.refinement.equations import BLOCK, add_blocks
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.equations import frame_of, object_distances
from realsim.scanning.scale.evidence import ScanEvidence
from realsim.scanning.scale.outlines import COLUMNS, add_outside
from realsim.scanning.scale.result import Similarity
from realsim.scanning.scale.shape import INNER_EXTENT, ScanShape, mirrored
from realsim.scanning.scale.starts import find_starts, starts_near
from realsim.scanning.scale.state import (
    PATCHES,
    SIMILARITY,
    ScaleState,
    claimed_cameras,
    first_state,
    moved_state,
    stacked,
)
from realsim.scanning.scale.verdict import explain

WIDTHS = (0.25, 0.12, 0.06)
"""Tukey's cut-offs as shares of the object's size: 25, 12 and 6 mm of 10 cm."""
STEPS = 8
"""Steps with each."""
POINTS = 5_000
"""Measured points used: 100 ns each and step."""
OUTLINE_VIEWS = 12
"""Views whose outlines are used."""
SAMPLE_STEP = 3
"""Every third sample of the surface is looked at."""
OUTSIDE_WEIGHT = 0.3
"""Weight of one sample outside an outline relative to one measured point."""
OUTSIDE_PX = 3.0
"""A sample must lie so far outside [px]: the foot of an object is not measured."""
DAMPING = 1e-3
"""Levenberg: directions seen with less than this share of the best are moved along little."""
SURFACE, OUTLINE = np.array([*range(6), BLOCK]), np.arange(7)
"""Columns of twist and size in blocks of points and of outlines."""
AGAINST = np.array([-1.0] * 6 + [1.0])
SETTLED = 2e-5
"""A step that moves no point by more than this share of the size ends a width."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Hypothesis:
    """A scale and pose after the coarse fit, and how well it explains the measurements."""

    state: ScaleState
    gain: float
    source: str


def from_given(shape: ScanShape, start: Similarity) -> Similarity:
    """Return a similarity of the given mesh as one of the inner mesh."""
    T = start.T_world_obj @ se3.from_translation(start.scale * shape.center)
    return Similarity(
        scale=start.scale / shape.unit, T_world_obj=T, score=start.score, source=start.source
    )


def to_given(shape: ScanShape, state: ScaleState, score: float, source: str) -> Similarity:
    """Return a state as a similarity of the given mesh."""
    scale = state.s * shape.unit
    T = state.poses[0] @ se3.from_translation(-scale * shape.center)
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
        near = starts_near(inner, rng)
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
        anew = find_starts(shape, evidence.cloud, evidence.plane)
        if size_m is not None:
            reach = np.log(config.search.size_factor)
            like = [a for a in anew if abs(np.log(a.scale * INNER_EXTENT / size_m)) < reach]
            anew = like or anew
        anew = anew[: config.search.starts]
        if len(anew) < config.search.few_starts:
            anew += [s for a in anew for s in starts_near(a, rng)[1:3]]
        found = _distinct([*found, *_fitted(shape, evidence, anew, config)], shape, config)
    return found


def mirror_gain(
    shape: ScanShape, evidence: ScanEvidence, state: ScaleState, config: ScaleConfig
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
        start = first_state(evidence, state.s, se3.from_rt(R, state.t))
        placed = coarse_fit(other, evidence, start)
        seen = explain(other, evidence, placed, views=c.rough_views, every=c.rough_every)
        if seen.gain > best - 0.05:
            seen = explain(other, evidence, placed, every=2)
            best = max(best, seen.gain)
    return float(best)


def _fitted(
    shape: ScanShape, evidence: ScanEvidence, starts: Sequence[Similarity], config: ScaleConfig
) -> list[Hypothesis]:
    """Return the starts after the coarse fit with their gain, the best ones compared finely."""
    c = config.search
    rough: list[Hypothesis] = []
    for start in starts:
        first = first_state(evidence, start.scale, start.T_world_obj)
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


def coarse_fit(shape: ScanShape, evidence: ScanEvidence, start: ScaleState) -> ScaleState:
    """Return scale and pose from a start that is right to a tenth of the size, cameras as said."""
    cameras = start.cameras(claimed_cameras(evidence.views))
    points, views = stacked([v.points for v in evidence.views])
    every = max(1, len(points) // POINTS)
    points, views = np.ascontiguousarray(points[::every]), np.ascontiguousarray(views[::every])
    samples = np.ascontiguousarray(shape.samples[::SAMPLE_STEP])
    some = range(0, len(cameras), max(1, len(cameras) // OUTLINE_VIEWS))
    no_view, shared = np.zeros((len(cameras), 6)), np.zeros(PATCHES)
    state = start
    for width in WIDTHS:
        cut = width * evidence.size_m
        for _ in range(STEPS):
            seen, Ms = object_distances(shape, state, cameras, points, views)
            # The shape is taken as it is: one patch without offset.
            H, b = (
                np.zeros((len(cameras), BLOCK + 1, BLOCK + 1)),
                np.zeros((len(cameras), BLOCK + 1)),
            )
            precision = (np.ones(len(points)), np.full(len(points), cut * cut))
            add_blocks(seen, views, frame_of(Ms), precision, (H, b), np.empty(len(points)))
            outside = np.zeros((COLUMNS, COLUMNS)), np.zeros(COLUMNS)
            for v in some:
                rule = (OUTSIDE_WEIGHT, OUTSIDE_PX, 2.0 * cut)
                add_outside(evidence, state, cameras[v], v, samples, rule, outside)
            A, a = np.zeros((7, 7)), np.zeros(7)
            for (M, right), columns in (((H.sum(0), b.sum(0)), SURFACE), (outside, OUTLINE)):
                # The object moves against the points: the sign of its twist is the other one.
                A += symmetric(M)[np.ix_(columns, columns)] * np.outer(AGAINST, AGAINST)
                a += right[columns] * AGAINST
            x = _step(shape, state, A, a)
            shared[SIMILARITY] = x
            state = moved_state(state, shared, no_view)
            reach = state.s * shape.radius
            if np.abs(x[:3]).max() + np.abs(x[3:6]).max() / reach + abs(x[6]) < SETTLED:
                break
    return state


def _step(shape: ScanShape, state: ScaleState, H: Array, b: Array) -> Array:
    """Return the damped step (7,): in scaled units every unknown moves the surface alike."""
    reach = state.s * shape.radius
    unit = np.array([reach, reach, reach, 1.0, 1.0, 1.0, reach])
    A = H / np.outer(unit, unit)
    A += DAMPING * max(float(np.trace(A)) / 7, 1e-9) * np.eye(7)
    return np.asarray(np.linalg.solve(A, b / unit) / unit)
