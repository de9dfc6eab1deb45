"""Which poses explain the images together: one for every object, or as many as there are objects.

Greedily first: the pose with the greatest gain / sqrt(cells) over what is already placed (the
square root keeps large objects from swallowing what several small ones explain better). Then
coordinate ascent: one object at a time is taken out and chosen again among all its poses with the
others in place, until nothing changes.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array32
from realsim.registration.search.candidates import Candidate
from realsim.registration.search.scoring import Canvas, Score, compose, score

Slot = frozenset[int]
"""A place for one object: the poses of the pool that it may have."""
Clash = Callable[[int, int], bool]
"""Tells of two poses of the pool whether they cannot both be."""
Good = Callable[[Score, int, Iterable[int]], bool]
"""Tells of a score and a pose of the pool, with others in place, whether it is accepted."""


SWEEPS = 4
"""Greatest number of sweeps of coordinate ascent; two mostly change nothing any more."""
LEAST_PER_CELL = 0.10
"""Least gain per visible cell of an object that is said to be there: a pose that explains
less than this is a guess."""
LEAST_PER_CELL_UNKNOWN = 0.35
"""The same where it is not known which objects are there: of 134 wrong poses 14 % gain more
than 0.66, so the joint choice has to sort them out; below 0.35 nothing right was seen."""
LEAST_CELLS = 12
"""Visible cells, over all frames, below which nothing is said."""
LEAST_VISIBLE = 0.05
"""Share of its cells that must not be hidden: a wrong pose inside of something else agrees on
the few cells that show."""
CLASH_DEPTH_M = 0.004
"""Surface deeper than this inside of another object [m]."""
CLASH_SHARE = 0.05
"""Two poses are impossible together if more than this share lies so deep."""
BETTER_PX = 1.0
"""Cells by which another pose must gain more to replace a chosen one: ends the ascent."""
PAIR_SHORTLIST = 6
"""Where two objects are chosen together, so many best poses of one are tried with all of the
other."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Selection:
    """The chosen poses."""

    chosen: tuple[int | None, ...]
    """Per slot the place in the pool."""
    scores: tuple[Score | None, ...]
    """Per slot what its pose gains with all others in place."""


def select(
    canvas: Canvas,
    pool: Sequence[Candidate],
    slots: Sequence[Slot],
    first: Sequence[int | None] | None = None,
) -> Selection:
    """Return one pose of the pool for every slot that gets one.

    Args:
        canvas: where the poses were rendered.
        pool: poses of all objects.
        slots: what is to be placed.
        first: what is chosen already (per slot); the greedy choice fills the rest.
    """
    chosen: list[int | None] = list(first) if first is not None else [None] * len(slots)

    def good(s: Score, n: int, _others: Iterable[int]) -> bool:
        return _accepted(s, pool[n], LEAST_PER_CELL)

    _fill(canvas, pool, slots, chosen, good)
    _ascend(canvas, pool, slots, chosen, good)
    return Selection(chosen=tuple(chosen), scores=_scores(canvas, pool, chosen))


def select_any(canvas: Canvas, pool: Sequence[Candidate], clash: Clash | None = None) -> Selection:
    """Return as many poses of the pool as the images support, of whatever objects.

    Args:
        canvas: where the poses were rendered.
        pool: poses of all objects that may be there.
        clash: tells whether two poses of the pool cannot both be; None = never.
    """
    everything = frozenset(range(len(pool)))

    def good(s: Score, n: int, others: Iterable[int]) -> bool:
        if not _accepted(s, pool[n], LEAST_PER_CELL_UNKNOWN):
            return False
        return clash is None or not any(clash(n, k) for k in others)

    chosen: list[int | None] = []
    for _ in range(SWEEPS):
        before = sorted(c for c in chosen if c is not None)
        while not chosen or chosen[-1] is not None:
            chosen.append(None)
            _fill(canvas, pool, [everything] * len(chosen), chosen, good)
        chosen = [c for c in chosen if c is not None]
        _ascend(canvas, pool, [everything] * len(chosen), chosen, good)
        chosen = [c for c in chosen if c is not None]
        if sorted(c for c in chosen if c is not None) == before:
            break
    return Selection(chosen=tuple(chosen), scores=_scores(canvas, pool, chosen))


def buffer_of(
    canvas: Canvas, pool: Sequence[Candidate], chosen: Sequence[int | None], but: int | None = None
) -> Array32:
    """Return the buffer that holds all chosen poses but that of one slot."""
    others = [pool[c].rendered for n, c in enumerate(chosen) if c is not None and n != but]
    return compose(canvas.table, others)


