"""The page of an upgrade: where every object was said to be, where it is, worst first."""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.first_surfaces import FirstSurfaces
from realsim.app.upgrade import tables
from realsim.app.upgrade.analytic import LEVEL_HEADER, correlation_line, level_rows
from realsim.app.upgrade.scene import Record
from realsim.arrays import Image, Int32
from realsim.pages import Page, View, counted
from realsim.records import ObjectModel
from realsim.rendering.overlay import VERDICT_RGB, draw_outlines
from realsim.rendering.rays import PlacedMesh
from realsim.store import SessionStore
from realsim.store.atomic import write_bytes

PAIRS = 60
"""Objects with pictures, the worst; a page of more is not looked at."""
FRAMES = 12
"""Whole frames at the top of the page."""
POSES = ("T_cam_obj_before", "T_cam_obj", "T_cam_obj_proposed")
ROWS = 400
"""Objects in the page's table; upgrade.csv has all."""
CROP_WIDTH_PX = 560
"""Width of a picture: an object's outline is seen in single pixels."""
MARGIN = 0.35
"""Surroundings on each side of the object [share of its size in the picture]."""
LEAST_SIDE_PX = 96
"""Least side of what is cut out: a small object alone does not show where it stands."""
THICKNESS_PX = (1, 2, 1)
"""Thickness of the outlines of the given pose, of the written one over it, of a proposed one."""
BEFORE_RGB = (245, 60, 200)
"""Colour of the pose that was given: a colour that no verdict has."""
PROPOSED_RGB = (255, 255, 255)
DASH_PX = 7
"""Length of the dashes of a pose that was not written, and of the gaps."""


def write_page(
    out: Path, records: Sequence[Record], failed: Mapping[str, str], analytic: Record | None
) -> None:
    """Write OUT/upgrade.html."""
    summary = tables.summary_of(records)
    ranked = tables.worst_first(tables.objects_of(records))
    pictured = [(r, o) for r, o in ranked if o["shown"] is not None]
    notes = [(place, f"was left out: {why}") for place, why in failed.items()]
    notes += [(str(r["place"]), str(note)) for r in records for note in r["notes"]]
    page = Page(title="Upgraded data set", about=tables.summary_line(summary))
    for line in notes_line(notes, len(failed)):
        page.text(line, "note")
    frames = list(_frames(out, pictured))
    if frames:
        page.section(
            "Frames",
            "Magenta, on both sides of the handle: the poses as the data set has them. Right of "
            "the handle also those that are written: green accepted, yellow doubtful, red "
            "rejected, grey unchecked.",
        )
        page.sliders(frames)
    pairs = [_pair(out, r, o) for r, o in pictured[:PAIRS]]
    if pairs:
        more = "" if len(pairs) == len(pictured) else f" The worst {PAIRS} of {len(pictured)}."
        page.section(
            "Objects one by one",
            "Magenta and thin, on both sides of the handle: the annotation. Right of the handle "
            "also the pose that is written: green accepted, yellow doubtful, red rejected, grey "
            "unchecked. Dashed white: a new pose that was not written, because it was refused or "
            f"not surely better. Whole outlines, as if nothing stood in front. Worst first.{more}",
        )
        page.sliders(pairs)
    shown = ranked[:ROWS]
    worst = f"The worst {ROWS} of {len(ranked)}; upgrade.csv has all."
    page.section(
        "Objects",
        f"{'Worst first.' if len(ranked) <= ROWS else worst} An annotation is improved only where "
        "the new pose is better on depth and on the photograph; where it is not, it is kept, and "
        "rejected says that the new pose was refused. The verdict is on the pose that is written. "
        "Moved: its centre, from the annotation. Depth agrees: share of the visible surface; "
        "edges: median distance of the outline from the photograph's edges; both also for a new "
        "pose that was not written.",
    )
    page.table(
        tables.HEADER, [tables.row_of(r, o) for r, o in shown],
        colors=[VERDICT_RGB.get(o["verdict"], (150, 150, 150)) for _, o in shown],
    )  # fmt: skip
    if analytic is not None:
        page.section(
            "Analytic grasps, tried", f"By the label's friction; {correlation_line(analytic)}."
        )
        page.table(LEVEL_HEADER, level_rows(analytic))
    if notes:
        first = f"The first {ROWS} of {len(notes)}; upgrade.json has all."
        page.section("Notes", "" if len(notes) <= ROWS else first)
        page.table(["scene", "note"], notes[:ROWS])
    write_bytes(out / tables.PAGE, page.encode())


def notes_line(notes: Sequence[tuple[str, str]], left_out: int) -> list[str]:
    """Return the banner that says that there are notes (scene, note); none without any."""
    if not notes:
        return []
    scenes = len({place for place, _ in notes})
    lost = f"{counted(left_out, 'scene')} left out; " if left_out else ""
    return [f"{lost}{counted(len(notes), 'note')} on {counted(scenes, 'scene')}: see below."]


