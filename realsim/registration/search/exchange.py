"""Two objects in each other's places: both are taken out and sought in the space they leave.

In a pile an angle bracket stands in the place of a T profile and explains most of it; the profile
finds its own place taken and settles for the bracket's. Moved one at a time neither can leave.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from realsim.registration.search import peel
from realsim.registration.search.bench import fitted_candidates, resting_starts
from realsim.registration.search.polish import owners
from realsim.registration.search.records import Region
from realsim.registration.search.refine import Fused
from realsim.registration.search.scoring import Array32, compose
from realsim.registration.search.selection import Selection, Slot, select_pair
from realsim.registration.search.state import Search

Array = NDArray[np.float64]


def exchanged(search: Search, selection: Selection) -> Selection:
    """Return the choice after unsure objects were tried in the places of others.

    Where it is not known which objects are there, every place is open to all of them anyway.
    """
    if search.wanted is None:
        return selection
    config = search.bench.config.exchange
    rng = np.random.default_rng(config.seed)
    pairs = _pairs(search, selection)[: config.most_pairs]
    for u, v in pairs:
        if selection.chosen[v] is None or peel.is_sure(selection.scores[u], _peel(search)):
            continue
        rest = [c for n, c in enumerate(selection.chosen) if c is not None and n not in (u, v)]
        buffer = compose(search.bench.canvas.table, [search.pool[c].rendered for c in rest])
        _seek(search, (u, v), selection, buffer, rng)
        slots = (Slot(choices=frozenset(search.choices[u] - set(rest))),
                 Slot(choices=frozenset(search.choices[v] - set(rest))))  # fmt: skip
        now = (selection.chosen[u], selection.chosen[v])
        better = select_pair(
            search.bench.canvas, search.pool, slots, now, buffer, search.bench.config.selection
        )
        search.bench.watch.lap("exchange")
        if better is None:
            continue
        chosen = list(selection.chosen)
        chosen[u], chosen[v] = better
        selection = search.choose(chosen)
    return selection


def _peel(search: Search) -> peel.PeelConfig:
    """Return when an object is sure."""
    return search.bench.config.peel


def _pairs(search: Search, selection: Selection) -> list[tuple[int, int]]:
    """Return an unsure object and a placed one of similar size, of another model, each.

    Those come first of which both agree least with the images.
    """
    assert search.wanted is not None
    bench, wanted, config = search.bench, search.wanted, search.bench.config.exchange
    radius = [bench.sought[w.obj_id].body.radius_m for w in wanted]
    agree = [-1.0 if s is None else s.agree for s in selection.scores]
    least = bench.config.peel.sure_agree
    found: list[tuple[float, int, int]] = []
    for u in (n for n in range(len(wanted)) if agree[n] < least):
        lost = selection.chosen[u] is None
        mine: list[tuple[float, int, int]] = []
        for v, c in enumerate(selection.chosen):
            twice = agree[v] < least and v < u and not lost
            if c is None or v == u or twice or wanted[u].obj_id == wanted[v].obj_id:
                continue
            ratio = abs(float(np.log(radius[u] / radius[v])))
            certain = agree[v] > config.certain_agree and not lost
            if ratio <= np.log(config.size_ratio) and not certain:
                mine.append((agree[u] + agree[v] + ratio, u, v))
        found += sorted(mine)[: config.most_per_object]
    return [(u, v) for _, u, v in sorted(found)]


def _seek(
    search: Search,
    pair: tuple[int, int],
    selection: Selection,
    buffer: Array32,
    rng: np.random.Generator,
) -> None:
    """Put poses of each of two objects in the other's place into the pool."""
    assert search.wanted is not None
    bench, wanted = search.bench, search.wanted
    at = [selection.chosen[n] for n in pair]
    placed = [
        (bench.sought[search.pool[c].obj_id], search.pool[c])
        for n, c in enumerate(selection.chosen) if c is not None and n not in pair
    ]  # fmt: skip
    peeling = bench.config.peel
    left = Fused(
        coarse=bench.fused.coarse.select(
            ~peel.explained_points(bench.fused.coarse, placed, peeling)
        ),
        fine=bench.fused.fine.select(~peel.explained_points(bench.fused.fine, placed, peeling)),
    )
    for n, there in zip(pair, reversed(at), strict=True):
        if there is None:
            continue
        starts = _starts(search, wanted[n].obj_id, there, left, rng)
        found = fitted_candidates(bench, wanted[n].obj_id, starts, wanted[n].region, (left, buffer))
        search.add(found, [n])


def _starts(
    search: Search, obj_id: int, there: int, left: Fused, rng: np.random.Generator
) -> Sequence[tuple[Array, str]]:
    """Return poses (4, 4) of a model in the place of another object, and their names."""
    bench, config = search.bench, search.bench.config.exchange
    other = search.pool[there]
    sought = bench.sought[other.obj_id]
    T = other.T_world_obj
    own = owners(left.coarse, [sought], [T], bench.config.peel.explained_m) == 0
    middle = sought.body.center(T)
    beside = Region(center_world=middle, radius_m=config.beside_m)
    starts = [(S, f"exchange, {name}") for S, name in resting_starts(bench, obj_id, beside)]
    if np.count_nonzero(own) >= bench.config.peel.least_points:
        turns = replace(bench.config.peel, rotations=config.turns, most_starts=config.turns)
        up = bench.plane.T_world_table[:3, 2]
        groups = [left.coarse.points[own]]
        random = peel.residual_starts(bench.sought[obj_id], groups, up, rng, turns)
        starts += [(S, name.replace("residual 0", "exchange")) for S, name in random]
    return starts
