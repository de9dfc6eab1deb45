"""`realsim check` of a data set, as a person and a program read it."""

from collections.abc import Sequence
from pathlib import Path

from realsim.app.check.agreement import ObjectAgreement, SceneAgreement
from realsim.app.check.checksums import ChecksumReport, check_checksums, checksum_list
from realsim.app.check.dataset import checked_scenes, is_dataset
from realsim.app.console import Console, shortened

HEADER = [
    "scene, object", "frames", "mask IoU", "worst", "visible IoU", "worst", "depth [mm]", "hidden",
    "agrees",
]  # fmt: skip
MOST_ROWS = 60
MOST_FINDINGS = 40
MORE = "... and {} more (--json has them all)"
"""Lines on the console; `--json` has all."""


def run_dataset_check(folder: Path, *, console: Console) -> bool:
    """Check a data set and print what was found: its labels, and its files by their checksums.

    Any other folder that has a list of checksums is checked by it alone.

    Returns:
        Whether everything agrees.

    Raises:
        InputError: no data set there, and no checksums.
    """
    sums = checksum_list(folder)
    scenes: list[SceneAgreement] = []
    has_labels = sums is None or is_dataset(folder)
    if has_labels:
        with console.stage("check", "masks, poses, depth") as tick:
            scenes = list(checked_scenes(folder, progress=tick))
    report: ChecksumReport | None = None
    if sums is not None:
        with console.stage("check", "checksums") as tick:
            report = check_checksums(sums, folder, progress=tick)
    agrees = all(s.agrees for s in scenes) and (report is None or report.agrees)
    told = {
        "agrees": agrees,
        "scenes": [s.to_json() for s in scenes],
        "checksums": None if report is None else report.to_json(),
    }
    console.result(told)
    if console.as_json:
        return agrees
    if has_labels:
        show_agreement(folder, scenes, console)
    if report is not None:
        show_checksums(report, console)
        if not has_labels:
            console.say("no annotated scenes of BOP or GraspNet here: only checksums were compared")
    return agrees


def show_checksums(report: ChecksumReport, console: Console) -> None:
    """Print which files are not as they were written."""
    faults = report.faults()
    console.say(*shortened([f"damaged: {line}" for line in faults], MOST_FINDINGS, MORE))
    good = report.listed - len(faults)
    console.say(f"{good} of {report.listed} files are as they were written ({report.file})")


def show_agreement(folder: Path, scenes: Sequence[SceneAgreement], console: Console) -> None:
    """Print a table of all objects, what disagrees first, and what was found."""
    rows = [(s, o) for s in scenes for o in s.objects]
    rows.sort(key=lambda row: not row[1].faults)
    shown = [_row(s, o) for s, o in rows[:MOST_ROWS]]
    if shown:
        console.table(f"Data set {folder}", HEADER, shown)
    if len(rows) > MOST_ROWS:
        console.say(f"... and {len(rows) - MOST_ROWS} more objects (--json has them all)")
    lines = [f"{s.place}: {f}" for s in scenes for f in s.findings]
    lines += [f"{s.place} object {o.obj_id} {o.name}: {f}" for s, o in rows for f in o.faults]
    console.say(*shortened([f"disagrees: {line}" for line in lines], MOST_FINDINGS, MORE))
    console.say(*dict.fromkeys(f"note: {s.place}: {n}" for s in scenes for n in s.notes))
    good = sum(s.agrees for s in scenes)
    rough = sum(s.approximate for s in scenes)
    console.say(
        f"{good} of {len(scenes)} scenes agree with themselves"
        + (f"; {rough} have approximate labels only" if rough else "")
    )


def _row(s: SceneAgreement, o: ObjectAgreement) -> list[str]:
    """Return an object's row."""
    return [
        f"{s.place} {o.obj_id} {o.name}",
        str(o.frames),
        _figure(o.mask_iou),
        _figure(o.mask_iou_worst),
        _figure(o.visible_iou),
        _figure(o.visible_iou_worst),
        "-" if o.depth_mm is None else f"{o.depth_mm:+.1f}",
        "-" if o.hidden is None else f"{100 * o.hidden:.1f} %",
        _verdict(s, o),
    ]


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _verdict(s: SceneAgreement, o: ObjectAgreement) -> str:
    """Return whether an object's labels agree, and whether they are meant to."""
    if s.approximate:
        return "no, approximate" if o.faults else "approximate"
    compared = (o.mask_iou, o.visible_iou, o.depth_mm)
    if not o.faults and all(value is None for value in compared):
        return "not compared"
    return "no" if o.faults else "yes"
