"""Two objects that stand in each other's places find their own."""

from functools import lru_cache

import numpy as np

from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.registration.search.bench import FindConfig, fitted_candidates, make_bench
from realsim.registration.search.candidates import CandidateConfig, candidate
from realsim.registration.search.records import Wanted
from realsim.registration.search.scoring import ScoreConfig
from realsim.registration.search.selection import Selection, buffer_of
from realsim.registration.search.state import Search, exchange_places
from realsim.registration.search.templates import TemplateConfig
from realsim.registration.views import SampleConfig, sample_views
from table_scenes import named_scene

NAMES = ("l_bracket", "t_profile", "wedge")
NOISE = DepthNoise(per_m=0.08 / (648 * 0.018), floor_m=2e-4)
PLANE = SupportPlane(T_world_table=np.eye(4), rms_m=1e-3, inliers=1000)
CONFIG = FindConfig(
    field_cells=48,
    templates=TemplateConfig(rays=1500),
    score=ScoreConfig(columns=80, frames=8),
    refine=CandidateConfig(refined=3),
)


@lru_cache(maxsize=1)
def swapped() -> tuple[Search, Selection]:
    """A search that knows of the first two objects only poses in each other's places."""
    scene = named_scene(2, NAMES)
    views = sample_views(scene.intrinsics, scene.frames, NOISE, SampleConfig(stride=1))
    bench = make_bench(
        scene.intrinsics, scene.frames, views, (PLANE, NOISE), scene.models, CONFIG, None
    )
    wanted = tuple(Wanted(obj_id=p.obj_id, instance=p.instance) for p in scene.truth)
    search = Search(bench=bench, wanted=wanted)
    search.choices = [set() for _ in wanted]
    centers = [bench.sought[p.obj_id].body.center(p.T_world_obj) for p in scene.truth]
    for n, there in ((0, 1), (1, 0)):
        p = scene.truth[n]
        T = se3.from_translation(centers[there] - centers[n]) @ p.T_world_obj
        search.add([candidate(bench.sought[p.obj_id], bench.canvas, T, "swapped", True)], [n])
    last = scene.truth[2]
    search.add(fitted_candidates(bench, last.obj_id, [(last.T_world_obj, "start")], None), [2])
    chosen = tuple(min(c) for c in search.choices)
    selection = Selection(
        chosen=chosen,
        scores=tuple(
            candidate_score(search, chosen, n) for n in range(len(chosen))
        ),
    )  # fmt: skip
    return search, selection


def candidate_score(search: Search, chosen: tuple[int, ...], n: int):
    from realsim.registration.search.scoring import score

    buffer = buffer_of(search.bench.canvas, search.pool, chosen, n)
    return score(search.bench.canvas, search.pool[chosen[n]].rendered, buffer)


def test_swapped_objects_find_their_own_places():
    search, selection = swapped()
    got = exchange_places(search, selection)
    for n, p in enumerate(named_scene(2, NAMES).truth):
        at = got.chosen[n]
        assert at is not None
        same = search.bench.sought[p.obj_id].sameness
        assert same.distance(p.T_world_obj, search.pool[at].T_world_obj) < 0.003
    # What is sure stays as it is.
    assert exchange_places(search, got).chosen == got.chosen
