"""Annotating a session, telling what was found, and drawing what a person should look at."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from realsim.app.console import Console
from realsim.app.stages import (
    annotate_session,
    judged_scene,
    open_session,
    registered_views,
    session_models,
)
from realsim.store import SessionStore

if TYPE_CHECKING:
    from realsim_sim_bridge.annotation.annotate import AnnotationSummary
    from realsim_sim_bridge.annotation.summary import ObjectSummary

HEADER = [
    "object", "verdict", "frames seen", "visible [%]", "agrees with depth [%]",
    "hidden by unknown [%]", "in frames",
]  # fmt: skip
MOST_NOTES = 12
"""So many notes are shown; the rest are in the annotations."""
PICTURES = 8
"""Frames on the contact sheet."""
SHEET_GRASPS = 9
"""Grasps drawn in a frame of the sheet: few, so that the outlines can be judged."""
SHEET_FILE = "reports/annotated.png"
SHEET_WIDTH_PX = 960
"""Width of a frame on the sheet [px]: names and grasps are legible."""


def run_annotate(
    session: Path, console: Console, *, maps: str, workers: int, check_depth: bool
) -> "AnnotationSummary":
    """Annotate a session, show the summary, and draw the contact sheet.

    Args:
        session: the session's folder.
        console: where it is told.
        maps: 'all', 'none', or a list of maps.
        workers: processes that compute frames.
        check_depth: whether the measured depth may take pixels out of the masks.

    Raises:
        InputError: no session there, it is not registered, or there is no such map.
    """
    store = open_session(session)
    summary = annotate_session(store, console, maps=maps, workers=workers, check_depth=check_depth)
    show_summary(summary, console)
    path = draw_sheet(store, summary)
    console.say(f"pictures  {path}")
    return summary


def show_summary(summary: "AnnotationSummary", console: Console) -> None:
    """Print what was annotated: one line, a row per object, and what was noticed."""
    console.say(str(summary))
    if summary.by_object:
        console.table("objects", HEADER, [_row(o) for o in summary.by_object])
    for note in summary.notes[:MOST_NOTES]:
        console.say(f"note: {note}")
    if len(summary.notes) > MOST_NOTES:
        console.say(f"note: and {len(summary.notes) - MOST_NOTES} more, in annotations/.")


def _row(o: "ObjectSummary") -> list[str]:
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


def draw_sheet(store: SessionStore, summary: "AnnotationSummary") -> Path:
    """Write reports/annotated.png: frames that are flagged first, others spread over the session.

    Returns:
        Where it is.
    """
    import cv2

    from realsim.rendering.overlay import contact_sheet
    from realsim.store import load_grasps
    from realsim_sim_bridge.annotation.pictures import overlay_pictures

    known = registered_views(store)
    views = [v.index for v in store.session.views if known is None or v.index in known]
    chosen = sheet_views(views, summary.flagged_views)
    grasps = load_grasps(store.folder / "grasps")
    pictures = overlay_pictures(
        store, chosen, judged_scene(store), session_models(store), grasps, SHEET_GRASPS
    )
    small: list[np.ndarray[tuple[int, ...], np.dtype[np.uint8]]] = []
    for picture in pictures:
        height = round(picture.shape[0] * SHEET_WIDTH_PX / picture.shape[1])
        size = (SHEET_WIDTH_PX, height)
        fitted = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        small.append(np.asarray(fitted, dtype=np.uint8))
    captions = [f"view {v}" + (": look here" if v in summary.flagged_views else "") for v in chosen]
    store.write_image(SHEET_FILE, contact_sheet(small, columns=2, captions=captions))
    return store.path(SHEET_FILE)


def sheet_views(views: Sequence[int], flagged: Sequence[int], most: int = PICTURES) -> list[int]:
    """Return the views on the sheet: at most half of them flagged, the rest evenly spread."""
    first = [v for v in views if v in set(flagged)]
    others = [v for v in views if v not in set(flagged)]
    shown = first[: most if not others else max(most // 2, most - len(others))]
    free = min(most - len(shown), len(others))
    pick = np.linspace(0, len(others) - 1, free).round().astype(int) if free else []
    return shown + [others[k] for k in sorted(set(pick))]