def _accepted(s: Score, c: Candidate, least_per_cell: float) -> bool:
    """Return whether a score is enough to say that the object is there."""
    visible = s.cells >= max(LEAST_CELLS, LEAST_VISIBLE * len(c.rendered.cells))
    return visible and s.gain > 0 and s.per_cell >= least_per_cell


def _fill(
    canvas: Canvas,
    pool: Sequence[Candidate],
    slots: Sequence[Slot],
    chosen: list[int | None],
    good: Good,
) -> None:
    """Fill the open slots greedily."""
    while True:
        open_slots = [n for n, c in enumerate(chosen) if c is None]
        free = set[int]().union(*(slots[n] for n in open_slots)) - set(chosen)
        buffer = buffer_of(canvas, pool, chosen)
        placed = [c for c in chosen if c is not None]
        best, at = 0.0, None
        for n in sorted(free):
            if pool[n].alone.gain <= 0:
                continue
            s = score(canvas, pool[n].rendered, buffer)
            value = s.gain / np.sqrt(max(s.cells, 1))
            if value > best and good(s, n, placed):
                best, at = value, n
        if at is None:
            return
        # Of slots that may have it, the one with the fewest other choices.
        fitting = [n for n in open_slots if at in slots[n]]
        chosen[min(fitting, key=lambda n: (len(slots[n]), n))] = at


def _ascend(
    canvas: Canvas,
    pool: Sequence[Candidate],
    slots: Sequence[Slot],
    chosen: list[int | None],
    good: Good,
) -> None:
    """Choose every slot again with the others in place, until nothing changes."""
    for _ in range(SWEEPS):
        changed = False
        for n, slot in enumerate(slots):
            buffer = buffer_of(canvas, pool, chosen, but=n)
            taken = {c for k, c in enumerate(chosen) if c is not None and k != n}
            now = chosen[n]
            best, at = 0.0, None
            if now is not None and good(s := score(canvas, pool[now].rendered, buffer), now, taken):
                best, at = s.gain + BETTER_PX, now
            for k in sorted(slot - taken):
                s = score(canvas, pool[k].rendered, buffer)
                if s.gain > best and good(s, k, taken):
                    best, at = s.gain, k
            changed |= at != now
            chosen[n] = at
        if not changed:
            return


def _scores(
    canvas: Canvas, pool: Sequence[Candidate], chosen: Sequence[int | None]
) -> tuple[Score | None, ...]:
    """Return what every chosen pose gains with all others in place."""
    return tuple(
        None if c is None else score(canvas, pool[c].rendered, buffer_of(canvas, pool, chosen, n))
        for n, c in enumerate(chosen)
    )


def select_pair(
    canvas: Canvas,
    pool: Sequence[Candidate],
    slots: tuple[Slot, Slot],
    chosen: tuple[int | None, int | None],
    buffer: Array32,
) -> tuple[int, int] | None:
    """Return poses for two objects that explain more together than those they have, or None.

    One at a time neither of two objects that stand in each other's places can leave it.

    Args:
        canvas: where the poses were rendered.
        pool: poses of all objects.
        slots: of the two objects.
        chosen: what they have; at most one of them may have none.
        buffer: holds all other objects.
    """
    now, filled = BETTER_PX, buffer
    for c in chosen:
        if c is not None:
            now += score(canvas, pool[c].rendered, filled).gain
            filled = compose(filled, [pool[c].rendered])
    best: tuple[int, int] | None = None
    for first in (0, 1):
        ranked = _ranked(canvas, pool, slots[first], buffer)
        for gain, n in ranked[:PAIR_SHORTLIST]:
            with_it = compose(buffer, [pool[n].rendered])
            others = slots[1 - first] - {n}
            for more, k in _ranked(canvas, pool, others, with_it)[:1]:
                if gain + more > now:
                    now, best = gain + more, (n, k) if first == 0 else (k, n)
    return best


def _ranked(
    canvas: Canvas, pool: Sequence[Candidate], choices: Iterable[int], buffer: Array32
) -> list[tuple[float, int]]:
    """Return the gain and the place in the pool of acceptable poses, the best first."""
    scored = [(score(canvas, pool[n].rendered, buffer), n) for n in sorted(choices)]
    good = [(s.gain, n) for s, n in scored if _accepted(s, pool[n], LEAST_PER_CELL)]
    return sorted(good, key=lambda g: (-g[0], g[1]))
