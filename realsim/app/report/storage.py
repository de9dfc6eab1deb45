"""The sections on files and checksums, and on versions and settings."""

import json
from collections.abc import Iterator
from typing import Any

from realsim import __version__
from realsim.app.report.figures import Figure, count
from realsim.app.report.section import Section, attempted
from realsim.pages import Cell
from realsim.store import SessionStore
from realsim.store.check_report import CheckReport
from realsim.store.session_check import check_session, read_lists

OWN = ("reports/", "stages/report.")
"""A report says nothing of its own files: it would differ from the next one."""
SHOWN = 30
LONGEST = 120
"""Characters of a setting that are shown."""


def files_section(section: Section, store: SessionStore) -> None:
    """Fill the section on files and checksums."""
    report = check_session(store.folder)
    lists = read_lists(store.folder)
    entries = {p: e for p, e in lists.entries.items() if not p.startswith(OWN)}
    total = sum(e.bytes for e in entries.values())
    found = [f for r in _all(report) for f in r.findings if not f.path.startswith(OWN)]
    damage = [f for f in found if f.is_damage]
    section.add(
        count("files.listed", len(entries)), count("files.damaged", len(damage)),
        Figure(name="files.megabytes", value=total / 1e6, sigma=0.0),
    )  # fmt: skip
    section.headline = f"{len(entries)} files, {total / 1e6:.0f} MB, " + (
        f"{len(damage)} damaged" if damage else "all as they were written"
    )
    if damage:
        names = ", ".join(f.path for f in damage[:3]) + (", ..." if len(damage) > 3 else "")
        section.say("bad", f"Files: {len(damage)} are missing or changed since they were written "
                    f"({names}). `realsim check SESSION` lists them.")  # fmt: skip
    folders: dict[str, list[int]] = {}
    for path, entry in entries.items():
        folder = path.split("/")[0] if "/" in path else "(session)"
        folders.setdefault(folder, []).append(entry.bytes)
    section.page.table(
        ["folder", "files with a checksum", "size [MB]"],
        [[name, len(sizes), f"{sum(sizes) / 1e6:.2f}"] for name, sizes in sorted(folders.items())],
    )
    if found:
        rows = [
            [f.path, Cell(text=f.kind, kind="bad" if f.is_damage else "off"), f.found]
            for f in sorted(found, key=lambda f: not f.is_damage)
        ]
        section.page.table(["file", "", "found"], rows[:SHOWN])
        if len(rows) > SHOWN:
            section.page.text(f"... and {len(rows) - SHOWN} more.")
    unproven = [p for p in report.unproven if not p.startswith(OWN)]
    if unproven:
        section.page.text(f"{len(unproven)} files of the session have no checksum.")


def _all(report: CheckReport) -> Iterator[CheckReport]:
    yield report
    for inner in report.inner:
        yield from _all(inner)


def settings_section(section: Section, store: SessionStore) -> None:
    """Fill the section on versions and settings."""
    header: Any = store.read_json("session.json")
    versions: Any = header.get("versions", {})
    section.headline = f"captured with realsim {versions.get('realsim', '?')}"
    rows = [["captured (UTC)", store.created], ["this report", f"realsim {__version__}"]]
    rows += [[f"captured with {name}", v] for name, v in sorted(versions.items())]
    rows += [[name, _short(value)] for name, value in sorted(store.extra.items())]
    section.page.table(["what", "value"], rows)
    attempted(section, "the settings", lambda: _settings(section, store))


def _settings(section: Section, store: SessionStore) -> None:
    """Add what the stages were asked for."""
    found: list[tuple[str, Any]] = []
    if store.has("plan.json"):
        found.append(("Settings of the plan", store.read_json("plan.json")["content"]["config"]))
    if store.has("registration/report.json"):
        report: Any = store.read_json("registration/report.json")
        found.append(("What registration was asked for", report.get("asked", {})))
    sets = sorted((store.folder / "grasps").glob("*_obj*.json"))
    if sets:
        told: Any = store.read_json(f"grasps/{sets[0].name}")
        found.append(("Settings of the Robot School", told["parameters"].get("config", {})))
        found.append(("Versions in the Robot School", told["parameters"].get("versions", {})))
    for title, values in found:
        rows = [[name, _short(v)] for name, v in _flat(values)]
        if rows:
            section.page.table(["setting", "value"], rows, folded=title)


def _flat(values: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and plain values."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
