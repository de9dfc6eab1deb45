"""Write a frame source into a session: one frame at a time, going on after a kill, checked.

A frame that is in the session is whole. The same source goes on where it stopped, which a key of
its content and the pixels of the last frame prove; another source is refused.
"""

import hashlib
import itertools
import json
import shutil
import time
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console, Tick
from realsim.errors import InputError, UnitError
from realsim.formats.folders.listing import shown
from realsim.formats.frame_source import FrameSource, SourceFrame
from realsim.records import CaptureSession, View
from realsim.store.atomic import only_run_in
from realsim.store.opening import finish_beginning
from realsim.store.session_store import SESSION_FILE, SessionStore
from realsim.untrusted.own_json import to_json
from realsim_capture_plans.capturing.contact_sheet import Thumbnails, cell_size, write_contact_sheet

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Sequence

    from realsim.formats.labelled_scene import LabelledScene

IMPORTED = ("rgb", "depth", "models", "imported")
"""Folders of a session that hold nothing but what an import writes."""
KEY = "import"
"""Entry of the session's extra under which the source is described."""
KEY_IN_SOURCE = "content_key"
"""Entry of a source's extra that stands for its content, wherever it lies."""
NO_DEPTH_UNIT_M = 0.001
"""Unit of a session without depth; nothing is stored in it, and the record wants a number."""
LONGEST_REACH_M = 5.0
"""A flange farther from its base than this is in millimetres: the largest arms reach 4.7 m."""
FARTHEST_CAMERA_M = 1000.0
"""A camera farther from the world's origin was written in millimetres or finer."""
SAME_PLACE_M = 1e-3
"""Cameras that all lie this close together and turn were divided by 1000 once too often."""
TURN_RAD = 0.1
"""From this turn on a camera in the hand moves noticeably."""
MIN_FOR_UNIT = 3
"""Fewer camera poses say nothing about the unit."""
LEAST_FILLED = 0.01
"""A depth image with a smaller share of measured pixels is as good as none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImportSummary:
    """What an import did and what the session holds."""

    folder: Path
    """The session."""
    frames: int
    """Frames in the session."""
    imported: int
    """Frames that this call wrote; the others were there."""
    with_depth: int
    """Frames with a depth image; an empty one that this call wrote does not count."""
    with_joints: int
    with_tool_pose: int
    with_camera_pose: int
    time_span_s: float
    """From the first to the last time stamp [s]; frame numbers where the source has no clock."""
    seconds: float
    """Wall time [s]."""
    notes: tuple[str, ...]
    """The source's notes."""
    contact_sheet: Path
    """Picture of all frames."""


def import_session(
    source: FrameSource, folder: Path, console: Console, *, overwrite: bool = False,
    whole: bool = False, labels: "tuple[LabelledScene, tuple[int, ...]] | None" = None,
) -> ImportSummary:  # fmt: skip
    """Write a frame source into a session and say what it holds.

    Args:
        source: the recording or folder.
        folder: the session; made if needed. An import of the same source goes on.
        console: where progress, notes and the table go.
        overwrite: replace a session that an earlier import made, once the new one is whole.
        whole: whether a session that this call began is taken away where a frame or a label is
            refused: a source that is mended is another one, and would not go on with it.
        labels: the data set's scene and the numbers of its images, in the order of the views.

    Raises:
        InputError: the folder holds something else, a frame cannot be read or has another size, or
            time stamps do not increase. What was imported until then stays, but for `whole` and
            `overwrite`.
        UnitError: poses are not in metres.
    """
    from realsim.app.importing.labels import save_labels, show_labels

    started = time.perf_counter()
    if not len(source):
        raise InputError(f"{source.name} has no frames. {' '.join(source.notes)}")
    key = content_key(source)
    folder = Path(folder)
    aside = folder.with_name(f".{folder.name}.replaced")
    if aside.is_dir():  # a kill came between the renames
        _put_away(aside, folder, console) if folder.exists() else aside.rename(folder)
    is_replaced = _is_replaced(folder, source, key, overwrite=overwrite)
    with _place_for(folder, console, is_replaced=is_replaced, whole=whole) as place:
        console.warn(*source.notes)
        store = _opened(place, source, key)
        try:
            done = len(store.completed)
            if done:
                console.say(f"{done} of {len(source)} frames are in {folder} already: going on.")
            size = (source.intrinsics.width, source.intrinsics.height)
            taken = Thumbnails(cell_size(len(source), size)[1:])
            with console.stage("import", source.name) as tick:
                empty = _write_frames(source, store, done, tick, taken)
            _warn_of_unit(store, console)
            sheet = folder / write_contact_sheet(store, len(source), source.name, taken)
            are_new = labels is not None and save_labels(*labels, store, console)
            summary = _summary(source, store, done, folder, sheet)
        finally:
            store.close()
    seconds = time.perf_counter() - started
    summary = replace(summary, with_depth=summary.with_depth - len(empty), seconds=seconds)
    show_import(summary, console)
    _warn_of_depth(summary, empty, console)
    if labels is not None and are_new:
        show_labels(*labels, folder, console, can_register=summary.with_depth > 0)
    return summary


