"""What a session keeps of its capture: the log of what happened, and views taken again.

`capture_log.jsonl` has one line per event. It is written whole at every event and listed in the
manifest by the same step, so that a kill never leaves a log that the manifest does not know; at
250 bytes a view that costs nothing.
"""

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from realsim.arrays import Array32, UInt8
from realsim.records import View
from realsim.store.session_store import depth_path, rgb_path

if TYPE_CHECKING:
    from realsim.store import SessionStore

LOG_FILE = "capture_log.jsonl"


class CaptureLog:
    """The log of one session; without a session (a dry run) it is kept in memory only."""

    def __init__(self, store: "SessionStore | None") -> None:
        """Read what earlier runs wrote; a line that cannot be read is left out."""
        self._store = store
        self._lines: list[str] = []
        self.entries: list[dict[str, Any]] = []
        if store is None or not store.has(LOG_FILE):
            return
        for line in store.path(LOG_FILE).read_text("utf-8", errors="replace").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                continue
            if isinstance(entry, dict):
                self._lines.append(line)
                self.entries.append({str(k): v for k, v in entry.items()})  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]

    def add(self, event: str, **values: Any) -> None:
        """Append an event with plain JSON values and put the log on the disk."""
        entry = {"event": event, **values}
        self._lines.append(json.dumps(entry, allow_nan=False))
        self.entries.append(entry)
        if self._store is not None:
            self._store.write_bytes(LOG_FILE, ("\n".join(self._lines) + "\n").encode("utf-8"))

    def views(self) -> dict[int, dict[str, Any]]:
        """Return the last stored or skipped entry of every view."""
        return last_of_views(self.entries)


def last_of_views(entries: Iterable[Mapping[str, Any]]) -> dict[int, dict[str, Any]]:
    """Return the last entry that says what became of each view."""
    last: dict[int, dict[str, Any]] = {}
    for entry in entries:
        if entry.get("event") in ("stored", "skipped") and isinstance(entry.get("view"), int):
            last[entry["view"]] = dict(entry)
    return last


FOLDER = "retaken"
"""Where in a session the earlier images of a view lie: `retaken/000017_1_rgb.png` and so on."""


def replace_view(store: "SessionStore", view: View, rgb: UInt8, depth_m: Array32) -> str:
    """Store a view that is there already; return where the earlier one went.

    The earlier images and the robot's state are on the disk under their new names before the old
    names go: a kill in between leaves the earlier view aside and this one to be captured again.

    Args:
        store: the session.
        view: number, robot state and time of the new one.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) depth along z [m].
    """
    k = view.index
    stem = _free_stem(store, k)
    earlier = store.session.view(k)
    images = {"rgb": rgb_path(k)} | ({"depth": depth_path(k)} if store.has_depth(k) else {})
    for kind, path in images.items():
        store.write_bytes(f"{stem}_{kind}.png", store.path(path).read_bytes())
    store.write_json(
        f"{stem}.json",
        {
            "index": k,
            "T_base_ee": None if earlier.T_base_ee is None else earlier.T_base_ee.tolist(),
            "joints": None if earlier.joints is None else earlier.joints.tolist(),
            "time_s": earlier.time_s,
        },
    )
    for path in images.values():
        store.remove(path)
    store.add_view(view, rgb, depth_m)
    return stem


def _free_stem(store: "SessionStore", k: int) -> str:
    """Return the first name for view k that is not taken."""
    count = 1
    while store.has(f"{FOLDER}/{k:06d}_{count}.json"):
        count += 1
    return f"{FOLDER}/{k:06d}_{count}"