def _frames(out: Path, pictured: Sequence[tuple[Record, Mapping[str, Any]]]) -> Iterator[View]:
    """Return whole frames with the outlines of their objects, those of the worst objects first."""
    frames: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for record, o in pictured:
        frames.setdefault((str(record["place"]), int(o["shown"]["image"])), []).append(o)
    for (place, image), objects in list(frames.items())[:FRAMES]:
        before, after = (partial(_frame, out / place, image, objects, k) for k in (1, 2))
        names = ", ".join(str(o["name"]) for o in objects)
        yield View(f"{place} image {image}: {names}", {"as given": before, "as written": after})


def _frame(folder: Path, image: int, objects: Sequence[Mapping[str, Any]], poses: int) -> Image:
    """Return a photograph with the outlines of objects as given, and as refined if poses is 2."""
    store, models = _scene(folder)
    picture: Image = store.rgb(image)
    for key, thickness in zip(POSES[:poses], THICKNESS_PX, strict=False):
        for o in objects:
            ids = _surface(store, models, o, o["shown"][key])
            refined = VERDICT_RGB.get(o["verdict"], (255, 255, 255))
            color = BEFORE_RGB if key == POSES[0] else refined
            picture = draw_outlines(picture, ids, colors={0: color}, thickness=thickness)
    return picture


def _pair(out: Path, record: Record, o: Mapping[str, Any]) -> View:
    """Return the two pictures of an object, drawn when the page asks for them."""
    before, after = (partial(_drawn, out / record["place"], o, k) for k in (False, True))
    moved = f"moved by {o['moved_mm']:.1f} mm and {o['moved_deg']:.1f} deg"
    right, became = {  # what stands right of the handle, and what is said of the annotation
        "improved": ("improved", f"improved, {moved}"), "kept": ("kept", "kept"),
        "rejected": ("new pose refused", tables.TOLD["rejected"]),
    }[o["outcome"]]  # fmt: skip
    label = (
        f"{record['place']} image {o['shown']['image']}, {o['name']}: annotation {became}; the "
        f"written pose is {o['verdict']}; {o['why']}"
    )
    more = "".join(f"; {r}" for r in o["reasons"] if o["why"] not in r)
    return View(label + more, {"as given": before, right: after})


def _drawn(folder: Path, o: Mapping[str, Any], changed: bool) -> Image:
    """Return an object's pose as given, or the refined one too, in the same window."""
    store, models = _scene(folder)
    poses = [o["shown"][key] for key in POSES if o["shown"].get(key) is not None]
    masks = [_surface(store, models, o, pose) for pose in poses]
    written = VERDICT_RGB.get(o["verdict"], (255, 255, 255))
    colors = [BEFORE_RGB, written, PROPOSED_RGB] if changed else [BEFORE_RGB]
    return _cropped(store.rgb(int(o["shown"]["image"])), masks, colors)


def _surface(
    store: SessionStore, models: Mapping[int, ObjectModel], o: Mapping[str, Any], pose: Any
) -> Int32:
    """Return where an object alone is seen (0, elsewhere -1) as it is said to stand."""
    placed = PlacedMesh(0, models[int(o["obj_id"])].mesh, np.array(pose))
    return FirstSurfaces([placed]).look(store.session.intrinsics, np.eye(4))[0]


@lru_cache(maxsize=1)
def _scene(folder: Path) -> tuple[SessionStore, dict[int, ObjectModel]]:
    """Return a scene's session and models; the pictures of one scene are drawn together."""
    from realsim.formats.bop.models import load_models

    return SessionStore.open(folder), load_models(folder / "models", notes=[])


def _cropped(rgb: Image, masks: Sequence[Int32], colors: Sequence[tuple[int, int, int]]) -> Image:
    """Return the part of a photograph around all outlines, enlarged.

    Args:
        rgb: (H, W, 3).
        masks: (H, W) each, negative beside the object.
        colors: of the first outlines; those without one are not drawn. A third one is dashed.
    """
    import cv2

    height, width = rgb.shape[:2]
    rows, columns = np.nonzero(np.any([m >= 0 for m in masks], axis=0))
    if len(rows) == 0:  # both outside the picture
        rows, columns = np.array([0, height - 1]), np.array([0, width - 1])
    centre = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    size = max(np.ptp(columns), np.ptp(rows)) * (1 + 2 * MARGIN)
    side = int(min(max(size, LEAST_SIDE_PX), width, height))
    x, y = np.clip(np.round(centre - side / 2).astype(int), 0, [width - side, height - side])
    window = slice(int(y), int(y) + side), slice(int(x), int(x) + side)
    big = (CROP_WIDTH_PX, CROP_WIDTH_PX)
    picture = np.asarray(cv2.resize(rgb[window], big, interpolation=cv2.INTER_CUBIC), np.uint8)
    i, j = np.indices(picture.shape[:2]) // DASH_PX
    for k, (mask, color) in enumerate(zip(masks, colors, strict=False)):
        # Linear between pixels, or an enlarged outline would be stairs.
        covered = cv2.resize((mask[window] >= 0).astype(np.float32), big)
        ids = np.where(np.asarray(covered) >= 0.5, 0, -1).astype(np.int32)
        drawn = draw_outlines(picture, ids, colors={0: color}, thickness=THICKNESS_PX[k])
        dash = ((i + j) % 2 == 0) | (k < 2)
        picture = np.where(dash[..., None], drawn, picture)
    return picture