def content_key(source: FrameSource) -> str:
    """Return a digest that stands for a source's content, wherever it lies.

    It is of the camera, the depth unit, the number of frames, and the source's own content key, or
    of all that its extra says where it has none.
    """
    extra = source.extra
    content: Any = extra.get(KEY_IN_SOURCE)
    if content is None:
        content = {k: v for k, v in extra.items() if k not in ("path", "source")}
    values = {
        "camera": to_json(source.intrinsics),
        "depth_unit_m": source.depth_unit_m,
        "frames": len(source),
        "content": content,
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@contextmanager
def _place_for(
    folder: Path, console: Console, *, is_replaced: bool, whole: bool
) -> "Generator[Path]":
    """Yield where to write: the session's folder, or one beside it that then takes its place.

    An earlier session that holds a file which the new one has not is kept beside it.

    Raises:
        InputError: the import was refused; says what stays.
    """
    aside = folder.with_name(f".{folder.name}.replaced")
    folder.mkdir(parents=True, exist_ok=True)
    place = folder.with_name(f".{folder.name}.new") if is_replaced else folder
    is_new = not (place / SESSION_FILE).is_file()
    with only_run_in(folder):
        try:
            if is_replaced:
                shutil.rmtree(place, ignore_errors=True)
                place.mkdir()
            yield place
            if is_replaced:
                folder.rename(aside)
                place.rename(folder)
                _put_away(aside, folder, console)
        except InputError as error:
            stays = f"The frames that are there stay in {folder}."
            if is_replaced:
                stays = f"The earlier import in {folder} stays as it was."
            elif whole and is_new:
                shutil.rmtree(folder, ignore_errors=True)
                stays = f"Nothing was kept in {folder}."
            raise type(error)(f"{error} {stays}") from error
        finally:
            if is_replaced:
                shutil.rmtree(place, ignore_errors=True)


def _put_away(aside: Path, folder: Path, console: Console) -> None:
    """Take an earlier session away, or keep it where it holds what no import writes."""
    names = (f"{folder.name}.before{k if k > 1 else ''}" for k in itertools.count(1))
    kept = next(path for name in names if not (path := folder.with_name(name)).exists())
    old, new = ({p.relative_to(f) for p in f.rglob("*") if p.is_file()} for f in (aside, folder))
    lost = sorted(p.as_posix() for p in old - new if p.parts[0] not in IMPORTED)
    if not lost:
        shutil.rmtree(aside)
        return
    aside.rename(kept)
    console.warn(
        f"the session that was in {folder} is kept as {kept}: it holds {len(lost)} files that the "
        f"new one has not ({shown(lost)})."
    )


def _is_replaced(folder: Path, source: FrameSource, key: str, *, overwrite: bool) -> bool:
    """Check that the folder may hold this import; return whether an earlier one has to go.

    Raises:
        InputError: it is a file, holds other things, or another session.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; the folder of a session is expected.")
    finish_beginning(folder)
    if not folder.is_dir() or not any(p for p in folder.iterdir()):
        return False
    if not (folder / SESSION_FILE).is_file():
        found = ", ".join(sorted(p.name for p in folder.iterdir())[:6])
        raise InputError(
            f"{folder} is not empty and holds no session ({found}). Choose a new folder, so that "
            "nothing is mixed."
        )
    store = SessionStore.open(folder)
    store.close()
    imported: Any = store.extra.get(KEY)
    if not isinstance(imported, dict):
        raise InputError(
            f"{folder} holds the session '{store.session.name}', which was captured and not "
            "imported: it is never replaced. Choose another folder."
        )
    is_same = imported.get("key") == key
    is_whole = len(store.completed) == len(source)
    if is_same and not (overwrite and is_whole):
        return False
    if not overwrite:
        raise InputError(
            f"{folder} holds the import of another source: '{store.session.name}' from "
            f"{imported.get('path', 'elsewhere')}, {len(store.completed)} frames; "
            f"'{source.name}' has {len(source)} frames, or its files, camera or options have "
            "changed. Choose another folder, or replace that import with --overwrite."
        )
    return True


def _opened(folder: Path, source: FrameSource, key: str) -> SessionStore:
    """Return the session to write into: the one that was begun, or a new one."""
    if (folder / SESSION_FILE).is_file():
        return SessionStore.open(folder)
    session = CaptureSession(
        name=source.name,
        intrinsics=source.intrinsics,
        depth_unit_m=source.depth_unit_m or NO_DEPTH_UNIT_M,
    )
    described = {**source.extra, "key": key, "notes": list(source.notes)}
    return SessionStore.create(folder, session, extra={KEY: described})


def _write_frames(
    source: FrameSource, store: SessionStore, done: int, tick: Tick, taken: Thumbnails
) -> list[str]:
    """Write the frames that are missing; the last one that is there must be the source's own.

    Returns:
        Those whose depth is empty.
    """
    if store.completed != set(range(done)):
        gap = min(set(range(done)) - store.completed)
        raise InputError(
            f"view {gap} of {store.folder} is gone, and later ones are there: an import has no "
            "gaps. Repair the session, or import again with --overwrite."
        )
    if done == len(source):
        tick(done, len(source))
        return []
    frames: Iterator[SourceFrame] = source.frames(max(done - 1, 0))
    last_s = -np.inf
    if done:
        first = next(frames, None)
        if first is None or not np.array_equal(first.rgb, store.rgb(done - 1)):
            raise InputError(
                f"frame {done - 1} of '{source.name}' is not the picture that {store.folder} holds "
                "as its last: the source has changed since. Import again with --overwrite."
            )
        last_s = first.time_s
    index = done
    empty: list[str] = []
    for frame in frames:
        _check(frame, index, last_s, source)
        _add(store, index, frame)
        taken.add(index, frame.rgb)
        counts = frame.depth_counts
        if counts is not None and np.count_nonzero(counts) < LEAST_FILLED * counts.size:
            empty.append(frame.name)
        last_s = frame.time_s
        index += 1
        tick(index, len(source))
    if index != len(source):
        raise InputError(
            f"'{source.name}' announced {len(source)} frames and gave {index}: it is cut off or "
            "still being written."
        )
    return empty


def _check(frame: SourceFrame, index: int, last_s: float, source: FrameSource) -> None:
    """Raise if a frame cannot be of this session."""
    where = f"frame {index} ({frame.name})"
    size = (source.intrinsics.height, source.intrinsics.width)
    if not np.isfinite(frame.time_s) or frame.time_s <= last_s:
        raise InputError(
            f"{where} has the time stamp {frame.time_s:.6f} s, the frame before it {last_s:.6f} s: "
            "time stamps must increase. Was the clock set back, or are two recordings in one?"
        )
    counts = frame.depth_counts
    if frame.rgb.shape != (*size, 3) or (counts is not None and counts.shape != size):
        found = frame.rgb.shape if counts is None else (frame.rgb.shape, counts.shape)
        raise InputError(
            f"{where} has the shape {found}; the camera is of {size[1]}x{size[0]} px. Images of "
            "another size belong to a session of their own."
        )
    if counts is not None and source.depth_unit_m is None:
        raise InputError(f"{where} has depth, but what a count is has not been said.")
    T = frame.T_base_ee
    if T is not None and np.linalg.norm(T[:3, 3]) > LONGEST_REACH_M:
        raise UnitError(
            f"{where}: the flange would be {np.linalg.norm(T[:3, 3]):.4g} m from the robot's base, "
            f"at most {LONGEST_REACH_M:g} m is accepted. Are the poses in millimetres? Say so, "
            "such as --reading rotvec,mm."
        )
    T = frame.T_world_cam
    if T is not None and np.linalg.norm(T[:3, 3]) > FARTHEST_CAMERA_M:
        raise UnitError(
            f"{where}: the camera would be {np.linalg.norm(T[:3, 3]):.4g} m from the world's "
            f"origin, at most {FARTHEST_CAMERA_M:g} m is accepted. Are the poses in millimetres? "
            "Divide the translations by 1000."
        )


def _add(store: SessionStore, index: int, frame: SourceFrame) -> None:
    """Write one frame; its camera pose goes into the view's own record."""
    view = View(
        index=index, time_s=frame.time_s, joints=frame.joints,
        T_base_ee=frame.T_base_ee, T_world_cam=frame.T_world_cam,
    )  # fmt: skip
    store.add_view(view, frame.rgb, depth_counts=frame.depth_counts)


def _warn_of_unit(store: SessionStore, console: Console) -> None:
    """Say it where the cameras turn but stand in one place: metres taken for millimetres."""
    Ts = store.session.Ts_world_cam
    if len(Ts) < MIN_FOR_UNIT:
        return
    stack = np.array(list(Ts.values()))
    extent = float(np.ptp(stack[:, :3, 3], axis=0).max())
    cosine = (np.einsum("ij,nij->n", stack[0, :3, :3], stack[:, :3, :3]) - 1) / 2
    turn = float(np.arccos(np.clip(cosine, -1, 1)).max())
    if turn > TURN_RAD and extent < SAME_PLACE_M:
        console.warn(
            f"the cameras of {len(Ts)} views turn by up to {np.degrees(turn):.0f} deg but stand "
            f"within {1e3 * extent:.3g} mm: are the positions metres in a file of millimetres?"
        )


def _warn_of_depth(summary: ImportSummary, empty: "Sequence[str]", console: Console) -> None:
    """Say it where depth images are empty, and where there is nothing to register by."""
    if empty:
        console.warn(
            f"depth images that are empty (at least {100 * (1 - LEAST_FILLED):.0f} % of the pixels "
            f"are 0): {len(empty)}, of {shown(empty)}. Was the depth stream running?"
        )
    if not summary.with_depth:
        console.warn(
            f"{summary.folder} has no depth, and `realsim register` needs it. Give the source depth"
            " images on the colour's pixels, and import with --overwrite. Without depth `realsim "
            f"calibrate` (on photographs of a board) and `realsim scan sfm {summary.folder}` work."
        )


def _summary(
    source: FrameSource, store: SessionStore, done: int, folder: Path, sheet: Path
) -> ImportSummary:
    views = store.session.views
    times = [v.time_s for v in views]
    return ImportSummary(
        folder=folder, frames=len(views), imported=len(views) - done,
        with_depth=sum(store.has_depth(v.index) for v in views),
        with_joints=sum(v.joints is not None for v in views),
        with_tool_pose=sum(v.T_base_ee is not None for v in views),
        with_camera_pose=len(store.session.Ts_world_cam),
        time_span_s=max(times) - min(times), seconds=0.0, notes=tuple(source.notes),
        contact_sheet=sheet,
    )  # fmt: skip


def show_import(summary: ImportSummary, console: Console) -> None:
    """Print what the session holds, and what to do with it."""
    rows: list[tuple[str, object]] = [
        ("frames", f"{summary.frames} ({summary.imported} now)"),
        ("with depth", summary.with_depth),
        ("with joints", summary.with_joints),
        ("with tool pose", summary.with_tool_pose),
        ("with camera pose", summary.with_camera_pose),
        ("first to last [s or frames]", f"{summary.time_span_s:.3f}"),
        ("time [s]", f"{summary.seconds:.1f}"),
        ("contact sheet", summary.contact_sheet.relative_to(summary.folder)),
    ]
    console.table(f"imported into {summary.folder}", ("", ""), rows)
