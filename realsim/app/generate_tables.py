"""What generated scenes are like: dataset.json, tables for people, a contact sheet."""

from collections import Counter
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from realsim import __version__
from realsim.app.console import Console
from realsim.app.generate_request import GenerateRequest
from realsim.app.generate_run import GenerateOutcome
from realsim.app.generate_scene import is_finished, load_layout, stored_costs
from realsim.formats.images import read_rgb
from realsim.store import atomic
from realsim.store.json_files import read_object
from realsim_sim_bridge.table_scenes.layout import Layout
from realsim_sim_bridge.table_scenes.scene import scene_name

DATASET_FILE = "dataset.json"
SHEET_FILE = "contact_sheet.png"
LIBRARIES = ("numpy", "scipy", "pybullet", "open3d-cpu")
"""Whose versions decide on bytes."""
BANDS = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
"""Borders of the visibility table."""
SHEET_PICTURES = 24
"""Pictures on the contact sheet at most."""
SHEET_WIDTH_PX = 480
"""Of each picture."""


def finished_layouts(out: Path, scenes: int, request: GenerateRequest) -> list[Layout]:
    """Return the layouts of the finished scenes."""
    return [load_layout(out, k) for k in range(scenes) if is_finished(out, k, request)]


def visibilities(out: Path, layout: Layout) -> list[float]:
    """Return the visible share of every object in every view of a scene where it is in the picture.

    Of the pixels that it would have if nothing hid it and the picture had no border (BOP).
    """
    path = out / scene_name(layout.number) / "scene_gt_info.json"
    if not path.is_file():
        return []
    rows: Any = read_object(path)
    return [float(o["visib_fract"]) for row in rows.values() for o in row if o["px_count_all"] > 0]


def dataset_of(out: Path, request: GenerateRequest, layouts: list[Layout]) -> dict[str, Any]:
    """Return dataset.json: what was asked for, what came out; no times, so that bytes repeat."""
    seen = [visibilities(out, layout) for layout in layouts]
    return {
        "format": 1,
        "key": request.key,
        "request": request.told,
        "versions": {"realsim": __version__} | {name: _version(name) for name in LIBRARIES},
        "scenes": [
            {
                "name": scene_name(layout.number),
                "table": layout.table,
                "side_m": layout.side_m,
                "objects": [
                    {"instance": k, "obj_id": k + 1, "name": o.name, "pool": o.source,
                     "key": o.key, "scale": o.scale, "size_m": o.size_m}
                    for k, o in enumerate(layout.objects)
                ],
                "drawn": layout.drawn,
                "tried": layout.tried,
                "fell": list(layout.fell),
                "overhung": list(layout.overhung),
                "restless": list(layout.restless),
                "skipped": list(layout.skipped),
                "figures": layout.figures,
                "mean_visibility": float(np.mean(v)) if v else None,
            }
            for layout, v in zip(layouts, seen, strict=True)
        ],
        "statistics": statistics(layouts, [x for v in seen for x in v], request.views.count),
    }  # fmt: skip


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError

    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


def statistics(layouts: list[Layout], seen: list[float], views: int) -> dict[str, Any]:
    """Return the figures of all scenes together."""
    counts = [len(layout.objects) for layout in layouts]
    shares = [o.size_m / layout.side_m for layout in layouts for o in layout.objects]
    bands = np.histogram(seen, bins=BANDS)[0].tolist() if seen else [0] * (len(BANDS) - 1)
    return {
        "scenes": len(layouts),
        "views": len(layouts) * views,
        "instances": sum(counts),
        "distinct_objects": len({(o.source, o.key) for lay in layouts for o in lay.objects}),
        "objects_per_scene": {str(n): c for n, c in sorted(Counter(counts).items())},
        "tables": dict(sorted(Counter(layout.table for layout in layouts).items())),
        "size_share": _spread(shares),
        "fell_off": sum(len(layout.fell) for layout in layouts),
        "overhung": sum(len(layout.overhung) for layout in layouts),
        "restless": sum(len(layout.restless) for layout in layouts),
        "skipped_meshes": sum(len(layout.skipped) for layout in layouts),
        "worst_moved_mm": max((lay.figures["moved_mm"] for lay in layouts), default=0.0),
        "worst_penetration_mm": max((x.figures["penetration_mm"] for x in layouts), default=0.0),
        "visibility": {
            "labels": len(seen),
            "borders": list(BANDS),
            "counts": bands,
            "mean": float(np.mean(seen)) if seen else None,
        },
    }


