"""Objects that are not where they were said to be, but where others were: ids taken for each other.

A rough pose restricts the search, so two swapped ids are both not found. What failed is sought once
more, anywhere; if it is found where another one was claimed, that is said, with both names.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from realsim.records import ObjectModel
from realsim.registration.judging.scene_checks import SceneFinding
from realsim.registration.search.records import Placed, SearchResult, Wanted

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class SwappedConfig:
    """When an object is sought again."""

    failed_gain: float = 0.9
    """An object that gains less than this per pixel was not surely found at its place: right ones
    gain 1.1 to 1.25 over the bare table."""
    failed_agree: float = 0.94
    """Likewise one of whose pixels less than this share agrees; right ones reach 0.95."""
    found_gain: float = 1.0
    """One that explains this much elsewhere is there."""


def with_swaps(
    result: SearchResult,
    asked: Sequence[Wanted],
    models: dict[int, ObjectModel],
    search: Callable[[Sequence[Wanted]], SearchResult],
    config: SwappedConfig,
) -> tuple[SearchResult, list[SceneFinding]]:
    """Return the search's result with objects that stand in each other's places, and who they are.

    Args:
        result: of the search at the claimed places.
        asked: what was sought.
        models: by id.
        search: seeks objects.
        config: see there.
    """
    good = {
        p.instance
        for p in result.placed
        if p.gain_per_pixel >= config.failed_gain and p.agree >= config.failed_agree
    }
    failed = [w for w in asked if w.T_start is not None and w.instance not in good]
    if len(failed) < 2:
        return result, []
    lost = {w.instance for w in failed}
    freed = [replace(w, region=None, T_start=None) if w.instance in lost else w for w in asked]
    second = {p.instance: p for p in search(freed).placed}
    moved: dict[int, Placed] = {}
    findings: list[SceneFinding] = []
    for w in failed:
        there = second.get(w.instance)
        if there is None or there.gain_per_pixel < config.found_gain:
            continue
        other = _claimed_there(there, w, failed, models)
        if other is not None:
            moved[w.instance] = there
            findings.append(_finding(w, other, models))
    if not moved:
        return result, []
    placed = [p for p in result.placed if p.instance not in moved]
    return replace(
        result, placed=(*placed, *moved.values()),
        not_placed=tuple(n for n in result.not_placed if n.instance not in moved),
    ), findings  # fmt: skip


def _claimed_there(
    placed: Placed, w: Wanted, failed: Sequence[Wanted], models: dict[int, ObjectModel]
) -> Wanted | None:
    """Return the other failed object that was claimed where this one was found."""
    center = _center(placed.T_world_obj, models[placed.obj_id])
    for other in failed:
        if other.obj_id == w.obj_id or other.T_start is None or other.region is None:
            continue
        gap = np.linalg.norm(center - _center(other.T_start, models[other.obj_id]))
        if gap < other.region.radius_m:
            return other
    return None


def _center(T: Array, model: ObjectModel) -> Array:
    """Return the centre of the model's box (3,) at a pose."""
    return T[:3, :3] @ model.mesh.bounds.mean(0) + T[:3, 3]


def _finding(w: Wanted, other: Wanted, models: dict[int, ObjectModel]) -> SceneFinding:
    """Return the finding of one object in another's place."""
    mine, theirs = models[w.obj_id].name, models[other.obj_id].name
    return SceneFinding(
        kind="swapped ids",
        words=f"{mine} (id {w.obj_id}, instance {w.instance}) was not found at its given pose but "
        f"where {theirs} (id {other.obj_id}, instance {other.instance}) was said to be: their ids "
        "are swapped. It was registered where it stands; correct the starts.",
        instances=(w.instance,),
        numbers={"other": other.instance},
    )
