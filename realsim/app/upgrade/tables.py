"""What an upgrade found, scene by scene and object by object: on the console, as JSON and CSV."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim import __version__
from realsim.app.console import Console
from realsim.app.upgrade.analytic import LEVEL_HEADER, correlation_line, level_rows
from realsim.app.upgrade.scene import Record
from realsim.store import atomic

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
