"""What the school found out about one grasp, in words: p_hold, score, slips, why it failed.

The texts are markdown for the review's panel; names and failures that come from files are escaped.
"""

import html
import re

import numpy as np

from realsim.records import STAGES, GraspSet
from realsim.records.grasps import LABEL_MEASURES

SHARE_WORDS = {
    "share_blocked": "fingers touch while open",
    "share_missed": "a pad meets nothing",
    "share_skewed": "the pads meet it outside the friction cone",
    "share_overloaded": "the load is too large",
}
"""Why draws of p_hold failed."""
STAGE_WORDS = dict(
    zip(STAGES, ("while the fingers closed", "during the lift", "while it was shaken",
                 "while it was swung"), strict=True)
)  # fmt: skip
"""When a grasp failed, by the stage that its failure names."""
HOLDS_FROM = 0.5
"""Least p_hold of a grasp of which no failure is told."""
MEASURE_WORDS = {
    "score_paper": "score by the paper's limits",
    "margin": "share of the tried frictions and forces that hold",
    "least_friction": "least friction",
    "least_force_n": "least finger force [N]",
    "confidence": "agreement of the two engines",
    "second_score": "score of the second engine",
    "ferrari_canny": "Ferrari-Canny quality",
    "closure_friction": "friction at which it closes",
    "dexnet_closure": "force closure (Dex-Net)",
}
"""The measures that are one value a grasp, in the order of the panel."""
NOT_SEEN = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]+")
NOT_TRIED, LOST = "not tried", "lost"


def grasp_words(grasps: GraspSet, row: int, name: str = "") -> str:
    """Return what is known of a grasp as markdown.

    Args:
        grasps: the set.
        row: which of its grasps.
        name: of the object; '' = its number alone.

    Raises:
        IndexError: the set has no such row.
    """
    if not 0 <= row < len(grasps):
        raise IndexError(f"row {row} of {len(grasps)} grasps")
    of = f"{escaped(name)} (instance {grasps.instance})" if name else f"instance {grasps.instance}"
    lines = [
        f"**Grasp {row}** of {len(grasps)}, {of}", "", why_words(grasps, row), "",
        *_p_hold(grasps, row), _score(grasps, row), f"- {_reach(grasps, row)}",
    ]  # fmt: skip
    lines.append(f"- distance of the contacts {1e3 * grasps.widths_m[row]:.1f} mm")
    lines += ["", *slip_table(grasps, row)]
    measured = measure_lines(grasps, row)
    if measured:
        lines += ["", "| measure | value |", "|:--|--:|", *measured]
    return "\n".join(lines)


def slip_table(grasps: GraspSet, row: int) -> list[str]:
    """Return the lines of the table of slips: one row a stage, with its safety if it is known."""
    safety = grasps.measures.get("safety")
    known = safety is not None and not np.isnan(safety[row]).all()
    lines = [
        "| stage | slip [mm] | turn [deg] |" + " safety |" * known, "|:--|--:|--:|" + "--:|" * known
    ]  # fmt: skip
    for k, stage in enumerate(STAGES):
        slip = slip_words(1e3 * float(grasps.slip_m[row, k]))
        turn = slip_words(float(np.degrees(grasps.slip_rad[row, k])))
        lines.append(f"| {stage} | {slip} | {turn} |")
        if safety is not None and known:
            factor = float(safety[row, k])
            lines[-1] += f" {f'{factor:.3g}' if np.isfinite(factor) else '-'} |"
    return lines


def slip_words(value: float) -> str:
    """Return a slip as it is read: a number, 'not tried' (NaN), or 'lost' (infinite)."""
    if np.isnan(value):
        return NOT_TRIED
    return f"{value:.2f}" if np.isfinite(value) else LOST


