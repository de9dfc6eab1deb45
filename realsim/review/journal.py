"""The reviewers' decisions: an append-only journal of JSON lines, and what it adds up to.

Nothing in the journal is ever changed or removed; taking a decision back is a line of its own.
The current state is the replay of all lines, so two servers, a crash, or a merge of two people's
journals (their lines one after the other) can lose nothing.
"""

import json
import os
import uuid
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from realsim.errors import InputError
from realsim.records import ObjectPose, Scene, Verdict

JOURNAL_FILE = "review/journal.jsonl"
"""Where in a session the decisions stand."""
Action = Literal["accept", "reject", "comment", "undo"]
FORMAT = 1
"""Version of the line format; a reader refuses a newer one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """One line of the journal: who decided what, when, and about which pose."""

    id: str
    """Unique name of this line; a line that is read twice counts once."""
    time: str
    """When [ISO 8601, UTC]."""
    reviewer: str
    action: Action
    instance: int
    """Object instance in the scene; for an undo, that of the line taken back."""
    subject: str
    """Digest of the pose that was looked at (see `subject_of`): a later registration is new."""
    comment: str = ""
    undoes: str = ""
    """For an undo: the id of the line it takes back; else empty."""

    def __post_init__(self) -> None:
        """Check the action, and that undo and only undo names a line."""
        if self.action not in get_args(Action):
            raise InputError(
                f"the journal's action is '{self.action}'; it must be one of "
                f"{', '.join(get_args(Action))}."
            )
        if (self.action == "undo") != bool(self.undoes):
            raise InputError(
                f"a journal line with the action '{self.action}' names the line "
                f"'{self.undoes}' to take back; undo needs one and no other action has one."
            )
        if self.action == "comment" and not self.comment.strip():
            raise InputError("the comment is empty; write it first.")


@dataclass(frozen=True, kw_only=True, slots=True)
class ReviewState:
    """What a journal adds up to."""

    entries: tuple[Entry, ...] = ()
    """Every line, once, in the order of the journal."""

    @property
    def standing(self) -> tuple[Entry, ...]:
        """The decisions and comments that no standing undo takes back, in order."""
        # From the end: whether a line stands depends only on the undo lines after it.
        undone: set[str] = set()
        kept: list[Entry] = []
        for entry in reversed(self.entries):
            if entry.id in undone:
                continue
            if entry.action == "undo":
                undone.add(entry.undoes)
            else:
                kept.append(entry)
        return tuple(reversed(kept))

    def decision(self, instance: int, subject: str) -> Entry | None:
        """Return the last standing accept or reject of this pose of this instance."""
        found = None
        for e in self.standing:
            if (e.instance, e.subject) == (instance, subject) and e.action != "comment":
                found = e
        return found

    def comments(self, instance: int) -> tuple[Entry, ...]:
        """Return the standing comments on this instance, on any of its poses."""
        return tuple(e for e in self.standing if e.instance == instance and e.comment.strip())


@dataclass(frozen=True, kw_only=True, slots=True)
class JournalContent:
    """What stands in a journal file."""

    entries: tuple[Entry, ...]
    damaged: tuple[int, ...]
    """Numbers (from 1) of lines that are not whole: a process died while it wrote them."""


def subject_of(placed: ObjectPose) -> str:
    """Return a digest of which object is meant and where it stands (to 1 um and 1e-6)."""
    T = np.round(placed.T_world_obj, 6) + 0.0  # + 0.0 turns -0.0 into 0.0
    text = f"{placed.obj_id} {placed.instance} ".encode() + T.astype("<f8").tobytes()
    return sha256(text).hexdigest()[:16]


def new_entry(
    action: Action, placed: ObjectPose, reviewer: str, *, comment: str = "", undoes: str = ""
) -> Entry:
    """Return a line for the journal, stamped with the time and a unique id.

    Raises:
        InputError: no reviewer is named, or the action and the other fields do not fit.
    """
    if not reviewer.strip():
        raise InputError("the reviewer's name is empty; a decision is signed: fill in your name.")
    return Entry(
        id=uuid.uuid4().hex,
        time=datetime.now(UTC).isoformat(timespec="milliseconds"),
        reviewer=reviewer.strip(),
        action=action,
        instance=placed.instance,
        subject=subject_of(placed),
        comment=comment.strip(),
        undoes=undoes,
    )


def replay(entries: Sequence[Entry], start: ReviewState | None = None) -> ReviewState:
    """Return the state after these lines.

    Laws: `replay(b, replay(a)) = replay(a + b)`, and a line that comes twice counts once.

    Args:
        entries: lines in their order.
        start: the state they are added to; none = an empty journal.
    """
    before = () if start is None else start.entries
    once = {e.id: e for e in (*before, *entries)}
    return ReviewState(entries=tuple(once.values()))


def append(path: Path, entry: Entry) -> None:
    """Add one line to the journal; when this returns, the line is on the disk.

    An exclusive lock (fcntl) lets several processes write to the same journal. A fragment that a
    killed process left without its line end is closed first, so that it spoils no other line.
    """
    import fcntl

    line = json.dumps({"format": FORMAT, **asdict(entry)}, ensure_ascii=False) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    created = not path.exists()
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        size = os.fstat(handle).st_size
        torn = size > 0 and os.pread(handle, 1, size - 1) != b"\n"
        rest = (b"\n" if torn else b"") + line.encode()
        while rest:
            rest = rest[os.write(handle, rest) :]
        os.fsync(handle)
    finally:
        os.close(handle)
    if created:
        _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Put the folder's entry for a new file on the disk too."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read(path: Path) -> JournalContent:
    """Return the lines of a journal; none if there is no file yet.

    Raises:
        InputError: a line is of a newer format, or is whole JSON that is no journal line.
    """
    if not path.exists():
        return JournalContent(entries=(), damaged=())
    entries: list[Entry] = []
    damaged: list[int] = []
    for number, line in enumerate(path.read_bytes().split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            fields = json.loads(line)
        except (json.JSONDecodeError, UnicodeDecodeError):
            damaged.append(number)
            continue
        entries.append(_entry(fields, f"{path.name}, line {number}"))
    return JournalContent(entries=tuple(entries), damaged=tuple(damaged))


def _entry(fields: Any, where: str) -> Entry:
    """Return the record of one parsed line."""
    if not isinstance(fields, dict) or fields.get("format") != FORMAT:
        raise InputError(
            f"{where}: this is no journal line of format {FORMAT}; was it written by a newer "
            "version? Update, or look at the line by hand."
        )
    named = {str(k): v for k, v in fields.items() if k != "format"}
    try:
        return Entry(**named)
    except TypeError as error:
        raise InputError(f"{where}: the fields do not fit a journal line ({error}).") from error


def reviewed_scene(scene: Scene, state: ReviewState) -> Scene:
    """Return the scene with the reviewers' decisions in place of the computed verdicts.

    A decision counts only for the very pose it was made about; an object that was registered
    anew since keeps its computed verdict.
    """
    verdicts: dict[str, Verdict] = {"accept": "accepted", "reject": "rejected"}

    def judged(placed: ObjectPose) -> ObjectPose:
        decision = state.decision(placed.instance, subject_of(placed))
        if decision is None:
            return placed
        reason = f"{decision.action}ed by {decision.reviewer}"
        if decision.comment:
            reason += f": {decision.comment}"
        reasons = (*placed.reasons, reason)
        return replace(placed, verdict=verdicts[decision.action], reasons=reasons)

    return replace(scene, objects=tuple(judged(o) for o in scene.objects))
