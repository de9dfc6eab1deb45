"""`session.json`: who a session is, its camera, and where the camera stood."""

import platform
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.records import CaptureSession
from realsim.store import records_json
from realsim.store.json_files import read_object

SESSION_FILE = "session.json"
FORMAT = "realsim session"
FORMAT_VERSION = 1
VERSIONS_OF = ("realsim", "numpy", "opencv-python-headless")


def new_header(session: CaptureSession, extra: dict[str, Any]) -> dict[str, Any]:
    """Return the content of session.json of a session without views."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": session.name,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "units": {"length": "m", "angle": "rad", "time": "s", "scene_camera.json": "mm"},
        "camera": records_json.intrinsics_to_json(session.intrinsics),
        "depth_unit_m": session.depth_unit_m,
        "T_world_cam": {},
        "versions": _versions(),
        "extra": extra,
    }


def checked_header(path: Path) -> dict[str, Any]:
    """Return the content of session.json.

    Raises:
        InputError: not JSON, not a session's header, incomplete, or of a newer format.
    """
    header = read_object(path)
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
    records_json.need(header, ("name", "camera", "depth_unit_m", "T_world_cam"), str(path))
    return header


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in VERSIONS_OF:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
