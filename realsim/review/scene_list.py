"""Which sessions a review is about, and their objects in the order in which they want a look."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from realsim.errors import InputError
from realsim.store.opening import require_header

SESSION_FILE = "session.json"
SCENE_FILE = "registration/scene.json"
VERDICT_ORDER = ("rejected", "doubtful", "unchecked", "accepted")
"""Worst first."""
DEEPEST = 4
"""How far below a given folder sessions are looked for: BOP's ROOT/SPLIT/SCENE, and one more."""
INNER = (
    "calibration", "cameras", "rgb", "depth", "models", "registration", "grasps", "labels",
    "annotations",
)  # fmt: skip
"""Folders of a session that hold no session to be reviewed."""
Which = Literal["all", "undecided", "decided"]


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectRow:
    """One object in the list."""

    session: int
    """Number of its session in the list of sessions."""
    instance: int
    name: str
    verdict: str
    """The reviewer's verdict; without one, the computed one: `unchecked` where it was moved."""
    agree: float
    """Share of its pixels that agree with the measured depth; NaN where it was not measured."""
    is_decided: bool
    """Whether a person has accepted or rejected it where it stands."""
    is_changed: bool = False
    """Whether a person has moved it or said that it is another object."""

    @property
    def key(self) -> tuple[int, int]:
        """(session, instance)."""
        return self.session, self.instance


def sessions_under(folders: Sequence[Path]) -> list[Path]:
    """Return the sessions that are meant: each folder itself, or those below it, in order.

    Raises:
        InputError: a folder is none, or holds no session.
    """
    found: list[Path] = []
    for folder in folders:
        if not folder.is_dir():
            raise InputError(
                f"'{folder}' is not a folder; a session (a folder that holds {SESSION_FILE}) or a "
                "folder of sessions is expected. `realsim demo` makes one in demo/session."
            )
        require_header(folder)
        inside = _sessions_in(folder, DEEPEST)
        if not inside:
            raise InputError(
                f"'{folder}' holds no {SESSION_FILE}, nor does a folder in it, so there is nothing "
                "to review. Give a folder that `realsim demo`, `capture`, `import`, `generate` or "
                "`upgrade` has filled."
            )
        found += inside
    once: dict[Path, Path] = {}
    for path in found:
        once.setdefault(path.resolve(), path)
    return list(once.values())


def names_of(folders: Sequence[Path]) -> list[str]:
    """Return what tells folders apart: the ends of their paths, of as many parts as that takes."""
    parts = [folder.resolve().parts for folder in folders]
    ends = [["/".join(p[-k:]) for k in range(1, len(p) + 1)] for p in parts]
    count = Counter(end for row in ends for end in row)
    return [next((end for end in row if count[end] == 1), row[-1]) for row in ends]


def _sessions_in(folder: Path, deepest: int) -> list[Path]:
    if (folder / SESSION_FILE).is_file():
        return [folder]
    if deepest == 0:
        return []
    found: list[Path] = []
    for inner in sorted(folder.iterdir()):
        if inner.is_dir() and inner.name not in INNER and not inner.name.startswith("."):
            found += _sessions_in(inner, deepest - 1)
    return found


def worst_first(rows: Sequence[ObjectRow]) -> list[ObjectRow]:
    """Return the objects: those that wait for a person first, then by verdict and agreement.

    The worst verdict comes first, then the smallest agreement with the measured depth.
    """

    def badness(row: ObjectRow) -> tuple[bool, int, float, int, int]:
        agree = 0.0 if math.isnan(row.agree) else row.agree
        verdict = VERDICT_ORDER.index(row.verdict)
        return row.is_decided, verdict, agree, row.session, row.instance

    return sorted(rows, key=badness)


def of_kind(rows: Sequence[ObjectRow], which: Which) -> list[ObjectRow]:
    """Return all objects, those that wait for a person, or those that a person judged."""
    return [r for r in rows if which == "all" or r.is_decided == (which == "decided")]


def next_undecided(
    rows: Sequence[ObjectRow], now: tuple[int, int] | None, step: Literal[1, -1]
) -> ObjectRow | None:
    """Return the next object that waits for a person, round the list; None = all are judged.

    Args:
        rows: in the order of the list.
        now: (session, instance) of the object looked at; None = none.
        step: 1 = the next one, -1 = the one before.
    """
    at = next((k for k, r in enumerate(rows) if r.key == now), -1 if step > 0 else len(rows))
    n = len(rows)
    for k in range(1, n + 1):
        row = rows[(at + step * k) % n]
        if not row.is_decided and (row.key != now or k == n):
            return row
    return None


def first_wanted(rows: Sequence[ObjectRow]) -> ObjectRow | None:
    """Return the object that a new window shows: the worst that waits for a person, else the worst.

    None = there is none at all.
    """
    ordered = worst_first(rows)
    return next_undecided(ordered, None, 1) or next(iter(ordered), None)


def counts(rows: Sequence[ObjectRow]) -> tuple[int, int]:
    """Return how many objects a person has judged, and how many there are."""
    return sum(r.is_decided for r in rows), len(rows)
