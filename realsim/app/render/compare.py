"""How much the synthetic twins are like the real frames: masks, edges, depth noise, holes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array32, Int32, Mask, Rgb, UInt8, evenly
from realsim.formats.bop.labels import mask_path
from realsim.geometry.metrics import mask_iou
from realsim.pages import View
from realsim.rendering import overlay
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.depth_sensors.statistics import hole_share, local_noise
from realsim.store import SessionStore

MOST_VIEWS = 24
"""Views that are compared, spread over the session: each costs a second."""
NEAR_EDGE_PX = 3.0
"""A rim pixel this near an image edge has found its own; further away the contour has no contrast
there, or the pose is off [px]."""
CANNY = (20.0, 60.0)
"""Thresholds of the edges in 8-bit pictures: contours of objects, not noise."""
ERODED_PX = 3
"""Depth is compared inside the objects, so far from their rims [px]: what happens at an edge is
another thing than noise."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TwinFigures:
    """Real frames against their synthetic twins; NaN = could not be measured."""

    views: int
    """Views compared."""
    mask_iou: float
    """Mean IoU of the visible masks, as annotated in the real session; 1 = the same pixels."""
    mask_iou_least: float
    edge_real_px: float
    """Median distance of the labels' rims to the nearest edge of the photograph [px]."""
    edge_synthetic_px: float
    """The same in the synthetic picture: what perfect poses leave."""
    edges_real: float
    """Share of the rims with an edge of the photograph within 3 px."""
    edges_synthetic: float
    noise_real_px: float
    """High-frequency depth noise on the objects, as disparity [px]."""
    noise_synthetic_px: float
    holes_real: float
    """Share of the objects' pixels without a measurement."""
    holes_synthetic: float
    rgb_difference: float
    """Mean difference of the objects' colours, 8-bit values."""

    @property
    def noise_ratio(self) -> float:
        """Synthetic over real noise."""
        return self.noise_synthetic_px / self.noise_real_px if self.noise_real_px else float("nan")

    @property
    def holes_ratio(self) -> float:
        """Synthetic over real share of holes."""
        return self.holes_synthetic / self.holes_real if self.holes_real else float("nan")

    def rows(self) -> list[list[str]]:
        """Return the table's rows: figure, real, synthetic, both compared."""
        masks = f"{self.mask_iou:.5f} (least {self.mask_iou_least:.5f})"
        if np.isnan(self.mask_iou):
            masks = "the real frames are not annotated"
        return [
            ["visible masks, IoU", "", "", masks],
            ["rim to nearest image edge, median", f"{self.edge_real_px:.2f} px",
             f"{self.edge_synthetic_px:.2f} px", ""],
            ["rims with an edge within 3 px", f"{100 * self.edges_real:.0f} %",
             f"{100 * self.edges_synthetic:.0f} %", ""],
            ["depth noise on objects", f"{self.noise_real_px:.3f} px",
             f"{self.noise_synthetic_px:.3f} px", f"x {self.noise_ratio:.2f}"],
            ["holes on objects", f"{100 * self.holes_real:.1f} %",
             f"{100 * self.holes_synthetic:.1f} %", f"x {self.holes_ratio:.2f}"],
            ["colour difference on objects", "", "", f"{self.rgb_difference:.1f} of 255"],
        ]  # fmt: skip


def compare_twins(
    store: SessionStore, twin: SessionStore, real: Sequence[int], camera: str
) -> TwinFigures:
    """Compare real frames with their twins.

    Args:
        store: the real session.
        twin: the synthetic one; its view k is the twin of view real[k].
        real: numbers of the real views.
        camera: the depth profile: its baseline turns depth into disparity.
    """
    intrinsics, baseline_m = store.session.intrinsics, profile(camera).baseline_m
    pairs = evenly(list(enumerate(real)), MOST_VIEWS)
    ious: list[float] = []
    edges: tuple[list[Array32], ...] = ([], [])
    noise: tuple[list[float], list[float]] = ([], [])
    holes: tuple[list[float], list[float]] = ([], [])
    colors: list[float] = []
    for made, shot in pairs:
        ids = label_ids(twin, made)
        ious += _ious(store, shot, ids)
        pictures = store.rgb(shot), twin.rgb(made)
        inside = _eroded(ids)
        for k, picture in enumerate(pictures):
            edges[k].append(rim_distances_px(ids, picture))
        if inside.any():
            difference = pictures[0].astype(np.int16) - pictures[1].astype(np.int16)
            colors.append(float(np.abs(difference[inside]).mean()))
        if not (store.has_depth(shot) and inside.any()):
            continue
        for k, depth_m in enumerate((store.depth_m(shot), twin.depth_m(made))):
            noise[k].append(local_noise(depth_m, intrinsics, baseline_m, inside).median_px)
            holes[k].append(hole_share(depth_m, inside))
    rims = [np.concatenate(found) for found in edges]
    medians = [float(np.median(r)) if len(r) else float("nan") for r in rims]
    shares = [float(np.mean(r <= NEAR_EDGE_PX)) if len(r) else float("nan") for r in rims]
    return TwinFigures(
        views=len(pairs), mask_iou=_mean(ious), mask_iou_least=min(ious, default=float("nan")),
        edge_real_px=medians[0], edge_synthetic_px=medians[1],
        edges_real=shares[0], edges_synthetic=shares[1],
        noise_real_px=_mean(noise[0]), noise_synthetic_px=_mean(noise[1]),
        holes_real=_mean(holes[0]), holes_synthetic=_mean(holes[1]),
        rgb_difference=_mean(colors),
    )  # fmt: skip


