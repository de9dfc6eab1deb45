"""The page of one registration: tables and pictures in one file that prints well."""

from collections.abc import Mapping

from realsim.app.register import tables
from realsim.app.register.pictures import GAIN, MAP, OVERLAY, RESIDUALS
from realsim.app.register.results import Registered
from realsim.pages import VERDICT_KIND, Cell, Page
from realsim.records import ObjectModel
from realsim.store import SessionStore

CAPTIONS: dict[str, tuple[str, str]] = {
    OVERLAY: (
        "In the photographs",
        "Outlines through the refined cameras, in the colour of the verdict: green accepted, amber "
        "doubtful, red rejected. One sigma of each view is that of its median object.",
    ),
    GAIN: (
        "What refining the cameras gained",
        "The same edge of the same object, much enlarged: through the camera as robot and "
        "calibration claim it, and as it was refined.",
    ),
    RESIDUALS: (
        "Measured depth against the scene",
        "Red: measured in front of the model; blue: behind. Speckle is the sensor's noise. An "
        "object of one colour is in the wrong place; a slope on the table is a tilted camera.",
    ),
    MAP: ("The table from above", "Frame of the table: z is up, out of the paper."),
}
"""Title and caption of every picture, in the order of the page."""


def page_bytes(
    store: SessionStore,
    result: Registered,
    models: Mapping[int, ObjectModel],
    pictures: Mapping[str, bytes],
) -> bytes:
    """Return the page.

    Args:
        store: the session.
        result: what was found.
        models: obj_id -> model.
        pictures: file name -> JPEG or PNG; those that are missing are left out.
    """
    n, taken = len(store.session.views), len(result.cameras.refined)
    method = result.report.get("asked", {}).get("method", "joint")
    page = Page(
        title=f"Registration of {result.scene.name}", about=f"{taken} of {n} views, method {method}"
    )
    page.section(
        "Objects",
        f"{tables.summary_line(result)}. {tables.table_line(result)} {tables.places_line(result)}",
    )
    if result.scene.objects:
        rows: list[list[object]] = [
            [name, Cell(verdict, kind=VERDICT_KIND[verdict]), *rest]
            for name, verdict, *rest in tables.object_rows(result, models)
        ]
        page.table(tables.OBJECT_HEADER, rows)
    if result.not_placed:
        page.section("Not placed")
        page.table(tables.MISSING_HEADER, tables.missing_rows(result, models))
    if result.remarks:
        page.section("Views and scene")
        page.table(tables.VIEW_HEADER, tables.view_rows(result))
    lines = (tables.camera_line(result), tables.depth_line(result), tables.odometry_line(result))
    page.section("Cameras", " ".join(t for t in lines if t))
    for file, (title, caption) in CAPTIONS.items():
        if file in pictures:
            page.section(title)
            page.picture(pictures[file], caption)
    page.section("Checks without ground truth")
    page.table(*tables.check_rows(result.scene.objects, models))
    return page.encode()
