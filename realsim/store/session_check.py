"""What in a session's folder is sound, missing or damaged; nothing is changed by looking.

Damage is what no interrupted run can leave behind. What one can leave (half a line, a file under a
temporary name, images of the view in flight) is a note: opening the session cleans it up.

What a check notes without calling it damage.
"""

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from realsim import images
from realsim.errors import RealsimError
from realsim.records import CameraIntrinsics, View
from realsim.store import atomic
from realsim.store.check_report import CheckReport, Lists, SessionFinding
from realsim.store.header import SESSION_FILE, checked_header
from realsim.store.manifest import NAME as MANIFEST_FILE
from realsim.store.manifest import entry_from, entry_of, fault_of, take
from realsim.store.opening import BEGUN_FILE, CAMERA_FILE, ROBOT_FILE
from realsim.store.view_files import depth_path, record_of, rgb_path
from realsim.untrusted.own_json import from_json

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
    if any(f.path == MANIFEST_FILE and f.kind == "missing" for f in lists.findings):
        return  # all of them: the lost list says it
    for path in unproven:
        if path not in noted:
            found = "no checksum: its line in the manifest is lost, or a run ended before it"
            if is_image(path):
                found += "; the image can be read"
            lists.note(path, "unproven", found)


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
            lists.note(ROBOT_FILE, "time", found)
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
            lists.note(ROBOT_FILE, "repeated", found)


def note_orphans(folder: Path, lists: Lists, lost: set[int]) -> None:
    """Note images that belong to no view."""
    for name in IMAGE_FOLDERS:
        for file in sorted((folder / name).glob("*.png")):
            path = file.relative_to(folder).as_posix()
            if not is_image(path) or int(file.stem) in lists.records:
                continue
            if int(file.stem) not in lost:
                found = "no line in robot.jsonl: the run ended before the view was complete"
                lists.note(path, "unlisted", found)


DAMAGED = "damaged"
"""Folder of a session that takes what a repair takes out."""
LISTED = re.compile(r'"path": "([^"]+)"')
INDEX = re.compile(r'"index": (\d+)')


def is_session(folder: Path) -> bool:
    """Return whether there is a session, perhaps a damaged one."""
    return any((folder / name).is_file() for name in (SESSION_FILE, MANIFEST_FILE, ROBOT_FILE))


def inner_sessions(folder: Path) -> list[Path]:
    """Return the folders of the sessions inside a session's folder."""
    found = {p.parent for name in (SESSION_FILE, MANIFEST_FILE) for p in folder.rglob(name)}
    return sorted(p for p in found - {folder} if DAMAGED not in p.relative_to(folder).parts)


def check_session(folder: Path | str, *, decode: bool = False) -> CheckReport:
    """Check every checksum, line and image of a session and of the sessions inside it.

    Args:
        folder: the session's folder; its session.json may be damaged.
        decode: decode every image; otherwise those alone that no checksum proves.
    """
    folder = Path(folder)
    lists = read_lists(folder)
    findings = lists.findings
    camera = _camera_of(folder, lists)
    interrupted = _note_leftovers(folder, lists)
    interrupted |= _check_robot_file(folder, lists) or any(f.kind == "torn" for f in findings)
    ok = 0
    for path, entry in lists.entries.items():
        if path == ROBOT_FILE or any(f.path == path for f in findings):
            continue
        fault = fault_of(folder, entry)
        if fault is None:
            ok += 1
        elif path != CAMERA_FILE or not interrupted:
            lists.note(path, fault.kind, fault.found)
    robot_damaged = any(f.path == ROBOT_FILE and f.is_damage for f in findings)
    ok += int(ROBOT_FILE in lists.entries and not robot_damaged)
    sound = set(_sound_views(folder, lists, camera, decode))
    lost = _views_of_lines(lists)
    lost |= {f.view for f in findings if f.view is not None and f.is_damage}
    note_times(folder, lists)
    note_repeated(folder, lists)
    note_orphans(folder, lists, lost)
    unproven, beside = without_checksum(_unlisted(folder, lists))
    note_unproven(lists, unproven)
    views = tuple(sorted(sound - lost))
    return CheckReport(
        folder=str(folder),
        views=views,
        damaged_views=tuple(sorted((lost | set(lists.records)) - set(views))),
        planned=_planned(folder),
        files_ok=ok,
        unproven=unproven,
        beside=beside,
        findings=tuple(findings),
        inner=tuple(
            check_session(p, decode=decode) for p in inner_sessions(folder) if _is_next(folder, p)
        ),
    )


def _is_next(folder: Path, inner: Path) -> bool:
    """Return whether no other session lies between the two."""
    between = [p for p in inner.parents if folder in p.parents]
    return not any(is_session(p) for p in between)


def read_lists(folder: Path) -> Lists:
    """Read manifest and robot lines; damaged and torn lines are findings."""
    lists = Lists(entries={}, records={})
    for name in (MANIFEST_FILE, ROBOT_FILE):
        path = folder / name
        if not path.is_file():
            if name == MANIFEST_FILE:
                lists.note(name, "missing", "no file")
            continue
        if name == MANIFEST_FILE and not atomic.complete_lines(path):
            lists.note(name, "missing", "no line in it")
        for number, line in enumerate(atomic.complete_lines(path), start=1):
            try:
                if name == MANIFEST_FILE:
                    take(lists.entries, entry_from(line))
                else:
                    record = record_of(line)
                    from_json(record, View, "a view")
                    index = int(record["index"])
                    lists.records.pop(index, None)  # the order is that of the lines that count
                    lists.records[index] = record
                    lists.lines.setdefault(index, []).append((number, line))
            except (ValueError, RealsimError) as error:
                named = INDEX.search(line) if name == ROBOT_FILE else None
                view = None if named is None else int(named[1])
                lists.note(name, "line", f"line {number} {error}", view)
        data = path.read_bytes()
        if data and not data.endswith(b"\n"):
            half = len(data) - data.rfind(b"\n") - 1
            found = f"half a line of {half} bytes at its end"
            tail = LISTED.search(data[-half:].decode(errors="replace"))
            if name == MANIFEST_FILE and tail is not None:
                found += f": the checksum of {tail[1]} is lost"
            lists.note(name, "torn", found)
    return lists


