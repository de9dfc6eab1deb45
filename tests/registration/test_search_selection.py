"""Scores of rendered poses: laws of the z-buffers, and that the truth gains most."""

from functools import lru_cache

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import symmetry_transforms
from realsim.geometry.metrics import mssd
from realsim.geometry.parts import part
from realsim.registration.body import Body, footprint
from realsim.registration.search.candidates import (
    Candidate,
    Sought,
    candidate,
    distinct,
    make_sameness,
)
from realsim.registration.search.scoring import (
    Canvas,
    ScoreConfig,
    compose,
    likelihoods,
    make_canvas,
    render,
    score,
)
from realsim.registration.search.selection import (
    LEAST_PER_CELL_UNKNOWN,
    Slot,
    select,
    select_any,
    select_pair,
)
from table_scenes import NOISE, TABLE, body_at, named_scene, part_models, small_scene

SEED = 3
CONFIG = ScoreConfig(columns=80, frames=6)


@lru_cache(maxsize=1)
def canvas() -> Canvas:
    scene = small_scene(SEED)
    return make_canvas(scene.intrinsics, scene.frames[:6], NOISE, TABLE, CONFIG)


@lru_cache(maxsize=1)
def bodies() -> list[tuple[Body, np.ndarray]]:
    scene = small_scene(SEED)
    return [(body_at(scene.models[p.obj_id], 24, 50), p.T_world_obj) for p in scene.truth]


def test_a_render_is_the_footprint_of_every_frame():
    scene, (body, T) = small_scene(SEED), bodies()[0]
    got = render(canvas(), body, T)
    seen: dict[int, float] = {}
    width = canvas().rays.shape[1]
    for n, frame in enumerate(scene.frames[:6]):
        f = footprint(body, scene.intrinsics, se3.invert(frame.T_world_cam) @ T, canvas().stride)
        at = (f.rows // canvas().stride) * width + f.columns // canvas().stride
        seen |= dict(zip((n * canvas().cells_per_frame + at).tolist(), f.z, strict=True))
    compared = {c: z for c, z in seen.items()
                if canvas().measured[c] > 0 and z < canvas().table[c]}  # fmt: skip
    assert len(compared) > 200
    assert dict(zip(got.cells.tolist(), got.z, strict=True)).keys() == compared.keys()
    np.testing.assert_allclose(got.z, [compared[c] for c in got.cells.tolist()], atol=1e-6)


def test_gains_of_a_whole_scene_do_not_depend_on_the_order():
    rendered = [render(canvas(), b, T) for b, T in bodies()]
    cells = np.arange(len(canvas().table), dtype=np.int32)
    empty = likelihoods(canvas(), canvas().table, cells).sum()
    full = likelihoods(canvas(), compose(canvas().table, rendered), cells).sum()
    for order in ([0, 1, 2, 3, 4], [4, 2, 0, 3, 1]):
        total = 0.0
        for k in range(5):
            before = compose(canvas().table, [rendered[i] for i in order[:k]])
            total += score(canvas(), rendered[order[k]], before).gain
        assert total == pytest.approx(full - empty, abs=1e-6 * abs(full))


@pytest.mark.parametrize("n", (0, 3))
def test_the_truth_gains_more_than_anything_beside_it(n: int):
    body, T = bodies()[n]
    others = compose(
        canvas().table, [render(canvas(), b, P) for k, (b, P) in enumerate(bodies()) if k != n]
    )
    right = score(canvas(), render(canvas(), body, T), others)
    assert right.agree > 0.9
    assert right.per_cell > 0.3
    for shift in ([0.008, 0, 0], [0, -0.008, 0], [0, 0, 0.006]):
        moved = render(canvas(), body, se3.from_translation(shift) @ T)
        assert score(canvas(), moved, others).gain < right.gain


# --- The joint choice: known answers on a real scene's images, with right and wrong poses mixed.

CHOSEN = ("mug", "wedge", "gear", "wedge")


@lru_cache(maxsize=1)
def material() -> tuple[Canvas, list[Candidate], list[int]]:
    """The canvas, a pool with the right poses first, and which object each pose is of."""
    scene = named_scene(1, CHOSEN)
    rng = np.random.default_rng(0)
    canvas = make_canvas(
        scene.intrinsics, scene.frames[:8], NOISE, TABLE, ScoreConfig(columns=80, frames=8)
    )
    right: list[Candidate] = []
    wrong: list[Candidate] = []
    for p in scene.truth:
        model = scene.models[p.obj_id]
        sought = Sought(body=body_at(model, 24, 50), sameness=make_sameness(model))
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
        frozenset(n for n, i in enumerate(ids) if i == pool[k].obj_id) for k in range(len(CHOSEN))
    ]


