"""The validation report as one picture."""

import io
from typing import Any

import numpy as np

from realsim_sim_bridge.validation.report import CheckResult, LimitRatio, ValidationReport

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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


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
