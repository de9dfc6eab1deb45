"""A capture session on disk: a folder that any BOP reader can open, plus what BOP has no place for.

    SESSION/
      session.json            camera, depth unit, calibrated camera poses, versions, extra
      scene_camera.json       the same cameras in BOP's form, derived from session.json
      rgb/000000.png  depth/000000.png
      robot.jsonl             one line per view, appended after its images are on the disk
      manifest.jsonl          checksum of every file

A view is complete when its line in robot.jsonl is whole. Killing the process at any moment loses at
most the view in flight; opening the folder again cleans up and goes on.
"""

import json
import platform
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.formats import bop_units, images
from realsim.records import CameraIntrinsics, CaptureSession, View
from realsim.store import atomic, records_json
from realsim.store.manifest import Fault, Manifest, entry_of

Array = NDArray[np.float64]

FORMAT = "realsim session"
FORMAT_VERSION = 1
SESSION_FILE = "session.json"
CAMERA_FILE = "scene_camera.json"
ROBOT_FILE = "robot.jsonl"
VERSIONS_OF = ("realsim", "numpy", "opencv-python-headless")


def rgb_path(index: int) -> str:
    """Return where the colour image of a view is, relative to the session."""
    return f"rgb/{index:06d}.png"


def depth_path(index: int) -> str:
    """Return where the depth image of a view is, relative to the session."""
    return f"depth/{index:06d}.png"


