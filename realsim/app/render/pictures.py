"""Pictures of synthetic views beside the real ones: a contact sheet, and a page with sliders."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.app.render.compare import label_ids
from realsim.pages import View
from realsim.rendering import overlay
from realsim.store import SessionStore

Rgb = NDArray[np.uint8]
SHEET_VIEWS = 6
"""Rows of the sheet."""
CELL_WIDTH_PX = 480
LABEL_SHARE = 0.45
"""How strongly an object is painted in the colour of its instance."""
SHEET_FILE = "reports/synthetic.png"
PAGE_FILE = "reports/synthetic.html"
PAGE_WIDTH_PX = 960
"""Of the pictures in the page."""
FULL = 65535.0
"""Greatest count of a label map."""


def shown_views(count: int) -> list[int]:
    """Return the synthetic views that are shown, spread over all."""
    pick = np.unique(np.linspace(0, count - 1, SHEET_VIEWS).round().astype(int))
    return [int(k) for k in pick]


def sheet(twin: SessionStore, store: SessionStore | None, real: Sequence[int] | None) -> Rgb:
    """Return rows of real | synthetic | labels | depth; new views have no real picture.

    Args:
        twin: the synthetic session.
        store: the real session, where there are twins.
        real: real view of each synthetic one; None = new views.
    """
    cells: list[Rgb] = []
    captions: list[str] = []
    views = shown_views(len(twin.session.views))
    depths = [twin.depth_m(k) for k in views]
    measured = np.concatenate([d[d > 0] for d in depths])
    near, far = (float(v) for v in np.percentile(measured, [1, 99])) if len(measured) else (0, 1)
    for k, depth_m in zip(views, depths, strict=True):
        if store is not None and real is not None:
            cells.append(fitted(store.rgb(real[k])))
            captions.append(f"real view {real[k]}")
        picture = twin.rgb(k)
        cells += [
            fitted(picture),
            fitted(label_picture(picture, label_ids(twin, k))),
            fitted(overlay.depth_picture(depth_m, near, far)),
        ]
        captions += [f"synthetic view {k}", "labels", f"depth {near:.2f} to {far:.2f} m"]
    columns = 3 if real is None else 4
    return overlay.contact_sheet(cells, columns, captions)


def label_picture(rgb: Rgb, ids: NDArray[np.int32]) -> Rgb:
    """Return the picture with every object painted and outlined in the colour of its instance."""
    colors = {int(i): overlay.instance_color(int(i)) for i in np.unique(ids[ids >= 0])}
    out = rgb.astype(np.float64)
    for i, color in colors.items():
        out[ids == i] = (1 - LABEL_SHARE) * out[ids == i] + LABEL_SHARE * np.array(color)
    return overlay.draw_outlines(np.round(out).astype(np.uint8), ids, colors)


def fitted(rgb: Rgb, width_px: int = CELL_WIDTH_PX) -> Rgb:
    """Return a picture at the width of a cell; small ones stay as they are."""
    import cv2

    if rgb.shape[1] <= width_px:
        return rgb
    size = (width_px, round(rgb.shape[0] * width_px / rgb.shape[1]))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


# --- for the page -----------------------------------------------------------------------------


def pairs(store: SessionStore, twin: SessionStore, real: Sequence[int]) -> list[View]:
    """Return real and synthetic pictures of the views that are shown, for sliders."""
    return [
        View(
            f"view {real[k]}",
            {
                "real": fitted(store.rgb(real[k]), PAGE_WIDTH_PX),
                "synthetic": fitted(twin.rgb(k), PAGE_WIDTH_PX),
            },
        )
        for k in shown_views(len(real))
    ]


def layers(
    twin: SessionStore, views: Sequence[int] | None = None, name: str = "synthetic view"
) -> list[View]:
    """Return views as layers: picture, labels, both depths, and the label maps that there are.

    Args:
        twin: the synthetic session.
        views: numbers of views; None = some, spread over all.
        name: what a view is called in its caption.
    """
    chosen = shown_views(len(twin.session.views)) if views is None else views
    return [
        View(f"{name} {k}", {n: fitted(p, PAGE_WIDTH_PX) for n, p in _layers_of(twin, k).items()})
        for k in chosen
    ]


def _layers_of(twin: SessionStore, k: int) -> dict[str, Rgb]:
    """Return the pictures of view k by the name of the layer."""
    from realsim.formats import label_maps
    from realsim.rendering import map_pictures

    unit_m = twin.session.depth_unit_m
    rgb, measured, ids = twin.rgb(k), twin.depth_m(k), label_ids(twin, k)
    exact = twin.read_image(f"labels/depth/{k:06d}.png").astype(np.float32) * unit_m
    known = measured[measured > 0]
    near, far = (float(v) for v in np.percentile(known, [1, 99])) if len(known) else (0.0, 1.0)
    pictures = {
        "picture": rgb,
        "labels": label_picture(rgb, ids),
        "depth of the camera": overlay.depth_picture(measured, near, far),
        "exact depth": overlay.depth_picture(exact, near, far),
    }
    normals, coordinates = (f"labels/{m}/{k:06d}.png" for m in ("normals", "coordinates"))
    if twin.has(normals):
        counts = twin.read_image(normals)
        pictures["normals"] = map_pictures.normals_picture(label_maps.normals_of(counts))
    if twin.has(coordinates):
        # The counts already are shares of each object's box.
        whole = {int(i): ((0.0, 0.0, 0.0), (FULL, FULL, FULL)) for i in np.unique(ids[ids >= 0])}
        pictures["object coordinates"] = map_pictures.coordinates_picture(
            twin.read_image(coordinates), ids, whole
        )
    return pictures
