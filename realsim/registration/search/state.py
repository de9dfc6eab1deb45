"""The state of a search: the poses found so far, and which wanted object may have which."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from realsim.registration.search.bench import Bench
from realsim.registration.search.records import Region, Wanted
from realsim.registration.search.refine import Candidate, inside_share
from realsim.registration.search.selection import Selection, Slot, select, select_any


@dataclass(eq=False, kw_only=True)
class Search:
    """The state of a search."""

    bench: Bench
    wanted: tuple[Wanted, ...] | None
    """None = whatever is there."""
    pool: list[Candidate] = field(default_factory=list[Candidate])
    choices: list[set[int]] = field(default_factory=list[set[int]])
    """Per wanted object its poses in the pool."""

    def choose(self, first: Sequence[int | None] | None = None) -> Selection:
        """Return the joint choice; `first` is what was chosen before."""
        canvas, config = self.bench.canvas, self.bench.config.selection
        if self.wanted is None:
            before = [c for c in first or () if c is not None]
            chosen = select_any(canvas, self.pool, config, before, self._clash)
        else:
            slots = [Slot(choices=frozenset(c)) for c in self.choices]
            chosen = select(canvas, self.pool, slots, config, first)
        self.bench.watch.lap("select")
        return chosen

    def _clash(self, n: int, k: int) -> bool:
        """Return whether two poses of the pool cannot both be."""
        config = self.bench.config.selection
        a, b = self.pool[n], self.pool[k]
        sought = self.bench.sought
        share = inside_share(
            sought[a.obj_id], a.T_world_obj, sought[b.obj_id], b.T_world_obj, config.clash_depth_m
        )
        return share > config.clash_share

    def add(self, found: Sequence[Candidate], places: Sequence[int]) -> None:
        """Put poses into the pool, for wanted objects at these places; known ones are left out."""
        for c in found:
            same = self.bench.sought[c.obj_id].sameness
            known = [n for n, k in enumerate(self.pool) if k.obj_id == c.obj_id]
            Ts = np.array([self.pool[n].T_world_obj for n in known]).reshape(-1, 4, 4)
            apart = same.distances(c.T_world_obj, Ts)
            if known and apart.min() < 0.5 * self.bench.config.refine.same_m:
                at = known[int(np.argmin(apart))]
                if c.alone.gain > self.pool[at].alone.gain:
                    self.pool[at] = c
            else:
                at = len(self.pool)
                self.pool.append(c)
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
