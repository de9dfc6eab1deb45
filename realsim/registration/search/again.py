"""What is unsure is sought again in what the sure ones leave over."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.registration.search import peel
from realsim.registration.search.bench import fitted_candidates, resting_starts
from realsim.registration.search.refine import Candidate, Fused, Sought
from realsim.registration.search.scoring import compose
from realsim.registration.search.selection import Selection
from realsim.registration.search.state import Search

Array = NDArray[np.float64]


def peeled(search: Search, selection: Selection) -> Selection:
    """Return the choice after what is unsure was sought again where the sure ones are not."""
    config = search.bench.config.peel
    rng = np.random.default_rng(search.bench.config.seed)
    for round_ in range(1 + config.rounds):
        unsure = [n for n, s in enumerate(selection.scores) if not peel.is_sure(s, config)]
        if (search.wanted is not None and not unsure) or not _sought(
            search, selection, unsure, None if round_ == 0 else rng
        ):
            break
        selection = search.choose(selection.chosen)
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
    bench, config = search.bench, search.bench.config.peel
    T_table_world = se3.invert(bench.plane.T_world_table)
    sure = _placed(search, selection, unsure)
    known = peel.explained_points(bench.fused.coarse, sure, config)
    rest = bench.fused.coarse.select(~known)
    groups = peel.clusters(rest.points, T_table_world, config)
    if not groups:
        return False
    fine = peel.explained_points(bench.fused.fine, sure, config)
    left = Fused(coarse=rest, fine=bench.fused.fine.select(~fine))
    buffer = compose(bench.canvas.table, [c.rendered for _, c in sure])
    taken = peel.taken_cells(bench.grid, T_table_world, bench.fused.coarse, known)
    bench.watch.lap("peel")
    for obj_id, region, places in search.groups(unsure):
        starts = (
            resting_starts(bench, obj_id, region, taken)
            if rng is None
            else peel.residual_starts(
                bench.sought[obj_id], groups, bench.plane.T_world_table[:3, 2], rng, config
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
    bench, config = search.bench, search.bench.config.peel
    at = [n for n, c in enumerate(selection.chosen) if c is not None]
    placed = _placed(search, selection)
    cloud = bench.fused.coarse
    rest = cloud.points[~peel.explained_points(cloud, placed, config)]
    left = peel.clusters(rest, se3.invert(bench.plane.T_world_table), config)
    found = [at[n] for n in peel.suspects(cloud, left, placed, config)]
    bench.watch.lap("peel")
    return found
