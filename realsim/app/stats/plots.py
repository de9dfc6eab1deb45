"""The pictures of the statistics: what became of grasps, how visible and certain objects are."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from realsim.app.report.plots import labels
from realsim.app.stats.statistics import VERDICTS, Statistics
from realsim.formats.grasps.scene_grasps import labelled
from realsim.pages import plots
from realsim.records import GraspSet
from realsim_sim_bridge.school.measure_statistics import label_chart
from realsim_sim_bridge.school.summary import GOOD as GOOD_OUTCOMES
from realsim_sim_bridge.school.summary import OUTCOME_NAMES, PAPER_CANDIDATES, PAPER_OUTCOMES

BINS = 20
LEAST_BINS = 5
"""Numbers that an axis of counts spans at least: one bar alone would be as wide as the plot."""
THIRD_PX = plots.WIDE_PX // 3 - 18
"""Width of a picture of which three stand side by side [px]."""
WIDE = 0.3
"""Room beside the first and the last bar [bars]."""


Drawn = tuple[bytes, str]
"""A picture and its caption."""


def figures(stats: Statistics) -> Iterator[tuple[str, int, list[Drawn]]]:
    """Return (title, width of a picture [px], pictures) of everything that there are figures for.

    Pictures stand side by side where the page is wide enough, and one below the other on a phone.
    """
    if stats.school.judged:
        both = [_outcomes(stats), (labels(_sets(stats)), "Red: below 0.5.")]
        yield ("What became of the candidates, beside the paper's", plots.WIDTH_PX, both)
        yield ("Force closure against p_hold or score", plots.WIDTH_PX, [_closure(stats)])
    if len(stats.visibility) or stats.objects:
        yield ("How visible and how certain the objects are", THIRD_PX, _trust(stats))
    if stats.objects and len(stats.sessions) > 1:  # of one, the table says it
        yield ("Objects, frames and verdicts of the scenes", THIRD_PX, _scenes(stats))


def _outcomes(stats: Statistics) -> Drawn:
    school = stats.school.by_paper or stats.school
    figure, ax = plots.axes(f"{school.judged:,} candidates, score_paper", "share [%]")
    names = [n for n in OUTCOME_NAMES if school.outcomes[n] or n in PAPER_OUTCOMES]
    rows = np.arange(len(names))
    here = [100 * school.share(school.outcomes[n]) for n in names]
    paper = [100 * PAPER_OUTCOMES.get(n, 0) / PAPER_CANDIDATES for n in names]
    colors = [plots.GOOD if n in GOOD_OUTCOMES else plots.BAD for n in names]
    ax.barh(rows - 0.2, here, 0.38, color=colors)
    ax.barh(rows + 0.2, paper, 0.38, color=plots.MUTED, alpha=0.5)
    for row, (ours, theirs) in enumerate(zip(here, paper, strict=True)):
        ax.text(ours + 0.5, row - 0.2, f"{ours:.1f} %", va="center", fontsize=7, color=plots.INK)
        if theirs:
            ax.text(theirs + 0.5, row + 0.2, f"{theirs:.1f} % paper", va="center", fontsize=7,
                    color=plots.MUTED)  # fmt: skip
    ax.set_yticks(rows, [OUTCOME_NAMES[n] for n in names])
    ax.invert_yaxis()
    ax.margins(x=0.12)
    return plots.png(figure), "Coloured: here. Grey: in the paper."


def _sets(stats: Statistics) -> list[GraspSet]:
    return [s for session in stats.sessions for s in session.sets]


def _closure(stats: Statistics) -> Drawn:
    sets = _sets(stats)
    name = label_chart(sets)[2]
    figure, right = plots.axes(
        f"{name} by the friction that closes", "least friction that closes", name
    )
    groups: dict[float, list[float]] = {}
    for s in sets:
        friction = s.measures.get("closure_friction")
        if friction is None:
            continue
        known = labelled(s) & ~np.isnan(friction)
        for mu, label in zip(friction[known].tolist(), s.labels[known].tolist(), strict=True):
            groups.setdefault(mu, []).append(label)
    levels = sorted(groups)
    for k, mu in enumerate(levels):
        values = groups[mu]
        right.vlines(k, *np.percentile(values, [25, 75]), color=plots.WARN, lw=8)
        right.plot([k], [np.mean(values)], "o", color=plots.INK, ms=4)
        right.text(k, 1.04, f"{len(values)}", ha="center", fontsize=7, color=plots.MUTED)
    right.set_xticks(range(len(levels)), ["none" if np.isinf(v) else f"{v:g}" for v in levels])
    right.set_ylim(-0.02, 1.12)
    if not levels:
        right.text(
            0.5, 0.5, "force closure was not computed", ha="center", color=plots.MUTED, fontsize=9
        )
    return plots.png(figure), "Dot: mean. Bar: middle half. Grey: number of grasps."


def _thirds() -> tuple[list[Any], list[Any]]:
    """Return three figures, and the axes of each."""
    drawn = [plots.axes(width_px=THIRD_PX) for _ in range(3)]
    return [figure for figure, _ in drawn], [ax for _, ax in drawn]


def _trust(stats: Statistics) -> list[Drawn]:
    drawn, (left, middle, right) = _thirds()
    seen = stats.visibility
    left.hist(seen, np.linspace(0, 1, BINS + 1).tolist(), color=plots.GOOD, rwidth=0.9)
    plots.titled(left, f"Visible share, {len(seen):,} objects in frames", "visible share", "number")
    for ax, name, unit in ((middle, "sigma_mm", "mm"), (right, "sigma_deg", "deg")):
        values = np.array([getattr(o, name) for o in stats.objects], dtype=np.float64)
        known = np.isfinite(values)
        if known.any():
            edges = np.linspace(0, max(1e-6, 1.02 * float(values[known].max())), BINS + 1)
            parts = [
                values[known & np.array([o.verdict == v for o in stats.objects])] for v in VERDICTS
            ]
            ax.hist(parts, edges.tolist(), stacked=True, rwidth=0.9, label=list(VERDICTS),
                    color=[plots.VERDICT_COLORS[v] for v in VERDICTS])  # fmt: skip
            plots.legend(ax)
        else:
            ax.text(0.5, 0.5, "not known", ha="center", transform=ax.transAxes, color=plots.MUTED)
        plots.titled(ax, "Uncertainty of the poses, 1 sigma", f"[{unit}]", "objects")
        plots.whole_numbers(ax.yaxis)
    return [(plots.png(figure), "") for figure in drawn]


def _scenes(stats: Statistics) -> list[Drawn]:
    drawn, (left, middle, right) = _thirds()
    counts = np.array([len(s.objects) for s in stats.sessions])
    edges = np.arange(counts.min(), counts.max() + 2) - 0.5
    left.hist(counts, edges.tolist(), color=plots.GOOD, rwidth=0.9)
    spare = max(0.0, 0.5 * (LEAST_BINS - (edges[-1] - edges[0])))
    left.set_xlim(edges[0] - spare - 0.1, edges[-1] + spare + 0.1)
    plots.titled(left, "Objects per scene", "objects", "scenes")
    kinds = Counter({s.kind: 0 for s in stats.sessions})
    annotated = Counter(kinds)
    for s in stats.sessions:
        kinds[s.kind] += s.frames
        annotated[s.kind] += s.frames_annotated
    places = range(len(kinds))
    middle.bar(places, list(kinds.values()), 0.6, color=plots.MUTED, alpha=0.5, label="all")
    middle.bar(places, [annotated[k] for k in kinds], 0.4, color=plots.GOOD, label="annotated")
    middle.set_xticks(list(places), list(kinds))
    middle.set_xlim(-0.5 - WIDE, len(kinds) - 0.5 + WIDE)
    middle.set_ylim(0, 1.25 * max(1, *kinds.values()))  # the legend stands above the bars
    plots.legend(middle, loc="upper right", ncols=2)
    plots.titled(middle, "Frames", "", "frames")
    verdicts = Counter(o.verdict for o in stats.objects)
    right.bar(VERDICTS, [verdicts.get(v, 0) for v in VERDICTS],
              color=[plots.VERDICT_COLORS[v] for v in VERDICTS])  # fmt: skip
    plots.titled(right, "Verdicts", "", "objects")
    plots.whole_numbers(left.xaxis, left.yaxis, middle.yaxis, right.yaxis)
    return [(plots.png(figure), "") for figure in drawn]
