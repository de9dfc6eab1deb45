"""Plots of several sessions over one another."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from realsim.app.report.compare import ObjectDifference
from realsim.pages.plots import (
    INK,
    MARKERS,
    MUTED,
    SERIES,
    STYLES,
    axes,
    legend,
    png,
    titled,
    whole_numbers,
)

Series = Sequence[tuple[str, Mapping[str, Any]]]
"""Label of every session with its series."""
BY_VIEW = (
    ("calibration.view_rms_px", "Residuals of the board views", "board view",
     "RMS reprojection [px]"),
    ("registration.view_sigma_px", "Where the labels lie in every view, 1 sigma", "view",
     "median object [px]"),
)  # fmt: skip
"""Series with a value a view."""
SHARES = (
    ("school.scores", "Scores of the grasps", "score", "share of the grasps [%]"),
    ("labels.visibility", "Visible share of the objects", "visible share",
     "share of objects in frames [%]"),
)  # fmt: skip
"""Series of values between 0 and 1."""
ROW_PX = 26


def overlaid(sessions: Series) -> list[tuple[bytes, str]]:
    """Return every plot that two sessions at least have something for."""
    drawn: list[tuple[bytes, str]] = []
    for name, title, x, y in BY_VIEW:
        mine = [(label, s[name], k) for k, (label, s) in enumerate(sessions) if _views(s, name)]
        if len(mine) > 1:
            figure, ax = axes()
            for label, values, k in mine:
                style = {"color": SERIES[k % 6], "marker": MARKERS[k % 6], "ls": STYLES[k % 6]}
                # The first ones larger: equal values would hide them.
                size = max(3, 7 - 2 * k)
                ax.plot(values["view"], values["value"], ms=size, lw=1, label=label, **style)
            ax.set_ylim(0, 1.3 * max(ax.get_ylim()[1], 1e-9))
            whole_numbers(ax.xaxis)
            legend(ax, loc="upper left", ncols=2)
            titled(ax, title, x, y)
            drawn.append((png(figure), f"{title}: {_labels(mine)}."))
    for name, title, x, y in SHARES:
        mine = [(label, s[name], k) for k, (label, s) in enumerate(sessions) if s.get(name)]
        if len(mine) > 1:
            figure, ax = axes()
            edges = np.linspace(0, 1, 21)
            for label, values, k in mine:
                counts, _ = np.histogram(values, edges)
                share = 100 * counts / len(values)
                ax.stairs(share, edges, color=SERIES[k % 6], ls=STYLES[k % 6], lw=2, label=label)
            ax.set_ylim(0, 1.25 * max(ax.get_ylim()[1], 1e-9))
            legend(ax, loc="upper left", ncols=2)
            titled(ax, title, x, y)
            drawn.append((png(figure), f"{title}: {_labels(mine)}."))
    return drawn


def _views(series: Mapping[str, Any], name: str) -> bool:
    return bool(series.get(name, {}).get("view"))


def _labels(mine: Sequence[tuple[str, Any, int]]) -> str:
    return ", ".join(label for label, _, _ in mine)


def moves(objects: Sequence[ObjectDifference], labels: str) -> bytes | None:
    """Plot how far the objects stand from one another, beside the noise; None where none do."""
    rows = [o for o in objects if o.shift_mm is not None]
    if not rows:
        return None
    figure, ax = axes(height_px=100 + ROW_PX * max(3, len(rows)))
    places = np.arange(len(rows))
    ax.barh(places, [o.shift_mm or 0.0 for o in rows], 0.6, color=SERIES[0])
    noise = [2 * o.sigma_mm if o.sigma_mm is not None else np.nan for o in rows]
    ax.plot(noise, places, "|", ms=16, mew=2, color=INK)
    ax.set_yticks(places, [o.name for o in rows])
    ax.invert_yaxis()
    ax.margins(x=0.1)
    ax.tick_params(axis="y", colors=INK)
    ax.axvline(0, color=MUTED, lw=1)
    titled(ax, f"How far the objects stand apart, {labels}", "distance of the middle [mm]", "")
    return png(figure)
