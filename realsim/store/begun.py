"""`session.begun.json`: what a session was begun with, kept a second time.

Arm, camera, lab and plan of a session stand in session.json, which is written anew with every
calibration. This copy is written once, has a checksum of its own, and is what a repair takes
them from where session.json is damaged.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from realsim.store import atomic

BEGUN_FILE = "session.begun.json"
CHECK = "sha256"
"""Key of the checksum: of the file's JSON without this key."""
RECOVERED = "recovered"
"""Key of `extra` in a header that was made anew without knowing all that it was begun with."""
CHANGING = ("T_world_cam",)
"""Keys of a header that do not belong to its beginning."""


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
