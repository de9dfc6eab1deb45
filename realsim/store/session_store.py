"""A capture session on disk: a folder that any BOP reader can open, plus what BOP has no place for.

    SESSION/
      session.json            camera, depth unit, calibrated camera poses, versions, extra
      session.begun.json      what it was begun with, once more
      scene_camera.json       the same cameras in BOP's form, derived from session.json
      rgb/000000.png  depth/000000.png
      robot.jsonl             one line per view, appended after its images are on the disk
      manifest.jsonl          checksum of every file

A view is complete when its line in robot.jsonl is whole. Killing the process at any moment, a power
cut or a full disk loses at most the view in flight; opening the folder again cleans up and goes on.

The order of `add_view`, each step on the disk before the next begins: the images' bytes, their
names, the line in robot.jsonl (from here on the view counts), the lines in manifest.jsonl, and
scene_camera.json, which only repeats what the others say. `open` does what a kill left undone.
"""

import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim import images
from realsim.arrays import Array32, UInt8, UInt16
from realsim.errors import InputError
from realsim.records import CameraIntrinsics, CaptureSession, View, bop_units
from realsim.store import atomic, opening
from realsim.store.atomic import storing
from realsim.store.header import SESSION_FILE, header_to_open, new_header
from realsim.store.manifest import Fault, Manifest, entry_of
from realsim.store.view_files import (
    RobotLines,
    check_sizes,
    depth_path,
    is_whole,
    record_of,
    rgb_path,
)
from realsim.untrusted.own_json import from_json, read_values, to_json

if TYPE_CHECKING:
    from realsim.store.session_check import CheckReport

__all__ = ["SESSION_FILE", "SessionStore", "depth_path", "rgb_path"]

EAGER_VIEWS = 256
"""Up to so many views scene_camera.json is written anew with each."""
LAZY_GROWTH = 1.1
"""Beyond, it is written when it has grown by this factor, so that a view costs the same however
many there are. The rest is written by the next file, by `close`, or by the next `open`."""


