"""A scale in words: the verdict first, then the figures, what limits them, and the worst views.

The page of one scale: verdict, figures and pictures in one file that prints well.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from realsim.app.console import Console
from realsim.app.scan.scale.inputs import LIBRARY, NamedMesh
from realsim.arrays import Array
from realsim.pages import VERDICT_KIND, Page
from realsim.records import Verdict
from realsim.scanning.scale.files import ScaleRecord
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
NOT_IN_SIGMA = "surface offset"
"""The limit that nothing in a session can tell: it is said, and not counted."""
CALIPER = (
    "check     nothing outside of this session has confirmed the scale: one length by caliper is "
    "the one independent check. Add --measured longest=...mm."
)
Rows = list[list[str]]


def size_rows(box_mm: Sequence[float] | Array, size_mm: Sequence[float] | Array) -> Rows:
    """Return the size: the smallest box first, which does not depend on the mesh's axes."""
    x, y, z = (f"{v:.1f}" for v in size_mm)
    return [
        ["smallest box", " x ".join(f"{v:.1f}" for v in box_mm) + " mm"],
        ["along the mesh's own x, y, z", f"{x}, {y}, {z} mm"],
    ]


def scale_rows(fit: ScaleFit, box_mm: Array) -> Rows:
    """Return the figures of a fit, with the smallest box (3,) around the scaled mesh [mm]."""
    low, high = fit.interval
    return [
        ["verdict", fit.verdict],
        ["scale", f"{fit.scale:.6g} m per unit of the mesh"],
        ["1 sigma", f"{fit.sigma_percent:.3f} %"],
        ["95 % interval", f"{low:.6g} to {high:.6g} m per unit"],
        *size_rows(box_mm, fit.extent_mm),
        ["CPU time of the fit", "-" if np.isnan(fit.cpu_s) else f"{fit.cpu_s:.1f} s"],
    ]


def limit_rows(fit: ScaleFit) -> Rows:
    """Return what limits the scale, worst first, and then what is not in the sigma."""
    ordered = sorted(fit.limits, key=lambda k: (k.name == NOT_IN_SIGMA, -k.percent))
    return [[k.name, f"{k.percent:.3f} %", k.text] for k in ordered]


def limits_title(fit: ScaleFit) -> str:
    """Return what stands above the limits."""
    is_there = any(k.name == NOT_IN_SIGMA for k in fit.limits)
    return "What limits it, worst first" + ("; the last is not in the sigma" if is_there else "")


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


def show_fit(
    name: str, fit: ScaleFit, checks: Sequence[MeasuredCheck], box_mm: Array, console: Console
) -> None:
    """Print everything about a fit, its verdict first; box_mm (3,) is the smallest box [mm]."""
    console.say(f"{fit.verdict.upper()}: {name}: {MEANING[fit.verdict]}")
    for reason in fit.reasons:
        console.say(f"  - {reason}")
    console.table(f"Scale of {name}", ["figure", "value"], scale_rows(fit, box_mm))
    if fit.limits:
        console.table(limits_title(fit), ["limit", "alone", "why"], limit_rows(fit))
    if checks:
        console.table("Measured by hand", MEASURED_HEADER, measured_rows(checks))
        for check in checks:
            if check.agrees:  # the others are among the reasons
                console.say(f"  {check.text}")
    if fit.views:
        console.table("Views, worst first", VIEW_HEADER, view_rows(fit))
    console.say(*[f"note: {note}" for note in fit.notes])


def model_lines(
    named: NamedMesh, model: Path | None, verdict: Verdict, *, is_stored: bool
) -> list[str]:
    """Return where the scaled model lies, and how it gets into a library.

    Args:
        named: the mesh.
        model: the scaled model's file [mm]; None where it was not written.
        verdict: on its scale.
        is_stored: whether the library is spoken of elsewhere: one was named, or it has the model.
    """
    lines = [] if model is None else [f"model     {model} in mm (its --unit is mm)"]
    if is_stored:
        return lines
    option = f"--library {named.library or LIBRARY}"
    if verdict != "accepted":
        option += " --accept-doubtful"
    text = f"library   none: {option}, added to this command, puts the model there"
    if named.scaled_id is not None and named.entry == named.name:
        text = (
            f"library   {named.library}: {named.name} ({named.scaled_id}) was not changed; "
            f"{option} --overwrite, added to this command, replaces it"
        )
    if verdict != "accepted":
        text += f" although its scale is {verdict}"
    if model is None:
        return [f"{text}; --out FOLDER writes it as a file. So far nothing was written."]
    # With --overwrite the scale, too, is fitted again.
    lines.append(f"{text}; nothing is computed twice." if named.scaled_id is None else f"{text}.")
    if verdict == "accepted" and named.scaled_id is None:
        lines.append(
            f"          `realsim scan import {model} --unit mm --name {named.name} --library "
            f"{named.library or LIBRARY}` does, too, without the scale's sigma."
        )
    return lines


