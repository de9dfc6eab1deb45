"""Annotating a session, telling what was found, and drawing what a person should look at."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from realsim.app.annotate.current import annotate_session
from realsim.app.annotate.page import HEADER, object_row, write_page
from realsim.app.console import Console, shortened
from realsim.app.stages import judged_scene, open_session, registered_views, session_models
from realsim.arrays import Image, evenly
from realsim.many import Workers
from realsim.store import SessionStore
from realsim.store.atomic import only_run_in

if TYPE_CHECKING:
    from realsim_sim_bridge.annotation.annotate import AnnotationSummary

MOST_NOTES = 12
"""Number of notes that are shown; the rest are in the annotations."""
PAGE_PICTURES = 12
"""Frames on the page."""
PICTURES = 8
"""Frames of the page that are on the contact sheet, too."""
SHEET_GRASPS = 9
"""Grasps drawn in a frame of the sheet: few, so that the outlines can be judged."""
SHEET_FILE = "reports/annotated.png"
SHEET_WIDTH_PX = 960
"""Width of a frame on the sheet [px]: names and grasps are legible."""


def run_annotate(
    session: Path, console: Console, *, maps: str, workers: Workers, check_depth: bool
) -> "AnnotationSummary":
    """Annotate a session, show the summary, and draw the contact sheet and the page.

    Args:
        session: the session's folder.
        console: where it is told.
        maps: 'all', 'none', or a list of maps.
        workers: who computes frames.
        check_depth: whether the measured depth may take pixels out of the masks.

    Raises:
        InputError: no session there, it is not registered, there is no such map, or another run
            is working there.
    """
    store = open_session(session)
    with only_run_in(store.folder):
        summary = annotate_session(
            store, console, maps=maps, workers=workers, check_depth=check_depth
        )
        show_summary(summary, console)
        sheet, page = draw(store, summary, console)
    console.say(f"pictures  {sheet}")
    console.say(f"page      {page}")
    return summary


def show_summary(summary: "AnnotationSummary", console: Console) -> None:
    """Print what was annotated: one line, a row per object, and what was noticed."""
    console.say(str(summary))
    if summary.by_object:
        console.table("objects", HEADER, [object_row(o) for o in summary.by_object])
    for note in shortened(summary.notes, MOST_NOTES, "and {} more, in annotations/."):
        console.say(f"note: {note}")


def draw(store: SessionStore, summary: "AnnotationSummary", console: Console) -> tuple[Path, Path]:
    """Write the contact sheet and the page: flagged frames first, others spread over the session.

    Returns:
        Where they are.
    """
    from realsim.store import load_grasps
    from realsim_sim_bridge.annotation.pictures import overlay_pictures

    views, scene = registered_views(store), judged_scene(store)
    there = {(o.instance, o.obj_id) for o in scene.objects}
    sets = load_grasps(store)
    chosen = sheet_views(views, summary.flagged_views, PAGE_PICTURES)
    pictures: list[Image] = []
    drawn = overlay_pictures(
        store, chosen, scene, session_models(store, console),
        [g for g in sets if (g.instance, g.obj_id) in there], SHEET_GRASPS,
    )  # fmt: skip
    with console.stage("pictures", f"{len(chosen)} frames") as tick:
        for picture in drawn:
            pictures.append(picture)
            tick(len(pictures), len(chosen))
    on_sheet = sheet_views(chosen, summary.flagged_views)
    _write_sheet(store, summary, on_sheet, [pictures[chosen.index(v)] for v in on_sheet])
    return store.path(SHEET_FILE), write_page(store, summary, chosen, pictures)


def _write_sheet(
    store: SessionStore,
    summary: "AnnotationSummary",
    views: Sequence[int],
    pictures: Sequence[Image],
) -> None:
    """Write the contact sheet of these pictures."""
    from realsim.images import resized
    from realsim.rendering.overlay import contact_sheet

    small = [resized(picture, SHEET_WIDTH_PX) for picture in pictures]
    captions = [f"view {v}" + (": look here" if v in summary.flagged_views else "") for v in views]
    store.write_image(SHEET_FILE, contact_sheet(small, columns=2, captions=captions))


def sheet_views(views: Sequence[int], flagged: Sequence[int], most: int = PICTURES) -> list[int]:
    """Return the views on the sheet: at most half of them flagged, the rest evenly spread."""
    first = [v for v in views if v in set(flagged)]
    others = [v for v in views if v not in set(flagged)]
    shown = first[: most if not others else max(most // 2, most - len(others))]
    return shown + evenly(others, most - len(shown))
