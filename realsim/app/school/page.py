"""The page of one school: counts, reasons, margins and pictures in one file that prints well."""

import base64
import html
from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template

from realsim import __version__
from realsim.app.report.session import Page
from realsim.app.school.pictures import MARGINS, SHEET
from realsim.app.school.tables import (
    FILTER_HEADER,
    REASON_HEADER,
    SCHOOL_HEADER,
    SUMMARY_HEADER,
    Names,
    agreement_line,
    doubts,
    filter_rows,
    level_tables,
    not_tried,
    reason_rows,
    school_rows,
    setting_lines,
)
from realsim.records import GraspSet

STYLE = """<style>
@media print {
  body { max-width: none; margin: 0; font-size: 11px; }
  figure, table { break-inside: avoid; }
  h2 { break-after: avoid; margin-top: 1.2em; }
}
</style>"""
MEANING = (
    "A label says what a simulated hand does at one force, one friction and one mass, not what a "
    "real hand will do. Of grasps that all pass, the margin tells which would with less of either."
)
CAPTIONS: dict[str, tuple[str, str]] = {
    SHEET: (
        "The grasps",
        "Above, how many candidates are left after each stage; below, every object as it stands "
        "with its grasps.",
    ),
    MARGINS: (
        "What is left with less friction and less force",
        "The farther left a curve keeps its height, the safer are the object's grasps.",
    ),
}
"""Title and caption of every picture, in the order of the page."""


def page_bytes(
    name: str,
    sets: Sequence[GraspSet],
    models: Names,
    pictures: Mapping[str, bytes],
) -> bytes:
    """Return the page.

    Args:
        name: of the scene.
        sets: the grasps.
        models: the objects by id.
        pictures: file name -> PNG; empty and missing ones are left out.
    """
    from realsim_sim_bridge.school.summary import summarise

    page = Page(parts=[STYLE])
    page.section("Objects", " ".join([*setting_lines(sets), MEANING]))
    page.table(SCHOOL_HEADER, school_rows(sets, models))
    for words in (agreement_line(sets), *not_tried(sets, models), *doubts(sets, models)):
        if words:
            page.parts.append(f'<p class="note">{html.escape(words)}</p>')
    for file, (title, caption) in CAPTIONS.items():
        if pictures.get(file):
            page.section(title)
            page.parts.append(_figure(pictures[file], caption))
    for what, header, rows in level_tables(sets, models):
        page.section(f"Share [%] of the tested grasps that pass, by {what}")
        page.table(header, rows)
    page.section("Why grasps stopped")
    page.table(REASON_HEADER, reason_rows(sets))
    page.section("What the filters took", "Candidates before the arm and physics had their say.")
    page.table(FILTER_HEADER, filter_rows(sets, models))
    page.section("Summary", "Row by row as in the paper's table of statistics.")
    page.table(SUMMARY_HEADER, summarise(sets).to_rows())
    template = Template((files("realsim.app") / "report_page.html").read_text())
    text = template.substitute(
        title=html.escape(f"Robot School of {name}"),
        about=html.escape(f"{sum(len(s) for s in sets)} grasps on {len(sets)} objects"),
        body="\n".join(page.parts),
        version=__version__,
    )
    return text.encode("utf-8")


def _figure(data: bytes, caption: str) -> str:
    """Return a picture inside the page itself."""
    text = html.escape(caption)
    code = base64.b64encode(data).decode()
    return (
        f'<figure><img src="data:image/png;base64,{code}" alt="{text}">'
        f"<figcaption>{text}</figcaption></figure>"
    )
