"""Further cameras of a session: sessions of the same shape inside it.

    SESSION/rgb/, depth/, session.json, ...                   the camera in the hand
    SESSION/cameras/NAME/rgb/, depth/, session.json, ...      a camera that stands still

Each has its lens, its depth unit, its camera poses and its checksums. What was seen is one scene:
models, registration and grasps lie in the session itself. Views of the same number are of the same
instant.
"""

import re
from pathlib import Path

from realsim.errors import InputError
from realsim.store.header import SESSION_FILE
from realsim.store.session_check import is_session
from realsim.store.session_store import SessionStore

CAMERAS = "cameras"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
"""Names that BOP's folders can have, too."""


def camera_folder(session: Path, name: str) -> Path:
    """Return where a further camera of a session lies, whether it is there or not.

    Raises:
        InputError: a name that no folder of a data set can have.
    """
    if not NAME.fullmatch(name):
        raise InputError(
            f"'{name}' is no name of a camera: letters, digits, _ and - are accepted, a letter or "
            "a digit first."
        )
    return session / CAMERAS / name


def camera_folders(session: Path) -> dict[str, Path]:
    """Return the further cameras of a session by name, those that lost their header among them."""
    place = session / CAMERAS
    folders = sorted(place.iterdir()) if place.is_dir() else []
    return {p.name: p for p in folders if NAME.fullmatch(p.name) and is_session(p)}


def open_cameras(store: SessionStore) -> dict[str, SessionStore]:
    """Open the further cameras of a session, by name.

    Raises:
        InputError: one of them is damaged; says how it is repaired.
    """
    return {name: SessionStore.open(path) for name, path in camera_folders(store.folder).items()}


def session_of_camera(folder: Path) -> Path | None:
    """Return the session that a folder is a further camera of; None = of none."""
    folder = folder.resolve()
    session = folder.parent.parent
    inside = folder.parent.name == CAMERAS and is_session(folder)
    return session if inside and (session / SESSION_FILE).is_file() else None
