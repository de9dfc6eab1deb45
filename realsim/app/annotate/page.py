"""The page of an annotated session: photographs under their labels, maps, and who saw what."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import shortened
from realsim.app.report.registering import registration_pairs
from realsim.arrays import Image
from realsim.pages import Page, Picture, View
from realsim.rendering.overlay import VERDICT_RGB
from realsim.store import SessionStore
from realsim.store.atomic import write_bytes

# --- The table of annotated objects, as the terminal and the page show it ------------------------


if TYPE_CHECKING:
    from realsim_sim_bridge.annotation.annotate import AnnotationSummary
    from realsim_sim_bridge.annotation.summary import ObjectSummary

HEADER = [
    "object", "verdict", "frames seen", "visible [%]", "agrees with depth [%]",
    "hidden by unknown [%]", "in frames",
]  # fmt: skip


def object_row(o: "ObjectSummary") -> list[str]:
    """Return one object's row of the table."""
    return [
        f"{o.instance} {o.name}",
        o.verdict,
        str(o.frames_seen),
        _percent(o.mean_visibility),
        _percent(o.agreement, 1),
        _percent(o.hidden_by_unknown, 1),
        str(o.frames_hidden),
    ]


def _percent(share: float, digits: int = 0) -> str:
    """Return a share in percent, or a dash where nothing was measured."""
    return "-" if np.isnan(share) else f"{100 * share:.{digits}f}"


PAGE_FILE = "reports/annotated.html"
MAP_VIEWS = 6
"""Views whose maps are shown: four pictures each."""
MOST_NOTES = 40
"""Number of notes on the page; all are in the annotations."""
LEGEND = (
    "Outlines and names: green accepted, amber doubtful, red rejected, grey unchecked. Axes: x "
    "red, y green, z blue. Grippers: p_hold (else score) 0 red, 0.5 yellow, 1 green, dashed where "
    "p_hold is of few draws. Magenta hatching: something that is not in the scene stands in front, "
    "and the object's mask ends there."
)
MAP_TITLES = {
    "instance": "instances", "depth": "exact depth", "coordinates": "object coordinates",
    "normals": "normals",
}  # fmt: skip


def write_page(
    store: SessionStore,
    summary: "AnnotationSummary",
    views: Sequence[int],
    overlays: Sequence[Image],
) -> Path:
    """Write reports/annotated.html.

    Args:
        store: the annotated session.
        summary: of its annotation.
        views: those that are shown, flagged ones first.
        overlays: their pictures with everything that was annotated.

    Returns:
        Where it is.
    """
    flagged = set(summary.flagged_views)
    page = Page(title=f"Annotation of {store.session.name}", about=summary.told())
    for note in shortened(summary.notes, MOST_NOTES, "And {} more, in annotations/."):
        page.text(note, "note")
    page.section("Photographs and labels", _which(summary, views) + LEGEND)
    page.sliders(
        [
            View(
                _caption(view, flagged) + _unseen(store, view),
                {"photo": partial(store.rgb, view), "labels": picture},
            )
            for view, picture in zip(views, overlays, strict=True)
        ]
    )
    _add_sections(page, store, summary, views)
    path = store.path(PAGE_FILE)
    path.parent.mkdir(exist_ok=True)
    write_bytes(path, page.encode())
    return path


def _caption(view: int, flagged: set[int]) -> str:
    """Return the name of a view."""
    return f"view {view}" + (": look here" if view in flagged else "")


def _which(summary: "AnnotationSummary", views: Sequence[int]) -> str:
    """Return which views are shown, where it is not all of them."""
    if len(views) == summary.views:
        return ""
    first = "those that need a look first, the others" if summary.flagged_views else "these"
    return f"Of {summary.views} views {len(views)} are here, {first} spread over the session. "


def _unseen(store: SessionStore, view: int) -> str:
    """Return which objects a view does not show, for its caption."""
    from realsim_sim_bridge.annotation.files import part_path

    part: Any = store.read_json(part_path(view))
    names = [str(e["name"]) for e in part["objects"] if not e["px_count_visib"]]
    return f" (not visible: {', '.join(names)})" if names else ""


def _add_sections(
    page: Page, store: SessionStore, summary: "AnnotationSummary", views: Sequence[int]
) -> None:
    """Add what stands below the sliders: the objects, the maps, and what registration did."""
    if summary.by_object:
        page.section("Objects")
        page.table(
            HEADER, [object_row(o) for o in summary.by_object],
            colors=[VERDICT_RGB[o.verdict] for o in summary.by_object],
        )  # fmt: skip
    layered = [_map_view(store, view, set(summary.flagged_views)) for view in views[:MAP_VIEWS]]
    layered = [view for view in layered if len(view.pictures) > 1]
    if layered:
        page.section("Maps")
        page.layers(layered)
    if summary.objects:
        registered, before = registration_pairs(store)
        if registered:
            page.section("Before and after registration", before)
            page.sliders(registered)


def _map_view(store: SessionStore, view: int, flagged: set[int]) -> View:
    """Return the maps of a view that have been written, under its photograph."""
    from realsim_sim_bridge.annotation.frame_labels import map_path

    layers: dict[str, Picture] = {"photo": partial(store.rgb, view)}
    for name, title in MAP_TITLES.items():
        if store.has(map_path(name, view)):
            layers[title] = partial(_map_picture, store, name, view)
    return View(_caption(view, flagged), layers)


def _map_picture(store: SessionStore, name: str, view: int) -> Image:
    """Return a map of a view as a picture for people."""
    from realsim.formats import label_maps
    from realsim.rendering.map_pictures import NOTHING, instance_picture, normals_picture
    from realsim.rendering.overlay import depth_picture
    from realsim_sim_bridge.annotation.frame_labels import map_path

    counts: Any = store.read_image(map_path(name, view))
    if name == "instance":
        return instance_picture(label_maps.instances_of(counts), store.rgb(view))
    if name == "depth":
        return depth_picture(counts * np.float32(store.session.depth_unit_m))
    if name == "normals":
        return normals_picture(label_maps.normals_of(counts))
    # Counts run over each object's own box already: their upper bytes are its colours.
    picture = (counts >> 8).astype(np.uint8)
    picture[~counts.any(axis=-1)] = NOTHING
    return picture
