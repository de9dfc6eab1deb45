"""The summary as the paper prints it, beside the paper's own figures."""

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from realsim_sim_bridge.school.summary import SchoolSummary, Spread

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

    def here(count: int) -> str:
        return _counted(count, summary.judged)

    def paper(count: int) -> str:
        return _counted(count, PAPER_CANDIDATES)

    rows = [
        ("scenes", f"{summary.scenes:,}", "1,035"),
        ("objects", f"{summary.objects:,}", "7,396"),
        ("candidates", f"{summary.candidates:,}", f"{PAPER_CANDIDATES:,}"),
        ("without a score", f"{summary.outcomes['not_tried']:,}", NOTHING),
        ("with trajectory", here(summary.with_trajectory), paper(PAPER_WITH_TRAJECTORY)),
        ("good (s >= 0.5)", here(summary.good), paper(PAPER_GOOD)),
        ("bad (s < 0.5)", here(summary.bad), paper(PAPER_BAD)),
        ("mean score", _spread(summary.score, 2), "0.72 ± 0.30"),
        ("mean score of good", _number(summary.score_good), "0.85"),
        ("mean score of bad", _number(summary.score_bad), "0.13"),
        ("candidates per object", _spread(summary.per_object["candidates"]), "307 ± 649"),
        ("candidates per scene", _spread(summary.per_scene["candidates"]), "2198 ± 1866"),
        ("good per object", _spread(summary.per_object["good"]), "255 ± 567"),
        ("bad per object", _spread(summary.per_object["bad"]), "52 ± 155"),
        ("good per scene", _spread(summary.per_scene["good"]), "1823 ± 1612"),
        ("bad per scene", _spread(summary.per_scene["bad"]), "375 ± 423"),
    ]
    for name, label in OUTCOME_NAMES.items():
        published = PAPER_OUTCOMES.get(name)
        rows.append(
            (
                label,
                here(summary.outcomes[name]),
                NOTHING if published is None else paper(published),
            )
        )
    for stage, count in summary.penalized_by.items():
        if count:
            failed = "no stage" if stage == "none" else stage
            rows.append((f"  penalized, failed first: {failed}", here(count), NOTHING))
    return rows + _measured_rows(summary)


def _measured_rows(summary: "SchoolSummary") -> list[tuple[str, str, str]]:
    """Return what was measured beside the score; the paper has none of it."""
    rows = [
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


def _spread(spread: "Spread", digits: int = 0) -> str:
    if math.isnan(spread.mean):
        return NOTHING
    return f"{spread.mean:.{digits}f} ± {spread.sd:.{digits}f}"


def _number(x: float) -> str:
    return NOTHING if math.isnan(x) else f"{x:.2f}"
