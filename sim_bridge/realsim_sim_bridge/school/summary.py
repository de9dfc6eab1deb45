"""The Robot School's results in figures, row by row as in the paper's table of statistics.

Every candidate is in exactly one outcome, so the outcomes sum to the candidates, and

    good = fail horizontal + fail pendulum + full success
    bad  = no trajectory + fail close + fail lift + penalized

The paper counts what fails to close as "no trajectory to closure"; here it has a row of its own.
Beside its table stands `score_paper`, whose 0.50 for what fails the oscillation is good there. The
nominal score (equation 3 on our stages) has rows of its own: by it a stage fails by the very slip
that is penalized, so such a grasp scores 0.42 at most; `penalized_by` says where they stopped.

Source: GraspIT, table "GraspIT v1 Statistics" and equation 3.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.formats.grasps.scene_grasps import check_values, executed
from realsim.json_values import json_value
from realsim.records import STAGES, GraspSet
from realsim_sim_bridge.school import measure_statistics
from realsim_sim_bridge.slip.score import judged, score_paper

# --- The summary as the paper prints it, beside the paper's own figures --------------------------


PAPER_CANDIDATES = 2_275_352
PAPER_OUTCOMES = {
    "no_trajectory": 260_663,
    "fail_lift": 33_029,
    "penalized": 94_475,
    "fail_horizontal": 167_549,
    "fail_pendulum": 883_733,
    "full_success": 835_903,
}
"""GraspIT, table "GraspIT v1 Statistics"; they sum to its candidates."""
PAPER_WITH_TRAJECTORY = 2_014_689
PAPER_GOOD = 1_887_185
PAPER_BAD = 388_167
NOTHING = "-"
"""Where the paper gives no figure, or there is none here."""
OUTCOME_NAMES = {
    "no_trajectory": "no trajectory (s = 0)",
    "fail_close": "fail close (s = 0)",
    "fail_lift": "fail lift (s <= 0.25)",
    "penalized": "penalized large slip (s < 0.5)",
    "fail_horizontal": "fail horizontal (s = 0.50)",
    "fail_pendulum": "fail pendulum (0.5 <= s <= 0.75)",
    "full_success": "full success (s = 1)",
}


def rows_of(summary: "SchoolSummary") -> list[tuple[str, str, str]]:
    """Return (property, here, in the paper) as texts."""
    by_paper = summary.by_paper or summary

    def here(count: int) -> str:
        return _counted(count, by_paper.judged)

    def paper(count: int) -> str:
        return _counted(count, PAPER_CANDIDATES)

    of_object, of_scene = by_paper.per_object, by_paper.per_scene
    rows = [
        ("scenes", f"{summary.scenes:,}", "1,035"),
        ("objects", f"{summary.objects:,}", "7,396"),
        ("candidates", f"{summary.candidates:,}", f"{PAPER_CANDIDATES:,}"),
        ("without a score", f"{by_paper.outcomes['not_tried']:,}", NOTHING),
        ("with trajectory", here(by_paper.with_trajectory), paper(PAPER_WITH_TRAJECTORY)),
        ("good (s >= 0.5)", here(by_paper.good), paper(PAPER_GOOD)),
        ("bad (s < 0.5)", here(by_paper.bad), paper(PAPER_BAD)),
        ("mean score", _mean_and_sigma(by_paper.score, 2), "0.72 ± 0.30"),
        ("mean score of good", _number(by_paper.score_good), "0.85"),
        ("mean score of bad", _number(by_paper.score_bad), "0.13"),
        ("candidates per object", _mean_and_sigma(of_object["candidates"]), "307 ± 649"),
        ("candidates per scene", _mean_and_sigma(of_scene["candidates"]), "2198 ± 1866"),
        ("good per object", _mean_and_sigma(of_object["good"]), "255 ± 567"),
        ("bad per object", _mean_and_sigma(of_object["bad"]), "52 ± 155"),
        ("good per scene", _mean_and_sigma(of_scene["good"]), "1823 ± 1612"),
        ("bad per scene", _mean_and_sigma(of_scene["bad"]), "375 ± 423"),
    ]
    for name, label in OUTCOME_NAMES.items():
        published = PAPER_OUTCOMES.get(name)
        told = NOTHING if published is None else paper(published)
        rows.append((label, here(by_paper.outcomes[name]), told))
    counts = {"good": summary.good, "penalized": summary.outcomes["penalized"]}
    counts |= {
        f"penalized, failed first: {'no stage' if stage == 'none' else stage}": count
        for stage, count in summary.penalized_by.items()
        if count
    }
    rows += [
        (f"nominal score: {name}", _counted(count, summary.judged), NOTHING)
        for name, count in counts.items()
    ]
    rows.append(("nominal score: mean", _mean_and_sigma(summary.score, 2), NOTHING))
    for h in summary.hands:
        on = f"{h.hand}, on the {h.objects} objects of all hands: "
        rows += [
            (on + "reached", _counted(h.reached, h.judged), NOTHING),
            (on + "good by the nominal score", _counted(h.good, h.judged), NOTHING),
            (on + "mean nominal score", _number(h.score), NOTHING),
        ]
    return rows + _measured_rows(summary)


def _measured_rows(summary: "SchoolSummary") -> list[tuple[str, str, str]]:
    """Return what was measured beside the score; the paper has none of it."""
    rows: list[tuple[str, str, str]] = []
    if (p := summary.p_hold) is not None:
        rows += [
            ("p_hold: grasps, of few draws", f"{p.grasps:,}, {p.unsure:,}", NOTHING),
            ("p_hold: mean, entropy [bits]", f"{p.mean:.2f}, {p.entropy_bits:.2f}", NOTHING),
            ("p_hold: grasps by tenths from 0", " ".join(map(str, p.tenths)), NOTHING),
        ]
    rows += [
        (
            f"rank correlation {c.first}, {c.second}",
            f"{NOTHING} (n = {c.grasps:,})"
            if math.isnan(c.rho)
            else f"{c.rho:+.2f} [{c.low:+.2f}, {c.high:+.2f}], n = {c.grasps:,}",
            NOTHING,
        )
        for c in summary.correlations
    ]
    for c in summary.closures:
        of = f"{c.closure}: "
        closed = "closed" if c.friction is None else f"closed at some level up to {c.friction:g}"
        rows += [
            (of + f"{closed}: good, bad", f"{c.closed_good:,}, {c.closed_bad:,}", NOTHING),
            (of + "not closed: good, bad", f"{c.open_good:,}, {c.open_bad:,}", NOTHING),
            (of + "agrees with good", f"{100 * c.agree:.1f} % of {c.grasps:,}", NOTHING),
        ]
    return rows


def _counted(count: int, of: int) -> str:
    return f"{count:,} ({100 * count / of:.2f} %)" if of else f"{count:,}"


def _mean_and_sigma(spread: "Spread", digits: int = 0) -> str:
    if math.isnan(spread.mean):
        return NOTHING
    return f"{spread.mean:.{digits}f} ± {spread.sd:.{digits}f}"


def _number(x: float) -> str:
    return NOTHING if math.isnan(x) else f"{x:.2f}"


OUTCOMES = (
    "not_tried", "no_trajectory", "fail_close", "fail_lift", "penalized", "fail_horizontal",
    "fail_pendulum", "full_success",
)  # fmt: skip
"""What can become of a candidate, worst first. not_tried: without a score (the object has no body
for physics); no_trajectory: the arm does not get there, score 0; fail_close and fail_lift: base
score 0 and 0.25; penalized: base score of 0.5 or more, but a score below 0.5; fail_horizontal,
fail_pendulum and full_success: base score 0.5, 0.75 and 1, and a score of 0.5 or more."""
GOOD = ("fail_horizontal", "fail_pendulum", "full_success")
"""Outcomes with a score of 0.5 or more."""
GOOD_FROM = 0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class Spread:
    """Mean and standard deviation (of the population) of what was counted; NaN of nothing."""

    mean: float
    sd: float


@dataclass(frozen=True, kw_only=True, slots=True)
class HandResult:
    """One hand on the objects that every hand has tried."""

    hand: str
    objects: int
    judged: int
    """Candidates with a score."""
    reached: int
    """Candidates of these that the arm gets to."""
    good: int
    score: float
    """Mean of the judged; NaN of none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SchoolSummary:
    """What became of all candidates."""

    scenes: int
    objects: int
    """Different object ids; scenes share their ids."""
    sets: int
    """Object instances."""
    outcomes: dict[str, int]
    """Candidates by OUTCOMES; they sum to `candidates`."""
    penalized_by: dict[str, int]
    """Penalized candidates by the stage that failed first; 'none' = none did."""
    score: Spread
    """Spread of the scores of all candidates that have one."""
    score_good: float
    score_bad: float
    """Mean scores; NaN of none."""
    per_object: dict[str, Spread]
    per_scene: dict[str, Spread]
    """Numbers of candidates, good and bad ones: of an object over all scenes, and of a scene."""
    hands: tuple["HandResult", ...] = ()
    """Where grasps of several hands are summed up: each hand on the objects that all have tried."""
    correlations: tuple[measure_statistics.RankCorrelation, ...] = ()
    closures: tuple[measure_statistics.ClosureConfusion, ...] = ()
    p_hold: measure_statistics.PHoldSpread | None = None
    """None = no set has one."""
    by_paper: "SchoolSummary | None" = None
    """The same by `score_paper` in place of the nominal score; None = this is it."""

    @property
    def candidates(self) -> int:
        """Return how many candidates there are."""
        return sum(self.outcomes.values())

    @property
    def judged(self) -> int:
        """Return how many have a score; shares are shares of these."""
        return self.candidates - self.outcomes["not_tried"]

    @property
    def with_trajectory(self) -> int:
        """Return how many of the judged ones the arm gets to."""
        return self.judged - self.outcomes["no_trajectory"]

    @property
    def good(self) -> int:
        """Return how many have a score of 0.5 or more."""
        return sum(self.outcomes[name] for name in GOOD)

    @property
    def bad(self) -> int:
        """Return how many have a score below 0.5."""
        return self.judged - self.good

    def share(self, count: int) -> float:
        """Return a number of candidates as a share of the judged ones; NaN of none."""
        return count / self.judged if self.judged else math.nan

    def to_rows(self) -> list[tuple[str, str, str]]:
        """Return (property, here, in the paper) as texts, in the paper's order."""
        return rows_of(self)

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain JSON values; null = not known."""
        derived = ("candidates", "judged", "with_trajectory", "good", "bad")
        shares = {name: self.share(count) for name, count in self.outcomes.items()}
        values = asdict(self) | {name: getattr(self, name) for name in derived}
        values["shares"] = shares | {
            name: self.share(getattr(self, name)) for name in ("with_trajectory", "good", "bad")
        }
        if self.by_paper is not None:
            values["by_paper"] = self.by_paper.to_json()
        for entry, c in zip(values["closures"], self.closures, strict=True):
            entry |= {"agree": c.agree, "balanced_accuracy": c.balanced_accuracy}
        return json_value(values)


def summarise(
    scenes: Mapping[str, Sequence[GraspSet]] | Sequence[GraspSet],
    rng: np.random.Generator | None = None,
) -> SchoolSummary:
    """Return what became of the candidates of any number of scenes.

    Args:
        scenes: grasp sets by the name of their scene, or those of one scene.
        rng: draws the bootstrap samples; None = always the same ones.

    Raises:
        InputError: a set holds scores that equation 3 cannot give.
    """
    by_scene = dict(scenes) if isinstance(scenes, Mapping) else {"": scenes}
    sets = [s for part in by_scene.values() for s in part]
    nominal = _counted_up(by_scene)
    return replace(
        nominal,
        correlations=measure_statistics.rank_correlations(sets, rng or np.random.default_rng(0)),
        closures=tuple(measure_statistics.closure_confusions(sets)),
        p_hold=measure_statistics.p_hold_spread(sets),
        by_paper=_counted_up({name: [_by_paper(s) for s in of] for name, of in by_scene.items()}),
    )


def _by_paper(s: GraspSet) -> GraspSet:
    """Return a set with `score_paper`, as its slips tell it, in place of its scores."""
    score = score_paper(s.slip_m, s.slip_rad, judged(s))
    return replace(s, scores=score, base_scores=score)


def _counted_up(by_scene: Mapping[str, Sequence[GraspSet]]) -> SchoolSummary:
    """Return what became of the candidates by the sets' scores."""
    sets = [s for part in by_scene.values() for s in part]
    outcome = [outcomes_of(s) for s in sets]
    scores = measure_statistics.joined([s.scores for s in sets])
    scored = scores[~np.isnan(scores)]
    is_good = scored >= GOOD_FROM
    by_object: dict[tuple[str, ...], list[GraspSet]] = {}
    for s in sets:
        by_object.setdefault(_identity(s), []).append(s)
    counts = np.bincount(
        measure_statistics.joined(outcome).astype(np.int64), minlength=len(OUTCOMES)
    )
    return SchoolSummary(
        scenes=len(by_scene),
        objects=len(by_object),
        sets=len(sets),
        outcomes={name: int(n) for name, n in zip(OUTCOMES, counts, strict=True)},
        penalized_by=_penalized_by(sets, outcome),
        score=_spread(scored),
        score_good=_spread(scored[is_good]).mean,
        score_bad=_spread(scored[~is_good]).mean,
        per_object=_numbers(list(by_object.values())),
        per_scene=_numbers(list(by_scene.values())),
        hands=tuple(_hands_on_same_objects(by_object)),
    )


