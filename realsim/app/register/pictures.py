"""Pictures of a registration: outlines on the photographs, depth residuals, gain, a map."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.app.first_surfaces import FirstSurfaces
from realsim.app.register.results import Registered
from realsim.arrays import Array, Image, Int32, evenly
from realsim.geometry import se3
from realsim.records import Mesh, ObjectModel, ObjectPose
from realsim.records.calibration import DepthBias
from realsim.rendering.overlay import INK, PAPER, VERDICT_RGB, contact_sheet, draw_outlines
from realsim.rendering.overlay_words import write_names
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.scanning.shading import diverging
from realsim.store import SessionStore

Color = tuple[int, int, int]
Window = tuple[slice, slice]
OUTLINE: Color = (70, 78, 88)
"""Colour of the outlines of objects under depth residuals: neither red nor blue."""
OVERLAY, GAIN, RESIDUALS, MAP = "overlay.jpg", "cameras.jpg", "residuals.jpg", "map.png"


VIEWS = 6
"""Photographs of a contact sheet."""
COLUMNS = 2
"""Columns of a contact sheet: on three, names are too small to read."""
WIDTH_PX = 960
"""Width of one photograph in a contact sheet [px]."""
MARGIN = 0.3
"""Surroundings shown on each side of the objects [share of their size in the picture]."""
LEAST_SHARE = 0.4
"""At least so much of a photograph's width is shown: one small object alone says little."""
RANGE_MM = 1.5
"""The strongest colour of depth residuals [mm]: an object that is off by more is not used."""
SMOOTH_PX = 21
"""Residuals are averaged over so many pixels of the same object: noise is not the question."""
WILD_MM = 6.0
"""Residuals beyond this count as this much: one flying pixel is not a patch [mm]."""
TABLE_M = 0.25
"""Half the side of the piece of table that residuals are drawn on, beyond the objects [m]."""
QUALITY = 88
"""Quality of JPEG files [percent]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Look:
    """One view as it should be by the result."""

    index: int
    ids: Int32
    """(H, W) instance; -1 = table or nothing."""
    depth_m: Array
    """(H, W) of objects and table [m]; NaN = nothing."""
    window: Window
    """The part around the objects."""


def draw_pictures(
    store: SessionStore, result: Registered, models: Mapping[int, ObjectModel]
) -> dict[str, bytes]:
    """Return file name -> bytes of every picture that can be drawn of a registration.

    Args:
        store: the session, for photographs and depth.
        result: what was found.
        models: obj_id -> model.
    """
    from realsim.app.register.gain import gain_picture, placed_objects
    from realsim.app.register.map import map_png

    if not result.scene.objects or not result.cameras.refined:
        return {}
    scene = FirstSurfaces([*placed_objects(result, models), *_table(result)])
    looks: list[_Look] = []
    for index in evenly(sorted(result.cameras.refined), VIEWS):
        ids, depth = scene.look(store.session.intrinsics, result.cameras.refined[index])
        looks.append(_Look(index=index, ids=ids, depth_m=depth, window=window_of(ids)))
    pictures = {
        OVERLAY: jpeg(_overlay_sheet(store, result, models, looks), QUALITY),
        RESIDUALS: jpeg(_residual_sheet(store, result, looks), QUALITY),
        MAP: map_png(result, models),
    }
    gain = gain_picture(store, result, models)
    if gain is not None:
        pictures[GAIN] = jpeg(gain, QUALITY)
    return pictures


def window_of(ids: Int32) -> Window:
    """Return the part of a picture around all objects, of the picture's own proportions.

    The whole picture where no object is in it.
    """
    height, width = ids.shape
    rows, columns = np.nonzero(ids >= 0)
    if len(rows) == 0:
        return slice(0, height), slice(0, width)
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1
    size = np.array([width, height])
    share = float(np.max((high - low) * (1 + 2 * MARGIN) / size))
    wide = np.round(np.clip(share, LEAST_SHARE, 1.0) * size).astype(int)
    x, y = np.clip(np.round((low + high - wide) / 2).astype(int), 0, size - wide)
    return slice(int(y), int(y + wide[1])), slice(int(x), int(x + wide[0]))


def jpeg(rgb: Image, quality: int) -> bytes:
    """Return a picture as JPEG."""
    from PIL import Image as Pil

    buffer = io.BytesIO()
    Pil.fromarray(rgb).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def _table(result: Registered) -> list[PlacedMesh]:
    """Return a piece of the table around the objects."""
    plane = result.scene.plane
    if plane is None:
        return []
    places = np.stack([o.T_world_obj[:3, 3] for o in result.scene.objects])
    local = se3.transform(se3.invert(plane.T_world_table), places)[:, :2]
    (x0, y0), (x1, y1) = local.min(0) - TABLE_M, local.max(0) + TABLE_M
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    return [PlacedMesh(BACKGROUND, Mesh(vertices=corners, faces=faces), plane.T_world_table)]


def _resized(rgb: Image) -> Image:
    """Return a picture at the width of the sheet."""
    import cv2

    height = round(rgb.shape[0] * WIDTH_PX / rgb.shape[1])
    kind = cv2.INTER_AREA if rgb.shape[1] > WIDTH_PX else cv2.INTER_CUBIC
    sized = cv2.resize(rgb, (WIDTH_PX, height), interpolation=kind)
    return np.ascontiguousarray(np.asarray(sized, dtype=np.uint8))


def _resized_ids(ids: Int32) -> Int32:
    """Return instances (H, W) at the width of the sheet."""
    import cv2

    height = round(ids.shape[0] * WIDTH_PX / ids.shape[1])
    sized = cv2.resize(ids, (WIDTH_PX, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(sized, dtype=np.int32)


# --- outlines ---------------------------------------------------------------------------------


def _overlay_sheet(
    store: SessionStore,
    result: Registered,
    models: Mapping[int, ObjectModel],
    looks: Sequence[_Look],
) -> Image:
    """Return photographs with every object's outline and name in the colour of its verdict."""
    colors = {o.instance: VERDICT_RGB[o.verdict] for o in result.scene.objects}
    names = {o.instance: _name_of(o, models) for o in result.scene.objects}
    pictures: list[Image] = []
    for look in looks:
        ids = _resized_ids(look.ids[look.window])
        photo = _resized(store.rgb(look.index)[look.window])
        picture = draw_outlines(photo, ids, colors, 2)
        pictures.append(write_names(picture, ids, names, colors))
    captions = [_view_caption(result, look.index) for look in looks]
    return contact_sheet(pictures, COLUMNS, captions)


