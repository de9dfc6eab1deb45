"""`session.json`: who a session is, its camera, and where the camera stood."""

import platform
import shlex
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from realsim.errors import InputError, UnreadableError
from realsim.records import CameraIntrinsics, CaptureSession
from realsim.untrusted import json_text
from realsim.untrusted.own_json import from_json, to_json
from realsim.untrusted.values import need

SESSION_FILE = "session.json"
FORMAT = "realsim session"
FORMAT_VERSION = 1
VERSIONS_OF = ("realsim", "numpy", "opencv-python-headless")


class NewerFormatError(InputError):
    """The session was written by a newer realsim."""


def repair_command(folder: Path) -> str:
    """Return the command that repairs the session in a folder, as it is typed."""
    return f"`realsim check {shlex.quote(str(folder))} --repair`"


def new_header(session: CaptureSession, extra: dict[str, Any]) -> dict[str, Any]:
    """Return the content of session.json of a session without views."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": session.name,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "units": {"length": "m", "angle": "rad", "time": "s", "scene_camera.json": "mm"},
        "camera": to_json(session.intrinsics),
        "depth_unit_m": session.depth_unit_m,
        "T_world_cam": {},
        "versions": {"python": platform.python_version()} | versions_of(VERSIONS_OF),
        "extra": extra,
    }


def checked_header(path: Path) -> dict[str, Any]:
    """Return the content of session.json.

    Raises:
        NewerFormatError: it was written by a newer realsim.
        InputError: not JSON, not a session's header, or incomplete.
    """
    header = _read(path)
    if header.get("format") != FORMAT or not isinstance(header.get("format_version"), int):
        raise InputError(
            f"{path} is not the header of a '{FORMAT}': it says format "
            f"{header.get('format')!r}, version {header.get('format_version')!r}."
        )
    if header["format_version"] > FORMAT_VERSION:
        raise NewerFormatError(
            f"{path} has format version {header['format_version']}; this realsim reads up to "
            f"{FORMAT_VERSION}. Use a newer realsim."
        )
    need(header, ("name", "camera", "depth_unit_m", "T_world_cam"), str(path))
    try:
        from_json(header["camera"], CameraIntrinsics, f"the camera of {path}")
        float(header["depth_unit_m"])
        for table in (header["T_world_cam"], header.get("extra", {})):
            if not isinstance(table, dict):
                raise TypeError(f"a table was expected, not {str(table)[:40]}")
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} has a camera, unit or pose that is none ({error}).") from error
    return header


def header_to_open(path: Path) -> dict[str, Any]:
    """Return the content of session.json; what is wrong with it is said with its remedy.

    Raises:
        InputError: see `checked_header`.
    """
    try:
        return checked_header(path)
    except (NewerFormatError, UnreadableError):
        raise
    except InputError as error:
        raise InputError(
            f"{error} {repair_command(path.parent)} makes it anew from what the session's other "
            "files say; images and robot poses are not touched."
        ) from error


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path} does not exist.")
    header: Any = json_text.read_json(path)
    if not isinstance(header, dict):
        raise InputError(f"{path} holds a {type(header).__name__}; an object is expected.")
    return {str(key): item for key, item in header.items()}  # pyright: ignore[reportUnknownVariableType]


def versions_of(names: Iterable[str]) -> dict[str, str]:
    """Return the versions of installed packages."""
    versions: dict[str, str] = {}
    for name in names:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
