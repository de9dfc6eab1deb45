"""What generated scenes are like: dataset.json, tables for people."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from realsim.app.console import Console
from realsim.app.generate.request import GenerateRequest
from realsim.app.generate.run import GenerateOutcome, is_finished, load_layout, stored_costs
from realsim.errors import InputError
from realsim.formats.folders.listing import shown
from realsim.pages import counted
from realsim.store import provenance
from realsim.untrusted.own_json import read_object
from realsim_sim_bridge.table_scenes.sample import Layout
from realsim_sim_bridge.table_scenes.scene import scene_name

DATASET_FILE = "dataset.json"
BANDS = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
"""Borders of the visibility table."""


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
        "versions": provenance.versions(),
        "scenes": [
            {
                "name": scene_name(layout.number),
                "table": layout.table,
                "side_m": layout.side_m,
                "objects": [
                    {"instance": k, "obj_id": k + 1, "name": o.name, "pool": o.source,
                     "key": o.key, "scale": o.scale, "size_m": o.size_m,
                     "open_edges": o.open_edges}
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


def kept_dataset(
    out: Path, request: GenerateRequest, layouts: list[Layout]
) -> dict[str, Any] | None:
    """Return dataset.json of the same scenes, if it is there: it speaks of them as they were made.

    A scene's labels are others once it was registered.
    """
    try:
        kept = read_object(out / DATASET_FILE)
        names = [str(row["name"]) for row in kept["scenes"]]
    except (InputError, KeyError, TypeError):
        return None
    same = kept.get("key") == request.key and names == [scene_name(x.number) for x in layouts]
    return kept if same else None


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


class FiguresTable(NamedTuple):
    """Figures of a data set as rows."""

    title: str
    header: list[str]
    rows: list[list[str]]
    text: str = ""


LOST = "lost: fell off / hung over the rim / never rested. Times are CPU seconds."
SCENES_HEADER = ["scene", "table", "objects", "lost", "moves [mm]", "sunk [mm]", "visible",
                 "physics [s]", "views [s]"]  # fmt: skip


def scene_rows(out: Path, dataset: dict[str, Any]) -> Iterator[list[str]]:
    """Return a row per scene: what stayed on its table, how much is seen, and CPU seconds."""
    for scene in dataset["scenes"]:
        costs = stored_costs(out, _number(scene))
        lost = [len(scene[k]) for k in ("fell", "overhung", "restless")]
        figures = scene["figures"]
        yield [
            scene["name"], scene["table"], str(len(scene["objects"])),
            "/".join(map(str, lost)), f"{figures['moved_mm']:.2f}",
            f"{figures['penetration_mm']:.2f}", _percent(scene["mean_visibility"]),
            f"{costs.get('physics_s', 0.0):.0f}", f"{costs.get('rendering_s', 0.0):.0f}",
        ]  # fmt: skip


def _number(scene: dict[str, Any]) -> int:
    return int(scene["name"].rpartition("_")[2])


def visibility_rows(dataset: dict[str, Any]) -> list[list[str]]:
    """Return a row per band of visibility: labels in it, and their share."""
    seen = dataset["statistics"]["visibility"]
    if not seen["labels"]:
        return []
    return [
        [f"{100 * a:.0f} - {100 * b:.0f} %", str(n), _percent(n / seen["labels"])]
        for a, b, n in zip(BANDS[:-1], BANDS[1:], seen["counts"], strict=True)
    ]


def cost_rows(out: Path, dataset: dict[str, Any]) -> list[list[str]]:
    """Return a row per part of a frame: CPU seconds, and its share, over the scenes' frames."""
    total: dict[str, float] = {}
    frames = 0
    for scene in dataset["scenes"]:
        costs = stored_costs(out, _number(scene))
        parts, rendered = costs.get("parts", {}), int(costs.get("rendered", 0))
        if not parts or not rendered:
            continue
        frames += rendered
        for name, value in parts.items():
            total[name] = total.get(name, 0.0) + rendered * float(value)
    whole = sum(total.values())
    return [
        [name, f"{value / frames:.2f}", _percent(value / max(whole, 1e-9))]
        for name, value in total.items()
    ]


def tables_of(out: Path, dataset: dict[str, Any]) -> list[FiguresTable]:
    """Return every table of a data set; empty ones are left out."""
    tables = [
        FiguresTable(title="Generated scenes", header=SCENES_HEADER,
              rows=list(scene_rows(out, dataset)), text=LOST),
        FiguresTable(title="Visibility of objects in views", header=["visible", "labels", "share"],
              rows=visibility_rows(dataset)),
        FiguresTable(title="CPU time of a frame", header=["part", "s", "share"],
              rows=cost_rows(out, dataset)),
    ]  # fmt: skip
    return [t for t in tables if t.rows]


def summary_of(dataset: dict[str, Any]) -> str:
    """Return a data set in one line."""
    s = dataset["statistics"]
    tables = f"{counted(len(s['tables']), 'kind')} of tables"
    return (
        f"{counted(s['scenes'], 'scene')}, {s['views']} views, "
        f"{s['instances']} objects of {s['distinct_objects']} kinds on {tables}; "
        f"{s['fell_off']} fell off, {s['overhung']} hung over the rim, {s['restless']} never "
        f"rested, {s['skipped_meshes']} meshes could not be used."
    )


def notes_of(dataset: dict[str, Any], outcome: GenerateOutcome) -> list[str]:
    """Return meshes that were skipped or are open, what the renderer says, scenes not made."""
    reasons = sorted({r for scene in dataset["scenes"] for r in scene["skipped"]})[:5]
    notes = [f"skipped: {reason}" for reason in reasons]
    laid: list[dict[str, Any]] = [o for scene in dataset["scenes"] for o in scene["objects"]]
    edges = {(o["pool"], o["key"]): n for o in laid if (n := o.get("open_edges"))}
    if edges:
        found = shown([f"{key} ({n} boundary edges)" for (_, key), n in sorted(edges.items())])
        notes.append(
            f"open meshes: {found}. Volume and mass of an open mesh are not known, physics closes "
            "it. Is the file whole? `realsim scan import` says where it is open."
        )
    notes += sorted({note for costs in outcome.made for note in costs.notes})
    return notes + [
        f"{scene_name(number)} could not be made: {why}" for number, why in outcome.failed.items()
    ]


def show(out: Path, dataset: dict[str, Any], outcome: GenerateOutcome, console: Console) -> None:
    """Print the scenes, the statistics, and what went wrong."""
    made = {c.number for c in outcome.made}
    for table in tables_of(out, dataset):
        if table.header is SCENES_HEADER:
            now = ["made" if _number(s) in made else "kept" for s in dataset["scenes"]]
            rows = [[*r, n] for r, n in zip(table.rows, now, strict=True)]
            console.table(table.title, [*table.header, ""], rows)
        else:
            console.table(table.title, table.header, table.rows)
    console.warn(*notes_of(dataset, outcome))
    console.say(summary_of(dataset) if dataset["scenes"] else "no scene was made.")


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"