class SessionStore:
    """One session folder; made by `create` or `open`, not directly."""

    def __init__(self, folder: Path, header: dict[str, Any]) -> None:
        """Take over a folder whose session.json has been read; see `open`."""
        self.folder = folder
        self._header: dict[str, Any] = header
        self._manifest = Manifest(folder)
        self._robot = _read_robot_lines(folder / ROBOT_FILE)
        self._session: CaptureSession | None = None
        self._views: dict[int, View] = {}
        self._camera_lines: dict[int, str] = {}

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
        if (folder / SESSION_FILE).exists():
            raise InputError(
                f"{folder} already holds a session. Open it to go on with it, or choose another "
                "folder."
            )
        if session.views:
            raise InputError(
                f"session '{session.name}' brings {len(session.views)} views without images; "
                "create it with views=() and give each view with add_view."
            )
        header: dict[str, Any] = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "name": session.name,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "units": {"length": "m", "angle": "rad", "time": "s", "scene_camera.json": "mm"},
            "camera": records_json.intrinsics_to_json(session.intrinsics),
            "depth_unit_m": session.depth_unit_m,
            "T_world_cam": {},
            "versions": _versions(),
            "extra": extra or {},
        }
        folder.mkdir(parents=True, exist_ok=True)
        store = cls(folder, header)
        store._write_header()
        store._write_cameras()
        return store

    @classmethod
    def open(cls, folder: Path | str) -> "SessionStore":
        """Open a session, clean up after a kill, and list what a kill kept off the manifest.

        Raises:
            InputError: no session there, or one of a newer format.
        """
        folder = Path(folder)
        path = folder / SESSION_FILE
        if not path.is_file():
            raise InputError(
                f"{folder} holds no session: {SESSION_FILE} is not there. The folder of a capture "
                "session is expected; a BOP dataset is read by realsim.formats.bop."
            )
        header = _read_object(path)
        if header.get("format") != FORMAT or not isinstance(header.get("format_version"), int):
            raise InputError(
                f"{path} is not the header of a '{FORMAT}': it says format "
                f"{header.get('format')!r}, version {header.get('format_version')!r}."
            )
        if header["format_version"] > FORMAT_VERSION:
            raise InputError(
                f"{path} has format version {header['format_version']}; this realsim reads up to "
                f"{FORMAT_VERSION}. Use a newer realsim."
            )
        Manifest(folder).finish_interrupted()
        atomic.repair_lines(folder / ROBOT_FILE)
        store = cls(folder, _read_object(path))
        store._finish_interrupted()
        return store

    def _finish_interrupted(self) -> None:
        """Do what a kill between a view's robot line and its manifest lines left undone."""
        path = self.folder / ROBOT_FILE
        lines = path.read_bytes() if path.is_file() else b""
        listed = self._manifest.entries.get(ROBOT_FILE)
        unlisted = lines[0 if listed is None else listed.bytes :]
        if unlisted:
            views = [int(json.loads(line)["index"]) for line in unlisted.splitlines()]
            names = [p for i in views for p in self._files_of(i)] + [ROBOT_FILE]
            present = [p for p in names if (self.folder / p).is_file()]
            self._manifest.add(entry_of(p, (self.folder / p).read_bytes()) for p in present)
        cameras = self.folder / CAMERA_FILE
        if not cameras.is_file() or cameras.read_bytes() != self._camera_bytes():
            self._write_cameras()

    # --- what is there ------------------------------------------------------------------------

    @property
    def session(self) -> CaptureSession:
        """The record of the session with every complete view, calibrated poses included."""
        if self._session is None:
            self._session = CaptureSession(
                name=str(self._header["name"]),
                intrinsics=records_json.intrinsics_from_json(self._header["camera"]),
                views=tuple(self._view(i) for i in sorted(self.completed)),
                depth_unit_m=float(self._header["depth_unit_m"]),
            )
        return self._session

    @property
    def completed(self) -> set[int]:
        """Numbers of the views whose robot line is whole and whose images are there."""
        return {
            i for i in self._robot if all((self.folder / p).is_file() for p in self._files_of(i))
        }

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
            view = records_json.view_from_json(self._robot[index])
            T = self._header["T_world_cam"].get(str(index))
            if T is not None:
                view = replace(view, T_world_cam=np.asarray(T))
                view = records_json.exactly(
                    view, T_base_ee=self._robot[index]["T_base_ee"], T_world_cam=T
                )
            self._views[index] = view
        return self._views[index]

    # --- images -------------------------------------------------------------------------------

    def add_view(
        self, view: View, rgb: NDArray[np.uint8], depth_m: NDArray[Any] | None = None
    ) -> None:
        """Write one view: colour, then depth, then its robot line, then the checksums.

        Args:
            view: number, robot state and time; its T_world_cam is kept where it is known.
            rgb: (H, W, 3) uint8.
            depth_m: (H, W) depth along z [m]; what does not fit into 16 bit becomes 0 = none.

        Raises:
            InputError: the view is there already, or an image does not have the camera's size.
        """
        if view.index < 0:
            raise InputError(f"view number {view.index}: a number of 0 or more is needed.")
        if view.index in self.completed:
            raise InputError(
                f"view {view.index} is already in {self.folder}; skip what `completed` lists, or "
                "start a new session."
            )
        camera = self.session.intrinsics
        size = (camera.height, camera.width)
        found = rgb.shape[:2] if depth_m is None else (*rgb.shape[:2], *depth_m.shape)
        if found not in (size, size + size) or rgb.ndim != 3:
            raise InputError(
                f"view {view.index}: colour {rgb.shape} and depth "
                f"{None if depth_m is None else depth_m.shape} do not have the camera's size "
                f"{size} (height, width)."
            )
        files = {rgb_path(view.index): images.png_bytes(rgb)}
        if depth_m is not None:
            counts = images.depth_counts(depth_m, self.session.depth_unit_m)
            files[depth_path(view.index)] = images.png_bytes(counts)
        for path, data in files.items():
            atomic.write_bytes(self.folder / path, data)
        record = records_json.view_to_json(view) | {"depth": depth_m is not None}
        atomic.append_line(self.folder / ROBOT_FILE, json.dumps(record, allow_nan=False))
        self._robot[view.index] = record
        self._session = None
        self._views.pop(view.index, None)
        self._camera_lines.pop(view.index, None)
        files[ROBOT_FILE] = (self.folder / ROBOT_FILE).read_bytes()
        self._manifest.add(entry_of(path, data) for path, data in files.items())
        self._write_cameras()

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """Return the colour image (H, W, 3) uint8 of a view."""
        self._require(index)
        return images.read_rgb(self.folder / rgb_path(index))

    def has_depth(self, index: int) -> bool:
        """Return whether the view has a depth image."""
        self._require(index)
        return bool(self._robot[index]["depth"])

    def depth_m(self, index: int) -> NDArray[np.float32]:
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
        camera = records_json.intrinsics_to_json(intrinsics)
        self._header = {**self._header, "camera": camera, "T_world_cam": poses}
        self._session = None
        self._views.clear()
        self._camera_lines.clear()
        self._write_header()
        self._write_cameras()

    def _write_header(self) -> None:
        self.write_json(SESSION_FILE, self._header)

    def _camera_bytes(self) -> bytes:
        """Return scene_camera.json, one line per image."""
        camera, unit_m = self.session.intrinsics, self.session.depth_unit_m
        for v in self.session.views:
            if v.index not in self._camera_lines:
                entry = bop_units.camera_entry(camera, unit_m, v.T_world_cam)
                self._camera_lines[v.index] = f'"{v.index}": {json.dumps(entry, allow_nan=False)}'
        lines = [self._camera_lines[v.index] for v in self.session.views]
        return ("{\n" + ",\n".join(lines) + "\n}\n").encode("ascii")

    def _write_cameras(self) -> None:
        self.write_bytes(CAMERA_FILE, self._camera_bytes())

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
        """Write a file whole or not at all, and list its checksum."""
        self.path(relative)  # refuses a path that leads out of the session
        self._manifest.write(PurePosixPath(relative).as_posix(), data)

    def write_json(self, relative: str, value: Any) -> None:
        """Write plain JSON values; NaN and infinity are refused."""
        self.write_bytes(relative, atomic.json_bytes(value))

    def remove(self, relative: str) -> None:
        """Take a file away and off the manifest; one that is not there is no error."""
        self.path(relative)  # refuses a path that leads out of the session
        self._manifest.remove(PurePosixPath(relative).as_posix())

    def read_json(self, relative: str) -> Any:
        """Return the values of a JSON file of the session.

        Raises:
            InputError: it is missing or not JSON.
        """
        return read_json_file(self.path(relative))

    def write_npz(self, relative: str, **arrays: ArrayLike) -> None:
        """Write arrays as npz; the same arrays give the same bytes."""
        self.write_bytes(relative, atomic.npz_bytes(**arrays))

    def write_image(self, relative: str, image: NDArray[Any]) -> None:
        """Write (H, W, 3) uint8 RGB, or (H, W) uint8, bool or uint16, as PNG."""
        self.write_bytes(relative, images.png_bytes(image))

    def read_image(self, relative: str) -> NDArray[Any]:
        """Return an image of the session as it was written: RGB, grey or 16 bit; masks as 0/255."""
        return images.read_image(self.path(relative))

    def verify(self) -> list[Fault]:
        """Return every listed file that is missing or does not have the bytes that were written."""
        return self._manifest.verify()


def read_json_file(path: Path | str) -> Any:
    """Return the values of a JSON file.

    Raises:
        InputError: it is missing or not JSON.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; has the step that writes it been run?")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(
            f"{path} is not valid JSON ({error}). Restore it, or delete it and run the step that "
            "writes it again."
        ) from error


def _read_object(path: Path) -> dict[str, Any]:
    value = read_json_file(path)
    if not isinstance(value, dict):
        raise InputError(f"{path} holds a {type(value).__name__}; an object is expected.")
    return {str(key): item for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]


def _read_robot_lines(path: Path) -> dict[int, dict[str, Any]]:
    """Return the whole lines of robot.jsonl by view number; the last line of a view wins."""
    records: dict[int, dict[str, Any]] = {}
    for number, line in enumerate(atomic.complete_lines(path), start=1):
        try:
            record: dict[str, Any] = json.loads(line)
            records[int(record["index"])] = record | {"depth": bool(record["depth"])}
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path}, line {number} is not a view ({line[:80]!r}). Delete the line: its view "
                "is then captured again."
            ) from error
    return records


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in VERSIONS_OF:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
