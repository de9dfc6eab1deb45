"""What an upgrade found, scene by scene and object by object: on the console, as JSON and CSV.

The page of an upgrade: where every object was said to be, where it is, worst first.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim import __version__
from realsim.app.console import Console
from realsim.app.first_surfaces import FirstSurfaces
from realsim.app.upgrade.analytic import LEVEL_HEADER, correlation_line, level_rows
from realsim.app.upgrade.scene import Record
from realsim.arrays import Image, Int32
from realsim.pages import Page, View, counted
from realsim.records import ObjectModel
from realsim.rendering.overlay import VERDICT_RGB, draw_outlines
from realsim.rendering.rays import PlacedMesh
from realsim.store import SessionStore, atomic
from realsim.store.atomic import write_bytes

if TYPE_CHECKING:
    from realsim.app.upgrade.run import UpgradeResult


JSON_FILE, CSV_FILE = "upgrade.json", "upgrade.csv"
VERDICTS = ("rejected", "doubtful", "unchecked", "accepted")
"""Worst first."""
COLUMNS = (
    "scene", "instance", "obj_id", "name", "outcome", "verdict", "agree", "probability",
    "moved_mm", "moved_deg", "proposed_mm", "agree_annotation", "agree_new", "depth_t",
    "edge_px_annotation", "edge_px_new", "photo_t", "visible", "candidates", "tried", "good",
    "why", "reasons",
)  # fmt: skip
PAGE = "upgrade.html"
HEADER = [
    "scene, object", "annotation", "verdict", "moved [mm]", "turned [deg]",
    "depth agrees: annotation, new [%]", "edges: annotation, new [px]", "good grasps",
]  # fmt: skip
TOLD = {"rejected": "kept, new pose refused", "kept": "kept", "improved": "improved"}
"""What became of an annotation, in words."""
OUTCOMES = tuple(TOLD)
MOST_ROWS = 60
"""Objects in the console's table, worst first where there are more; upgrade.csv has all."""
MOST_NOTES = 30
"""Notes that the console tells: so many on objects, and on scenes."""


def objects_of(records: Iterable[Record]) -> list[tuple[Record, dict[str, Any]]]:
    """Return (scene, object) of all scenes."""
    return [(record, o) for record in records for o in record["objects"]]


def worst_first(
    objects: Iterable[tuple[Record, dict[str, Any]]],
) -> list[tuple[Record, dict[str, Any]]]:
    """Return objects by verdict, then by how little of them agrees with the depth."""

    def rank(entry: tuple[Record, dict[str, Any]]) -> tuple[int, float]:
        verdict, agree = entry[1]["verdict"], entry[1]["agree"]
        place = VERDICTS.index(verdict) if verdict in VERDICTS else len(VERDICTS)
        return place, -1.0 if agree is None else float(agree)

    return sorted(objects, key=rank)


def row_of(record: Record, o: Mapping[str, Any]) -> list[str]:
    """Return an object's row of the table."""
    grasps = o["grasps"]
    agree = [o["agree_annotation"], o["agree_new"]]
    edges = [o["edge_px_annotation"], o["edge_px_new"]]
    return [
        f"{record['place']} {o['name']}",
        TOLD[o["outcome"]],
        str(o["verdict"]),
        f"{o['moved_mm']:.1f}",
        f"{o['moved_deg']:.1f}",
        ", ".join("-" if a is None else f"{100 * a:.0f}" for a in agree),
        ", ".join("-" if e is None else f"{e:.1f}" for e in edges),
        f"{grasps['good']} of {grasps['tried']}" if grasps["tried"] else "none tried",
    ]


def summary_of(records: Sequence[Record]) -> dict[str, Any]:
    """Return the counts and medians over all scenes."""
    objects = [o for _, o in objects_of(records)]
    became = {k: sum(o["outcome"] == k for o in objects) for k in reversed(OUTCOMES)}
    verdicts = {v: sum(o["verdict"] == v for o in objects) for v in reversed(VERDICTS)}

    def middle(values: list[float]) -> float | None:
        return round(float(np.median(values)), 3) if values else None

    return {
        "scenes": len(records),
        "objects": len(objects),
        "frames": sum(int(r["frames"]) for r in records),
        "annotations": {k: n for k, n in became.items() if n},
        "verdicts": {v: n for v, n in verdicts.items() if n},
        "median_moved_mm": middle([o["moved_mm"] for o in objects]),
        "median_moved_deg": middle([o["moved_deg"] for o in objects]),
        "median_agree": middle([o["agree"] for o in objects if o["agree"] is not None]),
        "grasps_tried": sum(int(o["grasps"]["tried"]) for o in objects),
        "grasps_good": sum(int(o["grasps"]["good"]) for o in objects),
    }


