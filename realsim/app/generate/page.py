"""Pictures of generated scenes for people: a contact sheet, and a page that switches layers."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from realsim.app.generate.tables import FiguresTable
from realsim.app.render.compare import fitted, layers
from realsim.arrays import Rgb
from realsim.images import read_rgb
from realsim.pages import Page, View
from realsim.pages import spread as spread_order
from realsim.store import SessionStore
from realsim.store.atomic import write_bytes
from realsim_sim_bridge.table_scenes.sample import Layout
from realsim_sim_bridge.table_scenes.scene import scene_name

SHEET_FILE = "contact_sheet.png"
PAGE_FILE = "index.html"
SHEET_PICTURES = 24
"""Pictures on the contact sheet at most."""
SHEET_WIDTH_PX = 480
"""Width of each picture."""
LEAST_COLUMNS, MOST_COLUMNS = 3, 6
"""Columns of the contact sheet: few pictures are not strung out in one row."""
PAGE_SCENES = 12
"""Scenes whose views can be switched through on the page."""
PAGE_VIEWS = 24
"""Views with layers on the page at most: as many as fit into a page that opens at once."""


def sheet_views(views: int, each: int) -> list[int]:
    """Return `each` views spread over a scene's views, which go round from low to high."""
    # Cameras rise with their number: the middles of equal parts are low, medium and high ones.
    count = min(each, views)
    return [int((k + 0.5) * views / count) for k in range(count)]


def write_sheet(out: Path, layouts: Sequence[Layout], views: int) -> Path | None:
    """Write a contact sheet with pictures of all scenes, or of as many as fit."""
    from realsim.rendering.overlay import contact_sheet, save_png

    if not layouts:
        return None
    each = max(1, min(views, SHEET_PICTURES // len(layouts), 6))
    pictures: list[Rgb] = []
    captions: list[str] = []
    for layout in _spread(layouts, SHEET_PICTURES):
        for view in sheet_views(views, each):
            path = out / scene_name(layout.number) / f"rgb/{view:06d}.png"
            if path.is_file():
                pictures.append(fitted(read_rgb(path), SHEET_WIDTH_PX))
                captions.append(f"{scene_name(layout.number)} {view:06d} {layout.table}")
    if not pictures:
        return None
    # A row a scene where that makes rows worth looking at, else about as many rows as columns.
    square = min(MOST_COLUMNS, int(np.ceil(np.sqrt(len(pictures)))))
    columns = each if LEAST_COLUMNS <= each < len(pictures) else square
    save_png(out / SHEET_FILE, contact_sheet(pictures, columns, captions))
    return out / SHEET_FILE


def write_page(
    out: Path,
    layouts: Sequence[Layout],
    views: int,
    tables: Sequence[FiguresTable],
    about: str,
    notes: Sequence[str] = (),
) -> Path | None:
    """Write the page of a data set: layers of some views, one picture of each scene, the figures.

    Args:
        out: the data set.
        layouts: of its finished scenes.
        views: of each scene.
        tables: its figures.
        about: the data set in one line.
        notes: what a reader must know first.

    Returns:
        The page; None = there is no finished scene.
    """
    if not layouts:
        return None
    chosen = _spread(layouts, PAGE_SCENES)
    each = max(1, min(views, PAGE_VIEWS // len(chosen), 4))
    shown: list[View] = []
    for layout in chosen:
        store = SessionStore.open(out / scene_name(layout.number))
        name = f"{scene_name(layout.number)}, {layout.table}, view"
        shown += layers(store, sheet_views(views, each), name)
    thumbnails = [
        View(f"{scene_name(layout.number)}, {layout.table}, {len(layout.objects)} objects",
             {"": partial(_picture, out, layout, sheet_views(views, 1)[0])})
        for layout in layouts
    ]  # fmt: skip
    page = Page(title=f"Generated scenes: {out.name}", about=about)
    for note in notes:
        page.text(note, "note")
    page.section(
        "Views", "Picture, labels, the simulated sensor's depth, exact depth and label maps."
    )
    page.layers(shown)
    page.section("Scenes")
    page.sheet(thumbnails)
    for table in tables:
        page.section(table.title, table.text)
        page.table(table.header, table.rows)
    write_bytes(out / PAGE_FILE, page.encode())
    return out / PAGE_FILE


def _picture(out: Path, layout: Layout, view: int) -> Rgb:
    """Return a photograph of a scene, small."""
    return fitted(read_rgb(out / scene_name(layout.number) / f"rgb/{view:06d}.png"))


def _spread(layouts: Sequence[Layout], most: int) -> list[Layout]:
    """Return at most so many scenes, spread over all of them, in their order."""
    chosen = sorted(list(spread_order(len(layouts)))[:most])
    return [layouts[k] for k in chosen]
