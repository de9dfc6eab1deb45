"""What the validation suite found: checks, each with its figure, its limit and a verdict."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from realsim.errors import InputError
from realsim.pages.plots import png


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckResult:
    """One figure against its limit."""

    group: str
    """Which part of the suite, one of `CHECKS`."""
    name: str
    """Short and unique in the report."""
    what: str
    """What the figure is, in a sentence."""
    measured: float
    """NaN = it could not be measured, which is a failure."""
    unit: str
    """Unit of figure and limit; '' = a share or a truth value."""
    limit: float
    at_least: bool = False
    """Whether the figure must be at least the limit; otherwise at most."""
    detail: str = ""
    """What lies behind the figure."""

    @property
    def passed(self) -> bool:
        """Whether the figure keeps its limit; NaN does not."""
        if self.at_least:
            return self.measured >= self.limit
        return self.measured <= self.limit

    def to_json(self) -> dict[str, Any]:
        """Return the check as plain JSON; a figure that is no number becomes null."""
        fields = asdict(self)
        if not np.isfinite(self.measured):
            fields["measured"] = None
        return fields | {"passed": self.passed}


@dataclass(frozen=True, kw_only=True, slots=True)
class LimitRatio:
    """The load at which an engine lets go, in units of the computed limit."""

    group: str
    """'coulomb' or 'torque'."""
    load: str
    """What pulls, e.g. 'x' or '30 mm off along z'."""
    case: str
    """Force and friction, e.g. '20 N, mu 0.25'."""
    held: float
    """Largest share of the limit below which every one tried was held; 0 = not even the least."""
    slipped: float
    """Smallest share from which on every one tried slipped; inf = not even the largest."""

    @property
    def error(self) -> float:
        """The farthest that the engine's limit can be from the computed one, as a share of it."""
        return max(abs(self.held - 1.0), abs(self.slipped - 1.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class ValidationReport:
    """All that was checked of one engine at its settings."""

    engine: str
    version: str
    settings: dict[str, Any]
    """The engine's and the physics' settings as plain JSON."""
    checks: tuple[CheckResult, ...]
    ratios: tuple[LimitRatio, ...]
    """What the limits' checks measured, one a load and case."""
    cpu_s: float
    """Processor time of the suite [s]."""

    @property
    def passed(self) -> bool:
        """Whether every check passed; a suite without checks has not."""
        return bool(self.checks) and all(c.passed for c in self.checks)

    def check(self, name: str) -> CheckResult:
        """Return a check by its name.

        Raises:
            InputError: the report has none of that name.
        """
        for found in self.checks:
            if found.name == name:
                return found
        names = ", ".join(c.name for c in self.checks)
        raise InputError(f"the validation report has no check '{name}'; it has: {names}.")

    def to_rows(self) -> list[tuple[str, str, str, str, str]]:
        """Return the table for a console: verdict, name, figure, limit, detail."""
        rows: list[tuple[str, str, str, str, str]] = []
        for c in self.checks:
            sign = ">=" if c.at_least else "<="
            unit = f" {c.unit}" if c.unit else ""
            rows.append(
                (
                    "pass" if c.passed else "FAIL",
                    c.name,
                    f"{c.measured:.4g}{unit}",
                    f"{sign} {c.limit:.4g}{unit}",
                    c.detail,
                )
            )
        return rows

    def to_json(self) -> dict[str, Any]:
        """Return the whole report as plain JSON."""
        return {
            "engine": self.engine,
            "version": self.version,
            "settings": self.settings,
            "passed": self.passed,
            "cpu_s": round(self.cpu_s, 3),
            "checks": [c.to_json() for c in self.checks],
            "ratios": [
                asdict(r) | {"slipped": r.slipped if np.isfinite(r.slipped) else None}
                for r in self.ratios
            ],
        }


# --- The validation report as one picture --------------------------------------------------------


INK, MUTED, GOOD, BAD, BAND = "#22303c", "#8a99a8", "#2a9d8f", "#c8553d", "#e4eeec"
FARTHEST = 1.25
"""Ratios beyond this, or below its mirror image 0.75, are drawn at the edge."""


def picture(report: ValidationReport) -> bytes:
    """Return a PNG: limits of pulls and of turning loads against theory, and labels' agreement."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.8), dpi=110, layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for axes, group, title in (
        (left, "coulomb", "Pull at which the cube slips"),
        (middle, "torque", "Load at which the cube turns"),
    ):
        limits = [c.limit for c in report.checks if c.group == group]
        ratios = [r for r in report.ratios if r.group == group]
        _draw_ratios(axes, ratios, limits[0] if limits else 0.0)
        axes.set_title(title, fontsize=10, loc="left", color=INK)
    _draw_agreement(right, [c for c in report.checks if c.group in ("convergence", "replay")])
    verdict = "all checks passed" if report.passed else "checks FAILED"
    failed = [c.name for c in report.checks if not c.passed]
    shown = ": " + ", ".join(failed[:4]) + (" ..." if len(failed) > 4 else "") if failed else ""
    figure.suptitle(
        f"{report.engine} {report.version}: {verdict}{shown}", x=0.01, ha="left", fontsize=11,
        fontweight="bold", color=GOOD if report.passed else BAD,
    )  # fmt: skip
    return png(figure)


def _draw_ratios(axes: Any, ratios: list[LimitRatio], limit_pct: float) -> None:
    """Draw, for each load and case, between which shares of the limit the cube begins to move."""
    _plain(axes)
    if not ratios:
        axes.text(0.5, 0.5, "not run", ha="center", color=MUTED, transform=axes.transAxes)
        return
    loads = list(dict.fromkeys(r.load for r in ratios))
    cases = list(dict.fromkeys(r.case for r in ratios))
    axes.axvspan(1 - limit_pct / 100, 1 + limit_pct / 100, color=BAND)
    axes.axvline(1.0, color=MUTED, lw=0.8)
    for r in ratios:
        y = loads.index(r.load) + 0.7 * ((cases.index(r.case) + 0.5) / len(cases) - 0.5)
        low, high = np.clip([r.held, r.slipped], 2 - FARTHEST, FARTHEST)
        color = GOOD if 100 * r.error <= limit_pct + 1e-6 else BAD
        axes.plot([low, high], [y, y], color=color, lw=2.4, solid_capstyle="butt")
        axes.plot([0.5 * (low + high)], [y], marker="|", ms=7, color=color)
    axes.set_yticks(range(len(loads)), loads, fontsize=8)
    axes.set_ylim(len(loads) - 0.5, -0.5)
    axes.set_xlim(2 - FARTHEST, FARTHEST)
    axes.set_xlabel(
        f"held to slipped, share of the computed limit; band ±{limit_pct:g} %\n"
        f"lines from top: {'; '.join(cases)}",
        fontsize=8, color=INK,
    )  # fmt: skip


def _draw_agreement(axes: Any, checks: list[CheckResult]) -> None:
    """Draw the share of equal labels of each comparison."""
    _plain(axes)
    axes.set_title("Labels of grasps on the edge", fontsize=10, loc="left", color=INK)
    if not checks:
        axes.text(0.5, 0.5, "not run", ha="center", color=MUTED, transform=axes.transAxes)
        return
    least = min(0.9, *(c.measured for c in checks)) - 0.02
    for y, check in enumerate(checks):
        color = GOOD if check.passed else BAD
        axes.barh(y, check.measured - least, left=least, height=0.5, color=color)
        axes.plot([check.limit] * 2, [y - 0.35, y + 0.35], color=INK, lw=1.2)
        axes.text(least, y - 0.32, f" {check.measured:.3f}", fontsize=8, color=INK)
    axes.set_yticks(range(len(checks)), [c.name for c in checks], fontsize=8)
    axes.set_ylim(len(checks) - 0.5, -0.6)
    axes.set_xlim(least, 1.0)
    axes.set_xlabel("share of equal labels; the line is what is asked", fontsize=8, color=INK)


def _plain(axes: Any) -> None:
    """Take away the frame that nobody reads."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=8)
