"""What a check notes without calling it damage."""

import json
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from realsim.store import atomic
from realsim.store.check_report import Lists, SessionFinding
from realsim.store.header import SESSION_FILE
from realsim.store.manifest import NAME as MANIFEST_FILE
from realsim.store.opening import BEGUN_FILE, CAMERA_FILE, ROBOT_FILE

PLAN_FILE = "plan.json"
LOG_FILE = "capture_log.jsonl"
"""What a capture writes of its runs: begun, stored, ended."""
RETAKEN = "retaken"
"""Folder of earlier images of views that were taken again."""
IMAGE_FOLDERS = ("rgb", "depth")
OWN_FILES = (SESSION_FILE, BEGUN_FILE, CAMERA_FILE, ROBOT_FILE, PLAN_FILE, LOG_FILE)
OWN_FOLDERS = (*IMAGE_FOLDERS, RETAKEN, "stages")
"""What is in a session is written by the session, and listed, if it is one of these files, or in
one of these folders; elsewhere people and other tools put files, too."""


def is_image(path: str) -> bool:
    """Return whether a file of this name is the image of a view."""
    folder, _, name = path.partition("/")
    return folder in IMAGE_FOLDERS and bool(re.fullmatch(r"\d{6,}\.png", name))


def is_own(path: str) -> bool:
    """Return whether a session lists files of this name, so that one not listed has lost it."""
    return path in OWN_FILES or path.partition("/")[0] in OWN_FOLDERS


def without_checksum(paths: Iterable[str]) -> tuple[tuple[str, ...], tuple[tuple[str, int], ...]]:
    """Return which of these unlisted files are the session's own, and how many others are where."""
    own: list[str] = []
    others: Counter[str] = Counter()
    for path in sorted(paths):
        if is_own(path):
            own.append(path)
        else:
            top, slash, _ = path.partition("/")
            others[top + slash] += 1
    return tuple(own), tuple(sorted(others.items()))


def note_unproven(lists: Lists, unproven: Iterable[str]) -> None:
    """Note files that are without a checksum though the session lists its files."""
    noted = {f.path for f in lists.findings}
    if MANIFEST_FILE in {f.path for f in lists.findings if f.kind == "missing"}:
        return  # all of them: the lost list says it
    for path in unproven:
        if path not in noted:
            found = "no checksum: its line in the manifest is lost, or a run ended before it"
            if is_image(path):
                found += "; the image can be read"
            lists.findings.append(SessionFinding(path=path, kind="unproven", found=found))


def note_times(folder: Path, lists: Lists) -> None:
    """Note a time stamp that is earlier than the one before it, within one run of a capture.

    A camera that is opened anew may count anew: where the capture log says that another run began
    (or a device was recovered) between two views, their stamps are not compared.
    """
    runs = runs_of_views(folder)
    before: tuple[int, float] | None = None
    for index, record in lists.records.items():
        moment = float(record["time_s"])
        if before is not None and moment < before[1] and _in_one_run(runs, index, before[0]):
            found = f"view {index} at {moment:.3f} s was stored after view {before[0]} at "
            found += f"{before[1]:.3f} s; a camera that was restarted counts anew"
            lists.findings.append(SessionFinding(path=ROBOT_FILE, kind="time", found=found))
            return  # one restart shifts all that follow: the first is what matters
        before = (index, moment)


def _in_one_run(runs: dict[int, int], a: int, b: int) -> bool:
    return not runs or (a in runs and runs[a] == runs.get(b))


def runs_of_views(folder: Path) -> dict[int, int]:
    """Return the run in which each view was stored last, by the capture log; empty without one."""
    runs: dict[int, int] = {}
    run = 0
    for entry in log_entries(folder):
        event, view = entry.get("event"), entry.get("view")
        if event in ("begun", "recovered"):
            run += 1
        elif event == "stored" and isinstance(view, int):
            runs[view] = run
    return runs


def log_entries(folder: Path) -> list[dict[str, Any]]:
    """Return the events of the capture log that can be read."""
    entries: list[dict[str, Any]] = []
    for line in atomic.complete_lines(folder / LOG_FILE):
        try:
            entry: Any = json.loads(line)
        except ValueError:
            continue
        if isinstance(entry, dict):
            entries.append({str(k): v for k, v in entry.items()})  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    return entries


def note_repeated(folder: Path, lists: Lists) -> None:
    """Note views with more lines in robot.jsonl than they were taken."""
    taken = Counter(p.name.partition("_")[0] for p in (folder / RETAKEN).glob("*_*.json"))
    for index, lines in sorted(lists.lines.items()):
        same = len(lines) - len({text for _, text in lines})
        # A simulated arm and camera that come to a view again write the very same line again.
        surplus = len(lines) - 1 - taken[f"{index:06d}"]
        if surplus > 0:
            numbers = ", ".join(str(number) for number, _ in lines)
            found = f"view {index} has {len(lines)} lines ({numbers}); the last one counts"
            found += f"; {same} of them repeat another" if same else ""
            lists.findings.append(SessionFinding(path=ROBOT_FILE, kind="repeated", found=found))


def note_orphans(folder: Path, lists: Lists, lost: set[int]) -> None:
    """Note images that belong to no view."""
    for name in IMAGE_FOLDERS:
        for file in sorted((folder / name).glob("*.png")):
            path = file.relative_to(folder).as_posix()
            if not is_image(path) or int(file.stem) in lists.records:
                continue
            if int(file.stem) not in lost:
                found = "no line in robot.jsonl: the run ended before the view was complete"
                lists.findings.append(SessionFinding(path=path, kind="unlisted", found=found))
