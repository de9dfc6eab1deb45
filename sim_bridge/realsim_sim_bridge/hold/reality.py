"""How well labels tell what a real robot did: trials, every predictor, intervals by object."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.formats.grasps.graspa import TriedObject
from realsim.models.convex import ConvexConfig, convex_parts
from realsim.models.properties import DEFAULT_DENSITY, physical_properties
from realsim.robots.hand import Hand, find_hand
from realsim_sim_bridge.grasping.force_closure import ClosureConfig, force_closure
from realsim_sim_bridge.hold.calibration import (
    FAILURES,
    Calibration,
    Reliability,
    evidence_of,
    fitted_curve,
    left_out,
    shipped,
)
from realsim_sim_bridge.hold.draws import PALM_M, GraspedObject, HoldConfig, chance_columns
from realsim_sim_bridge.school.shards import stand_of
from realsim_sim_bridge.slip.engines import make_engine
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, SlipTrial, run_slip_test
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.validation.specimens import ready_trial

Names = NDArray[np.str_]

RESAMPLES = 2000
"""Bootstrap samples of whole objects."""
BINS = 10
"""Equal ones of p_hold, in the expected calibration error and the reliability diagram."""
FEW_OBJECTS = 3
"""Least objects for which an interval is given and one can be left out."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RealityConfig:
    """What the trials are judged with; nothing here is chosen after the trials are read."""

    hand: Hand = field(default_factory=find_hand)
    slip: SlipConfig = field(default_factory=SlipConfig)
    hold: HoldConfig = field(default_factory=HoldConfig)
    convex: ConvexConfig = field(default_factory=ConvexConfig)
    seed: int = 0
    """Seed of the intervals' bootstrap."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Judged:
    """What was predicted of T trials, and what came of them."""

    held: Mask
    """(T,) whether the robot lifted the object."""
    objects: Names
    """(T,)"""
    evidence: Array
    """(T,) of p_hold, before calibration."""
    columns: dict[str, Array]
    """(T,) each: other predictors, greater = more likely to hold."""
    shares: dict[str, Array]
    """(T,) shares of the draws' failures."""
    digest: str
    engine: str
    notes: tuple[str, ...] = ()
    """What was assumed."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PredictorRow:
    """How well one predictor orders the trials."""

    name: str
    auc: float
    """Probability that a trial that held is ranked before one that did not."""
    auc_low: float
    auc_high: float
    """95 % interval; whole objects are resampled. NaN = too few objects."""
    within: float
    """The same among trials of one object only; NaN = constant there."""
    average_precision: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Reality:
    """All predictors' figures, and p_hold's calibration."""

    rows: tuple[PredictorRow, ...]
    p_hold: Array
    """(T,) as the shipped calibration has it; on its own trials by curves that were fitted on the
    other objects."""
    in_sample: bool
    """Whether the shipped calibration was fitted on these trials."""
    ece: float
    """Expected calibration error of it: ten equal bins."""
    balanced_accuracy: float
    """Mean share of held and of dropped trials told right; told as held: more p_hold than the share
    of the calibration's trials that held."""
    gain: float
    gain_low: float
    gain_high: float
    """AUC of p_hold less that of the nominal score, with its interval by object."""
    reliability: tuple[Reliability, ...]


