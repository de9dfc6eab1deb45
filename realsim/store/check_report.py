"""What a check of a session found, as records."""

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from realsim.store.manifest import Entry

Damage = Literal["missing", "changed", "unreadable", "line"]
Kind = Damage | Literal["torn", "leftover", "unlisted", "time", "repeated", "unproven"]
DAMAGE: tuple[Kind, ...] = get_args(Damage)


@dataclass(frozen=True, kw_only=True, slots=True)
class SessionFinding:
    """One thing that is not as it was written."""

    path: str
    """Relative to the session."""
    kind: Kind
    """missing, changed (other bytes than were written), unreadable, line (a damaged one): damage.
    torn, leftover, unlisted (what an interrupted run leaves), time (a stamp goes back), repeated
    (a view has a line too many), unproven (it lost its checksum): notes."""
    found: str
    """What is there."""
    view: int | None = None
    """The view that it costs, if it costs one."""

    @property
    def is_damage(self) -> bool:
        """Whether it is more than an interrupted run can leave."""
        return self.kind in DAMAGE


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckReport:
    """What a check found in one session, and in the sessions inside it."""

    folder: str
    views: tuple[int, ...]
    """Numbers of the views that are whole and sound."""
    damaged_views: tuple[int, ...]
    """Numbers of views that were stored once and are not whole any more."""
    planned: int | None
    """Views of the plan that the session is captured by; None without a plan."""
    files_ok: int
    """Listed files that have the bytes that were written."""
    unproven: tuple[str, ...]
    """Files of the kind that a session lists, and that are not listed."""
    beside: tuple[tuple[str, int], ...]
    """(folder or file, how many files) of what others wrote beside the session, such as models/:
    no checksum covers it, and none was meant to."""
    findings: tuple[SessionFinding, ...] = ()
    inner: tuple["CheckReport", ...] = ()
    """Reports of the sessions inside, such as the board views in calibration/capture."""

    def paths(self, kind: Kind) -> tuple[str, ...]:
        """Return the files of one kind of finding."""
        return tuple(f.path for f in self.findings if f.kind == kind)

    @property
    def not_captured(self) -> tuple[int, ...]:
        """Views of the plan that are not there."""
        have = set(self.views)
        return tuple(k for k in range(self.planned or 0) if k not in have)

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged here and inside; notes do not count."""
        return not any(f.is_damage for f in self.findings) and all(r.sound for r in self.inner)

    def to_json(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        return {
            "folder": self.folder,
            "sound": self.sound,
            "views": len(self.views),
            "views_planned": self.planned,
            "views_damaged": list(self.damaged_views),
            "views_not_captured": list(self.not_captured),
            "files_ok": self.files_ok,
            "files_without_checksum": list(self.unproven),
            "files_beside": dict(self.beside),
            "findings": [
                {"path": f.path, "kind": f.kind, "found": f.found, "view": f.view,
                 "damage": f.is_damage}
                for f in self.findings
            ],
            "inner": [r.to_json() for r in self.inner],
        }  # fmt: skip


@dataclass(kw_only=True, slots=True)
class Lists:
    """The two lists of a session, read without stopping at a damaged line."""

    entries: dict[str, Entry]
    """The manifest: the last sound entry of every path."""
    records: dict[int, dict[str, Any]]
    """The last sound robot line of every view, in the order of the file."""
    lines: dict[int, list[tuple[int, str]]] = field(
        default_factory=dict[int, list[tuple[int, str]]]
    )
    """The sound robot lines of every view."""
    findings: list[SessionFinding] = field(default_factory=list[SessionFinding])

    def note(self, path: str, kind: Kind, found: str, view: int | None = None) -> None:
        """Add a finding."""
        self.findings.append(SessionFinding(path=path, kind=kind, found=found, view=view))