def _identity(s: GraspSet) -> tuple[str, ...]:
    """Return what tells an object from others: its id, and its mesh where the school noted it.

    Ids alone do not: scenes of other programs all count theirs from 1.
    """
    inputs: Any = s.parameters.get("inputs")
    mesh: Any = inputs.get("mesh") if isinstance(inputs, dict) else None
    return (str(s.obj_id), str(mesh))


def _hands_on_same_objects(
    by_object: Mapping[tuple[str, ...], Sequence[GraspSet]],
) -> Iterator[HandResult]:
    """Yield each hand's results on the objects that all hands have tried; nothing of one hand."""
    names = sorted({s.hand[0] for sets in by_object.values() for s in sets})
    if len(names) < 2:
        return
    shared = [sets for sets in by_object.values() if {s.hand[0] for s in sets} == set(names)]
    for name in names:
        mine = [s for sets in shared for s in sets if s.hand[0] == name]
        scores = measure_statistics.joined([s.scores for s in mine])
        known = ~np.isnan(scores)
        reached = measure_statistics.joined([s.reachable for s in mine])[known]
        scores = scores[known]
        yield HandResult(
            hand=name, objects=len(shared), judged=len(scores), reached=int(reached.sum()),
            good=int(np.sum(scores >= GOOD_FROM)), score=_spread(scores).mean,
        )  # fmt: skip


