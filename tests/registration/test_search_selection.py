"""The joint choice: known answers on a real scene's images, with right and wrong poses mixed."""

from functools import lru_cache

import numpy as np

from realsim.geometry import se3
from realsim.records import ObjectPose, SupportPlane
from realsim.registration.body import make_body
from realsim.registration.evidence import DepthNoise
from realsim.registration.search.candidates import Candidate, Sought, candidate
from realsim.registration.search.sameness import make_sameness
from realsim.registration.search.scoring import Canvas, ScoreConfig, compose, make_canvas
from realsim.registration.search.selection import (
    SelectionConfig,
    Slot,
    select,
    select_any,
    select_pair,
)
from table_scenes import named_scene

NAMES = ("mug", "wedge", "gear", "wedge")
NOISE = DepthNoise(per_m=0.08 / (648 * 0.018), floor_m=2e-4)
PLANE = SupportPlane(T_world_table=np.eye(4), rms_m=1e-3, inliers=1000)
CONFIG = SelectionConfig()


@lru_cache(maxsize=1)
def material() -> tuple[Canvas, list[Candidate], list[int]]:
    """The canvas, a pool with the right poses first, and which object each pose is of."""
    scene = named_scene(1, NAMES)
    rng = np.random.default_rng(0)
    canvas = make_canvas(
        scene.intrinsics, scene.frames[:8], NOISE, PLANE, ScoreConfig(columns=80, frames=8)
    )
    right: list[Candidate] = []
    wrong: list[Candidate] = []
    for p in scene.truth:
        start = ObjectPose(obj_id=p.obj_id, instance=0, T_world_obj=np.eye(4))
        model = scene.models[p.obj_id]
        body = make_body(start, model, 24, 50)
        sought = Sought(body=body, sameness=make_sameness(model))
        right.append(candidate(sought, canvas, p.T_world_obj, "right", True))
        for q in scene.truth:  # everywhere else, turned at random
            shift = q.T_world_obj[:3, 3] - p.T_world_obj[:3, 3]
            turn = se3.from_rt(se3.random_rotation(rng), np.zeros(3))
            T = se3.from_translation(shift + 0.004 * rng.normal(size=3)) @ p.T_world_obj @ turn
            wrong.append(candidate(sought, canvas, T, "wrong", False))
    pool = right + wrong
    return canvas, pool, [c.obj_id for c in pool]


def slots() -> list[Slot]:
    """One per object; the two wedges share theirs."""
    _, pool, ids = material()
    return [
        frozenset(n for n, i in enumerate(ids) if i == pool[k].obj_id) for k in range(len(NAMES))
    ]


def test_the_right_poses_are_chosen():
    canvas, pool, _ = material()
    got = select(canvas, pool, slots(), CONFIG)
    assert {c for c in got.chosen} == {0, 1, 2, 3}
    assert got.chosen[0] == 0
    assert got.chosen[2] == 2
    for s in got.scores:
        assert s is not None
        assert s.agree > 0.9


def test_two_of_one_model_never_share_a_pose():
    canvas, pool, _ = material()
    only = [frozenset([1]), frozenset([1])]
    got = select(canvas, pool, only, CONFIG)
    assert sorted(map(str, got.chosen)) == ["1", "None"]


def test_a_bad_first_choice_is_mended():
    canvas, pool, ids = material()
    bad = [n for n in range(len(pool)) if n >= 4 and ids[n] == pool[0].obj_id][1]
    got = select(canvas, pool, slots(), CONFIG, [bad, None, None, None])
    assert got.chosen[0] == 0


def test_wrong_poses_alone_are_refused():
    canvas, pool, _ = material()
    got = select_any(canvas, pool[4:], CONFIG)
    assert all(s is not None and s.per_cell >= CONFIG.least_per_cell_unknown for s in got.scores)
    empty = select(canvas, pool, [frozenset()], CONFIG)
    assert empty.chosen == (None,)
    assert empty.scores == (None,)


def test_two_that_stand_in_each_others_places_change_them():
    canvas, pool, ids = material()
    mug, gear = 0, 2
    here = [n for n in range(4, len(pool)) if ids[n] == pool[mug].obj_id][gear]
    there = [n for n in range(4, len(pool)) if ids[n] == pool[gear].obj_id][mug]
    others = compose(canvas.table, [pool[1].rendered, pool[3].rendered])
    pair = (slots()[mug], slots()[gear])
    assert select_pair(canvas, pool, pair, (here, there), others, CONFIG) == (mug, gear)
    assert select_pair(canvas, pool, pair, (here, None), others, CONFIG) == (mug, gear)
    assert select_pair(canvas, pool, pair, (mug, gear), others, CONFIG) is None
    # One of which there is no acceptable pose cannot have the other's place.
    alone = (frozenset([here]), slots()[gear])
    assert select_pair(canvas, pool, alone, (None, gear), others, CONFIG) is None
