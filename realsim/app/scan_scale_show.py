"""A scale in words: the verdict first, then the figures, what limits them, and the worst views."""

from collections.abc import Sequence

import numpy as np

from realsim.app.console import Console
from realsim.scanning.scale.measured import LengthScale
from realsim.scanning.scale.measured_check import MeasuredCheck
from realsim.scanning.scale.picture_overlays import worst_views
from realsim.scanning.scale.result import ScaleFit

WORST_VIEWS = 5
"""Views that are listed one by one; the others are summed up."""
MEANING = {
    "accepted": "the scale can be used.",
    "doubtful": "look at the pictures before this scale is used.",
    "rejected": "do not use this scale.",
    "unchecked": "nothing but the measurement says so; nobody has checked it.",
}
Rows = list[list[str]]


def verdict_line(name: str, fit: ScaleFit) -> str:
    """Return the verdict and what it means."""
    return f"{fit.verdict.upper()}: {name}: {MEANING[fit.verdict]}"


def scale_rows(fit: ScaleFit) -> Rows:
    """Return the figures of a fit."""
    low, high = fit.interval
    x, y, z = fit.extent_mm
    return [
        ["verdict", fit.verdict],
        ["scale", f"{fit.scale:.6g} m per unit of the mesh"],
        ["1 sigma", f"{fit.sigma_percent:.3f} %"],
        ["95 % interval", f"{low:.6g} to {high:.6g} m per unit"],
        ["size along x, y, z", f"{x:.2f}, {y:.2f}, {z:.2f} mm"],
        ["CPU time of the fit", "-" if np.isnan(fit.cpu_s) else f"{fit.cpu_s:.1f} s"],
    ]


def limit_rows(fit: ScaleFit) -> Rows:
    """Return what limits the scale, worst first."""
    ordered = sorted(fit.limits, key=lambda k: -k.percent)
    return [[k.name, f"{k.percent:.3f} %", k.text] for k in ordered]


VIEW_HEADER = ["view", "used", "agree", "IoU", "RMS [mm]", "moved [mm]", "turned [deg]"]


def view_rows(fit: ScaleFit, worst: int | None = WORST_VIEWS) -> Rows:
    """Return the median of all views and the worst of them; None = every view."""
    if not fit.views:
        return []
    names = ("agree", "iou", "rms_mm", "shift_mm", "turn_deg")
    kept = [v for v in fit.views if v.used] or list(fit.views)
    median = [float(np.nanmedian([getattr(v, n) for v in kept])) for n in names]
    rows = [["median", f"{len(kept)} of {len(fit.views)}", *_figures(median)]]
    chosen = fit.views if worst is None else worst_views(fit)[:worst]
    rows += [
        [str(v.index), "yes" if v.used else "LEFT OUT", *_figures([getattr(v, n) for n in names])]
        for v in chosen
    ]
    return rows


def _figures(values: Sequence[float]) -> list[str]:
    digits = (3, 3, 2, 2, 3)
    return [f"{v:.{d}f}" if np.isfinite(v) else "-" for v, d in zip(values, digits, strict=True)]


MEASURED_HEADER = ["measured", "fitted [mm]", "difference", "sigmas", "agrees"]


def measured_rows(checks: Sequence[MeasuredCheck]) -> Rows:
    """Return every measured length against the fit."""
    return [
        [
            c.measurement.text,
            f"{c.fitted_mm:.2f}",
            f"{c.difference_percent:+.2f} %",
            f"{abs(c.z):.1f}",
            "yes" if c.agrees else "NO",
        ]
        for c in checks
    ]


def show_fit(name: str, fit: ScaleFit, checks: Sequence[MeasuredCheck], console: Console) -> None:
    """Print everything about a fit, its verdict first."""
    console.say(verdict_line(name, fit))
    for reason in fit.reasons:
        console.say(f"  - {reason}")
    console.table(f"Scale of {name}", ["figure", "value"], scale_rows(fit))
    if fit.limits:
        console.table("What limits it, worst first", ["limit", "alone", "why"], limit_rows(fit))
    if checks:
        console.table("Measured by hand", MEASURED_HEADER, measured_rows(checks))
        for check in checks:
            if check.agrees:  # the others are among the reasons
                console.say(f"  {check.text}")
    if fit.views:
        console.table("Views, worst first", VIEW_HEADER, view_rows(fit))
    for note in fit.notes:
        console.say(f"note: {note}")


def show_measured(
    name: str, scale: float, sigma: float, each: Sequence[LengthScale], size_mm: Sequence[float],
    console: Console,
) -> None:  # fmt: skip
    """Print a scale that rests on measured lengths alone."""
    console.say(f"UNCHECKED: {name}: {MEANING['unchecked']}")
    console.say("  - No session was given, so that no depth image speaks for this scale.")
    console.say("  - A mesh whose shape is off by 2 % makes it wrong by as much; sigma says only "
                "how well the length was measured.")  # fmt: skip
    low, high = scale - 1.96 * sigma, scale + 1.96 * sigma
    rows = [
        ["verdict", "unchecked"],
        ["scale", f"{scale:.6g} m per unit of the mesh"],
        ["1 sigma", f"{100 * sigma / scale:.3f} %, of the measurement alone"],
        ["95 % interval", f"{low:.6g} to {high:.6g} m per unit"],
        ["size along x, y, z", ", ".join(f"{v:.2f}" for v in size_mm) + " mm"],
    ]
    rows += [[e.measurement.text, f"{e.scale:.6g} m per unit"] for e in each]
    console.table(f"Scale of {name}", ["figure", "value"], rows)
