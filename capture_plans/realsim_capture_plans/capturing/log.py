"""What happened at each view: `capture_log.jsonl` in the session, one line per event.

The file is written whole at every event and listed in the manifest by the same step, so that a
kill never leaves a log that the manifest does not know; at 250 bytes a view that costs nothing.
"""

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

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