def _spread(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    low, middle, high = (float(v) for v in np.quantile(values, (0.0, 0.5, 1.0)))
    return {"least": low, "median": middle, "most": high}


# --- for people -------------------------------------------------------------------------------


def show(out: Path, dataset: dict[str, Any], outcome: GenerateOutcome, console: Console) -> None:
    """Print the scenes, the statistics, and what went wrong."""
    made = {c.number for c in outcome.made}
    rows: list[list[str]] = []
    for scene in dataset["scenes"]:
        number = int(scene["name"].rpartition("_")[2])
        costs = stored_costs(out, number)
        lost = [len(scene[k]) for k in ("fell", "overhung", "restless")]
        figures = scene["figures"]
        rows.append(
            [scene["name"], scene["table"], str(len(scene["objects"])),
             "/".join(map(str, lost)), f"{figures['moved_mm']:.2f}",
             f"{figures['penetration_mm']:.2f}", _percent(scene["mean_visibility"]),
             f"{costs.get('physics_s', 0.0):.0f}", f"{costs.get('rendering_s', 0.0):.0f}",
             "made" if number in made else "kept"]
        )  # fmt: skip
    console.table(
        "Generated scenes",
        ["scene", "table", "objects", "lost", "moves [mm]", "sunk [mm]", "visible", "physics [s]",
         "views [s]", ""],
        rows,
    )  # fmt: skip
    s = dataset["statistics"]
    seen = s["visibility"]
    bands = [
        [f"{100 * a:.0f} - {100 * b:.0f} %", str(n), _percent(n / max(1, seen["labels"]))]
        for a, b, n in zip(BANDS[:-1], BANDS[1:], seen["counts"], strict=True)
    ]
    console.table("Visibility of objects in views", ["visible", "labels", "share"], bands)
    for reason in sorted({r for scene in dataset["scenes"] for r in scene["skipped"]})[:5]:
        console.warn(f"skipped: {reason}")
    for number, why in outcome.failed.items():
        console.warn(f"{scene_name(number)} could not be made: {why}")
    console.say(
        f"{s['scenes']} scenes, {s['views']} views, {s['instances']} objects of "
        f"{s['distinct_objects']} kinds on {len(s['tables'])} kinds of tables; "
        f"{s['fell_off']} fell off, {s['overhung']} hung over the rim, {s['restless']} never "
        f"rested, {s['skipped_meshes']} meshes could not be used."
    )


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def write_sheet(out: Path, layouts: list[Layout], views: int) -> Path | None:
    """Write a contact sheet with pictures of all scenes, or of as many as fit."""
    import cv2

    from realsim.rendering.overlay import contact_sheet, save_png

    if not layouts:
        return None
    each = max(1, min(views, SHEET_PICTURES // len(layouts), 4))
    pictures: list[Any] = []
    captions: list[str] = []
    for layout in layouts[:SHEET_PICTURES]:
        for view in np.linspace(0, views - 1, each).round().astype(int):
            path = out / scene_name(layout.number) / f"rgb/{view:06d}.png"
            if not path.is_file():
                continue
            rgb = read_rgb(path)
            size = (SHEET_WIDTH_PX, round(SHEET_WIDTH_PX * rgb.shape[0] / rgb.shape[1]))
            pictures.append(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
            captions.append(f"{scene_name(layout.number)} {view:06d} {layout.table}")
    if not pictures:
        return None
    columns = each if each > 1 else min(6, len(pictures))
    save_png(out / SHEET_FILE, contact_sheet(pictures, columns, captions))
    return out / SHEET_FILE


def write_dataset(out: Path, dataset: dict[str, Any]) -> None:
    """Write dataset.json."""
    atomic.write_json(out / DATASET_FILE, dataset)
