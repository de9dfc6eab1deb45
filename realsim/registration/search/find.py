"""All objects of a scene, from nothing or from rough starts, known by name or not.

fuse the views           points above the table, heights over it
hypotheses per model     height templates over the table; starts that someone claims
fit, compare, render     alike poses kept once
choose jointly           one pose per object, all z-buffers together
peel                     what is unsure is sought again in what the sure ones leave over
exchange                 ... and in the places of others
polish                   every point belongs to one object
contrast                 near-symmetric poses against each other
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.records import CameraIntrinsics, ObjectModel, SupportPlane
from realsim.registration.evidence import DepthFrame, DepthNoise
from realsim.registration.search.bench import (
    FindConfig,
    claimed_starts,
    fitted_candidates,
    make_bench,
    resting_starts,
    within,
)
from realsim.registration.search.candidates import Candidate, candidate
from realsim.registration.search.polish import Decision, decide_rivals, polish_poses
from realsim.registration.search.records import NotPlaced, Placed, SearchResult, Wanted
from realsim.registration.search.scoring import compose, render, score
from realsim.registration.search.selection import LEAST_PER_CELL, Selection
from realsim.registration.search.state import Search, exchange_places, seek_unsure
from realsim.registration.views import ViewPoints

__all__ = ["FindConfig", "find_objects"]


def find_objects(  # noqa: PLR0913 - the stage's inputs, all of them needed
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    views: Sequence[ViewPoints],
    plane: SupportPlane,
    noise: DepthNoise,
    models: Mapping[int, ObjectModel],
    wanted: Sequence[Wanted] | None,
    config: FindConfig,
    *,
    field_folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    told: Callable[[str], None] | None = None,
) -> SearchResult:
    """Return the poses of the wanted objects, or of whatever models are there.

    Args:
        intrinsics: the camera.
        frames: depth images to render into; of a lazy sequence as long as `views`, and in the same
            order, only those used are read.
        views: thinned points of all views.
        plane: what the objects stand on.
        noise: of the depth.
        models: by id.
        wanted: what is sought; None = all models compete, number and identity unknown.
        config: settings.
        field_folder: where what is derived from meshes is kept between runs; None = in memory.
        progress: called with (groups of hypotheses made, groups).
        told: called with words for what is being done.

    Raises:
        InputError: no frames, no views, no models, or two wanted objects of one instance number.
    """
    sensible, missing = _check_wanted(models, wanted)
    used = {w.obj_id for w in sensible} if sensible is not None else set(models)
    bench = make_bench(
        intrinsics, frames, views, (plane, noise), {i: models[i] for i in used}, config,
        field_folder, told,
    )  # fmt: skip
    search = Search(bench=bench, wanted=sensible, told=told)
    search.choices = [set() for _ in sensible or ()]
    groups = search.groups(range(len(sensible or ())))
    for n, (obj_id, region, places) in enumerate(groups):
        search.say(f"searching model {n + 1} of {len(groups)}", obj_id)
        starts = [s for p in places if sensible for s in claimed_starts(bench, sensible[p])]
        starts += resting_starts(bench, obj_id, region)
        search.add(fitted_candidates(bench, obj_id, starts, region), places)
        if progress is not None:
            progress(n + 1, len(groups))
    selection = search.choose()
    first = len(search.pool)
    before = seek_unsure(search, selection)
    selection = exchange_places(search, before)
    if selection.chosen != before.chosen:
        selection = seek_unsure(search, selection)
    final, decisions = _finish(search, selection)
    report = {
        "cpu_s": {k: round(v, 3) for k, v in bench.watch.seconds.items()},
        "poses_first": first,
        "poses": len(search.pool),
        "changed_by_contrast": sum(d is not None and d.changed for d in decisions),
    }
    placed, not_placed = _results(search, final, decisions)
    return SearchResult(placed=placed, not_placed=(*not_placed, *missing), report=report)


def _check_wanted(
    models: Mapping[int, ObjectModel], wanted: Sequence[Wanted] | None
) -> tuple[tuple[Wanted, ...] | None, list[NotPlaced]]:
    """Return the wanted objects that have a model, and those that have none."""
    if not models:
        raise InputError("no models were given; a search needs the meshes of what it seeks.")
    if wanted is None:
        return None, []
    if len({w.instance for w in wanted}) != len(wanted):
        raise InputError("two wanted objects have the same instance number; each needs its own.")
    missing = [
        NotPlaced(
            obj_id=w.obj_id,
            instance=w.instance,
            reason=f"there is no model with the id {w.obj_id}; there are {sorted(models)}",
        )
        for w in wanted
        if w.obj_id not in models
    ]
    return tuple(w for w in wanted if w.obj_id in models), missing


def _finish(
    search: Search, selection: Selection
) -> tuple[list[Candidate | None], list[Decision | None]]:
    """Return the chosen poses, polished and set against their near-symmetric rivals."""
    bench = search.bench
    at = [n for n, c in enumerate(selection.chosen) if c is not None]
    chosen = [search.pool[c] for c in selection.chosen if c is not None]
    soughts = [bench.sought[c.obj_id] for c in chosen]

    def polish() -> list[Candidate]:
        pairs = list(zip(soughts, chosen, strict=True))
        out = polish_poses(bench.canvas, bench.fused.fine, pairs)
        bench.watch.lap("polish")
        return out

    search.say(f"comparing {len(chosen)} poses with what looks nearly the same")
    chosen = polish()
    renders = [
        render(bench.close, s.body, c.T_world_obj) for s, c in zip(soughts, chosen, strict=True)
    ]
    decisions: list[Decision | None] = []
    for n, sought in enumerate(soughts):
        others = compose(bench.close.table, [r for k, r in enumerate(renders) if k != n])
        evidence = (bench.close, bench.fused.fine, _near(search, at[n], chosen[n]))
        d = decide_rivals(sought, chosen[n].T_world_obj, others, evidence)
        if d.changed:
            chosen[n] = candidate(sought, bench.canvas, d.T_world_obj, chosen[n].source)
            renders[n] = render(bench.close, sought.body, d.T_world_obj)
        decisions.append(d)
    bench.watch.lap("contrast")
    if any(d is not None and d.changed for d in decisions):
        chosen = polish()
    final: list[Candidate | None] = [None] * len(selection.chosen)
    of: list[Decision | None] = [None] * len(selection.chosen)
    for n, c, d in zip(at, chosen, decisions, strict=True):
        final[n], of[n] = c, d
    return final, of


def _near(search: Search, n: int, pose: Candidate) -> Array:
    """Return the near-symmetries (N, 4, 4) of a pose that lead to where its object may be."""
    bench = search.bench
    near = bench.near(pose.obj_id)
    region = None if search.wanted is None else search.wanted[n].region
    if region is None:
        return near
    sought = bench.sought[pose.obj_id]
    return near[[within(bench, sought, pose.T_world_obj @ S, region) for S in near]]


def _results(
    search: Search, final: Sequence[Candidate | None], decisions: Sequence[Decision | None]
) -> tuple[tuple[Placed, ...], tuple[NotPlaced, ...]]:
    """Return what was found, and what was not and why."""
    canvas = search.bench.canvas
    placed: list[Placed] = []
    missing: list[NotPlaced] = []
    pixels = float(canvas.stride**2)
    for n, c in enumerate(final):
        instance = n if search.wanted is None else search.wanted[n].instance
        if c is None:
            missing.append(_not_placed(search, final, n))
            continue
        others = [k.rendered for m, k in enumerate(final) if k is not None and m != n]
        s = score(canvas, c.rendered, compose(canvas.table, others))
        d = decisions[n]
        placed.append(
            Placed(
                obj_id=c.obj_id,
                instance=instance,
                T_world_obj=c.T_world_obj,
                gain_px=s.gain * pixels,
                gain_per_pixel=s.per_cell,
                agree=s.agree,
                pixels=s.cells * pixels,
                contrast=None if d is None else d.contrast,
                T_rival=None if d is None else d.T_rival,
                source=c.source,
            )
        )
    return tuple(placed), tuple(missing)


def _not_placed(search: Search, final: Sequence[Candidate | None], n: int) -> NotPlaced:
    """Return why a wanted object has no pose."""
    assert search.wanted is not None
    wanted, canvas = search.wanted[n], search.bench.canvas
    where = "on the table" if wanted.region is None else "in its region"
    buffer = compose(canvas.table, [k.rendered for k in final if k is not None])
    rest = [search.pool[k] for k in search.choices[n]]
    scores = [score(canvas, c.rendered, buffer).per_cell for c in rest]
    strange = "" if wanted.T_start is None else ", or its start is of another scene"
    reason = (
        f"nothing {where} looks like it"
        if not rest
        else f"nothing that was measured {where} looks like it, beside what the other objects and "
        f"the table explain (best of {len(rest)} poses: {max(scores):.2f} likelier per pixel, "
        f"{LEAST_PER_CELL:.2f} is needed): it is not there, or the depth does not show it{strange}"
    )
    return NotPlaced(obj_id=wanted.obj_id, instance=wanted.instance, reason=reason)
