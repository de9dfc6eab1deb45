"""The reviewers' decisions: an append-only journal of JSON lines, and what it adds up to.

Nothing in the journal is ever changed or removed; taking a decision back is a line of its own.
The current state is the replay of all lines, so two servers, a crash, or a merge of two people's
journals (their lines one after the other) can lose nothing.
"""

import io
import json
import os
import sys
import threading
import uuid
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import ObjectPose
from realsim.review.refusals import SessionGone
from realsim.store.atomic import sync_folder

JOURNAL_FILE = "review/journal.jsonl"
"""Where in a session the decisions stand."""
Action = Literal[
    "accept", "reject", "comment", "undo", "move", "swap", "symmetric", "exclude", "include"
]
PLACED_ACTIONS = ("accept", "reject", "comment", "move", "swap")
"""About one object as it stands in the scene."""
VIEW_ACTIONS = ("exclude", "include")
"""About one view."""
FORMAT = 2
"""Version of the line format; a reader refuses a newer one."""
READABLE = (1, FORMAT)
"""Format 1 has decisions and comments only, without the pose that was looked at."""
Rows = tuple[tuple[float, ...], ...]
MOST_COMMENT, MOST_NAME = 2000, 80
"""Characters of a comment, of a name or another short text."""
MOST_BYTES = 64_000_000
"""Size of a journal: a line has about 500, so this is more than a hundred thousand decisions."""
REPEATED = ("reviewer", "action", "subject", "symmetry", "how")
"""Texts that many lines have in common; they are held once."""
MOST_POSES = 1000
"""Poses that are held once for all lines that name them."""
BLOCK_BYTES = 1 << 16
NO_CHECKS = dict[str, float]()
"""What most lines have measured; it is held once."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """One line of the journal: who decided what, when, and about which pose."""

    id: str
    """Unique name of this line; a line that is read twice counts once."""
    time: str
    """When [ISO 8601, UTC]."""
    reviewer: str
    action: Action
    instance: int | None = None
    """Object instance in the scene; for an undo, that of the line taken back."""
    subject: str = ""
    """Digest of the pose that was looked at (see `subject_of`): a later registration is new."""
    comment: str = ""
    undoes: str = ""
    """For an undo: the id of the line it takes back; else empty."""
    T_world_obj: Rows | None = None
    """(4, 4) [m]: for a move or a swap the new pose; for a decision the pose looked at."""
    obj_id: int | None = None
    """For a swap: the object that it really is; for a decision: the object that was judged; for a
    mark of symmetry: whose it is."""
    view: int | None = None
    """For exclude and include: the view."""
    symmetry: str = ""
    """For a mark of symmetry: what `symmetric.symmetry_of` reads, such as z, x:2 or none."""
    how: str = ""
    """For a move: by what, such as gizmo, keyboard, icp or points."""
    checks: dict[str, float] = field(default_factory=lambda: NO_CHECKS)
    """For a move: what was measured of the new pose, such as agree."""

    def __post_init__(self) -> None:
        """Check that the action has what it needs, and nothing else."""
        self._check_types()
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
        if self.undoes and self.undoes == self.id:
            raise InputError("an undo names itself; it takes back another line.")
        if self.action == "comment" and not self.comment.strip():
            raise InputError("the comment is empty; write it first.")
        self._check_fields()

    def _check_types(self) -> None:
        """Raise if a field is of another type, too long, or a number that cannot be meant."""
        for name in ("id", "time", "comment", "undoes", *REPEATED):
            value, most = getattr(self, name), MOST_COMMENT if name == "comment" else MOST_NAME
            if not isinstance(value, str) or len(value) > most:
                what = f"{len(value)} characters" if isinstance(value, str) else repr(value)[:60]
                raise InputError(f"'{name}' is {what}; a text of at most {most} is accepted.")
            if name in REPEATED:
                object.__setattr__(self, name, sys.intern(str(value)))
        if not self.id:
            raise InputError("a journal line has no id.")
        for name in ("instance", "obj_id", "view"):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if value is not None and not (whole and 0 <= value < 2**31):
                raise InputError(
                    f"'{name}' is {value!r:.60}; a whole number from 0 on is accepted."
                )
        said: Any = self.checks
        if not isinstance(said, dict) or not all(
            isinstance(k, str) and isinstance(v, int | float)
            for k, v in dict[Any, Any](said).items()
        ):
            raise InputError("'checks' is no mapping of names to numbers.")
        object.__setattr__(self, "checks", said or NO_CHECKS)

    def _check_fields(self) -> None:
        needed = {
            "instance": self.action in PLACED_ACTIONS and self.instance is None,
            "view": self.action in VIEW_ACTIONS and self.view is None,
            "obj_id": self.action in ("swap", "symmetric") and self.obj_id is None,
            "symmetry": self.action == "symmetric" and not self.symmetry,
            "T_world_obj": self.action in ("move", "swap") and self.T_world_obj is None,
        }
        missing = [name for name, is_missing in needed.items() if is_missing]
        if missing:
            raise InputError(
                f"a journal line with the action '{self.action}' has no {' and no '.join(missing)}."
            )
        if self.T_world_obj is not None:
            rows = tuple(tuple(row) for row in self.T_world_obj)
            object.__setattr__(self, "T_world_obj", _one_pose(rows))

    @property
    def pose(self) -> Array | None:
        """(4, 4) the pose that the line names [m]."""
        return None if self.T_world_obj is None else np.array(self.T_world_obj)


@dataclass(frozen=True, kw_only=True, slots=True)
class ReviewState:
    """What a journal adds up to."""

    entries: tuple[Entry, ...] = ()
    """Every line, once, in the order of the journal."""
    standing: tuple[Entry, ...] = field(init=False, compare=False, repr=False)
    """The decisions and comments that no standing undo takes back, in order."""

    def __post_init__(self) -> None:
        """Find out what stands."""
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
        object.__setattr__(self, "standing", tuple(reversed(kept)))

    def of(self, instance: int) -> tuple[Entry, ...]:
        """Return the standing lines on this instance, in order."""
        return tuple(e for e in self.standing if e.instance == instance)

    def excluded_views(self) -> dict[int, Entry]:
        """Return view -> the line that excludes it, of the views that are excluded."""
        last = {e.view: e for e in self.standing if e.action in VIEW_ACTIONS and e.view is not None}
        return {k: e for k, e in sorted(last.items()) if e.action == "exclude"}

    def marks(self) -> dict[int, Entry]:
        """Return obj_id -> the line that says how it is symmetric."""
        marks = (e for e in self.standing if e.action == "symmetric")
        return {e.obj_id: e for e in marks if e.obj_id is not None}


@dataclass(frozen=True, kw_only=True, slots=True)
class JournalContent:
    """What stands in a journal file."""

    entries: tuple[Entry, ...]
    damaged: tuple[int, ...]
    """Numbers (from 1) of lines that are not whole: a process died while it wrote them."""


@lru_cache(MOST_POSES)
def _one_pose(rows: Rows) -> Rows:
    """Return a pose checked, and the same object whenever it is named again."""
    T = se3.check_rigid(np.array(rows, dtype=np.float64), "the journal's pose")
    return tuple(tuple(row) for row in T.tolist())


def subject_of(placed: ObjectPose) -> str:
    """Return a digest of which object is meant and where it stands (to 1 um and 1e-6)."""
    T = np.round(placed.T_world_obj, 6) + 0.0  # + 0.0 turns -0.0 into 0.0
    text = f"{placed.obj_id} {placed.instance} ".encode() + T.astype("<f8").tobytes()
    return sha256(text).hexdigest()[:16]


def new_entry(
    action: Action,
    placed: ObjectPose | None,
    reviewer: str,
    *,
    comment: str = "",
    undoes: str = "",
    pose: ArrayLike | None = None,
    **said: Any,
) -> Entry:
    """Return a line for the journal, stamped with the time and a unique id.

    Args:
        action: what is decided.
        placed: the object as it stands now; None for what is about a view or a model.
        reviewer: who decides.
        comment: why.
        undoes: for an undo, the id of the line that is taken back.
        pose: (4, 4) T_world_obj [m], the new pose of a move or a swap.
        said: the entry's other fields: obj_id, view, symmetry, how, checks.

    Raises:
        InputError: no reviewer is named, a text is too long, or the action and the other fields do
            not fit.
    """
    if not reviewer.strip():
        raise InputError("the reviewer's name is empty; a decision is signed: fill in your name.")
    T = None if placed is None or action in ("undo", "comment") else placed.T_world_obj
    if pose is not None:
        T = np.asarray(pose, dtype=np.float64)
    if placed is not None and action in ("accept", "reject"):
        said = {"obj_id": placed.obj_id} | said
    return Entry(
        id=uuid.uuid4().hex, time=datetime.now(UTC).isoformat(timespec="milliseconds"),
        reviewer=reviewer.strip(), action=action,
        instance=None if placed is None else placed.instance,
        subject="" if placed is None else subject_of(placed), comment=comment.strip(),
        undoes=undoes, T_world_obj=None if T is None else tuple(tuple(row) for row in T.tolist()),
        **said,
    )  # fmt: skip


def replay(entries: Sequence[Entry], start: ReviewState | None = None) -> ReviewState:
    """Return the state after these lines.

    Laws: `replay(b, replay(a)) = replay(a + b)`, and a line that comes twice counts once.

    Args:
        entries: lines in their order.
        start: the state they are added to; none = an empty journal.

    Raises:
        InputError: two lines have one id and say different things.
    """
    before = () if start is None else start.entries
    fresh = _fresh(entries, {e.id: e for e in before})
    return ReviewState(entries=(*before, *fresh.values()))


def _fresh(entries: Iterable[Entry], once: Mapping[str, Entry]) -> dict[str, Entry]:
    """Return, by id, the lines that are not among those that were there before."""
    fresh: dict[str, Entry] = {}
    for entry in entries:
        was = once.get(entry.id) or fresh.setdefault(entry.id, entry)
        if was != entry:
            raise InputError(
                f"two lines of the journal have the id '{entry.id}' and say different things "
                f"({was.action} by {was.reviewer}, {entry.action} by "
                f"{entry.reviewer}): was it merged or edited by hand? Keep the right one."
            )
    return fresh


def append(
    path: Path,
    entry: Entry,
    *,
    check: Callable[[ReviewState], None] | None = None,
    journal: "Journal | None" = None,
) -> None:
    """Add one line to the journal; when this returns, the line is on the disk.

    An exclusive lock (fcntl) lets several processes write to the same journal. A fragment that a
    killed process left without its line end is closed first, so that it spoils no other line.

    Args:
        path: the journal.
        entry: the line.
        check: called, nobody else writing, with what the journal adds up to; what it raises keeps
            the line out (see `corrections.check_is_current`).
        journal: who has read it before and reads on; None = it is read whole.
    """
    import fcntl

    line = json.dumps({"format": FORMAT, **asdict(entry)}, ensure_ascii=False) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    created = not path.exists()
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        if check is not None:
            check((journal or Journal(path)).read())
        size = os.fstat(handle).st_size
        torn = size > 0 and os.pread(handle, 1, size - 1) != b"\n"
        rest = (b"\n" if torn else b"") + line.encode()
        try:
            while rest:
                rest = rest[os.write(handle, rest) :]
            os.fsync(handle)
        except OSError:
            os.ftruncate(handle, size)  # the disk is full: nothing of the line stays
            raise
    finally:
        os.close(handle)
    if created:
        sync_folder(path.parent)


def read(path: Path) -> JournalContent:
    """Return the lines of a journal; none if there is no file yet.

    Raises:
        InputError: it is no file or far too large, a line is of a newer format, or is whole JSON
            that is no journal line.
    """
    journal = Journal(path)
    return JournalContent(entries=journal.read().entries, damaged=journal.damaged)


class Journal:
    """A journal that is read again and again; everything here may be called from any thread.

    What was read stays. While the file begins with the very bytes that were read, which a checksum
    tells, only the lines after them are parsed; otherwise it is read whole.
    """

    def __init__(self, path: Path) -> None:
        """Take where it stands; nothing is read yet."""
        self._path, self._lock = path, threading.RLock()
        self.state, self._once = ReviewState(), dict[str, Entry]()
        """What it added up to when it was read last, and its lines by id."""
        self.damaged: tuple[int, ...] = ()
        """As in `JournalContent`."""
        self._stamp, self._end = (0, 0, 0), (0, 0, 0)
        """The file as it was, and what was read of it: bytes, their checksum, lines."""

    def read(self) -> ReviewState:
        """Return what it adds up to as it is on disk now; the same object if nothing is new.

        Raises:
            SessionGone: lines that were read are gone.
            InputError: as `read` does.
        """
        with self._lock:
            if (stamp := stamp_of(self._path)) != self._stamp:
                self._read_on()
                self._stamp = stamp
            return self.state

    def _read_on(self) -> None:
        entries, damaged, line, checksum = list[Entry](), list[int](), b"\n", 0
        there = self._path.exists()
        if there and (not self._path.is_file() or self._path.stat().st_size > MOST_BYTES):
            raise InputError(
                f"'{self._path}' is no journal: a file of at most {MOST_BYTES / 1e6:.0f} MB is "
                "expected."
            )
        with self._path.open("rb") if there else io.BytesIO() as file:
            for at in range(0, self._end[0], BLOCK_BYTES):
                block = file.read(min(BLOCK_BYTES, self._end[0] - at))
                checksum = zlib.crc32(block, checksum)
            goes_on = (file.tell(), checksum) == self._end[:2]
            size, checksum, number = self._end if goes_on else (0, 0, 0)
            file.seek(size)
            for line in file:
                size, checksum, number = size + len(line), zlib.crc32(line, checksum), number + 1
                try:
                    fields = json.loads(line)
                except (ValueError, RecursionError):
                    damaged += [number] if line.strip() else []
                else:
                    entries.append(_entry(fields, f"{self._path.name}, line {number}"))
        fresh = _fresh(entries, self._once if goes_on else {})
        if not goes_on:
            if lost := len(self._once.keys() - fresh.keys()):
                raise SessionGone(
                    f"the journal that was read is gone: {self._path} lacks {lost} of its "
                    f"{len(self._once)} lines. Nothing is recorded meanwhile. Put the file back, "
                    "or end `realsim review` and start it again to go on without them."
                )
            self.state, self._once, self.damaged = ReviewState(), {}, ()
        if fresh:
            self.state = ReviewState(entries=(*self.state.entries, *fresh.values()))
            self._once |= fresh
        self.damaged += tuple(damaged)
        # A line without its end may go on: the file is then read whole again.
        self._end = size, checksum if line.endswith(b"\n") else -1, number


def stamp_of(path: Path) -> tuple[int, int, int]:
    """Return number, size and time of change of a file; zeros where there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return 0, 0, 0
    return found.st_ino, found.st_size, found.st_mtime_ns


def _entry(fields: Any, where: str) -> Entry:
    """Return the record of one parsed line."""
    if not isinstance(fields, dict) or fields.get("format") not in READABLE:
        raise InputError(
            f"{where}: this is no journal line of format 1 or {FORMAT}; was it written by a newer "
            "version? Update, or look at the line by hand."
        )
    named = {str(k): v for k, v in fields.items() if k != "format"}
    try:
        return Entry(**named)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{where}: the fields do not fit a journal line ({error}).") from error
