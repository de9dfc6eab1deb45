"""The page of one scale: verdict, figures and pictures in one file that prints well."""

from collections.abc import Mapping
from pathlib import Path

from realsim.app.scan.scale import show
from realsim.arrays import Array
from realsim.pages import VERDICT_KIND, Page
from realsim.scanning.scale.files import ScaleRecord

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
        VERDICT_KIND[fit.verdict], fit.verdict.upper(), f"– {show.MEANING[fit.verdict]}",
        [[reason] for reason in fit.reasons],
    )  # fmt: skip
    page.section("The scale")
    page.table(["figure", "value"], show.scale_rows(fit, box_mm))
    for note in fit.notes:
        page.text(note, "note")
    if fit.limits:
        page.section(show.limits_title(fit), "Each alone, as a 1-sigma of the scale.")
        page.table(["limit", "alone", "why"], show.limit_rows(fit))
    if record.measured:
        page.section("Measured by hand", "Against the fit without them.")
        page.table(show.MEASURED_HEADER, show.measured_rows(record.measured))
        for c in record.measured:
            if c.agrees:
                page.text(c.text)
    for file, (title, caption) in CAPTIONS.items():
        if file in pictures:
            page.section(title)
            page.picture((folder / file).read_bytes(), caption)
    page.section("Views")
    page.table(show.VIEW_HEADER, show.view_rows(fit, worst=None))
    if fit.checks:
        page.section("Checks without ground truth")
        page.table(["check", "value"], [[k, f"{v:.4g}"] for k, v in fit.checks.items()])
    page.section("What it was made from")
    rows = [["mesh", record.inputs.get("mesh", {}).get("where", "")],
            ["session", session], ["hash of all inputs", record.inputs.get("key", "")],
            *[[k, v] for k, v in record.versions.items()]]  # fmt: skip
    page.table(["input", "value"], rows)
    return page.encode()
