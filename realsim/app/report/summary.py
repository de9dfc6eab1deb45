"""The first screen: can this session be trusted, what speaks against it, what is missing."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from realsim.app.console import StageTime
from realsim.app.report.figures import Figure, count, figures_to_json
from realsim.app.report.section import SEVERITIES, ReportFinding, Section
from realsim.pages import Cell, Page, Picture

SCHEMA, SCHEMA_VERSION = "realsim report", 1
SHOWN = 3
"""Findings on the first screen; all of them stand in the sections, and in report.json."""
NOTES_SHOWN = 3
"""Notes of the run there; the others open when they are asked for."""
LONGEST = 260
"""Characters of a finding there."""
STATE_KIND = {"done": "good", "missing": "off", "damaged": "bad"}
NEEDED = ("calibration", "capture", "registration", "labels")
"""Stages without which a session is not finished."""
LEADING = (
    "truth.object_mssd_mm", "registration.accepted", "registration.sigma_mm_max",
    "school.good_share", "registration.agree_min", "calibration.sigma_mm", "registration.doubtful",
)  # fmt: skip
"""What matters, the most first: three of the figures that there are lead the page."""
VERDICTS = {
    "bad": ("Do not use it yet", "bad"),
    "look": ("Look first", "warn"),
    "unfinished": ("Not finished", "off"),
    "sound": ("All checks passed", "good"),
}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Report:
    """A report of one session: what stands on its page, and what a program reads of it."""

    name: str
    about: str
    sections: tuple[Section, ...]
    notes: Sequence[str] = ()
    """What the run that made it has to say, and the reader must know first."""
    times: Sequence[StageTime] = ()
    """Cost of the stages of that run."""

    @property
    def findings(self) -> list[ReportFinding]:
        """Return all findings, worst first, then in the order of the sections."""
        found = [f for s in self.sections for f in s.findings]
        return sorted(found, key=lambda f: SEVERITIES.index(f.severity))

    @property
    def missing(self) -> list[Section]:
        """Return the stages that have not been run and can be."""
        return [s for s in self.sections if s.state == "missing" and s.command]

    @property
    def verdict(self) -> str:
        """Return one of VERDICTS."""
        severities = {f.severity for f in self.findings}
        if "bad" in severities:
            return "bad"
        if "warn" in severities:
            return "look"
        unfinished = any(s.key in NEEDED for s in self.missing)
        return "unfinished" if unfinished else "sound"

    @property
    def figures(self) -> dict[str, Figure]:
        """Return all figures by name, in the order of the sections."""
        severities = [f.severity for f in self.findings]
        found = {
            "report.bad": count("report.bad", severities.count("bad")),
            "report.warnings": count("report.warnings", severities.count("warn")),
        }
        for s in self.sections:
            found |= s.figures
        return found

    @property
    def objects(self) -> list[dict[str, Any]]:
        """Return the placed objects as plain JSON values."""
        return [o for s in self.sections for o in s.objects]

    def document(self, page: Page) -> dict[str, Any]:
        """Return everything as plain JSON values.

        Args:
            page: whose rules on private text hold for the findings, too.
        """
        return {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "session": page.plain(self.name),
            "verdict": self.verdict,
            "figures": figures_to_json(self.figures),
            "missing": {s.key: s.command for s in self.missing},
            "stages": {s.key: s.state for s in self.sections},
            "findings": [
                {"severity": f.severity, "section": f.section, "text": page.plain(f.text)}
                for f in self.findings
            ],
            "objects": self.objects,
            "series": {name: v for s in self.sections for name, v in s.series.items()},
        }


def write_summary(
    page: Page, report: Report, picture: tuple[Picture | None, str] = (None, "")
) -> None:
    """Write the first screen: verdict, one picture, the figures that matter, what to do next.

    Args:
        page: to write on.
        report: what was found.
        picture: that picture, and its caption.
    """
    found = [f for f in report.findings if f.severity != "note"]
    title, kind = VERDICTS[report.verdict]
    if report.verdict == "sound" and report.missing:
        title = "What was run passed its checks"
    rows: list[list[object]] = [
        [Cell(f.severity, kind=f.severity), f.text, Cell("more", href=f.section)] for f in found
    ]
    first = [
        [severity, textwrap.shorten(str(text), LONGEST, placeholder="…"), more]
        for severity, text, more in rows[:SHOWN]
    ]
    page.verdict(kind, f"{title}.", f"{_why(report)} {_next(report)}".strip(), first)
    page.lead(*picture, _leading(report))
    if len(found) > SHOWN:
        rest = rows[SHOWN:]
        page.table(["", "what", ""], rest, folded=f"{len(rest)} more things to look at")
    rows = []
    for s in report.sections:
        run = f"run {s.command}" if s in report.missing else ""
        state = _state(s)
        rows.append([Cell(text=s.title, href=s.key), state, s.headline, run])
    page.table(["stage", "state", "in short", "next"], rows)
    _notes(page, report.notes)


def _leading(report: Report) -> list[tuple[str, str]]:
    """Return value and meaning of the three figures that lead the page."""
    figures = report.figures
    found: list[tuple[str, str]] = []
    for name in LEADING:
        if name not in figures or len(found) == 3:
            continue
        f = figures[name]
        told = f.shown if f.sigma else f"{float(f'{f.value:.3g}'):g}"
        value = f"{told} {f.meaning.unit}".strip()
        if name == "registration.accepted":
            value = f"{f.value:.0f} of {figures['registration.objects'].value:.0f}"
        found.append((value, f.meaning.text))
    return found


def _next(report: Report) -> str:
    """Return what to do next; '' = nothing is left."""
    needed = [s.command for s in report.missing if s.key in NEEDED and s.command]
    if needed:
        return f"Next: {needed[0]}."
    if any(
        f.section in ("registration", "review") for f in report.findings if f.severity != "note"
    ):
        return "Next: realsim review SESSION."
    if any(f.severity == "bad" for f in report.findings):
        return "Next: realsim check SESSION."
    return ""


def _notes(page: Page, notes: Sequence[str]) -> None:
    """Add what the run itself has to say: the first ones in sight, the rest one click away."""
    for note in notes[:NOTES_SHOWN]:
        page.text(note, "note")
    if len(notes) > NOTES_SHOWN:
        rest = [[note] for note in notes[NOTES_SHOWN:]]
        page.table(["note"], rest, folded=f"{len(rest)} more notes of the run")


def _state(section: Section) -> Cell:
    """Return the worst that is to be said of a stage, in one word."""
    severities = {f.severity for f in section.findings}
    if section.state == "done" and "bad" in severities:
        return Cell(text="bad", kind="bad")
    if section.state == "done" and "warn" in severities:
        return Cell(text="look", kind="warn")
    return Cell(text=section.state, kind=STATE_KIND[section.state])


def _why(report: Report) -> str:
    """Return in words why the verdict is what it is."""
    severities = [f.severity for f in report.findings]
    bad, warn = severities.count("bad"), severities.count("warn")
    told = [f"{bad} {'thing speaks' if bad == 1 else 'things speak'} against it"] * bool(bad)
    told += [f"{warn} {'thing' if warn == 1 else 'things'} to look at"] * bool(warn)
    if report.missing:
        told.append(f"not done: {', '.join(s.title for s in report.missing)}")
    text = "; ".join(told)
    return f"{text[0].upper()}{text[1:]}." if text else ""


def truth_section(
    section: Section, rows: Sequence[Sequence[str]], found: Mapping[str, float]
) -> None:
    """Fill the section on errors against a known truth.

    Args:
        section: to fill.
        rows: figure, measured, goal.
        found: figure's name without `truth.` -> value.
    """
    section.page.text("The simulated lab knows the truth; none of the stages was told it.")
    section.page.table(["figure", "measured", "goal"], rows)
    section.add(*[Figure(name=f"truth.{n}", value=float(v)) for n, v in found.items()])
    section.headline = (
        f"hand-eye {found['handeye_mm']:.2f} mm / {found['handeye_deg']:.3f} deg, objects "
        f"{found['object_mssd_mm']:.2f} mm, masks {found['mask_iou']:.3f}"
    )