def _camera_of(folder: Path, lists: Lists) -> CameraIntrinsics | None:
    """Return the camera of the header; a header that cannot be used is a finding."""
    try:
        return from_json(
            checked_header(folder / SESSION_FILE)["camera"], CameraIntrinsics, "the camera"
        )
    except RealsimError as error:
        if (folder / SESSION_FILE).is_file():
            lists.note(SESSION_FILE, "unreadable", str(error))
        else:
            lists.note(SESSION_FILE, "missing", "no file")
        return None


def _note_leftovers(folder: Path, lists: Lists) -> bool:
    """Note temporary files of dead runs; return whether one holds what the manifest lists."""
    finished = False
    inner = inner_sessions(folder)
    for temporary, final in atomic.leftovers(folder):
        if any(p in temporary.parents for p in inner):
            continue
        path = final.relative_to(folder).as_posix()
        whole = lists.entries.get(path) == entry_of(path, temporary.read_bytes())
        finished |= whole
        found = f"{temporary.name}, of a run that is over"
        if whole:
            found += "; opening the session gives it its name"
        name = path if whole else temporary.relative_to(folder).as_posix()
        lists.note(name, "leftover", found)
    return finished


def _check_robot_file(folder: Path, lists: Lists) -> bool:
    """Compare robot.jsonl with its entry; return whether a run ended before it was listed."""
    path, entry = folder / ROBOT_FILE, lists.entries.get(ROBOT_FILE)
    data = path.read_bytes() if path.is_file() else b""
    data = data[: data.rfind(b"\n") + 1]
    if entry is None:
        return bool(data)
    if entry_of(ROBOT_FILE, data[: entry.bytes]) != entry:
        found = f"{len(data)} bytes, {entry.bytes} were listed"
        if len(data) >= entry.bytes:
            found = f"other bytes than were written among the first {entry.bytes}"
        lists.note(ROBOT_FILE, "changed" if path.is_file() else "missing", found)
        return False
    return len(data) > entry.bytes


def _sound_views(
    folder: Path, lists: Lists, camera: CameraIntrinsics | None, decode: bool
) -> Iterator[int]:
    """Yield the views whose images are there and whole; what is wrong is a finding."""
    for index, record in lists.records.items():
        paths = [rgb_path(index), *([depth_path(index)] if record["depth"] else [])]
        whole = True
        for path in paths:
            known = [k for k, f in enumerate(lists.findings) if f.path == path]
            for k in known:
                old = lists.findings[k]
                whole = whole and not old.is_damage
                lists.findings[k] = replace(old, view=index)
            if known:
                continue
            fault = None
            if path not in lists.entries and not (folder / path).is_file():
                fault = SessionFinding(path=path, kind="missing", found="no file", view=index)
            elif decode or path not in lists.entries:
                fault = _image_fault(folder, path, index, camera)
            if fault is not None:
                lists.findings.append(fault)
                whole = False
        if whole:
            yield index


def _image_fault(
    folder: Path, path: str, index: int, camera: CameraIntrinsics | None
) -> SessionFinding | None:
    """Decode an image; return what is wrong with it."""
    try:
        if path == depth_path(index):
            size = images.read_depth(folder / path, 1.0).shape[:2]
        else:
            size = images.read_rgb(folder / path).shape[:2]
    except RealsimError as error:
        return SessionFinding(path=path, kind="unreadable", found=str(error), view=index)
    if camera is not None and size != (camera.height, camera.width):
        found = f"{size[1]}x{size[0]}, the camera has {camera.width}x{camera.height}"
        return SessionFinding(path=path, kind="unreadable", found=found, view=index)
    return None


def _views_of_lines(lists: Lists) -> set[int]:
    """Return the views that damaged or lost robot lines cost, and name them in the findings.

    They are the views whose images are listed without a line. A damaged line may name another
    view, its number being what was damaged; only where no view has lost its line is it believed:
    it was a view taken again, and the earlier line does not belong to the images.
    """
    damaged = [k for k, f in enumerate(lists.findings) if f.path == ROBOT_FILE and f.is_damage]
    if not damaged:
        return set()
    lost = {int(Path(p).stem) for p in lists.entries if is_image(p)} - set(lists.records)
    for k in damaged:
        finding = lists.findings[k]
        if finding.view in lists.records and lost:
            lists.findings[k] = replace(finding, view=None)
    return lost


def _planned(folder: Path) -> int | None:
    """Return the number of views of the session's plan; None without one that can be read."""
    try:
        plan: Any = json.loads((folder / PLAN_FILE).read_text(encoding="utf-8"))
        return len(plan.get("content", plan)["joints"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _unlisted(folder: Path, lists: Lists) -> list[str]:
    """Return the files of the session that no checksum covers."""
    inner = [folder / DAMAGED, *inner_sessions(folder)]
    temporary = {t for t, _ in atomic.leftovers(folder)}
    paths = [
        p for p in folder.rglob("*")
        if p.is_file() and p != folder / MANIFEST_FILE and p not in temporary
        and not any(i in p.parents for i in inner)
    ]  # fmt: skip
    return [p for p in (q.relative_to(folder).as_posix() for q in paths) if p not in lists.entries]
