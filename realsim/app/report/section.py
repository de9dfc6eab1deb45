"""A section of the report: what a stage found, as figures, findings and markup.

A stage that is missing or damaged gives a section that says so; a report never ends in an error
because a file of the session is broken.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from realsim.app.report.figures import Figure
from realsim.errors import RealsimError
from realsim.pages import Page

Severity = Literal["bad", "warn", "note"]
State = Literal["done", "missing", "damaged"]
Pictures = Literal["kept", "shown", "none"]
"""kept: on the page, and as files in reports/; shown: on the page alone; none: figures alone."""
SEVERITIES: tuple[Severity, ...] = ("bad", "warn", "note")
"""Worst first."""
READING = (
    RealsimError, ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, OSError,
    TypeError, ValueError,
)  # fmt: skip
"""What reading damaged files raises: JSON of another shape, arrays cut short, no such file."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ReportFinding:
    """Something that the reader must know."""

    severity: Severity
    """bad: do not use it as it is; warn: look at it first; note: good to know."""
    section: str
    text: str


@dataclass(eq=False, kw_only=True, slots=True)
class Section:
    """One stage of the session."""

    key: str
    title: str
    page: Page
    command: str = ""
    """What makes it."""
    pictures: Pictures = "kept"
    state: State = "done"
    headline: str = ""
    """Its most important figures, in one line."""
    findings: list[ReportFinding] = field(default_factory=list[ReportFinding])
    figures: dict[str, Figure] = field(default_factory=dict[str, Figure])
    series: dict[str, Any] = field(default_factory=dict[str, Any])
    """Name -> plain JSON values that plots of several sessions are drawn from."""
    objects: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    """The placed objects as plain JSON values."""

    def add(self, *figures: Figure) -> None:
        """Add figures."""
        self.figures |= {f.name: f for f in figures}

    def say(self, severity: Severity, text: str) -> None:
        """Add a finding."""
        self.findings.append(ReportFinding(severity=severity, section=self.key, text=text))

    def missing(self, text: str) -> None:
        """Say that the stage has not been run."""
        self.state, self.headline = "missing", text
        run = f" Run `{self.command}`." if self.command else ""
        self.page.text(f"{text}{run}", "missing")

    def damaged(self, error: Exception) -> None:
        """Say that the stage's files cannot be read."""
        told = words_of(error)
        self.state, self.headline = "damaged", "cannot be read"
        again = (
            f" Run `realsim check SESSION`, then `{self.command}` again." if self.command else ""
        )
        self.say("bad", f"{self.title}: a file cannot be read ({told}).{again}")
        self.page.text(f"A file of this stage cannot be read: {told}{again}", "note")


def words_of(error: Exception) -> str:
    """Return in words what is wrong with a file."""
    if isinstance(error, RealsimError):
        return str(error)
    if isinstance(error, KeyError):
        return f"its {error} is missing"
    return f"its content is of another kind: {error}"


def built(section: Section, build: Callable[[Section], None]) -> Section:
    """Return the section built; where its files are damaged it says so."""
    section.page.section(section.title, key=section.key)
    try:
        build(section)
    except READING as error:
        section.damaged(error)
    _say_what_is_marked(section)
    section.page.parts[0]["folded"] = section.headline or section.state
    return section


def _say_what_is_marked(section: Section) -> None:
    """Say that values of a table are marked, where no finding says so: both must agree."""
    if any(f.severity in ("bad", "warn") for f in section.findings):
        return
    rows = [r for p in section.page.parts if p["part"] == "table" for r in p["rows"]]
    named = [str(r[0]) for r in rows if any(c.kind == "warn" for c in r)]
    if named:
        listed = ", ".join(named[:3]) + ", ..." * (len(named) > 3)
        section.say("warn", f"{section.title}: marked in its table: {listed}.")


def drawn(section: Section, what: str, draw: Callable[[], None]) -> None:
    """Add pictures, if there are to be any; what hinders them is said."""
    if section.pictures != "none":
        attempted(section, what, draw)


def attempted(section: Section, what: str, build: Callable[[], None]) -> None:
    """Add a part that a section can do without; what hinders it is said."""
    try:
        build()
    except READING as error:
        told = words_of(error)
        section.say("warn", f"{section.title}: {what} cannot be shown ({told}).")
        section.page.text(f"Not shown: {what} ({told}).", "note")