def outcomes_of(s: GraspSet) -> Int64:
    """Return (N,) the number in OUTCOMES of every candidate.

    Raises:
        InputError: a score without a base score, or above it, or a base score that is none.
    """
    check_values(s)
    judged = ~np.isnan(s.scores)
    base, score = np.nan_to_num(s.base_scores), np.nan_to_num(s.scores)
    wrong = (judged == np.isnan(s.base_scores)) | (score > base)
    if np.any(wrong):
        row = int(np.flatnonzero(wrong)[0])
        raise InputError(
            f"grasp {row} of instance {s.instance} has the score {s.scores[row]:g} and the base "
            f"score {s.base_scores[row]:g}; a score is at most its base score, and both are known "
            "or neither."
        )
    stopped = np.select(
        [base == 0, base == 0.25, score < GOOD_FROM, base == 0.5, base == 0.75],
        [OUTCOMES.index(n) for n in
         ("fail_close", "fail_lift", "penalized", "fail_horizontal", "fail_pendulum")],
        OUTCOMES.index("full_success"),
    )  # fmt: skip
    # A set tried without an arm has slips, but no trajectory was asked for.
    nowhere = ~s.reachable & ~executed(s)
    stopped = np.where(nowhere, OUTCOMES.index("no_trajectory"), stopped)
    return np.where(judged, stopped, OUTCOMES.index("not_tried")).astype(np.int64)