def label_ids(store: SessionStore, view: int) -> Int32:
    """Return the instance (H, W) that the session's masks say is seen, -1 = none."""
    i = store.session.intrinsics
    ids = np.full((i.height, i.width), -1, np.int32)
    for k, row in enumerate(_entries(store, view)):
        mask = store.read_image(mask_path(view, int(row.get("mask", k)), visible=True)) > 0
        ids[mask] = int(row["instance"])
    return ids


def _entries(store: SessionStore, view: int) -> Sequence[Mapping[str, int]]:
    path = f"annotations/{view:06d}.json"
    return store.read_json(path)["objects"] if store.has(path) else ()


def _ious(store: SessionStore, view: int, ids: Int32) -> Iterator[float]:
    """Return the IoU of each object's annotated visible mask with what the twin's labels say."""
    for k, row in enumerate(_entries(store, view)):
        path = mask_path(view, int(row.get("mask", k)), visible=True)
        if store.has(path):
            iou = mask_iou(store.read_image(path) > 0, ids == int(row["instance"]))
            if np.isfinite(iou):
                yield iou


def rim_distances_px(ids: Int32, rgb: UInt8) -> Array32:
    """Return how far each pixel of the labels' rims is from the nearest edge of a picture [px].

    Args:
        ids: (H, W) instance, -1 = none.
        rgb: (H, W, 3) the picture.

    Returns:
        (R,), one for each pixel of a rim; infinite where the picture has no edge at all.
    """
    import cv2

    rim = np.zeros(ids.shape, np.bool_)
    rim[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    rim[1:] |= ids[1:] != ids[:-1]
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    edge = np.asarray(cv2.Canny(grey, *CANNY)) > 0
    if not edge.any():
        return np.full(int(np.count_nonzero(rim)), np.inf, np.float32)
    away = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away, np.float32)[rim]


def _eroded(ids: Int32) -> Mask:
    """Return (H, W) the insides of the objects, away from every rim."""
    import cv2

    kernel = np.ones((2 * ERODED_PX + 1, 2 * ERODED_PX + 1), np.uint8)
    value = (ids + 1).astype(np.float32)
    even = cv2.dilate(value, kernel) == cv2.erode(value, kernel)
    return np.asarray(even) & (ids >= 0)


def _mean(values: Sequence[float]) -> float:
    finite = [v for v in values if np.isfinite(v)]
    return float(np.mean(finite)) if finite else float("nan")


# --- Pictures of synthetic views beside the real ones: a contact sheet, and a page with sliders --


SHEET_VIEWS = 6
"""Rows of the sheet."""
CELL_WIDTH_PX = 480
LABEL_SHARE = 0.45
"""How strongly an object is painted in the colour of its instance."""
SHEET_FILE = "reports/synthetic.png"
PAGE_FILE = "reports/synthetic.html"
PAGE_WIDTH_PX = 960
"""Width of the pictures in the page."""
FULL = 65535.0
"""Greatest count of a label map."""


def shown_views(count: int) -> list[int]:
    """Return the synthetic views that are shown, spread over all."""
    return evenly(range(count), SHEET_VIEWS)


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


def label_picture(rgb: Rgb, ids: Int32) -> Rgb:
    """Return the picture with every object painted and outlined in the colour of its instance."""
    colors = {int(i): overlay.instance_color(int(i)) for i in np.unique(ids[ids >= 0])}
    out = rgb.astype(np.float64)
    for i, color in colors.items():
        out[ids == i] = (1 - LABEL_SHARE) * out[ids == i] + LABEL_SHARE * np.array(color)
    return overlay.draw_outlines(np.round(out).astype(np.uint8), ids, colors)


def fitted(rgb: Rgb, width_px: int = CELL_WIDTH_PX) -> Rgb:
    """Return a picture at the width of a cell; small ones stay as they are."""
    from realsim.images import resized

    return rgb if rgb.shape[1] <= width_px else resized(rgb, width_px)


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
