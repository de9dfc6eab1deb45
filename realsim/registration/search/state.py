"""The state of a search: the poses found so far, and which wanted object may have which."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.registration.search import peel
from realsim.registration.search.bench import Bench, fitted_candidates, resting_starts
from realsim.registration.search.candidates import SAME_M, Candidate, Fused, Sought, inside_share
from realsim.registration.search.polish import owners
from realsim.registration.search.records import Region, Wanted
from realsim.registration.search.scoring import compose
from realsim.registration.search.selection import (
    CLASH_DEPTH_M,
    CLASH_SHARE,
    Selection,
    select,
    select_any,
    select_pair,
)

SIZE_RATIO = 1.7
"""Objects whose radii differ by more do not explain each other's points."""
EXCHANGE_TURNS = 40
"""Random turns tried in the other's place, 45 deg apart: a fit converges from 30."""
EXCHANGE_BESIDE_M = 0.025
"""Resting poses are sought so near to the other's middle [m]."""
CERTAIN_AGREE = 0.995
"""An object of which a greater share agrees stands in nobody's place, unless the other has none
at all."""
MOST_PER_OBJECT = 3
"""Places tried for one unsure object: 0.2 s each."""
MOST_PAIRS = 8
"""Pairs tried at most, the least sure ones first."""
EXCHANGE_SEED = 1
"""Seed of the random turns."""


@dataclass(eq=False, kw_only=True)
class Search:
    """The state of a search."""

    bench: Bench
    wanted: tuple[Wanted, ...] | None
    """None = whatever is there."""
    pool: list[Candidate] = field(default_factory=list[Candidate])
    choices: list[set[int]] = field(default_factory=list[set[int]])
    """Per wanted object its poses in the pool."""
    told: Callable[[str], None] | None = None
    """Is told in words what is being done."""
    _known: dict[int, list[int]] = field(default_factory=dict[int, list[int]])
    """Per model its poses in the pool."""

    def say(self, words: str, obj_id: int | None = None) -> None:
        """Tell what is being done, and for which model."""
        if self.told is not None:
            name = "" if obj_id is None else f": {self.bench.sought[obj_id].body.model.name}"
            self.told(f"{words}{name}")

    def choose(self, first: Sequence[int | None] | None = None) -> Selection:
        """Return the joint choice; `first` is what was chosen before, of wanted objects."""
        canvas = self.bench.canvas
        self.say(f"choosing among {len(self.pool)} poses")
        if self.wanted is None:
            # A new pose of a large object can stand for several small ones: all compete again.
            chosen = select_any(canvas, self.pool, self._clash)
        else:
            slots = [frozenset(c) for c in self.choices]
            chosen = select(canvas, self.pool, slots, first)
        self.bench.watch.lap("select")
        return chosen

    def _clash(self, n: int, k: int) -> bool:
        """Return whether two poses of the pool cannot both be."""
        a, b = self.pool[n], self.pool[k]
        sought = self.bench.sought
        share = inside_share(
            sought[a.obj_id], a.T_world_obj, sought[b.obj_id], b.T_world_obj, CLASH_DEPTH_M
        )
        return share > CLASH_SHARE

    def add(self, found: Sequence[Candidate], places: Sequence[int]) -> None:
        """Put poses into the pool, for wanted objects at these places; known ones are left out.

        Where anything may be anywhere, poses that explain nothing are left out, too.
        """
        least = -np.inf if self.wanted is not None else 0.0
        for c in (c for c in found if c.alone.gain > least):
            same = self.bench.sought[c.obj_id].sameness
            known = self._known.setdefault(c.obj_id, [])
            Ts = np.array([self.pool[n].T_world_obj for n in known]).reshape(-1, 4, 4)
            apart = same.distances(c.T_world_obj, Ts)
            if known and apart.min() < 0.5 * SAME_M:
                at = known[int(np.argmin(apart))]
                if c.alone.gain > self.pool[at].alone.gain:
                    self.pool[at] = c
            else:
                at = len(self.pool)
                self.pool.append(c)
                known.append(at)
            for n in places:
                self.choices[n].add(at)

    def groups(self, places: Sequence[int]) -> list[tuple[int, Region | None, list[int]]]:
        """Return what is sought at once: id, region, and the wanted objects at these places."""
        if self.wanted is None:
            return [(obj_id, None, []) for obj_id in self.bench.sought]
        free: dict[int, list[int]] = {}
        out: list[tuple[int, Region | None, list[int]]] = []
        for n in places:
            w = self.wanted[n]
            if w.region is not None:
                out.append((w.obj_id, w.region, [n]))
            else:
                free.setdefault(w.obj_id, []).append(n)
        return out + [(obj_id, None, ns) for obj_id, ns in free.items()]


