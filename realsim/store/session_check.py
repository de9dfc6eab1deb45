"""What in a session's folder is sound, missing or damaged; nothing is changed by looking.

Damage is what no interrupted run can leave behind. What one can leave (half a line, a file under a
temporary name, images of the view in flight) is a note: opening the session cleans it up.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from realsim.errors import RealsimError
from realsim.formats import images
from realsim.records import CameraIntrinsics
from realsim.store import atomic, records_json
from realsim.store.header import SESSION_FILE, checked_header
from realsim.store.manifest import NAME as MANIFEST_FILE
from realsim.store.manifest import REMOVED, Entry, entry_from, entry_of, fault_of
from realsim.store.robot_lines import record_of
from realsim.store.session_store import CAMERA_FILE, ROBOT_FILE, depth_path, rgb_path

DAMAGED = "damaged"
"""Folder of a session that takes what a repair takes out."""
PLAN_FILE = "plan.json"
INDEX = re.compile(r'"index": (\d+)')
IMAGE_FOLDERS = ("rgb", "depth")

Kind = Literal["missing", "changed", "unreadable", "line", "torn", "leftover", "unlisted", "time"]
DAMAGE: tuple[Kind, ...] = ("missing", "changed", "unreadable", "line")


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One thing that is not as it was written."""

    path: str
    """Relative to the session."""
    kind: Kind
    """missing, changed (other bytes than were written), unreadable, line (a damaged one): damage.
    torn, leftover, unlisted (what an interrupted run leaves), time (a stamp goes back): notes."""
    found: str
    """What is there."""
    view: int | None = None
    """The view that it costs, if it costs one."""

    @property
    def is_damage(self) -> bool:
        """Whether it is more than an interrupted run can leave."""
        return self.kind in DAMAGE


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckReport:
    """What a check found in one session, and in the sessions inside it."""

    folder: str
    views: tuple[int, ...]
    """Numbers of the views that are whole and sound."""
    damaged_views: tuple[int, ...]
    """Numbers of views that were stored once and are not whole any more."""
    planned: int | None
    """Views of the plan that the session is captured by; None without a plan."""
    files_ok: int
    """Listed files that have the bytes that were written."""
    unproven: int
    """Files that no checksum covers: written beside the session, or by other tools."""
    findings: tuple[Finding, ...] = ()
    inner: tuple["CheckReport", ...] = ()
    """Reports of the sessions inside, such as the board views in calibration/capture."""

    def _paths(self, kind: Kind) -> tuple[str, ...]:
        return tuple(f.path for f in self.findings if f.kind == kind)

    @property
    def missing(self) -> tuple[str, ...]:
        """Listed files that are not there."""
        return self._paths("missing")

    @property
    def changed(self) -> tuple[str, ...]:
        """Listed files with other bytes than were written."""
        return self._paths("changed")

    @property
    def torn(self) -> tuple[str, ...]:
        """Lists whose last line is half: a run was interrupted."""
        return self._paths("torn")

    @property
    def leftovers(self) -> tuple[str, ...]:
        """Temporary files of runs that are over."""
        return self._paths("leftover")

    @property
    def unlisted(self) -> tuple[str, ...]:
        """Images and lines that no complete view has."""
        return self._paths("unlisted")

    @property
    def not_captured(self) -> tuple[int, ...]:
        """Views of the plan that are not there."""
        have = set(self.views)
        return tuple(k for k in range(self.planned or 0) if k not in have)

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged here and inside; notes do not count."""
        return not any(f.is_damage for f in self.findings) and all(r.sound for r in self.inner)

    def to_json(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        return {
            "folder": self.folder,
            "sound": self.sound,
            "views": len(self.views),
            "views_planned": self.planned,
            "views_damaged": list(self.damaged_views),
            "views_not_captured": list(self.not_captured),
            "files_ok": self.files_ok,
            "files_without_checksum": self.unproven,
            "findings": [
                {"path": f.path, "kind": f.kind, "found": f.found, "view": f.view,
                 "damage": f.is_damage}
                for f in self.findings
            ],
            "inner": [r.to_json() for r in self.inner],
        }  # fmt: skip


@dataclass(kw_only=True, slots=True)
class Lists:
    """The two lists of a session, read without stopping at a damaged line."""

    entries: dict[str, Entry]
    """The manifest: the last sound entry of every path."""
    records: dict[int, dict[str, Any]]
    """The last sound robot line of every view, in the order of the file."""
    findings: list[Finding] = field(default_factory=list[Finding])


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
    camera = _camera_of(folder, findings)
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
            findings.append(Finding(path=path, kind=fault.kind, found=fault.found))
    robot_damaged = any(f.path == ROBOT_FILE and f.is_damage for f in findings)
    ok += int(ROBOT_FILE in lists.entries and not robot_damaged)
    sound = set(_sound_views(folder, lists, camera, decode))
    lost = _views_of_lines(lists)
    lost |= {f.view for f in findings if f.view is not None and f.is_damage}
    _note_times(lists)
    _note_orphans(folder, lists, lost)
    views = tuple(sorted(sound - lost))
    return CheckReport(
        folder=str(folder),
        views=views,
        damaged_views=tuple(sorted((lost | set(lists.records)) - set(views))),
        planned=_planned(folder),
        files_ok=ok,
        unproven=_unproven(folder, lists),
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
                lists.findings.append(Finding(path=name, kind="missing", found="no file"))
            continue
        for number, line in enumerate(atomic.complete_lines(path), start=1):
            try:
                if name == MANIFEST_FILE:
                    _take_entry(lists.entries, entry_from(line))
                else:
                    record = record_of(line)
                    records_json.view_from_json(record)
                    lists.records[record["index"]] = record
            except (ValueError, RealsimError) as error:
                index = INDEX.search(line) if name == ROBOT_FILE else None
                lists.findings.append(
                    Finding(
                        path=name, kind="line", found=f"line {number} {error}",
                        view=None if index is None else int(index[1]),
                    )
                )  # fmt: skip
        data = path.read_bytes()
        if data and not data.endswith(b"\n"):
            half = len(data) - data.rfind(b"\n") - 1
            lists.findings.append(
                Finding(path=name, kind="torn", found=f"half a line of {half} bytes at its end")
            )
    return lists


def _take_entry(entries: dict[str, Entry], entry: Entry) -> None:
    if entry.bytes == REMOVED:
        entries.pop(entry.path, None)
    else:
        entries[entry.path] = entry


def _camera_of(folder: Path, findings: list[Finding]) -> CameraIntrinsics | None:
    """Return the camera of the header; a header that cannot be used is a finding."""
    try:
        return records_json.intrinsics_from_json(checked_header(folder / SESSION_FILE)["camera"])
    except RealsimError as error:
        there = (folder / SESSION_FILE).is_file()
        found = str(error) if there else "no file"
        findings.append(
            Finding(path=SESSION_FILE, kind="unreadable" if there else "missing", found=found)
        )
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
            lists.findings.append(Finding(path=path, kind="leftover", found=found))
        else:
            name = temporary.relative_to(folder).as_posix()
            lists.findings.append(Finding(path=name, kind="leftover", found=found))
    return finished


def _check_robot_file(folder: Path, lists: Lists) -> bool:
    """Compare robot.jsonl with its entry; return whether a run ended before it was listed."""
    path, entry = folder / ROBOT_FILE, lists.entries.get(ROBOT_FILE)
    data = path.read_bytes() if path.is_file() else b""
    data = data[: data.rfind(b"\n") + 1]
    if entry is None:
        return bool(data)
    if entry_of(ROBOT_FILE, data[: entry.bytes]) != entry:
        kind: Kind = "changed" if path.is_file() else "missing"
        found = f"{len(data)} bytes, {entry.bytes} were listed"
        if len(data) >= entry.bytes:
            found = f"other bytes than were written among the first {entry.bytes}"
        lists.findings.append(Finding(path=ROBOT_FILE, kind=kind, found=found))
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
                lists.findings[k] = Finding(path=path, kind=old.kind, found=old.found, view=index)
            if known:
                continue
            fault = None
            if path not in lists.entries and not (folder / path).is_file():
                fault = Finding(path=path, kind="missing", found="no file", view=index)
            elif decode or path not in lists.entries:
                fault = _image_fault(folder, path, index, camera)
            if fault is not None:
                lists.findings.append(fault)
                whole = False
        if whole:
            yield index


def _image_fault(
    folder: Path, path: str, index: int, camera: CameraIntrinsics | None
) -> Finding | None:
    """Decode an image; return what is wrong with it."""
    try:
        if path == depth_path(index):
            size = images.read_depth(folder / path, 1.0).shape[:2]
        else:
            size = images.read_rgb(folder / path).shape[:2]
    except RealsimError as error:
        return Finding(path=path, kind="unreadable", found=str(error), view=index)
    if camera is not None and size != (camera.height, camera.width):
        found = f"{size[1]}x{size[0]}, the camera has {camera.width}x{camera.height}"
        return Finding(path=path, kind="unreadable", found=found, view=index)
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
    lost = {int(Path(p).stem) for p in lists.entries if _is_image(p)} - set(lists.records)
    for k in damaged:
        finding = lists.findings[k]
        if finding.view in lists.records and lost:
            lists.findings[k] = replace(finding, view=None)
    return lost


def _is_image(path: str) -> bool:
    folder, _, name = path.partition("/")
    return folder in IMAGE_FOLDERS and bool(re.fullmatch(r"\d{6,}\.png", name))


def _note_times(lists: Lists) -> None:
    """Note a time stamp that is earlier than the one before it in the file."""
    before: tuple[int, float] | None = None
    for index, record in lists.records.items():
        moment = float(record["time_s"])
        if before is not None and moment < before[1]:
            found = f"view {index} at {moment:.3f} s was stored after view {before[0]} at "
            found += f"{before[1]:.3f} s; a camera that was restarted counts anew"
            lists.findings.append(Finding(path=ROBOT_FILE, kind="time", found=found))
            return  # one restart shifts all that follow: the first is what matters
        before = (index, moment)


def _note_orphans(folder: Path, lists: Lists, lost: set[int]) -> None:
    """Note images that belong to no view."""
    for name in IMAGE_FOLDERS:
        for file in sorted((folder / name).glob("*.png")):
            path = file.relative_to(folder).as_posix()
            if not _is_image(path) or int(file.stem) in lists.records:
                continue
            if int(file.stem) not in lost:
                found = "no line in robot.jsonl: the run ended before the view was complete"
                lists.findings.append(Finding(path=path, kind="unlisted", found=found))


def _planned(folder: Path) -> int | None:
    """Return the number of views of the session's plan; None without one that can be read."""
    try:
        plan: Any = json.loads((folder / PLAN_FILE).read_text(encoding="utf-8"))
        return len(plan.get("content", plan)["joints"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _unproven(folder: Path, lists: Lists) -> int:
    """Return how many files of the session no checksum covers."""
    inner = [folder / DAMAGED, *inner_sessions(folder)]
    return sum(
        p.is_file()
        and p.name != MANIFEST_FILE
        and p.relative_to(folder).as_posix() not in lists.entries
        and not any(i in p.parents for i in inner)
        for p in folder.rglob("*")
    )