def summary_line(summary: Mapping[str, Any]) -> str:
    """Return the summary as a sentence."""
    verdicts = ", ".join(f"{n} {v}" for v, n in summary["verdicts"].items()) or "no verdict"
    became = ", ".join(f"{n} {TOLD[k]}" for k, n in summary["annotations"].items()) or "none"
    moved = summary["median_moved_mm"]
    far = "" if moved is None else (
        f"; moved by {moved:.1f} mm and {summary['median_moved_deg']:.1f} deg in the median"
    )  # fmt: skip
    return (
        f"{summary['scenes']} scenes, {summary['frames']} frames, {summary['objects']} objects: "
        f"annotations: {became}; {verdicts}{far}; {summary['grasps_good']} of "
        f"{summary['grasps_tried']} grasps are good"
    )


def write_tables(
    out: Path, records: Sequence[Record], failed: Mapping[str, str], analytic: Record | None
) -> None:
    """Write upgrade.json and upgrade.csv."""
    document = {
        "version": __version__, "summary": summary_of(records), "scenes": list(records),
        "left_out": dict(failed), "analytic": analytic,
    }  # fmt: skip
    atomic.write_json(out / JSON_FILE, document)
    rows: list[list[object]] = []
    for record, o in objects_of(records):
        flat = {**o, **o["grasps"], "scene": record["place"], "reasons": "; ".join(o["reasons"])}
        rows.append([flat[c] for c in COLUMNS])
    atomic.write_bytes(out / CSV_FILE, atomic.csv_bytes(COLUMNS, rows))


def show_upgrade(result: "UpgradeResult", console: Console) -> None:
    """Print one table over all scenes, the notes, and where pictures and tables are."""
    objects = objects_of(result.scenes)
    shown = objects if len(objects) <= MOST_ROWS else worst_first(objects)[:MOST_ROWS]
    console.table("Upgraded scenes", HEADER, [row_of(r, o) for r, o in shown])
    if len(shown) < len(objects):
        console.say(f"the worst {len(shown)} of {len(objects)} objects; {CSV_FILE} has all")
    for notes in notes_of(result.scenes):
        console.warn(*notes[-MOST_NOTES:])
        if len(notes) > MOST_NOTES:
            console.warn(f"and {len(notes) - MOST_NOTES} more notes, in {JSON_FILE}")
    for place, reason in result.failed.items():
        console.warn(f"scene {place} was left out: {reason}")
    if result.analytic is not None:
        rows = level_rows(result.analytic)
        console.table("Analytic grasps, tried by the School", LEVEL_HEADER, rows)
        console.say(correlation_line(result.analytic))
    if len(result.scenes) > 1:
        console.say(summary_line(summary_of(result.scenes)))
    console.say(f"page      {result.out / PAGE}")
    console.say(f"tables    {result.out / JSON_FILE}, {CSV_FILE}")
    console.say(f"dataset   {result.out}; judge it with: realsim review {result.out}")


def notes_of(records: Sequence[Record]) -> tuple[list[str], list[str]]:
    """Return what a person must know of objects, then of scenes: equal notes once, common last."""
    of_objects = [
        (f"{r['place']} {o['name']}", note)
        for r, o in objects_of(records)
        for none in [o["grasps"]["why_none"]]
        for note in (f"no grasp: {none}" if none else "", "; ".join(o["reasons"]))
    ]
    of_scenes = [
        (f"scene {r['place']}", note)
        for r in records
        for note in ("no supporting plane was found" if r["plane"] is None else "", *r["notes"])
    ]
    return _told_once(of_objects), _told_once(of_scenes)


def _told_once(notes: Sequence[tuple[str, str]]) -> list[str]:
    """Return (place, note) in words, each note with its first place and the number of others."""
    first = {note: place for place, note in reversed(notes)}
    rows = reversed(Counter(note for _, note in notes).most_common())
    return [f"{first[n]}{f' and {k - 1} more' if k > 1 else ''}: {n}" for n, k in rows if n]


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
    summary = summary_of(records)
    ranked = worst_first(objects_of(records))
    pictured = [(r, o) for r, o in ranked if o["shown"] is not None]
    notes = [(place, f"was left out: {why}") for place, why in failed.items()]
    notes += [(str(r["place"]), str(note)) for r in records for note in r["notes"]]
    page = Page(title="Upgraded data set", about=summary_line(summary))
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
        HEADER, [row_of(r, o) for r, o in shown],
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
    write_bytes(out / PAGE, page.encode())


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
        "rejected": ("new pose refused", TOLD["rejected"]),
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