def _name_of(o: ObjectPose, models: Mapping[int, ObjectModel]) -> str:
    """Return number and name of an object, with its verdict where it is not accepted."""
    name = f"{o.instance} {models[o.obj_id].name}"
    return name if o.verdict == "accepted" else f"{name} ({o.verdict})"


def _view_caption(result: Registered, index: int) -> str:
    """Return the number of a view and how well it is known where its objects are."""
    sigmas = [p.sigma_px for p in result.seen.get(index, {}).values() if np.isfinite(p.sigma_px)]
    return f"view {index}" + (f": 1 sigma {np.median(sigmas):.2f} px" if sigmas else "")


# --- depth ------------------------------------------------------------------------------------


def _residual_sheet(store: SessionStore, result: Registered, looks: Sequence[_Look]) -> Image:
    """Return by how much the measured depth is nearer than the scene's, in colours."""
    bias = bias_of(result)
    pictures: list[Image] = []
    captions: list[str] = []
    for look in looks:
        measured = bias.corrected(store.depth_m(look.index).astype(np.float64))
        nearer = np.where(measured > 0, 1e3 * (look.depth_m - measured), np.nan)
        smooth = _averaged(nearer, look.ids)[look.window]
        photo = store.rgb(look.index)[look.window]
        grey = 0.4 * photo.mean(-1, keepdims=True).repeat(3, -1) + 0.6 * 255
        colored = np.where(np.isfinite(smooth)[..., None], diverging(smooth, RANGE_MM), grey)
        picture = _resized(np.clip(np.round(colored), 0, 255).astype(np.uint8))
        ids = _resized_ids(look.ids[look.window])
        outlines = dict.fromkeys(np.unique(ids[ids >= 0]).tolist(), OUTLINE)
        pictures.append(draw_outlines(picture, ids, outlines, 1))
        captions.append(_residual_caption(look.index, nearer[look.ids >= 0]))
    sheet = contact_sheet(pictures, COLUMNS, captions)
    return np.concatenate([sheet, _color_bar(sheet.shape[1], RANGE_MM)], axis=0)


def _averaged(values: Array, ids: Int32) -> Array:
    """Return values (H, W) averaged over the pixels around that see the same thing; NaN stays."""
    import cv2

    out = np.full(values.shape, np.nan)
    side = (SMOOTH_PX, SMOOTH_PX)
    held = np.clip(values, -WILD_MM, WILD_MM)
    for instance in np.unique(ids):
        mine = (ids == instance) & np.isfinite(values)
        total = cv2.boxFilter(np.where(mine, held, 0.0), -1, side, normalize=False)
        count = cv2.boxFilter(mine.astype(np.float64), -1, side, normalize=False)
        out[mine] = np.asarray(total)[mine] / np.asarray(count)[mine]
    return out


def _residual_caption(index: int, nearer_mm: Array) -> str:
    """Return the number of a view and its median residual on the objects."""
    known = nearer_mm[np.isfinite(nearer_mm)]
    if len(known) == 0:
        return f"view {index}: no object measured"
    return f"view {index}: median on the objects {np.median(known):+.2f} mm"


def bias_of(result: Registered) -> DepthBias:
    """Return the depth's whole bias: the calibration's, and what the refinement found beyond it."""
    first: dict[str, Any] = result.report.get("asked", {}).get("depth_bias_taken_out", {})
    then: dict[str, Any] = result.report.get("refinement", {})
    s1, o1 = float(first.get("scale", 1.0)), float(first.get("offset_per_m", 0.0))
    s2, o2 = float(then.get("depth_scale", 1.0)), float(then.get("depth_offset_per_m", 0.0))
    # 1 / z2 = s2 (s1 / z + o1) + o2
    return DepthBias(scale=s1 * s2, offset_per_m=s2 * o1 + o2)


def _color_bar(width_px: int, range_mm: float) -> Image:
    """Return a strip with the colours of the residuals and their numbers."""
    import cv2

    size = float(np.clip(width_px / 1900, 0.4, 0.9))
    height = round(64 * size)
    strip = np.full((height, width_px, 3), PAPER, np.uint8)
    low, high = round(0.34 * width_px), round(0.66 * width_px)
    ramp = diverging(np.linspace(-range_mm, range_mm, high - low), range_mm)
    strip[round(10 * size) : round(34 * size), low:high] = np.round(ramp).astype(np.uint8)
    left = f"-{range_mm:g} mm: measured behind the model"
    right = f"+{range_mm:g} mm: measured in front"
    (w, _), _ = cv2.getTextSize(left, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    y = round(30 * size)
    for text, x in ((left, low - w - 12), (right, high + 12)):
        cv2.putText(strip, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1, cv2.LINE_AA)
    return strip