def test_the_right_poses_are_chosen():
    canvas, pool, _ = material()
    got = select(canvas, pool, slots())
    assert set(got.chosen) == {0, 1, 2, 3}
    assert got.chosen[0] == 0 and got.chosen[2] == 2
    assert all(s is not None and s.agree > 0.9 for s in got.scores)


def test_two_of_one_model_never_share_a_pose():
    canvas, pool, _ = material()
    got = select(canvas, pool, [frozenset([1])] * 2)
    assert sorted(map(str, got.chosen)) == ["1", "None"]


def test_a_bad_first_choice_is_mended():
    canvas, pool, ids = material()
    bad = [n for n in range(len(pool)) if n >= 4 and ids[n] == pool[0].obj_id][1]
    got = select(canvas, pool, slots(), [bad, None, None, None])
    assert got.chosen[0] == 0


def test_wrong_poses_alone_are_refused():
    canvas, pool, _ = material()
    got = select_any(canvas, pool[4:])
    assert all(s is not None and s.per_cell >= LEAST_PER_CELL_UNKNOWN for s in got.scores)
    empty = select(canvas, pool, [frozenset()])
    assert empty.chosen == empty.scores == (None,)


def test_two_that_stand_in_each_others_places_change_them():
    canvas, pool, ids = material()
    mug, gear = 0, 2
    here = [n for n in range(4, len(pool)) if ids[n] == pool[mug].obj_id][gear]
    there = [n for n in range(4, len(pool)) if ids[n] == pool[gear].obj_id][mug]
    others = compose(canvas.table, [pool[1].rendered, pool[3].rendered])
    pair = (slots()[mug], slots()[gear])
    assert select_pair(canvas, pool, pair, (here, there), others) == (mug, gear)
    assert select_pair(canvas, pool, pair, (here, None), others) == (mug, gear)
    assert select_pair(canvas, pool, pair, (mug, gear), others) is None
    # One of which there is no acceptable pose cannot have the other's place.
    alone = (frozenset([here]), slots()[gear])
    assert select_pair(canvas, pool, alone, (None, gear), others) is None


# --- Distance of poses modulo symmetry: zero for symmetric poses, the plain distance without.


@pytest.mark.parametrize("obj_id", sorted(part_models())[::6])
def test_symmetric_poses_are_the_same(obj_id: int):
    model = part_models()[obj_id]
    rng = np.random.default_rng(obj_id)
    same = make_sameness(model)
    T = se3.random_transform(rng)
    turned = T @ symmetry_transforms(model, 0.3)
    assert same.distances(T, turned).max() < 1e-9
    # Turned by any angle about the axis, not only by the sampled ones.
    for axis, point in model.symmetry_axes:
        p, a = np.array(point), np.array(axis) / np.linalg.norm(axis)
        R = se3.exp_so3(rng.uniform(-3, 3) * a)
        S = se3.from_rt(R, p - R @ p) @ model.symmetries[-1]
        assert same.distance(T, T @ S) < 1e-9
        assert same.angle_deg(T[:3, :3], (T @ S)[:3, :3]) < 1e-4


@pytest.mark.parametrize("name", ["gear", "bottle"])
def test_it_is_the_sampled_distance_with_the_sampling_gone(name: str):
    model = part(name)
    same = make_sameness(model)
    rng = np.random.default_rng(2)
    T = se3.random_transform(rng)
    other = T @ se3.exp(np.concatenate([0.05 * rng.normal(size=3), 0.004 * rng.normal(size=3)]))
    sampled = mssd(T, other, same.corners, symmetry_transforms(model, 0.005))
    got = same.distance(T, other)
    # The twist is the turn that fits best in the mean, not at the worst corner.
    assert 0.9 * sampled - 3e-4 < got < 1.35 * sampled


def test_distinct_keeps_the_first_of_those_alike():
    model = part("gear")
    T = se3.from_translation([0.1, 0, 0])
    alike = T @ model.symmetries[5]
    apart = se3.from_translation([0.0, 0.01, 0]) @ T
    same = make_sameness(model)
    assert distinct(same, [T, alike, apart, apart @ model.symmetries[2]], 0.002) == [0, 2]
    assert distinct(same, [], 0.002) == []