def _penalized_by(sets: Sequence[GraspSet], outcome: Sequence[Int64]) -> dict[str, int]:
    """Return at which stage the penalized grasps failed first."""
    names = (*STAGES, "none")
    counts = np.zeros(len(names), dtype=np.int64)
    for s, out in zip(sets, outcome, strict=True):
        passed = np.rint(s.base_scores[out == OUTCOMES.index("penalized")] * len(STAGES))
        counts += np.bincount(passed.astype(np.int64), minlength=len(names))
    return {name: int(n) for name, n in zip(names, counts, strict=True)}


def _numbers(groups: Sequence[Sequence[GraspSet]]) -> dict[str, Spread]:
    """Return how many candidates, good and bad ones the groups have."""
    good = np.array([sum(int(s.good.sum()) for s in group) for group in groups], dtype=np.float64)
    judged = np.array(
        [sum(int(np.sum(~np.isnan(s.scores))) for s in group) for group in groups], dtype=np.float64
    )
    total = np.array([sum(len(s) for s in group) for group in groups], dtype=np.float64)
    return {"candidates": _spread(total), "good": _spread(good), "bad": _spread(judged - good)}


def _spread(values: Array) -> Spread:
    if len(values) == 0:
        return Spread(mean=math.nan, sd=math.nan)
    return Spread(mean=float(np.mean(values)), sd=float(np.std(values)))
