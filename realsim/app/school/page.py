"""The page of one school: counts, reasons, margins and pictures in one file that prints well."""

from collections.abc import Mapping, Sequence

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
from realsim.pages import Page
from realsim.records import GraspSet

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

    page = Page(
        title=f"Robot School of {name}",
        about=f"{sum(len(s) for s in sets)} grasps on {len(sets)} objects",
    )
    page.section("Objects", " ".join([*setting_lines(sets), MEANING]))
    page.table(SCHOOL_HEADER, school_rows(sets, models))
    for words in (agreement_line(sets), *not_tried(sets, models), *doubts(sets, models)):
        if words:
            page.text(words, "note")
    for file, (title, caption) in CAPTIONS.items():
        if pictures.get(file):
            page.section(title)
            page.picture(pictures[file], caption)
    for what, header, rows in level_tables(sets, models):
        page.section(f"Share [%] of the tested grasps that pass, by {what}")
        page.table(header, rows)
    page.section("Why grasps stopped")
    page.table(REASON_HEADER, reason_rows(sets))
    page.section("What the filters took", "Candidates before the arm and physics had their say.")
    page.table(FILTER_HEADER, filter_rows(sets, models))
    page.section("Summary", "Row by row as in the paper's table of statistics.")
    page.table(SUMMARY_HEADER, summarise(sets).to_rows())
    return page.encode()
