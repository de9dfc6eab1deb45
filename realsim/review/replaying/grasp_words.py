"""What the school found out about one grasp, in words: p_hold, score, slips, why it failed.

The texts are markdown for the review's panel; names and failures that come from files are escaped.
"""

import html
import re

import numpy as np

from realsim.records import STAGES, GraspSet

SHARE_WORDS = {
    "share_blocked": "fingers touch while open",
    "share_missed": "a pad meets nothing",
    "share_skewed": "pads outside the friction cone",
    "share_overloaded": "too large a load",
}
"""Why draws of p_hold failed."""
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
        f"**Grasp {row}** of {len(grasps)}, {of}",
        "",
        *_p_hold(grasps, row),
        _score(grasps, row),
    ]
    why = failure_words(grasps, row)
    if why:
        lines.append(f"- {why}")
    lines.append(f"- {_reach(grasps, row)}")
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


def failure_words(grasps: GraspSet, row: int) -> str:
    """Return why a grasp stopped where it stopped; '' = it passed all four stages."""
    why = grasps.failures[row]
    if why:
        return f"stopped at {escaped(why)}" if why.split(":")[0] in STAGES else escaped(why)
    if np.isnan(grasps.scores[row]):
        return "not tried"
    return ""


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

    def value(name: str) -> float:
        return float(grasps.measures[name][row]) if name in grasps.measures else np.nan

    if np.isnan(value("p_hold")):
        return []
    told = f"- p_hold **{value('p_hold'):.2f}**"
    if np.isfinite(value("p_hold_error")):
        told += f" ± {value('p_hold_error'):.2f}"
    if np.isfinite(value("p_hold_draws")):
        told += f" of {value('p_hold_draws'):.0f} draws"
    told += ": few, take it as a guess" if grasps.unsure[row] else ""
    shares = [f"{words} {100 * value(n):.0f} %" for n, words in SHARE_WORDS.items() if value(n) > 0]
    return [told, *([f"- draws that fail: {', '.join(shares)}"] if shares else [])]


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
