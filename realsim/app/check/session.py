"""`realsim check`: what of a session is sound, missing or damaged; taking out what is damaged.

A data set (BOP, GraspNet, or what `realsim upgrade` made) is checked for whether its labels agree;
whatever `realsim export` wrote, for whether its files are as they were written.

`realsim check` of a data set, as a person and a program read it.
"""

from collections.abc import Sequence
from pathlib import Path

from realsim.app.check.agreement import ObjectAgreement, SceneAgreement
from realsim.app.check.checksums import ChecksumReport, check_checksums, checksum_list
from realsim.app.check.dataset import checked_scenes, is_dataset
from realsim.app.console import Console, shortened
from realsim.app.option_values import ranges_of
from realsim.app.stages import hint_of
from realsim.errors import InputError
from realsim.store.atomic import only_run_in
from realsim.store.session_check import CheckReport, check_session, is_session
from realsim.store.session_repair import RepairReport, repair_session

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


SHOWN = 40
"""Rows of a table; the rest is counted (`--json` has all)."""
NAMED = 6
"""Names in a line; `--json` has all."""


def run_check(folder: Path, console: Console, *, repair: bool, decode: bool) -> bool:
    """Check a session or a data set, repair a session if asked, and print what was found.

    Returns:
        Whether the session is sound (after the repair, if one was asked for), or the data set's
        labels agree with its poses and depth, and its files with their checksums.

    Raises:
        InputError: neither, a data set is to be repaired, or another run is working in the session.
    """
    if not is_session(folder) and (is_dataset(folder) or _has_checksums(folder)):
        if repair:
            raise InputError(
                f"'{folder}' is a data set; only sessions are repaired. Labels that disagree are "
                "made anew by `realsim upgrade`, damaged files by `realsim export`."
            )
        return run_dataset_check(folder, console=console)
    if not folder.is_dir() or not is_session(folder):
        raise InputError(
            f"'{folder}' is not a session: it has none of session.json, manifest.jsonl and "
            f"robot.jsonl; it is no annotated data set of BOP or GraspNet, and no SHA256SUMS lists "
            f"its files.{hint_of(folder)}"
        )
    if not repair:
        report = check_session(folder, decode=decode)
        console.result(report.to_json())
        if not console.as_json:
            show_check(report, console)
        return report.sound
    with only_run_in(folder):
        repaired = repair_session(folder)
    console.result(repaired.to_json())
    if not console.as_json:
        show_repair(repaired, console)
    return repaired.after.sound


def _has_checksums(folder: Path) -> bool:
    return folder.is_dir() and checksum_list(folder) is not None


def show_check(report: CheckReport, console: Console) -> None:
    """Print what was found in a session and in those inside it, and what to do."""
    _show_tables(report, console)
    if report.sound:
        console.say("sound: every listed file has the bytes that were written")
        if count := _unproven(report):
            console.say(
                f"{count} files of the session have no checksum: whether they are as they were "
                "written, nothing can tell."
            )
    else:
        console.say(
            "damaged: `realsim check --repair` takes out what is damaged, and only that; files "
            "move to damaged/, and the views concerned can be captured again."
        )


def _show_tables(report: CheckReport, console: Console) -> None:
    views = f"{len(report.views)}"
    if report.planned is not None:
        views += f" of {report.planned} planned"
    rows = [["views sound", views]]
    if report.damaged_views:
        rows.append(["views damaged", ranges_of(report.damaged_views)])
    if report.planned is not None and report.not_captured:
        rows.append(["views not captured", ranges_of(report.not_captured)])
    rows.append(["files as written", f"{report.files_ok}"])
    if report.unproven:
        rows.append(["files without checksum", _names(report.unproven)])
    if report.beside:
        others = ", ".join(f"{name} {count}" for name, count in report.beside[:NAMED])
        more = ", ..." if len(report.beside) > NAMED else ""
        rows.append(["files beside it", f"{others}{more} (no checksum is kept of these)"])
    console.table(f"Session {report.folder}", ["", ""], rows)
    found = sorted(report.findings, key=lambda f: not f.is_damage)
    if found:
        kinds = [f.kind if f.is_damage else f"note: {f.kind}" for f in found]
        rows = [[f.path, kind, f.found] for f, kind in zip(found, kinds, strict=True)]
        console.table("Damage and notes", ["file", "", "found"], rows[:SHOWN])
        if len(found) > SHOWN:
            console.say(f"... and {len(found) - SHOWN} more (--json has them all)")
    for inner in report.inner:
        _show_tables(inner, console)


def show_repair(report: RepairReport, console: Console) -> None:
    """Print what a repair did."""
    if report.before.sound:
        console.say(f"{report.before.folder}: nothing was damaged, nothing was taken out")
    for path, place in report.moved:
        console.say(f"{path} -> {place}")
    console.say(*report.notes)
    for inner in report.inner:
        show_repair(inner, console)
    if not report.after.sound:
        show_check(report.after, console)


def _unproven(report: CheckReport) -> int:
    return len(report.unproven) + sum(_unproven(inner) for inner in report.inner)


def _names(paths: Sequence[str]) -> str:
    """Return how many files, and the names of the first."""
    return f"{len(paths)}: {', '.join(paths[:NAMED])}{', ...' if len(paths) > NAMED else ''}"