class SessionStore:
    """One session folder; made by `create` or `open`, not directly."""

    def __init__(self, folder: Path, header: dict[str, Any]) -> None:
        """Take over a folder whose session.json has been read; see `open`."""
        self.folder = folder
        self._header: dict[str, Any] = header
        self._manifest = Manifest(folder)
        self._lines = RobotLines(folder / opening.ROBOT_FILE)
        self._robot = self._lines.records
        self._session: CaptureSession | None = None
        self._views: dict[int, View] = {}
        self._camera_lines: dict[int, str] = {}
        self._cameras_written = self._cameras_due = 0
        self._intrinsics = from_json(header["camera"], CameraIntrinsics, "the camera")

    # --- making and opening -------------------------------------------------------------------

    @classmethod
    def create(
        cls, folder: Path | str, session: CaptureSession, extra: dict[str, Any] | None = None
    ) -> "SessionStore":
        """Make the folder of a session that has no views yet.

        Args:
            folder: a folder without a session; made if it does not exist.
            session: name, camera and depth unit; its views are added by `add_view`.
            extra: plain JSON values to keep with the session (plan, devices, ...).

        Raises:
            InputError: there is a session already, or the record brings views without images.
        """
        folder = Path(folder)
        opening.require_free(folder)
        if session.views:
            raise InputError(
                f"session '{session.name}' brings {len(session.views)} views without images; "
                "create it with views=() and give each view with add_view."
            )
        header = new_header(session, extra or {})
        folder.mkdir(parents=True, exist_ok=True)
        store = cls(folder, header)
        with storing(folder, SESSION_FILE):
            store._write_header()
            store._manifest.write(opening.BEGUN_FILE, opening.begun_bytes(header))
            store._write_cameras()
        return store

    @classmethod
    def open(cls, folder: Path | str) -> "SessionStore":
        """Open a session, clean up after a kill, and list what a kill kept off the manifest.

        Raises:
            InputError: no session there, one of a newer format, or a damaged one.
            StorageError: what a kill left undone cannot be written.
        """
        folder = Path(folder)
        path = folder / SESSION_FILE
        opening.require_session(folder)
        header = header_to_open(path)
        with storing(folder, "what an interrupted run left undone"):
            Manifest(folder).finish_interrupted()
            atomic.repair_lines(folder / opening.ROBOT_FILE)
            if path.is_file():  # an interrupted write of the header has been finished by now
                header = header_to_open(path)
            store = cls(folder, header)
            store._finish_interrupted()
        return store

    def _finish_interrupted(self) -> None:
        """Do what a kill between a view's robot line and its manifest lines left undone."""
        listed, path = self._manifest.entries, self.folder / opening.ROBOT_FILE
        data = path.read_bytes() if path.is_file() else b""
        known = listed.get(opening.ROBOT_FILE)
        start = 0 if known is None else known.bytes
        # Only what was appended is listed: a file that was changed stays a fault of `verify`.
        sound = known is None or entry_of(opening.ROBOT_FILE, data[:start]) == known
        if sound:
            new = {int(record_of(line)["index"]) for line in data[start:].decode().splitlines()}
            names = [
                p for i in self._robot for p in self._files_of(i) if i in new or p not in listed
            ]
            names += [opening.ROBOT_FILE] if new else []
            # An image without a checksum is only listed if it is whole: `check` names the others.
            whole = [p for p in names if p == opening.ROBOT_FILE or is_whole(self.folder / p)]
            self._manifest.add(entry_of(p, (self.folder / p).read_bytes()) for p in whole)
        opening.keep_beginning(self.folder, self._header, self._manifest)
        self._camera_lines = {v.index: self._camera_line(v) for v in self.session.views}
        cameras, data = self.folder / opening.CAMERA_FILE, self._camera_bytes()
        is_same = cameras.is_file() and cameras.read_bytes() == data
        is_listed = self._manifest.entries.get(opening.CAMERA_FILE) == entry_of(
            opening.CAMERA_FILE, data
        )
        # A view whose image was deleted keeps its line: no kill does that, and it may come back.
        kept = (p for i in self._robot for p in self._files_of(i) if p in listed)
        sound = sound and all((self.folder / p).is_file() for p in kept)
        if sound and not (is_same and is_listed):
            self._write_cameras()
        self._cameras_written = len(self._camera_lines)

    def close(self) -> None:
        """Write what `add_view` has put off; the store can still be used."""
        self._write_due_cameras()

    def __enter__(self) -> "SessionStore":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- what is there ------------------------------------------------------------------------

    @property
    def session(self) -> CaptureSession:
        """The record of the session with every complete view, calibrated poses included."""
        if self._session is None:
            self._session = CaptureSession(
                name=str(self._header["name"]),
                intrinsics=self._intrinsics,
                views=tuple(self._view(i) for i in sorted(self.completed)),
                depth_unit_m=float(self._header["depth_unit_m"]),
            )
        return self._session

    @property
    def completed(self) -> set[int]:
        """Numbers of the views whose robot line is whole and whose images are there."""
        return {i for i in self._robot if self._is_complete(i)}

    @property
    def incomplete(self) -> list[int]:
        """Numbers of the views whose robot line is whole, and an image of which is missing."""
        return sorted(self._robot.keys() - self.completed)

    def _is_complete(self, index: int) -> bool:
        return index in self._robot and all(
            (self.folder / p).is_file() for p in self._files_of(index)
        )

    @property
    def extra(self) -> dict[str, Any]:
        """What was kept with the session when it was created."""
        return dict(self._header.get("extra", {}))

    @property
    def created(self) -> str:
        """When the session was created (ISO 8601, UTC)."""
        return str(self._header.get("created", ""))

    def _files_of(self, index: int) -> list[str]:
        has_depth = self._robot[index]["depth"]
        return [rgb_path(index), depth_path(index)] if has_depth else [rgb_path(index)]

    def _view(self, index: int) -> View:
        # Kept, because the capture of view 256 should not take longer than that of view 1.
        if index not in self._views:
            record, T = dict(self._robot[index]), self._header["T_world_cam"].get(str(index))
            if T is not None:
                record["T_world_cam"] = T
            where = f"view {index} in {SESSION_FILE} or {opening.ROBOT_FILE} of {self.folder}"
            self._views[index] = from_json(record, View, where)
        return self._views[index]

    # --- images -------------------------------------------------------------------------------

    def add_view(
        self,
        view: View,
        rgb: UInt8,
        depth_m: NDArray[Any] | None = None,
        *,
        depth_counts: UInt16 | None = None,
    ) -> None:
        """Write one view: colour, then depth, then its robot line, then the checksums.

        Args:
            view: number, robot state and time; its T_world_cam is kept where it is known.
            rgb: (H, W, 3) uint8.
            depth_m: (H, W) depth along z [m]; what does not fit into 16 bit becomes 0 = none.
            depth_counts: (H, W) uint16 of the session's depth unit, instead of `depth_m`.

        Raises:
            InputError: the view is there already, or an image does not have the camera's size.
            StorageError: the disk is full, or refuses; the views before are as they were.
        """
        if view.index < 0:
            raise InputError(f"view number {view.index}: a number of 0 or more is needed.")
        if self._is_complete(view.index):
            raise InputError(
                f"view {view.index} is already in {self.folder}; skip what `completed` lists, or "
                "start a new session."
            )
        size = (self._intrinsics.height, self._intrinsics.width)
        check_sizes(view.index, size, rgb, depth_m, depth_counts)
        counts = depth_counts
        if depth_m is not None:
            counts = images.depth_counts(depth_m, float(self._header["depth_unit_m"]))
        files = {rgb_path(view.index): images.png_bytes(rgb)}
        if counts is not None:
            files[depth_path(view.index)] = images.png_bytes(counts)
        entries = [entry_of(path, data) for path, data in files.items()]
        record = to_json(view) | {"depth": counts is not None}
        with storing(self.folder, f"view {view.index}"):
            for path, data in files.items():
                atomic.write_bytes(self.folder / path, data)
            self._lines.append(record)
            self._session = None
            self._views.pop(view.index, None)
            self._camera_lines[view.index] = self._camera_line(self._view(view.index))
            self._cameras_due += 1
            if len(self._camera_lines) <= max(EAGER_VIEWS, LAZY_GROWTH * self._cameras_written):
                # Not flushed: `open` writes it again if a power cut loses it.
                data = self._camera_bytes()
                atomic.write_bytes(self.folder / opening.CAMERA_FILE, data, flush=False)
                entries.append(entry_of(opening.CAMERA_FILE, data))
                self._cameras_written, self._cameras_due = len(self._camera_lines), 0
            # The list of views comes last: where its line is missing, a run was interrupted.
            self._manifest.add_sealed([*entries, self._lines.entry(opening.ROBOT_FILE)])

    def rgb(self, index: int) -> UInt8:
        """Return the colour image (H, W, 3) uint8 of a view."""
        self._require(index)
        return images.read_rgb(self.folder / rgb_path(index))

    def has_depth(self, index: int) -> bool:
        """Return whether the view has a depth image."""
        self._require(index)
        return bool(self._robot[index]["depth"])

    def depth_m(self, index: int) -> Array32:
        """Return the depth image (H, W) float32 [m] of a view, 0 = no measurement.

        Raises:
            InputError: there is no such view, it has no depth, or its file is broken.
        """
        if not self.has_depth(index):
            raise InputError(f"view {index} of {self.folder} was recorded without depth.")
        return images.read_depth(
            self.folder / depth_path(index), float(self._header["depth_unit_m"])
        )

    def _require(self, index: int) -> None:
        if index not in self._robot:
            self.session.view(index)  # raises and names the views that are there

    # --- cameras ------------------------------------------------------------------------------

    def set_cameras(
        self, intrinsics: CameraIntrinsics, Ts_world_cam: Mapping[int, ArrayLike]
    ) -> None:
        """Set the camera and where it stood in the views; views not named keep what they had.

        session.json is replaced first and is what counts; scene_camera.json follows from it.

        Args:
            intrinsics: the camera of all views.
            Ts_world_cam: view number -> (4, 4) camera in world [m].
        """
        poses: dict[str, Any] = dict(self._header["T_world_cam"])
        for index, T in Ts_world_cam.items():
            self._require(index)
            checked = View(index=index, T_world_cam=np.asarray(T, dtype=np.float64)).T_world_cam
            poses[str(index)] = None if checked is None else checked.tolist()
        camera = to_json(intrinsics)
        self._header = {**self._header, "camera": camera, "T_world_cam": poses}
        self._intrinsics = intrinsics
        self._session = None
        self._views.clear()
        self._cameras_due += 1
        self._write_header()
        self._write_due_cameras()

    def _write_header(self) -> None:
        self._manifest.write(SESSION_FILE, atomic.json_bytes(self._header))

    def _camera_line(self, view: View) -> str:
        unit_m = float(self._header["depth_unit_m"])
        entry = bop_units.camera_entry(self._intrinsics, unit_m, view.T_world_cam)
        return f'"{view.index}": {json.dumps(entry, allow_nan=False)}'

    def _camera_bytes(self) -> bytes:
        """Return scene_camera.json, one line per image."""
        lines = [self._camera_lines[i] for i in sorted(self._camera_lines)]
        return ("{\n" + ",\n".join(lines) + "\n}\n").encode("ascii")

    def _write_cameras(self) -> None:
        self._camera_lines = {v.index: self._camera_line(v) for v in self.session.views}
        self._manifest.write(opening.CAMERA_FILE, self._camera_bytes())
        self._cameras_written, self._cameras_due = len(self._camera_lines), 0

    def _write_due_cameras(self) -> None:
        if self._cameras_due:
            with storing(self.folder, opening.CAMERA_FILE):
                self._write_cameras()

    # --- other files --------------------------------------------------------------------------

    def path(self, relative: str) -> Path:
        """Return the full path of a file of the session.

        Raises:
            InputError: the path leads out of the session.
        """
        pure = PurePosixPath(relative)
        if pure.is_absolute() or ".." in pure.parts or not pure.parts:
            raise InputError(
                f"'{relative}' is not a path inside the session; something like "
                "'registration/scene.json' is expected."
            )
        return self.folder / pure

    def has(self, relative: str) -> bool:
        """Return whether the session has this file."""
        return self.path(relative).is_file()

    def write_bytes(self, relative: str, data: bytes) -> None:
        """Write a file whole or not at all, and list its checksum.

        Raises:
            StorageError: the disk is full, or refuses; an earlier file of this name is as it was.
        """
        self.path(relative)  # refuses a path that leads out of the session
        self._write_due_cameras()
        with storing(self.folder, relative):
            self._manifest.write(PurePosixPath(relative).as_posix(), data)

    def write_derived(self, files: Mapping[str, bytes]) -> None:
        """Write files that can be made again from others: many small ones at the price of one.

        Raises:
            StorageError: the disk is full, or refuses; files written before it did stay unlisted.
        """
        for relative in files:
            self.path(relative)  # refuses a path that leads out of the session
        self._write_due_cameras()
        with storing(self.folder, f"{len(files)} files that are made from others"):
            self._manifest.write_derived(
                {PurePosixPath(p).as_posix(): data for p, data in files.items()}
            )

    def write_json(self, relative: str, value: Any) -> None:
        """Write plain JSON values; NaN and infinity are refused."""
        self.write_bytes(relative, atomic.json_bytes(value))

    def remove(self, relative: str) -> None:
        """Take a file away and off the manifest; one that is not there is no error."""
        self.path(relative)  # refuses a path that leads out of the session
        with storing(self.folder, f"the removal of {relative}"):
            self._manifest.remove(PurePosixPath(relative).as_posix())
        self._session = None

    def read_json(self, relative: str) -> Any:
        """Return the values of a JSON file of the session.

        Raises:
            InputError: it is missing or not JSON.
        """
        return read_values(self.path(relative))

    def write_npz(self, relative: str, **arrays: ArrayLike) -> None:
        """Write arrays as npz; the same arrays give the same bytes."""
        self.write_bytes(relative, atomic.npz_bytes(**arrays))

    def write_image(self, relative: str, image: NDArray[Any]) -> None:
        """Write (H, W, 3) uint8 RGB, or (H, W) uint8, bool or uint16, as PNG."""
        self.write_bytes(relative, images.png_bytes(image))

    def read_image(self, relative: str) -> NDArray[Any]:
        """Return an image of the session as it was written: RGB, grey or 16 bit; masks as 0/255."""
        return images.read_image(self.path(relative))

    def is_as_written(self, relative: str) -> bool:
        """Return whether a file that is there has the bytes that were listed, if any were."""
        return self._manifest.is_as_written(PurePosixPath(relative).as_posix())

    def verify(self) -> list[Fault]:
        """Return every listed file that is missing or does not have the bytes that were written."""
        return self._manifest.verify()

    def stored_faults(self) -> list[Fault]:
        """Return the images of stored views that are gone or not of the size that was listed.

        Only names and sizes are compared, which costs nothing; `verify` reads every byte.
        """
        paths = [p for i in sorted(self._robot) for p in self._files_of(i)]
        return opening.stored_faults(self.folder, paths, self._manifest.entries)

    def check(self) -> "CheckReport":
        """Return what is sound, missing or damaged in the session's folder; nothing is changed."""
        from realsim.store.session_check import check_session

        return check_session(self.folder)
