"""What must hold before a session's folder is gone on with, and what it was begun with.

`session.begun.json`: arm, camera, lab and plan of a session stand in session.json, which is written
anew with every calibration. This copy is written once, has a checksum of its own, and is what a
repair takes them from where session.json is damaged.
"""

import contextlib
import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.store import atomic
from realsim.store.header import SESSION_FILE, repair_command
from realsim.store.manifest import NAME as MANIFEST_FILE
from realsim.store.manifest import Entry, Fault, Manifest, entry_of, size_fault_of

CAMERA_FILE, ROBOT_FILE = "scene_camera.json", "robot.jsonl"
BEGUN_FILE = "session.begun.json"
CHECK = "sha256"
"""Key of the checksum: of the file's JSON without this key."""
RECOVERED = "recovered"
"""Key of `extra` in a header that was made anew without knowing all that it was begun with."""
CHANGING = ("T_world_cam",)
"""Keys of a header that do not belong to its beginning."""


def require_free(folder: Path) -> None:
    """Refuse to begin a session where there is one.

    Raises:
        InputError: there is one, or what is left of one.
    """
    if (folder / SESSION_FILE).exists():
        raise InputError(
            f"{folder} already holds a session. Open it to go on with it, or choose another folder."
        )
    if (folder / ROBOT_FILE).exists():
        raise InputError(
            f"{folder} holds views of a session whose {SESSION_FILE} is lost. "
            f"{repair_command(folder)} makes it anew; or choose another folder."
        )


def finish_beginning(folder: Path) -> None:
    """Give a session's first header its name where a kill kept it from it, or take it away.

    Until its header has its name nobody knows a folder as a session.
    """
    if (folder / SESSION_FILE).exists():
        return
    for _, final in atomic.leftovers(folder):
        if final == folder / SESSION_FILE:
            manifest = Manifest(folder)
            if not manifest.entries:
                (folder / MANIFEST_FILE).unlink(missing_ok=True)
            manifest.finish_interrupted()
    # Ctrl-C takes away the bytes that the list has already.
    if folder.is_dir() and [p.name for p in folder.iterdir()] == [MANIFEST_FILE]:
        if set(Manifest(folder).entries) <= {SESSION_FILE}:
            (folder / MANIFEST_FILE).unlink()


def require_header(folder: Path) -> None:
    """Refuse a session whose session.json is gone; any other folder is none of ours.

    Raises:
        InputError: there are views, or what the session was begun with, and no header.
    """
    left = [name for name in (ROBOT_FILE, BEGUN_FILE) if (folder / name).is_file()]
    if left and not (folder / SESSION_FILE).is_file():
        raise InputError(
            f"{folder} holds a session ({left[0]} is there), but its {SESSION_FILE} is lost. "
            f"{repair_command(folder)} makes it anew."
        )


def require_session(folder: Path) -> None:
    """Refuse a folder without a session, and views without a manifest.

    To list such views as they are now would call damage sound.

    Raises:
        InputError: no session.json, or views and no manifest; no kill takes that away.
    """
    views = atomic.complete_lines(folder / ROBOT_FILE)
    require_header(folder)
    if not (folder / SESSION_FILE).is_file():
        raise InputError(
            f"{folder} holds no session: {SESSION_FILE} is not there. The folder of a capture "
            "session is expected; a BOP dataset is read by realsim.formats.bop.scene."
        )
    if views and not atomic.complete_lines(folder / MANIFEST_FILE):
        raise InputError(
            f"{folder / MANIFEST_FILE} is lost, and the checksums of the session's views with it: "
            f"which of them are sound is not known. {repair_command(folder)} looks at every "
            "image, takes out what is broken, and lists the rest anew."
        )


def begun_bytes(header: dict[str, Any]) -> bytes:
    """Return the file for the header of a session."""
    begun = {key: value for key, value in header.items() if key not in CHANGING}
    return atomic.json_bytes(begun | {CHECK: _check_of(begun)})


def read_begun(folder: Path) -> dict[str, Any] | None:
    """Return the header that the session was begun with; None if it is lost or damaged."""
    try:
        begun: dict[str, Any] = json.loads((folder / BEGUN_FILE).read_text(encoding="utf-8"))
        check = begun.pop(CHECK)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return begun if check == _check_of(begun) else None


def _check_of(begun: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(begun, sort_keys=True).encode()).hexdigest()


def keep_beginning(folder: Path, header: dict[str, Any], manifest: Manifest) -> None:
    """Write session.begun.json where it is not there and session.json is as it was written."""
    extra: Any = header.get("extra")
    if (folder / BEGUN_FILE).exists() or (isinstance(extra, dict) and RECOVERED in extra):
        return
    data = (folder / SESSION_FILE).read_bytes()
    if manifest.entries.get(SESSION_FILE) == entry_of(SESSION_FILE, data):
        with contextlib.suppress(OSError):  # a copy: a session that may only be read has none
            manifest.write(BEGUN_FILE, begun_bytes(header))


def stored_faults(folder: Path, paths: Iterable[str], listed: Mapping[str, Entry]) -> list[Fault]:
    """Return which images of stored views are gone or not of the size that was listed.

    An image that is neither there nor listed is no fault: a run ended while its view was taken
    again.
    """
    faults: list[Fault] = []
    for path in paths:
        fault = None
        if path in listed:
            fault = size_fault_of(folder, listed[path])
        elif (folder / path).is_file():
            fault = Fault(path=path, kind="changed", found="not listed, and it cannot be read")
        if fault is not None:
            faults.append(fault)
    return faults