def judge_trials(
    objects: Sequence[TriedObject],
    config: RealityConfig,
    cache: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Judged:
    """Return what every predictor says of the trials.

    Args:
        objects: with their trials.
        config: see `RealityConfig`.
        cache: folder for convex parts; None = they are not kept.
        progress: called with (trials done, trials).

    Raises:
        InputError: there is no trial, or an engine is not installed.
    """
    total = sum(len(o.held) for o in objects)
    if total == 0:
        raise InputError("there are no trials to judge by; grasps with a result each are needed.")
    engine = make_engine(config.slip.engine)
    parts: list[dict[str, Array]] = []
    notes: list[str] = []
    done = 0
    for obj in objects:
        trial, surface = _trial_of(obj, config, cache, notes)
        found = _of_object(obj, trial, config)
        stopped, _ = surface.stopped(trial.Ts_obj_grasp, config.hand, PALM_M)
        reached = replace(
            trial, Ts_obj_grasp=stopped, Ts_table_grasp=obj.T_board_obj @ stopped
        )  # fmt: skip
        slips = run_slip_test(reached, config.slip, ScoreLimits(), config.hand, engine)
        found["safety"] = slips.safety[:, 1:].min(axis=1)
        for name, limits in (("score", ScoreLimits()), ("score_old", ScoreLimits.paper())):
            found[name] = slips.scores(limits)[1]
        parts.append(found)
        done += len(trial)
        if progress is not None:
            progress(done, total)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    shares = {name: joined.pop(name) for name in tuple(joined) if name.startswith("share_")}
    share = joined.pop("draws")
    return Judged(
        held=np.concatenate([o.held for o in objects]),
        objects=np.array([o.name for o in objects for _ in o.held], dtype=np.str_),
        evidence=evidence_of(share, joined["score"], config.hold.draws),
        columns={"draws": share, **joined},
        shares=shares,
        digest=_digest(objects),
        engine=engine.name,
        notes=tuple(notes),
    )


def _trial_of(
    obj: TriedObject, config: RealityConfig, cache: Path | None, notes: list[str]
) -> tuple[SlipTrial, GraspedObject]:
    """Return an object's trials where it stood, and its surface."""
    parts = convex_parts(obj.mesh, config.convex, cache)
    if obj.mass_kg is None:
        matter = physical_properties(obj.mesh, density=DEFAULT_DENSITY, parts=parts)
        told = (
            f"{obj.name} was not weighed: {DEFAULT_DENSITY:g} kg/m^3 make {matter.mass_kg:.3f} kg; "
            f"weigh it and give --weighed {obj.name}=KG."
        )
        if told not in notes:
            notes.append(told)
    else:
        matter = physical_properties(obj.mesh, mass_kg=obj.mass_kg, parts=parts)
    body = SlipBody.of(parts, matter)
    trial = ready_trial(body, obj.Ts_obj_grasp, obj.Ts_board_grasp, config.hand.max_opening_m)
    surface = GraspedObject.of(obj.mesh)
    stand = stand_of(config.slip, obj.T_board_obj, body, ())
    return replace(trial, stand=stand), surface


def _of_object(obj: TriedObject, trial: SlipTrial, config: RealityConfig) -> dict[str, Array]:
    """Return what geometry and statics say of an object's trials."""
    hand, physics = config.hand, config.slip.physics
    closure = force_closure(
        obj.mesh, trial.Ts_obj_grasp, trial.openings_m, ClosureConfig(friction=physics.friction),
        hand, trial.body.center_of_mass,
    )  # fmt: skip
    columns = chance_columns(obj.mesh, trial, config.slip, hand, config.hold)
    del columns["p_hold_error"]  # predicts nothing
    share = 1.0 - sum(columns[f"share_{name}"] for name in FAILURES)
    return {
        "draws": np.asarray(share),
        "dexnet_closure": closure.dexnet_closure,
        "closure_friction": -closure.closure_friction,
        "ferrari_canny": closure.ferrari_canny,
        **columns,
    }


def reality_of(judged: Judged, calibration: Calibration | None = None, seed: int = 0) -> Reality:
    """Return how well each predictor tells what came of the trials.

    Args:
        judged: see `judge_trials`.
        calibration: of p_hold; None = the shipped one.
        seed: of the bootstrap.
    """
    calibration = calibration or shipped()
    held, groups = judged.held, judged.objects
    in_sample = calibration.digest == judged.digest
    enough = len(np.unique(groups)) >= FEW_OBJECTS
    p = calibration.p_hold(judged.evidence)
    told = left_out(judged.evidence, held, groups) if in_sample and enough else p
    columns = {
        "p_hold": judged.evidence,
        **judged.columns,
        "object": _identity(held, groups),
        "always holds": np.ones(len(held)),
    }
    kinds = len(np.unique(groups))
    all_once, samples = np.ones(kinds), _resampled(kinds, RESAMPLES if enough else 0, seed)
    rows = tuple(_row(name, values, held, groups, samples) for name, values in columns.items())
    mine, old = (
        _wins(values, held, groups) for values in (judged.evidence, judged.columns["score_old"])
    )
    low, high = _interval(_aucs(*mine, samples) - _aucs(*old, samples))
    share = calibration.held_share
    return Reality(
        rows=rows,
        p_hold=told,
        in_sample=in_sample,
        ece=expected_calibration_error(told, held),
        balanced_accuracy=_balanced_accuracy(told > share, held),
        gain=float(_aucs(*mine, all_once) - _aucs(*old, all_once)),
        gain_low=low,
        gain_high=high,
        reliability=reliability(told, held),
    )


def _balanced_accuracy(told: Mask, held: Mask) -> float:
    """Return the mean share of trials told right of those that held and of the others, or NaN."""
    if held.all() or not held.any():
        return float("nan")
    return 0.5 * float(np.mean(told[held]) + np.mean(~told[~held]))


def calibrate(judged: Judged, data: str) -> Calibration:
    """Return the calibration that fits the trials, with what objects left out say of it.

    Raises:
        InputError: the trials cannot calibrate anything.
    """
    kinds = np.unique(judged.objects)
    if len(kinds) < FEW_OBJECTS:
        raise InputError(
            f"the trials are of {len(kinds)} objects; {FEW_OBJECTS} or more are needed, so that "
            "each can be left out."
        )
    w = fitted_curve(judged.evidence, judged.held)
    return Calibration(
        intercept=float(w[0]),
        slope=float(w[1]),
        data=data,
        digest=judged.digest,
        trials=len(judged.held),
        objects=tuple(kinds.tolist()),
        held_share=float(judged.held.mean()),
        engine=judged.engine,
        reliability=reliability(
            left_out(judged.evidence, judged.held, judged.objects), judged.held
        ),
    )


def reliability(p: Array, held: Mask) -> tuple[Reliability, ...]:
    """Return mean p_hold and share held of the trials in each of ten equal bins with any."""
    bins = np.minimum((p * BINS).astype(np.int64), BINS - 1)
    return tuple(
        Reliability(
            predicted=float(p[bins == k].mean()),
            held=float(held[bins == k].mean()),
            trials=int(np.sum(bins == k)),
        )
        for k in range(BINS)
        if np.any(bins == k)
    )


def expected_calibration_error(p: Array, held: Mask) -> float:
    """Return the mean distance of p_hold from the share held, over ten equal bins (Guo 2017)."""
    return sum(r.trials * abs(r.predicted - r.held) for r in reliability(p, held)) / len(p)


def _row(name: str, values: Array, held: Mask, groups: Names, samples: Array) -> PredictorRow:
    """Return the figures of one predictor."""
    wins, pairs = _wins(values, held, groups)
    low, high = _interval(_aucs(wins, pairs, samples))
    # The object's other trials tell nothing about one of its trials: a count is a count.
    known = np.trace(pairs) > 0 and name not in ("object", "always holds")
    return PredictorRow(
        name=name,
        auc=float(_aucs(wins, pairs, np.ones(len(wins)))),
        auc_low=low,
        auc_high=high,
        within=float(np.trace(wins) / np.trace(pairs)) if known else float("nan"),
        average_precision=_average_precision(values, held),
    )


def _wins(values: Array, held: Mask, groups: Names) -> tuple[Array, Array]:
    """Return how often the held trials of object i are before the others of j, ties by half.

    Returns:
        the counts (G, G), and of how many pairs (G, G).
    """
    # Infinite values share a rank, and NaN is the least.
    ranks = rankdata(np.nan_to_num(values, nan=-np.inf, posinf=1e300, neginf=-1e300))
    number = np.unique(groups, return_inverse=True)[1]
    kinds = int(number.max()) + 1
    wins = np.empty((kinds, kinds))
    for j in range(kinds):
        others = np.sort(ranks[~held & (number == j)])
        ties = (np.searchsorted(others, ranks[held], side) for side in ("left", "right"))
        wins[:, j] = np.bincount(number[held], 0.5 * sum(ties), kinds)
    yes, no = (np.bincount(number[rows], minlength=kinds) for rows in (held, ~held))
    return wins, np.outer(yes, no).astype(np.float64)


def _aucs(wins: Array, pairs: Array, samples: Array) -> Array:
    """Return the areas under the ROC curve (...) with objects taken `samples` (..., G) times.

    NaN where all ended alike.
    """
    with np.errstate(invalid="ignore"):
        return np.sum(samples @ wins * samples, -1) / np.sum(samples @ pairs * samples, -1)


def _average_precision(values: Array, held: Mask) -> float:
    """Return the mean precision at each trial that held; equal values are taken together."""
    order = np.argsort(-values, kind="stable")
    sorted_values, hits = values[order], np.cumsum(held[order])
    last = np.append(np.flatnonzero(sorted_values[1:] != sorted_values[:-1]), len(values) - 1)
    recall = hits[last] / max(int(held.sum()), 1)
    return float(np.sum(np.diff(np.append(0.0, recall)) * hits[last] / (last + 1)))


def _identity(held: Mask, groups: Names) -> Array:
    """Return, of each trial, the share of the object's other trials that held."""
    found = np.full(len(held), held.mean())
    for group in np.unique(groups):
        mine = groups == group
        if mine.sum() > 1:
            found[mine] = (held[mine].sum() - held[mine]) / (mine.sum() - 1)
    return found


def _resampled(kinds: int, count: int, seed: int) -> Array:
    """Return how often each object is taken (B, G) by each sample of the bootstrap."""
    rng = np.random.default_rng(seed)
    taken = [np.bincount(rng.integers(0, kinds, kinds), minlength=kinds) for _ in range(count)]
    return np.array(taken, dtype=np.float64).reshape(count, kinds)


def _interval(values: Array) -> tuple[float, float]:
    """Return the 95 % interval of bootstrap values; NaN of none."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (2.5, 97.5)) if known.size else (np.nan, np.nan)
    return float(low), float(high)


def _digest(objects: Sequence[TriedObject]) -> str:
    """Return a hash of all poses and results."""
    told = hashlib.sha256()
    for obj in objects:
        told.update(obj.name.encode())
        # Without + 0.0 the sign of a zero, which is chance, would be told.
        told.update((np.round(obj.Ts_obj_grasp, 6) + 0.0).tobytes() + obj.held.tobytes())
    return told.hexdigest()[:16]
