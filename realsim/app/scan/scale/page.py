"""The page of one scale: verdict, figures and pictures in one file that prints well."""

import html
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template

from realsim import __version__
from realsim.app.report.session import Page
from realsim.app.scan.scale.show import (
    MEANING,
    MEASURED_HEADER,
    VIEW_HEADER,
    Array,
    limit_rows,
    limits_title,
    measured_rows,
    scale_rows,
    view_rows,
)
from realsim.scanning.scale.files import ScaleRecord
from realsim.scanning.scale.pictures import VERDICT_COLORS

STYLE = """<style>
.verdict { color: white; padding: .6em 1em; border-radius: 4px; font-size: 1.15em; }
.verdict b { letter-spacing: .04em; }
.verdict ul { margin: .3em 0 0; padding-left: 1.2em; font-size: .9em; }
@media print {
  body { max-width: none; margin: 0; font-size: 11px; }
  figure, table { break-inside: avoid; }
  h2 { break-after: avoid; margin-top: 1.2em; }
  .verdict { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
</style>"""
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
    page = Page(parts=[STYLE, _banner(record)])
    page.section("The scale")
    page.table(["figure", "value"], scale_rows(fit, box_mm))
    for note in fit.notes:
        page.parts.append(f'<p class="note">{html.escape(note)}</p>')
    if fit.limits:
        page.section(limits_title(fit), "Each alone, as a 1-sigma of the scale.")
        page.table(["limit", "alone", "why"], limit_rows(fit))
    if record.measured:
        page.section("Measured by hand", "Against the fit without them.")
        page.table(MEASURED_HEADER, measured_rows(record.measured))
        page.parts += [f"<p>{html.escape(c.text)}</p>" for c in record.measured if c.agrees]
    for file, (title, caption) in CAPTIONS.items():
        if file in pictures:
            page.section(title)
            page.picture(folder / file, caption)
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
    template = Template((files("realsim.app") / "report_page.html").read_text())
    text = template.substitute(
        title=html.escape(f"Scale of {name}"),
        about=html.escape(f"session {session}, {len(fit.views)} views" if session else ""),
        body="\n".join(page.parts),
        version=__version__,
    )
    return text.encode("utf-8")


def _banner(record: ScaleRecord) -> str:
    """Return the verdict with its reasons, in its colour."""
    fit = record.fit
    reasons = "".join(f"<li>{html.escape(r)}</li>" for r in fit.reasons)
    return (
        f'<div class="verdict" style="background:{VERDICT_COLORS[fit.verdict]}">'
        f"<b>{fit.verdict.upper()}</b> – {html.escape(MEANING[fit.verdict])}"
        f"{f'<ul>{reasons}</ul>' if reasons else ''}</div>"
    )
