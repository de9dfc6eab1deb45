"""The comparison of reports: a table for the console, a document for programs, a page."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.app.report import compare
from realsim.app.report.figures import CATALOGUE, figures_to_json
from realsim.app.report.sources import SERIES_BY_VIEW, Source
from realsim.app.report.summary import SCHEMA_VERSION, VERDICTS
from realsim.pages import Cell, Page, plots

SCHEMA = "realsim report comparison"
KINDS = {"better": "good", "worse": "bad", "same": "", "other": "", "unknown": "off"}
SIGNS = {"better": "▲ better", "worse": "▼ worse", "same": "same", "other": "differs",
         "unknown": "?"}  # fmt: skip
"""Words as well as colours: both are read."""
EXPLAINED = (
    f"A difference counts where it is more than {compare.SIGMAS:g} sigma of both together. Counts "
    "are exact. Where a sigma is not known, a difference may be noise and is marked with '?'."
)
WORLD_NOTE = (
    "Poses are compared in the robot's world: objects that were moved, or a robot that stands "
    "elsewhere, show here as well as errors. MSSD: largest distance of a point of the surface, the "
    "object's symmetries considered."
)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Comparison:
    """The first of several sessions against each of the others."""

    sources: tuple[Source, ...]
    figures: tuple[tuple[compare.Difference, ...], ...]
    """Figures of every other session."""
    objects: tuple[tuple[compare.ObjectDifference, ...], ...]

    @property
    def worse(self) -> list[tuple[Source, compare.Difference]]:
        """Return the figures that are worse by more than noise."""
        return [
            (other, d)
            for other, found in zip(self.sources[1:], self.figures, strict=True)
            for d in found
            if d.outcome == "worse"
        ]


def comparison_of(sources: Sequence[Source]) -> Comparison:
    """Compare the first of several sessions with each of the others."""
    first, others = sources[0], sources[1:]
    return Comparison(
        sources=tuple(sources),
        figures=tuple(tuple(compare.differences(first, other)) for other in others),
        objects=tuple(tuple(compare.object_differences(first, other)) for other in others),
    )


def figure_header(c: Comparison) -> list[str]:
    """Return the header of the table of figures."""
    first = c.sources[0].letter
    header = ["figure", "unit", *[s.letter for s in c.sources]]
    for other in c.sources[1:]:
        header += [f"{other.letter} - {first}", "means"]
    return header


def figure_rows(c: Comparison, *, all_figures: bool = True) -> Iterator[list[object]]:
    """Return the rows of the table of figures.

    Args:
        c: the comparison.
        all_figures: False leaves out those that are the same in all.
    """
    by = [{d.name: d for d in found} for found in c.figures]
    for name, meaning in CATALOGUE.items():
        mine = [found[name] for found in by if name in found]
        if not mine or (not all_figures and all(d.value == 0 for d in mine)):
            continue
        row: list[object] = [Cell(text=name, hover=meaning.text), meaning.unit]
        for s in c.sources:
            row.append(s.figures[name].shown if name in s.figures else "-")
        for found, other in zip(by, c.sources[1:], strict=True):
            row += _outcome(found.get(name), c.sources[0], other)
        yield row


def _outcome(d: compare.Difference | None, first: Source, other: Source) -> list[object]:
    """Return difference and meaning of one figure."""
    if d is None:
        return ["-", "in neither"]
    if d.outcome is None:
        where = first.letter if d.second is None else other.letter
        return ["-", f"only in {where}"]
    text = SIGNS[d.outcome]
    if d.outcome == "unknown" and d.tends:
        text = f"? ({d.tends})"
    return [d.shown, Cell(text=text, kind=KINDS[d.outcome], hover=compare.OUTCOMES[d.outcome])]


OBJECT_HEADER = [
    "object", "verdict", "then", "MSSD [mm]", "shift [mm]", "turn [deg]", "2 sigma [mm]", "moved",
    "note",
]  # fmt: skip


def object_rows(found: Sequence[compare.ObjectDifference]) -> Iterator[list[object]]:
    """Return the rows of the table of objects."""
    for o in found:
        moved = {None: "not known", True: "yes", False: "within noise"}[o.is_moved]
        moved = "no" if o.shift_mm == 0 and o.turn_deg == 0 else moved
        noise = None if o.sigma_mm is None else compare.SIGMAS * o.sigma_mm
        yield [
            o.name,
            "-" if o.first is None else o.first["verdict"],
            "-" if o.second is None else o.second["verdict"],
            *[_number(v, 3) for v in (o.mssd_mm, o.shift_mm, o.turn_deg, noise)],
            moved if o.shift_mm is not None else "-",
            o.note,
        ]


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def as_json(c: Comparison) -> dict[str, Any]:
    """Return the comparison as plain JSON values."""
    others = [
        {
            "with": other.label,
            "figures": {
                d.name: {
                    "difference": d.value, "sigma": d.sigma, "outcome": d.outcome,
                    "better": CATALOGUE[d.name].better, "unit": CATALOGUE[d.name].unit,
                }
                for d in figures
            },
            "objects": [
                {
                    "name": o.name, "note": o.note, "mssd_mm": o.mssd_mm,
                    "shift_mm": o.shift_mm, "turn_deg": o.turn_deg, "sigma_mm": o.sigma_mm,
                    "moved": o.is_moved,
                    "verdicts": [None if s is None else s["verdict"] for s in (o.first, o.second)],
                }
                for o in objects
            ],
        }
        for other, figures, objects in zip(c.sources[1:], c.figures, c.objects, strict=True)
    ]  # fmt: skip
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "sessions": [
            {"label": s.label, "verdict": s.verdict, "figures": figures_to_json(s.figures)}
            for s in c.sources
        ],
        "against": c.sources[0].label,
        "differences": others,
    }


def comparison_page(c: Comparison) -> Page:
    """Return the comparison as a page."""
    names = " and ".join(s.label for s in c.sources[:2]) + " ..." * (len(c.sources) > 2)
    page = Page(title=f"Comparison: {names}", document=as_json(c))
    _summary(page, c)
    drawings = list(overlaid([(s.label, s.series) for s in c.sources]))
    for other, found in zip(c.sources[1:], c.objects, strict=True):
        labels = f"{c.sources[0].letter} and {other.letter}"
        page.section(f"Objects, {labels}", WORLD_NOTE)
        if found:
            page.table(OBJECT_HEADER, object_rows(found))
            picture = moves(found, labels)
            if picture is not None:
                said = "Bars: shift. Marks: 2 sigma: a bar beyond is more than noise."
                page.plots([(picture, said)])
        else:
            page.text("Neither has objects.")
    page.section("Plots")
    if drawings:
        page.plots(drawings)
    else:
        page.text("There is nothing that two of them have measured.")
    page.section("All figures", EXPLAINED)
    page.table(figure_header(c), figure_rows(c))
    return page


def _summary(page: Page, c: Comparison) -> None:
    """Add what is worse and what is better, for the first screen."""
    for other, found in zip(c.sources[1:], c.figures, strict=True):
        worse = [d for d in found if d.outcome == "worse"]
        better = [d for d in found if d.outcome == "better"]
        kind = "bad" if worse else "good" if better else "off"
        page.verdict(
            kind, other.label,
            f"against {c.sources[0].label}: {len(worse)} figures worse, {len(better)} better, by "
            "more than noise.",
        )  # fmt: skip
        rows: list[list[object]] = []
        for d in [*worse, *better]:
            sign = Cell(text=SIGNS[d.outcome or "same"], kind=KINDS[d.outcome or "same"])
            values = [f.shown if f is not None else "-" for f in (d.first, d.second)]
            unit = CATALOGUE[d.name].unit
            rows.append([sign, CATALOGUE[d.name].text, *values, f"{d.shown} {unit}".strip()])
        if rows:
            header = ["", "what", c.sources[0].letter, other.letter, "difference"]
            page.table(header, rows)
        only = [d for d in found if d.value is None]
        if only:
            page.text(_uncompared(only, c.sources[0], other))
    rows = [
        [s.label, Cell(text=VERDICTS[s.verdict][0], kind=VERDICTS[s.verdict][1]),
         len(s.objects), len(s.figures)]
        for s in c.sources
    ]  # fmt: skip
    page.table(["session", "its report says", "objects", "figures"], rows)


def _uncompared(only: Sequence[compare.Difference], first: Source, other: Source) -> str:
    """Return which stages one side alone has."""
    told: list[str] = []
    for letter, missing in ((first.letter, "second"), (other.letter, "first")):
        names = sorted({d.name.split(".")[0] for d in only if getattr(d, missing) is None})
        if names:
            told.append(f"{len([d for d in only if getattr(d, missing) is None])} figures are only "
                        f"in {letter} ({', '.join(names)})")  # fmt: skip
    return f"Not compared: {'; '.join(told)}."


# --- plots of several sessions over one another ---

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
    ("school.p_hold", "p_hold of the grasps", "p_hold", "share of the grasps [%]"),
    ("labels.visibility", "Visible share of the objects", "visible share",
     "share of objects in frames [%]"),
)  # fmt: skip
"""Series of values between 0 and 1."""


def overlaid(sessions: Series) -> Iterator[tuple[bytes, str]]:
    """Return every plot that two sessions at least have something for."""
    for name, title, x, y in (*BY_VIEW, *SHARES):
        by_view = name in SERIES_BY_VIEW
        mine = [(label, s[name], k) for k, (label, s) in enumerate(sessions) if s.get(name)]
        mine = [m for m in mine if not by_view or m[1].get("view")]
        if len(mine) < 2:
            continue
        figure, ax = plots.axes(title, x, y)
        for label, values, k in mine:
            style = {"color": plots.SERIES[k % 6], "ls": plots.STYLES[k % 6], "label": label}
            if by_view:
                # The first ones larger: equal values would hide them.
                style |= {"marker": plots.MARKERS[k % 6], "ms": max(3, 7 - 2 * k), "lw": 1}
                ax.plot(values["view"], values["value"], **style)
            else:
                counts, edges = np.histogram(values, np.linspace(0, 1, 21))
                ax.stairs(100 * counts / len(values), edges, lw=2, **style)
        ax.set_ylim(0, (1.3 if by_view else 1.25) * max(ax.get_ylim()[1], 1e-9))
        if by_view:
            plots.whole_numbers(ax.xaxis)
        plots.legend(ax, loc="upper left", ncols=2)
        yield (plots.png(figure), f"{title}: {', '.join(label for label, _, _ in mine)}.")


def moves(objects: Sequence[compare.ObjectDifference], labels: str) -> bytes | None:
    """Plot how far the objects stand from one another, beside the noise; None where none do."""
    rows = [o for o in objects if o.shift_mm is not None]
    if not rows:
        return None
    title = f"How far the objects stand apart, {labels}"
    height_px = 100 + plots.BAR_PX * max(3, len(rows))
    figure, ax = plots.axes(title, "distance of the middle [mm]", height_px=height_px)
    places = np.arange(len(rows))
    ax.barh(places, [o.shift_mm or 0.0 for o in rows], 0.6, color=plots.SERIES[0])
    noise = [2 * o.sigma_mm if o.sigma_mm is not None else np.nan for o in rows]
    ax.plot(noise, places, "|", ms=16, mew=2, color=plots.INK)
    ax.set_yticks(places, [o.name for o in rows])
    ax.invert_yaxis()
    ax.margins(x=0.1)
    ax.tick_params(axis="y", colors=plots.INK)
    ax.axvline(0, color=plots.MUTED, lw=1)
    return plots.png(figure)
