"""`realsim check` of a data set, as a person and a program read it."""

import json
from collections.abc import Sequence
from pathlib import Path

from realsim.app.check.dataset import ObjectAgreement, SceneAgreement, checked_scenes
from realsim.app.console import Console

HEADER = [
    "scene, object", "frames", "mask IoU", "worst", "visible IoU", "worst", "depth [mm]", "hidden",
    "agrees",
]  # fmt: skip
MOST_ROWS = 60
MOST_FINDINGS = 40
"""Lines on the console; `--json` has all."""


def run_dataset_check(folder: Path, *, as_json: bool, console: Console) -> bool:
    """Check a data set and print what was found.

    Returns:
        Whether everything agrees.

    Raises:
        InputError: no data set there.
    """
    with console.stage("check", "masks, poses, depth") as tick:
        scenes = list(checked_scenes(folder, progress=tick))
    agrees = all(s.agrees for s in scenes)
    if as_json:
        print(json.dumps({"agrees": agrees, "scenes": [s.to_json() for s in scenes]}, indent=1))
    else:
        show_agreement(folder, scenes, console)
    return agrees


def show_agreement(folder: Path, scenes: Sequence[SceneAgreement], console: Console) -> None:
    """Print a table of all objects, what disagrees first, and what was found."""
    rows = [(s.place, o) for s in scenes for o in s.objects]
    rows.sort(key=lambda row: not row[1].faults)
    shown = [_row(place, o) for place, o in rows[:MOST_ROWS]]
    if shown:
        console.table(f"Data set {folder}", HEADER, shown)
    if len(rows) > MOST_ROWS:
        console.say(f"... and {len(rows) - MOST_ROWS} more objects (--json has them all)")
    lines = [f"{s.place}: {f}" for s in scenes for f in s.findings]
    lines += [f"{place} object {o.obj_id} {o.name}: {f}" for place, o in rows for f in o.faults]
    for line in lines[:MOST_FINDINGS]:
        console.say(f"disagrees: {line}")
    if len(lines) > MOST_FINDINGS:
        console.say(f"... and {len(lines) - MOST_FINDINGS} more (--json has them all)")
    for note in dict.fromkeys(f"{s.place}: {n}" for s in scenes for n in s.notes):
        console.say(f"note: {note}")
    good = sum(s.agrees for s in scenes)
    console.say(f"{good} of {len(scenes)} scenes agree with themselves")


def _row(place: str, o: ObjectAgreement) -> list[str]:
    """Return an object's row."""
    return [
        f"{place} {o.obj_id} {o.name}",
        str(o.frames),
        _figure(o.mask_iou),
        _figure(o.mask_iou_worst),
        _figure(o.visible_iou),
        _figure(o.visible_iou_worst),
        "-" if o.depth_mm is None else f"{o.depth_mm:+.1f}",
        "-" if o.hidden is None else f"{100 * o.hidden:.1f} %",
        "no" if o.faults else "yes",
    ]


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