def measure_lines(grasps: GraspSet, row: int) -> list[str]:
    """Return the table lines of what was measured of a grasp besides its slips."""
    lines: list[str] = []
    for name, words in MEASURE_WORDS.items():
        values = grasps.measures.get(name)
        if values is None or np.isnan(values[row]):
            continue
        value = float(values[row])
        text = f"{value:.3g}" if np.isfinite(value) else "none of those tried"
        lines.append(f"| {words} | {text} |")
    forces = grasps.measures.get("force_n")
    if forces is not None and np.isfinite(forces[row]).any():
        lines.append(f"| least finger force over the stages [N] | {np.nanmin(forces[row]):.3g} |")
    return lines


def why_words(grasps: GraspSet, row: int) -> str:
    """Return in one sentence why a grasp failed, or that it held."""
    stage, _, told = grasps.failures[row].partition(":")
    why = escaped(told.strip() if stage in STAGE_WORDS else grasps.failures[row]).rstrip(".")
    if stage in STAGE_WORDS:
        return f"It failed {STAGE_WORDS[stage]}: {why}."
    if not grasps.reachable[row]:
        return f"The arm does not reach it: {why}." if why else "The arm does not reach it."
    if np.isnan(grasps.scores[row]):
        return f"It was not tried: {why}." if why else "It was not tried."
    if why or not grasps.base_scores[row] >= 1.0:
        return f"It failed: {why or 'no reason is stored'}."
    p_hold = _value(grasps, row, "p_hold")
    if not p_hold < HOLDS_FROM:
        return "It held in all four stages."
    share, words = max((np.nan_to_num(_value(grasps, row, n)), w) for n, w in SHARE_WORDS.items())
    often = f", most often because {words}" if share > 0 else ""
    return f"It held as planned, but fails in {100 - 100 * p_hold:.0f} % of the draws{often}."


def escaped(text: str) -> str:
    """Return text from a file or a person with nothing that HTML or markdown would take for its.

    It stays one line: the next one could look like somebody else's.
    """
    return re.sub(r"([\\`*_{}\[\]|#~])", r"\\\1", html.escape(one_line(text), quote=False))


def one_line(text: str) -> str:
    """Return text with spaces in place of line breaks and of what is not seen.

    Line breaks, control characters, and those that turn the direction of writing.
    """
    return NOT_SEEN.sub(" ", text)


def _p_hold(grasps: GraspSet, row: int) -> list[str]:
    """Return p_hold with its error, and why draws failed; nothing where it is not known."""
    p_hold, error, draws = (_value(grasps, row, n) for n in LABEL_MEASURES[:3])
    if np.isnan(p_hold):
        return []
    told = f"- p_hold **{p_hold:.2f}**"
    told += f" ± {error:.2f}" if np.isfinite(error) else ""
    told += f" of {draws:.0f} draws" if np.isfinite(draws) else ""
    told += ": few, take it as a guess" if grasps.unsure[row] else ""
    each = ((100 * _value(grasps, row, n), words) for n, words in SHARE_WORDS.items())
    shares = [f"{words} {share:.0f} %" for share, words in each if share > 0]
    return [told, *([f"- draws that fail: {', '.join(shares)}"] if shares else [])]


def _value(grasps: GraspSet, row: int, name: str) -> float:
    """Return a measure of a grasp; NaN = not measured."""
    return float(grasps.measures[name][row]) if name in grasps.measures else np.nan


def _score(grasps: GraspSet, row: int) -> str:
    score, base = float(grasps.scores[row]), float(grasps.base_scores[row])
    if np.isnan(score):
        return "- score: not tried"
    passed = "" if np.isnan(base) else f" (base {base:.2f}: {_stages(base)})"
    return f"- score **{score:.2f}** of one nominal attempt{passed}"


def _stages(base: float) -> str:
    """Return which stages a base score says were passed."""
    passed = round(base * len(STAGES))
    if passed == len(STAGES):
        return "all four stages passed"
    return f"passed {', '.join(STAGES[:passed])}" if passed else "no stage passed"


def _reach(grasps: GraspSet, row: int) -> str:
    if grasps.reachable[row]:
        return "the arm reaches it without a collision"
    return "the arm does not reach it"
