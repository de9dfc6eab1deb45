"""Plots of registration, the Robot School and the labels."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.pages.plots import (
    BAD,
    GOOD,
    INK,
    MUTED,
    VERDICT_COLORS,
    WARN,
    axes,
    legend,
    png,
    titled,
    whole_numbers,
)
from realsim.records import STAGES

Array = NDArray[np.float64]
MOST_BARS = 12
"""Reasons in one plot; further ones are summed up."""
ROW_PX = 26
LONGEST_LABEL = 44


def probabilities(
    names: Sequence[str], values: Sequence[float], verdicts: Sequence[str], accept: float
) -> bytes:
    """Plot the probability that every object is right, in the colour of its verdict."""
    figure, ax = axes(height_px=90 + ROW_PX * max(3, len(names)))
    ax.barh(names, values, 0.7, color=[VERDICT_COLORS[v] for v in verdicts])
    for k, (value, verdict) in enumerate(zip(values, verdicts, strict=True)):
        inside = value > 0.3
        ax.text(
            value - 0.01 if inside else value + 0.01, k, verdict, va="center", fontsize=8,
            ha="right" if inside else "left", color="white" if inside else INK,
        )  # fmt: skip
    ax.axvline(accept, color=INK, lw=1, ls="--")
    ax.set_xlim(0, 1)
    ax.invert_yaxis()
    titled(ax, f"Probability that an object is right (dashed: {accept:g})",
           "probability of less than 3 mm", "")  # fmt: skip
    return png(figure)


def view_uncertainty(sigma_px: Mapping[int, Sequence[float]], left_out: Sequence[int]) -> bytes:
    """Plot how certain the objects are in every view: median, least and greatest."""
    figure, ax = axes()
    views = sorted(sigma_px)
    rows = [np.asarray(sigma_px[k], dtype=np.float64) for k in views]
    middle = np.array([np.median(r) for r in rows])
    low, high = (np.array([f(r) for r in rows]) for f in (np.min, np.max))
    ax.vlines(views, low, high, color=MUTED, lw=2, label="least to greatest object")
    ax.plot(views, middle, "o", ms=4, color=INK, label="median object")
    if left_out:
        ax.plot(list(left_out), [0] * len(left_out), "x", ms=7, color=BAD, label="took no part",
                clip_on=False)  # fmt: skip
    ax.set_ylim(0, 1.35 * float(high.max()))
    whole_numbers(ax.xaxis)
    legend(ax, loc="upper left", ncols=3)
    titled(ax, "Where the labels lie in every view, 1 sigma", "view", "1 sigma [px]")
    return png(figure)


def sigmas(names: Sequence[str], mm: Sequence[float], verdicts: Sequence[str]) -> bytes:
    """Plot 1 sigma of the objects' positions."""
    figure, ax = axes(height_px=90 + ROW_PX * max(3, len(names)))
    ax.barh(names, np.nan_to_num(mm), 0.7, color=[VERDICT_COLORS[v] for v in verdicts])
    ax.invert_yaxis()
    titled(ax, "How certain the objects' places are", "1 sigma along the worst axis [mm]", "")
    return png(figure)


def errors(names: Sequence[str], mm: Sequence[float]) -> bytes:
    """Plot the error of every object against the truth."""
    figure, ax = axes(height_px=90 + ROW_PX * max(3, len(names)))
    ax.barh(names, mm, 0.7, color=INK)
    ax.invert_yaxis()
    titled(ax, "Error of every object against the truth", "MSSD [mm]", "")
    return png(figure)


def stages(tried: int, reachable: int, base_scores: Array) -> bytes:
    """Plot how many grasps passed each stage."""
    names = ["tried", "reached by the arm", *[f"passed: {s}" for s in STAGES]]
    passed = [int(np.sum(base_scores >= 0.25 * (k + 1))) for k in range(len(STAGES))]
    counts = [tried, reachable, *passed]
    figure, ax = axes(height_px=90 + ROW_PX * len(names))
    bars = ax.barh(names, counts, 0.7, color=[MUTED, MUTED, *[GOOD] * len(STAGES)])
    labels = [f"{n} ({100 * n / max(1, tried):.0f} %)" for n in counts]
    ax.bar_label(bars, labels, fontsize=8, padding=3, color=INK)
    ax.set_xlim(0, 1.2 * max(1, *counts))
    ax.invert_yaxis()
    whole_numbers(ax.xaxis)
    titled(ax, "Grasps through the four stages", "grasps", "")
    return png(figure)


def scores(values: Array, good_from: float = 0.5) -> bytes:
    """Plot how the scores are distributed."""
    figure, ax = axes()
    edges = np.linspace(0, 1, 21)
    counts, _ = np.histogram(values, edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    ax.bar(middle, counts, 0.045, color=[GOOD if m >= good_from else BAD for m in middle])
    ax.axvline(good_from, color=INK, lw=1, ls="--")
    ax.text(good_from + 0.01, 0.97, "good from here", fontsize=8, color=INK, va="top",
            transform=ax.get_xaxis_transform())  # fmt: skip
    whole_numbers(ax.yaxis)
    titled(ax, f"Scores of {len(values)} grasps", "score", "grasps")
    return png(figure)


def slips(slip_mm: Array, slip_deg: Array) -> bytes:
    """Plot how far objects slipped in grasps that kept them, and how far they turned."""
    figure, ax = axes()
    ax.scatter(slip_mm, slip_deg, s=14, color=INK, alpha=0.6, linewidths=0)
    ax.set_xscale("symlog", linthresh=0.1)
    ax.set_yscale("symlog", linthresh=0.1)
    ax.set_xlim(left=0)
    ax.set_ylim(bottom=0)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    titled(ax, f"Largest slip of {len(slip_mm)} grasps that kept their object",
           "slip in the hand [mm]", "turn in the hand [deg]")  # fmt: skip
    return png(figure)


def failures(counts: Mapping[str, int]) -> bytes:
    """Plot why grasps failed, the most frequent reasons first."""
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    shown, rest = ordered[:MOST_BARS], ordered[MOST_BARS:]
    if rest:
        shown.append((f"{len(rest)} other reasons", sum(n for _, n in rest)))
    names = [_shortened(name) for name, _ in shown]
    figure, ax = axes(height_px=90 + ROW_PX * len(shown))
    bars = ax.barh(range(len(shown)), [n for _, n in shown], 0.7, color=WARN)
    ax.set_yticks(range(len(shown)), names, fontsize=8)
    ax.bar_label(bars, fontsize=8, padding=3, color=INK)
    ax.margins(x=0.15)
    ax.invert_yaxis()
    whole_numbers(ax.xaxis)
    titled(ax, "Where grasps failed", "grasps", "")
    return png(figure)


def _shortened(name: str) -> str:
    name = f"lost while: {name}" if name in STAGES else name
    return name if len(name) <= LONGEST_LABEL else name[: LONGEST_LABEL - 1] + "…"


def visibility(shares: Array) -> bytes:
    """Plot how visible the objects are in the frames."""
    figure, ax = axes()
    ax.hist(shares, np.linspace(0, 1, 21).tolist(), color=GOOD, rwidth=0.9)
    whole_numbers(ax.yaxis)
    titled(ax, f"Visible share of {len(shares)} objects in frames", "visible share", "number")
    return png(figure)
