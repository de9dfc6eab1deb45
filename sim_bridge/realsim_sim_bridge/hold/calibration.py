"""p_hold from what the draws and the simulated attempt say, calibrated on trials of a real robot.

The evidence is the share of draws that hold; the attempt that is simulated in all stages counts as
one draw more. Draws that were simulated too told real trials apart worse than limit analysis did
(AUC 0.60 and 0.67), so the time goes into more draws. A logistic curve of two numbers (Platt 1999)
turns the evidence into how often real grasps with such evidence held.
"""

from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.store import atomic
from realsim.untrusted.own_json import read_own

SHIPPED = Path(__file__).parent / "calibration.json"
FAILURES = ("blocked", "missed", "skewed", "overloaded")
SURE = 0.02
"""Evidence is kept this far from 0 and 1: neither is proven by some draws."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Reliability:
    """Trials of like p_hold."""

    predicted: float
    """Their mean p_hold, fitted without the trials' own object."""
    held: float
    """Share that held."""
    trials: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Calibration:
    """The curve p = 1 / (1 + exp(-intercept - slope logit(evidence))), and where it is from."""

    intercept: float
    slope: float
    data: str
    """Name of the trials that it was fitted on."""
    digest: str
    """SHA-256 of their results and poses: on the same trials it must not be judged."""
    trials: int
    objects: tuple[str, ...]
    held_share: float
    """Share of the trials that held; a grasp with more p_hold is told as one that holds."""
    engine: str
    """Engine of the simulated attempt."""
    reliability: tuple[Reliability, ...] = ()

    def p_hold(self, evidence: Array) -> Array:
        """Return the probabilities (N,) of evidence (N,) in [0, 1]; NaN stays."""
        return _curve(np.array([self.intercept, self.slope]), evidence)

    def error(self, evidence: Array, evidence_error: Array) -> Array:
        """Return the standard errors (N,) of p_hold that come of the evidence's.

        Half of what p_hold spans over the evidence's error; at the curve's ends a tangent would
        tell more than there is.
        """
        span = self.p_hold(evidence + evidence_error) - self.p_hold(evidence - evidence_error)
        return 0.5 * span

    def write(self, path: Path) -> None:
        """Write it as JSON."""
        atomic.write_json(path, asdict(self))


def evidence_of(share: Array, scores: Array, draws: int) -> Array:
    """Return the evidence (N,): the mean over the draws and the simulated attempt.

    Args:
        share: (N,) of the draws that hold.
        scores: (N,) of the simulated attempt.
        draws: their number.
    """
    return (draws * share + scores) / (draws + 1)


def p_hold_columns(
    measures: dict[str, Array], scores: Array, draws: int, calibration: Calibration | None = None
) -> dict[str, Array]:
    """Return p_hold, its error and its draws of what the draws and the attempt said.

    Args:
        measures: columns of `draws.chance_columns`.
        scores: (N,) of the simulated attempt; NaN = there was none.
        draws: their number.
        calibration: the curve; None = the shipped one.
    """
    curve = calibration or shipped()
    share = 1.0 - sum(measures[f"share_{name}"] for name in FAILURES)
    evidence = evidence_of(np.asarray(share), scores, draws)
    told = np.isfinite(evidence)
    return {
        "p_hold": curve.p_hold(evidence),
        "p_hold_error": curve.error(evidence, measures["p_hold_error"]),
        "p_hold_draws": np.where(told, float(draws), np.nan),
    }


def fitted_curve(evidence: Array, held: Mask) -> Array:
    """Return intercept and slope of the logistic curve of greatest likelihood.

    Raises:
        InputError: all trials ended alike, or more evidence goes with fewer that hold.
    """
    if held.all() or not held.any():
        raise InputError(
            f"all {len(held)} trials ended alike; a calibration needs some that held and some "
            "that did not."
        )
    x, sign = _logit(evidence), np.where(held, 1.0, -1.0)

    def cost(w: Array) -> float:
        return float(np.logaddexp(0.0, -sign * (w[0] + w[1] * x)).sum())

    w = np.asarray(minimize(cost, np.array([0.0, 1.0]), method="BFGS").x, dtype=np.float64)
    if not w[1] > 0:
        raise InputError(
            "grasps with more evidence held less often in these trials, so they calibrate nothing. "
            "Are the poses' conventions right?"
        )
    return w


def left_out(evidence: Array, held: Mask, groups: NDArray[np.str_]) -> Array:
    """Return p_hold (N,) of each trial by a curve that was fitted on the other groups."""
    found = np.full(len(evidence), np.nan)
    for group in np.unique(groups):
        mine = groups == group
        found[mine] = _curve(fitted_curve(evidence[~mine], held[~mine]), evidence[mine])
    return found


@cache
def shipped() -> Calibration:
    """Return the calibration that comes with realsim."""
    return read_own(SHIPPED, Calibration)


def _curve(w: Array, evidence: Array) -> Array:
    """Return the logistic curve's values (N,)."""
    return 1.0 / (1.0 + np.exp(-(w[0] + w[1] * _logit(evidence))))


def _logit(evidence: Array) -> Array:
    """Return the logarithm of the odds (N,)."""
    e = np.clip(evidence, SURE, 1.0 - SURE)
    return np.log(e / (1.0 - e))
