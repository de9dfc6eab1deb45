"""Take out of a session what is damaged, and nothing else; nothing is deleted.

Damaged files move to `damaged/` in the session. A view that lost an image or its robot line counts
as not captured, so that the command that captured it takes it again. The order is such that a kill
leaves a session that can be repaired again.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim import images
from realsim.errors import InputError, RealsimError
from realsim.records import CaptureSession, bop_units
from realsim.store import atomic, session_check
from realsim.store.header import SESSION_FILE, checked_header, new_header
from realsim.store.manifest import NAME as MANIFEST_FILE
from realsim.store.manifest import Manifest, entry_from, entry_of
from realsim.store.opening import BEGUN_FILE, CAMERA_FILE, RECOVERED, ROBOT_FILE, read_begun
from realsim.store.session_store import SessionStore
from realsim.store.view_files import CHECK, depth_path, record_of, rgb_path
from realsim.untrusted.own_json import read_object

LENS = ("camera", "depth_unit_m")
"""What a calibration changes after the beginning."""
DERIVED = ("calibration/", "registration/", "grasps/", "annotations/", "mask/", "reports/")
"""Results: a step writes them again."""
SHOWN = 8
"""Names that a note gives."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RepairReport:
    """What a repair did to one session, and to the sessions inside it."""

    before: session_check.CheckReport
    after: session_check.CheckReport
    dropped_views: tuple[int, ...]
    """Views that count as not captured from now on."""
    moved: tuple[tuple[str, str], ...]
    """(file, where it went), relative to the session."""
    notes: tuple[str, ...]
    """What a person should know or do."""
    inner: tuple["RepairReport", ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        return {
            "before": self.before.to_json(),
            "after": self.after.to_json(),
            "dropped_views": list(self.dropped_views),
            "moved": [list(pair) for pair in self.moved],
            "notes": list(self.notes),
            "inner": [r.to_json() for r in self.inner],
        }


class _Repair:
    """One repair, step by step."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.moved: list[tuple[str, str]] = []
        self.notes: list[str] = []

    def _place(self, path: str) -> Path:
        """Return a free name for a file in the folder of damaged files."""
        target, count = self.folder / session_check.DAMAGED / path, 0
        while target.exists():
            count += 1
            target = self.folder / session_check.DAMAGED / f"{path}.{count}"
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def keep_copy(self, path: str) -> None:
        """Copy a file that is about to be rewritten to the damaged ones."""
        target = self._place(path)
        atomic.write_bytes(target, (self.folder / path).read_bytes())
        self.moved.append((path, target.relative_to(self.folder).as_posix()))

    def move(self, path: str) -> None:
        """Move a file to the damaged ones; one that is not there is no error."""
        if (self.folder / path).is_file():
            target = self._place(path)
            os.replace(self.folder / path, target)
            self.moved.append((path, target.relative_to(self.folder).as_posix()))

    def header(self) -> None:
        """Make session.json anew from its copy of the beginning, BOP's file and an image."""
        begun = read_begun(self.folder)
        header = _recovered_header(self.folder, begun)
        told = header | _still_told(self.folder) if begun is None else header
        self.move(SESSION_FILE)
        atomic.write_json(self.folder / SESSION_FILE, told)
        if begun is not None:
            self.notes.append(
                f"{SESSION_FILE} was made anew: name, arm, camera, lab and plan from {BEGUN_FILE}, "
                f"the lens and the camera poses from {CAMERA_FILE}."
            )
            return
        self.notes.append(
            f"{SESSION_FILE} was made anew from {CAMERA_FILE}, an image, the plan and the capture "
            "log: the lens, the depth unit, camera poses and the plan's hash are what they were; "
            "the rest (name, arm, camera, lab) is what could still be read, or is lost. Compare "
            "with a copy if there is one."
        )
        if told["extra"].get(RECOVERED):
            self.notes.append(
                "which arm, camera and lab the session was begun with is not known for certain: "
                "capture adds no views to it until somebody says so (it tells how)."
            )

    def manifest(self) -> Manifest:
        """Take damaged lines out of the manifest."""
        path = self.folder / MANIFEST_FILE
        if lines := atomic.complete_lines(path):
            sound = [line for line in lines if _is_entry(line)]
            if len(sound) < len(lines):
                self.keep_copy(MANIFEST_FILE)
                atomic.write_text(path, "".join(line + "\n" for line in sound))
        else:
            self.notes.append(
                f"{MANIFEST_FILE} was lost: the files are listed as they are now; whether they "
                "changed before, nothing can tell."
            )
        return Manifest(self.folder)

    def robot(self, dropped: set[int], manifest: Manifest) -> None:
        """Take damaged lines and those of dropped views out of robot.jsonl."""
        path = self.folder / ROBOT_FILE
        lines = atomic.complete_lines(path)
        if atomic.repair_lines(path):
            self.notes.append(f"half a line at the end of {ROBOT_FILE} was cut off.")
        kept = [line for line in lines if _is_kept(line, dropped)]
        listed = manifest.entries.get(ROBOT_FILE)
        if len(kept) < len(lines):
            self.keep_copy(ROBOT_FILE)
            manifest.write(ROBOT_FILE, "".join(line + "\n" for line in kept).encode())
        elif listed is not None and lines:
            data = path.read_bytes()
            if entry_of(ROBOT_FILE, data[: listed.bytes]) == listed:
                return
            if all(f'"{CHECK}"' in line for line in lines):
                manifest.add([entry_of(ROBOT_FILE, data)])
            else:
                self.notes.append(
                    f"{ROBOT_FILE} is not what was written, and its lines carry no checksums that "
                    "would tell which. Restore it from a copy; it was left as it is."
                )
        elif listed is not None:
            manifest.forget(ROBOT_FILE)

    def list_anew(self, before: session_check.CheckReport) -> None:
        """List the session's own files that no checksum covers, and say which they are."""
        lost = any(f.path == MANIFEST_FILE and f.kind == "missing" for f in before.findings)
        orphans = set(before.paths("unlisted"))
        there = [
            p for p in before.unproven
            if session_check.is_own(p) and p not in orphans and (self.folder / p).is_file()
        ]  # fmt: skip
        manifest = Manifest(self.folder)
        manifest.add(
            entry_of(p, (self.folder / p).read_bytes())
            for p in there
            if p not in manifest.entries and not session_check.is_image(p)
        )
        if there and not lost:
            named = ", ".join(there[:SHOWN]) + (", ..." if len(there) > SHOWN else "")
            self.notes.append(
                f"{len(there)} files had no checksum and are listed as they are now: {named}. "
                "Whether they changed before, nothing can tell."
            )

    def poses(self, dropped: set[int], manifest: Manifest) -> None:
        """Forget the calibrated poses of dropped views: the new ones will stand elsewhere."""
        header = checked_header(self.folder / SESSION_FILE)
        poses = {k: T for k, T in header["T_world_cam"].items() if int(k) not in dropped}
        header = {**header, "T_world_cam": poses}
        data = atomic.json_bytes(header)
        if manifest.entries.get(SESSION_FILE) != entry_of(SESSION_FILE, data):
            manifest.write(SESSION_FILE, data)


def repair_session(folder: Path | str) -> RepairReport:
    """Take out what is damaged in a session and in the sessions inside it.

    Raises:
        InputError: session.json is damaged and nothing is left to make it from.
        StorageError: the disk is full.
    """
    folder = Path(folder)
    with atomic.storing(folder, "the repaired lists"):
        before = session_check.check_session(folder)
        repair = _Repair(folder)
        dropped = set(before.damaged_views)
        damaged = {f.path for f in before.findings if f.is_damage}
        if any(f.is_damage for f in before.findings):
            if SESSION_FILE in damaged:
                repair.header()
            manifest = repair.manifest()
            repair.robot(dropped, manifest)
            for index in sorted(dropped):
                for path in (rgb_path(index), depth_path(index)):
                    repair.move(path)
                    manifest.forget(path)
            for path in sorted(damaged - {SESSION_FILE, MANIFEST_FILE, ROBOT_FILE}):
                repair.move(path)
                manifest.forget(path)
            repair.poses(dropped, manifest)
        SessionStore.open(folder)
        repair.list_anew(before)
        inner = tuple(repair_session(p.folder) for p in before.inner)
        _advise(repair, before, dropped, damaged)
        return RepairReport(
            before=before,
            after=session_check.check_session(folder),
            dropped_views=tuple(sorted(dropped)),
            moved=tuple(repair.moved),
            notes=tuple(repair.notes),
            inner=inner,
        )


def _advise(
    repair: _Repair, before: session_check.CheckReport, dropped: set[int], damaged: set[str]
) -> None:
    """Say what is to be done about what was taken out."""
    if dropped:
        named = ", ".join(map(str, sorted(dropped)[:12])) + ("..." if len(dropped) > 12 else "")
        repair.notes.append(
            f"views {named} count as not captured: the command that captured the session takes "
            "them again. Calibrate and register anew if they were used."
        )
    results = sorted(p for p in damaged if p.startswith(DERIVED))
    if results:
        repair.notes.append(
            f"results were taken out ({', '.join(results[:4])}{'...' if len(results) > 4 else ''})"
            ": run the steps that write them again."
        )
    if session_check.PLAN_FILE in damaged:
        repair.notes.append(
            f"{session_check.PLAN_FILE} was taken out: capturing with the same plan writes it."
        )


def _is_entry(line: str) -> bool:
    try:
        entry_from(line)
    except ValueError:
        return False
    return True


def _is_kept(line: str, dropped: set[int]) -> bool:
    try:
        return int(record_of(line)["index"]) not in dropped
    except ValueError:
        return False


def _recovered_header(folder: Path, begun: dict[str, Any] | None) -> dict[str, Any]:
    """Return what can be known of a lost session.json.

    Args:
        folder: the session.
        begun: the header that it was begun with, if that is known.

    Raises:
        InputError: nothing is left to make it from.
    """
    if begun is not None and not session_check.read_lists(folder).records:
        return begun | {"T_world_cam": {}}  # without views, nothing has changed since
    rgb = next(iter(sorted((folder / "rgb").glob("*.png"))), None)
    try:
        cameras = read_object(folder / CAMERA_FILE)
        if rgb is None or not cameras:
            raise InputError(f"{folder} holds no view")
        entry = next(iter(cameras.values()))
        width, height = images.image_size(rgb)
        session = CaptureSession(
            name=folder.resolve().name,
            intrinsics=bop_units.intrinsics_of(entry, width, height, CAMERA_FILE),
            depth_unit_m=bop_units.depth_unit_of(entry, CAMERA_FILE),
        )
        Ts = {k: bop_units.T_world_cam_of(e, f"{CAMERA_FILE}, {k}") for k, e in cameras.items()}
    except (RealsimError, AttributeError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder / SESSION_FILE} is damaged, and {CAMERA_FILE}, from which it could be made "
            f"anew, is of no use ({error}). Restore one of the two from a copy; images and "
            f"{ROBOT_FILE} were not touched."
        ) from error
    header = new_header(session, {RECOVERED: True} | _plan_hash(folder) | _devices(folder))
    if begun is not None:
        header |= {key: value for key, value in begun.items() if key not in LENS}
    header["T_world_cam"] = {k: T.tolist() for k, T in Ts.items() if T is not None}
    return header


def _devices(folder: Path) -> dict[str, Any]:
    """Return what the capture log's first run says of arm and camera."""
    begun = next((e for e in session_check.log_entries(folder) if e.get("event") == "begun"), {})
    return {f"{key}_description": begun[key] for key in ("arm", "camera") if key in begun}


def _still_told(folder: Path) -> dict[str, Any]:
    """Return what a damaged header that can be read says beside cameras and depth."""
    try:
        old = checked_header(folder / SESSION_FILE)
    except RealsimError:
        return {}
    return {key: old[key] for key in ("name", "created", "extra", "versions") if key in old}


def _plan_hash(folder: Path) -> dict[str, str]:
    """Return the hash of the session's plan as captures note it, if there is a plan."""
    try:
        return {"plan_hash": str(read_object(folder / session_check.PLAN_FILE)["sha256"])}
    except (RealsimError, KeyError):
        return {}