def show_measured(
    name: str,
    found: tuple[float, float],
    each: Sequence[LengthScale],
    sizes_mm: tuple[Sequence[float], Sequence[float]],
    console: Console,
) -> None:
    """Print a scale that rests on measured lengths alone.

    Args:
        name: of the model.
        found: scale and its 1-sigma [m per unit].
        each: the scale by every length.
        sizes_mm: the smallest box, and the extents along the mesh's axes [mm].
        console: where.
    """
    scale, sigma = found
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
        *size_rows(*sizes_mm),
    ]
    rows += [[e.measurement.text, f"{e.scale:.6g} m per unit"] for e in each]
    console.table(f"Scale of {name}", ["figure", "value"], rows)


CAPTIONS: dict[str, tuple[str, str]] = {
    "residuals.png": (
        "Where the real surface lies",
        "Blue: the real surface is inside of the model; red: outside. One colour all over is a "
        "scale that is off; patches are the shape.",
    ),
    "overlays.png": (
        "The model in the photographs",
        "Outline of the scaled model, and beside it the model's depth minus the measured one.",
    ),
    "views.png": (
        "Agreement of every view",
        "A view that stands out has a bad camera pose, or something stands in its way.",
    ),
    "candidates.png": (
        "Other scales that were looked at",
        "A point of another scale as high as the result means that the shape allows both.",
    ),
}
"""Title and caption of every picture, in the order of the page."""


def page_bytes(
    record: ScaleRecord, pictures: Mapping[str, bytes], folder: Path, box_mm: Array
) -> bytes:
    """Return the page.

    Args:
        record: what was found.
        pictures: file name -> PNG; those that are missing are left out.
        folder: where the pictures lie.
        box_mm: (3,) the smallest box around the scaled mesh [mm].
    """
    fit = record.fit
    name = str(record.inputs.get("mesh", {}).get("name", "mesh"))
    session = str(record.inputs.get("session", {}).get("name", ""))
    page = Page(
        title=f"Scale of {name}",
        about=f"session {session}, {len(fit.views)} views" if session else "",
    )
    page.verdict(
        VERDICT_KIND[fit.verdict], fit.verdict.upper(), f"– {MEANING[fit.verdict]}",
        [[reason] for reason in fit.reasons],
    )  # fmt: skip
    page.section("The scale")
    page.table(["figure", "value"], scale_rows(fit, box_mm))
    for note in fit.notes:
        page.text(note, "note")
    if fit.limits:
        page.section(limits_title(fit), "Each alone, as a 1-sigma of the scale.")
        page.table(["limit", "alone", "why"], limit_rows(fit))
    if record.measured:
        page.section("Measured by hand", "Against the fit without them.")
        page.table(MEASURED_HEADER, measured_rows(record.measured))
        for c in record.measured:
            if c.agrees:
                page.text(c.text)
    for file, (title, caption) in CAPTIONS.items():
        if file in pictures:
            page.section(title)
            page.picture((folder / file).read_bytes(), caption)
    page.section("Views")
    page.table(VIEW_HEADER, view_rows(fit, worst=None))
    if fit.checks:
        page.section("Checks without ground truth")
        page.table(["check", "value"], [[k, f"{v:.4g}"] for k, v in fit.checks.items()])
    page.section("What it was made from")
    rows = [["mesh", record.inputs.get("mesh", {}).get("where", "")],
            ["session", session], ["hash of all inputs", record.inputs.get("key", "")],
            *[[k, v] for k, v in record.versions.items()]]  # fmt: skip
    page.table(["input", "value"], rows)
    return page.encode()