def seek_unsure(search: Search, selection: Selection) -> Selection:
    """Return the choice after what is unsure was sought again where the sure ones are not."""
    rng = np.random.default_rng(search.bench.config.seed)
    for round_ in range(1 + peel.ROUNDS):
        unsure = [n for n, s in enumerate(selection.scores) if not peel.is_sure(s)]
        if (search.wanted is not None and not unsure) or not _sought(
            search, selection, unsure, None if round_ == 0 else rng
        ):
            break
        before, selection = selection, search.choose(selection.chosen)
        if search.wanted is None and round_ > 0 and selection.chosen == before.chosen:
            break
    if search.wanted is None:
        return selection
    unsure = _suspects(search, selection)
    if unsure and _sought(search, selection, unsure, rng):
        selection = search.choose(selection.chosen)
    return selection


def _sought(
    search: Search, selection: Selection, unsure: Sequence[int], rng: np.random.Generator | None
) -> bool:
    """Put poses of unsure objects into the pool; return whether there was anything left to explain.

    Args:
        search: the pool grows.
        selection: what is chosen.
        unsure: the places of those that are sought.
        rng: of the turns at clusters; None = at rest on the table.
    """
    bench = search.bench
    T_table_world = se3.invert(bench.plane.T_world_table)
    sure = _placed(search, selection, unsure)
    known = peel.explained_points(bench.fused.coarse, sure)
    rest = bench.fused.coarse.select(~known)
    groups = peel.clusters(rest.points, T_table_world)
    if not groups:
        return False
    fine = peel.explained_points(bench.fused.fine, sure)
    left = Fused(coarse=rest, fine=bench.fused.fine.select(~fine))
    buffer = compose(bench.canvas.table, [c.rendered for _, c in sure])
    taken = peel.taken_cells(bench.grid, T_table_world, bench.fused.coarse, known)
    bench.watch.lap("peel")
    most = min(peel.MOST_STARTS, max(1, peel.MOST_STARTS_TOGETHER // len(bench.sought)))
    sought = search.groups(unsure)
    for n, (obj_id, region, places) in enumerate(sought):
        search.say(f"searching what is left for model {n + 1} of {len(sought)}", obj_id)
        starts = (
            resting_starts(bench, obj_id, region, taken)
            if rng is None
            else peel.residual_starts(
                bench.sought[obj_id],
                groups,
                bench.plane.T_world_table[:3, 2],
                rng,
                peel.ROTATIONS,
                most,
            )
        )
        search.add(fitted_candidates(bench, obj_id, starts, region, (left, buffer)), places)
    return True


def _placed(
    search: Search, selection: Selection, but: Sequence[int] = ()
) -> list[tuple[Sought, Candidate]]:
    """Return the chosen objects but some."""
    kept = [c for n, c in enumerate(selection.chosen) if c is not None and n not in but]
    chosen = [search.pool[c] for c in kept]
    return [(search.bench.sought[c.obj_id], c) for c in chosen]


def _suspects(search: Search, selection: Selection) -> list[int]:
    """Return the places of the objects about which much is left over."""
    bench = search.bench
    at = [n for n, c in enumerate(selection.chosen) if c is not None]
    placed = _placed(search, selection)
    cloud = bench.fused.coarse
    rest = cloud.points[~peel.explained_points(cloud, placed)]
    left = peel.clusters(rest, se3.invert(bench.plane.T_world_table))
    found = [at[n] for n in peel.suspects(cloud, left, placed)]
    bench.watch.lap("peel")
    return found


def exchange_places(search: Search, selection: Selection) -> Selection:
    """Return the choice after unsure objects were tried in the places of others.

    Where it is not known which objects are there, every place is open to all of them anyway.
    """
    if search.wanted is None:
        return selection
    rng = np.random.default_rng(EXCHANGE_SEED)
    pairs = _pairs(search, selection)[:MOST_PAIRS]
    for u, v in pairs:
        if selection.chosen[v] is None or peel.is_sure(selection.scores[u]):
            continue
        rest = [c for n, c in enumerate(selection.chosen) if c is not None and n not in (u, v)]
        buffer = compose(search.bench.canvas.table, [search.pool[c].rendered for c in rest])
        _seek(search, (u, v), selection, buffer, rng)
        taken = set(rest)
        slots = (frozenset(search.choices[u] - taken), frozenset(search.choices[v] - taken))
        now = (selection.chosen[u], selection.chosen[v])
        better = select_pair(search.bench.canvas, search.pool, slots, now, buffer)
        search.bench.watch.lap("exchange")
        if better is None:
            continue
        chosen = list(selection.chosen)
        chosen[u], chosen[v] = better
        selection = search.choose(chosen)
    return selection


def _pairs(search: Search, selection: Selection) -> list[tuple[int, int]]:
    """Return an unsure object and a placed one of similar size, of another model, each.

    Those come first of which both agree least with the images.
    """
    assert search.wanted is not None
    bench, wanted = search.bench, search.wanted
    radius = [bench.sought[w.obj_id].body.radius_m for w in wanted]
    agree = [-1.0 if s is None else s.agree for s in selection.scores]
    least = peel.SURE_AGREE
    found: list[tuple[float, int, int]] = []
    for u in (n for n in range(len(wanted)) if agree[n] < least):
        lost = selection.chosen[u] is None
        mine: list[tuple[float, int, int]] = []
        for v, c in enumerate(selection.chosen):
            twice = agree[v] < least and v < u and not lost
            if c is None or v == u or twice or wanted[u].obj_id == wanted[v].obj_id:
                continue
            ratio = abs(float(np.log(radius[u] / radius[v])))
            certain = agree[v] > CERTAIN_AGREE and not lost
            if ratio <= np.log(SIZE_RATIO) and not certain:
                mine.append((agree[u] + agree[v] + ratio, u, v))
        found += sorted(mine)[:MOST_PER_OBJECT]
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
    placed = _placed(search, selection, pair)
    coarse, fine = (
        cloud.select(~peel.explained_points(cloud, placed))
        for cloud in (bench.fused.coarse, bench.fused.fine)
    )
    left = Fused(coarse=coarse, fine=fine)
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
    bench = search.bench
    other = search.pool[there]
    sought = bench.sought[other.obj_id]
    T = other.T_world_obj
    own = owners(left.coarse, [sought], [T], peel.EXPLAINED_M) == 0
    middle = sought.body.center(T)
    beside = Region(center_world=middle, radius_m=EXCHANGE_BESIDE_M)
    starts = [(S, f"exchange, {name}") for S, name in resting_starts(bench, obj_id, beside)]
    if np.count_nonzero(own) >= peel.LEAST_POINTS:
        up = bench.plane.T_world_table[:3, 2]
        groups = [left.coarse.points[own]]
        random = peel.residual_starts(
            bench.sought[obj_id], groups, up, rng, EXCHANGE_TURNS, EXCHANGE_TURNS
        )
        starts += [(S, name.replace("residual 0", "exchange")) for S, name in random]
    return starts
