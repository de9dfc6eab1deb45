"""How the physical score and what was measured beside it go together.

Only grasps that physics has tried are counted: of the others nobody knows what they are worth.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int64
from realsim.formats.grasps.scene_grasps import executed, labelled
from realsim.records import GraspSet
from realsim.records.grasps import label_words

QUALITIES = ("score", "p_hold", "margin", "ferrari_canny", "closure_friction")
"""What is ranked; closure_friction is better where it is smaller, so its correlations are negative
where it agrees."""
LEAST_GRASPS = 10
"""Least grasps for which a correlation is given: of fewer its interval would span nearly
everything."""
RESAMPLES = 1000
"""Bootstrap samples: the ends of a 95 % interval are good to about a twentieth of its width."""
MOST_DRAWS = 50_000_000
"""Numbers drawn in one bootstrap; beyond, there are fewer samples, and the interval is tiny."""
INTERVAL = (2.5, 97.5)
"""Percentiles of the interval."""
LABEL_BINS = 10
"""Equal bins of p_hold, or of the score, over 0 to 1."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RankCorrelation:
    """Spearman's rank correlation of two qualities, with its 95 % bootstrap interval."""

    first: str
    second: str
    grasps: int
    """Grasps of which both are known."""
    rho: float
    """NaN = too few grasps, or one of the two is the same for all."""
    low: float
    high: float
    """The grasps are resampled one by one: what other objects would say is not in the interval."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClosureConfusion:
    """Force closure as an analytic label against the physical one: good = score >= 0.5."""

    closure: str
    """How closure was told: the name of the measure."""
    closed_good: int
    closed_bad: int
    open_good: int
    open_bad: int
    friction: float | None = None
    """Greatest level of closure_friction at which a grasp closes; those that close at any
    level count as closed, also above the friction that physics tried them with. None = of a measure
    that has one friction only, or no grasp closes."""

    @property
    def grasps(self) -> int:
        """Return of how many grasps both are known."""
        return self.closed_good + self.closed_bad + self.open_good + self.open_bad

    @property
    def agree(self) -> float:
        """Return the share of grasps on which both agree; NaN of none."""
        same = self.closed_good + self.open_bad
        return same / self.grasps if self.grasps else math.nan

    @property
    def balanced_accuracy(self) -> float:
        """Return the mean share of good and of bad ones told right; NaN without either."""
        good, bad = self.closed_good + self.open_good, self.closed_bad + self.open_bad
        if not good or not bad:
            return math.nan
        return 0.5 * (self.closed_good / good + self.open_bad / bad)


@dataclass(frozen=True, kw_only=True, slots=True)
class PHoldSpread:
    """How the p_hold of the grasps that have one is distributed."""

    grasps: int
    mean: float
    tenths: tuple[int, ...]
    """Grasps in each of ten equal bins."""
    unsure: int
    """Grasps of few draws, or of a large error."""
    entropy_bits: float

    @property
    def in_words(self) -> str:
        """Return it in one line."""
        few = f"; {self.unsure} of few draws" if self.unsure else ""
        return (
            f"p_hold of {self.grasps} grasps by tenths: {' '.join(map(str, self.tenths))}; mean "
            f"{self.mean:.2f}, entropy {self.entropy_bits:.2f} of {math.log2(LABEL_BINS):.2f} bits"
            f"{few}."
        )


def mean_label(sets: Sequence[GraspSet]) -> str:
    """Return the mean p_hold with its name; where no set has one, the mean score of all judged.

    The mean score counts those that the arm does not reach as 0, p_hold is of those it reaches.
    """
    spread = p_hold_spread(sets)
    if spread is not None:
        return f"p_hold {spread.mean:.2f}"
    return f"score {np.nanmean(_quality(sets, 'score', tried=False)):.2f}"


def rank_correlations(
    sets: Sequence[GraspSet], rng: np.random.Generator
) -> tuple[RankCorrelation, ...]:
    """Return the correlation of every pair of QUALITIES that was measured."""
    values = {name: _quality(sets, name) for name in QUALITIES}
    known = [name for name in QUALITIES if not np.all(np.isnan(values[name]))]
    found: list[RankCorrelation] = []
    for first, second in combinations(known, 2):
        both = ~np.isnan(values[first]) & ~np.isnan(values[second])
        x, y = values[first][both], values[second][both]
        rho, low, high = spearman(x, y, rng)
        found.append(
            RankCorrelation(first=first, second=second, grasps=len(x), rho=rho, low=low, high=high)
        )
    return tuple(found)


def closure_confusions(sets: Sequence[GraspSet]) -> Iterator[ClosureConfusion]:
    """Yield the confusion of every way of telling force closure that was measured."""
    score = _quality(sets, "score")
    for name in ("dexnet_closure", "closure_friction"):
        value = _quality(sets, name)
        known = ~np.isnan(value) & ~np.isnan(score)
        if not known.any():
            continue
        closed = value > 0.5 if name == "dexnet_closure" else np.isfinite(value)
        good = score >= 0.5
        levels = value[known & closed] if name == "closure_friction" else value[:0]
        yield ClosureConfusion(
            closure=name,
            friction=float(levels.max()) if len(levels) else None,
            closed_good=int(np.sum(known & closed & good)),
            closed_bad=int(np.sum(known & closed & ~good)),
            open_good=int(np.sum(known & ~closed & good)),
            open_bad=int(np.sum(known & ~closed & ~good)),
        )


def label_histogram(sets: Sequence[GraspSet]) -> Int64:
    """Return how many grasps have a p_hold, of sets without one a score, in each of ten bins.

    Counted are the grasps with a label of their own, not those that the arm does not reach.
    """
    values = joined(s.labels[labelled(s)] for s in sets)
    return np.histogram(values, LABEL_BINS, (0.0, 1.0))[0].astype(np.int64)


def label_chart(sets: Sequence[GraspSet]) -> tuple[Int64, str, str]:
    """Return what a chart of `label_histogram` shows: the counts, its title, and their label."""
    counts, name, bits = label_histogram(sets), label_words(sets), p_hold_entropy_bits(sets)
    entropy = (
        "" if math.isnan(bits) else f", entropy {bits:.2f} of {math.log2(LABEL_BINS):.2f} bits"
    )
    return counts, f"{name} of {counts.sum():,} tried grasps{entropy}", name


def p_hold_entropy_bits(sets: Sequence[GraspSet]) -> float:
    """Return how much a p_hold tells apart [bits]: 0 = all in one of ten bins, 3.32 = evenly.

    NaN where no set has one.
    """
    counts = label_histogram([s for s in sets if s.label == "p_hold"])
    shares = counts[counts > 0] / max(1, counts.sum())
    return float(-np.sum(shares * np.log2(shares))) + 0.0 if len(shares) else math.nan


def p_hold_spread(sets: Sequence[GraspSet]) -> "PHoldSpread | None":
    """Return how the p_hold of sets is distributed; None where no set has one."""
    told = [s for s in sets if s.label == "p_hold"]
    if not told:
        return None
    counts = label_histogram(told)
    known = joined(s.labels[labelled(s)] for s in told)
    return PHoldSpread(
        grasps=len(known), mean=float(known.mean()), tenths=tuple(counts.tolist()),
        unsure=sum(int(s.unsure.sum()) for s in told), entropy_bits=p_hold_entropy_bits(told),
    )  # fmt: skip


def spearman(x: Array, y: Array, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return Spearman's rank correlation of (N,) and (N,), and the ends of its interval.

    Ties have their mean rank. The percentile bootstrap ranks every sample anew: the rank of a value
    follows from how often it and the smaller ones were drawn, which needs no sorting.
    """
    n = len(x)
    nothing = (math.nan, math.nan, math.nan)
    if n < LEAST_GRASPS:
        return nothing
    x_level = np.unique(x, return_inverse=True)[1]
    y_level = np.unique(y, return_inverse=True)[1]
    rho = _rank_correlation(x_level, y_level)
    if math.isnan(rho):
        return nothing
    samples = max(100, min(RESAMPLES, MOST_DRAWS // n))
    drawn: list[float] = []
    for _ in range(samples):
        rows = rng.integers(0, n, n)
        drawn.append(_rank_correlation(x_level[rows], y_level[rows]))
    low, high = np.nanpercentile(drawn, INTERVAL)
    return rho, float(low), float(high)


def _rank_correlation(x_level: NDArray[np.intp], y_level: NDArray[np.intp]) -> float:
    """Return Pearson's correlation of the mean ranks of levels; NaN where all are the same."""
    x, y = (_mean_ranks(levels) for levels in (x_level, y_level))
    x, y = x - x.mean(), y - y.mean()
    spread = math.sqrt(float(x @ x) * float(y @ y))
    return float(x @ y) / spread if spread > 0 else math.nan


def _mean_ranks(levels: NDArray[np.intp]) -> Array:
    counts = np.bincount(levels)
    return (np.cumsum(counts) - 0.5 * (counts - 1))[levels]


def _quality(sets: Sequence[GraspSet], name: str, *, tried: bool = True) -> Array:
    """Return a quality of all grasps, one after the other; NaN = not tried or not measured.

    Args:
        sets: the grasps.
        name: of the quality.
        tried: whether those that physics has not tried are NaN, whatever they have.
    """
    parts: list[Array] = []
    for s in sets:
        nothing = np.full(len(s), np.nan)
        value = s.scores if name == "score" else s.measures.get(name, nothing)
        parts.append(np.where(executed(s), value, np.nan) if tried else value)
    return joined(parts)


def joined(parts: Iterable[NDArray[Any]]) -> Array:
    """Return values of several sets, one after the other; there may be no set."""
    return np.concatenate([np.zeros(0), *parts])
