"""Whole scenes: objects found from nothing, from rough starts, known by name or not."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import merged, sample_surface, symmetry_transforms, transformed
from realsim.geometry.metrics import mssd
from realsim.geometry.parts import part
from realsim.records import Mesh, ObjectModel, ObjectPose
from realsim.registration.body import Body, footprint
from realsim.registration.evidence import Cloud, join_clouds
from realsim.registration.find_table import find_table
from realsim.registration.search.candidates import (
    Candidate,
    Sought,
    candidate,
    distinct,
    fuse,
    make_sameness,
)
from realsim.registration.search.find import FindConfig, find_objects
from realsim.registration.search.peel import clusters, explained_points, suspects
from realsim.registration.search.polish import SAME_SHARE, Decision, decide_rivals
from realsim.registration.search.records import SearchResult, Wanted
from realsim.registration.search.scoring import (
    Canvas,
    Render,
    Score,
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
from realsim.registration.search.templates import TemplateConfig
from realsim.registration.simulated import TableScene, table_scene
from refusals import refused
from table_scenes import (
    NOISE,
    SMALL_LAB,
    TABLE,
    body_at,
    named_scene,
    part_models,
    small_scene,
    views_of,
)

NAMES = ("l_bracket", "wedge", "stepped_shaft", "wedge")
SCORE = ScoreConfig(columns=80, frames=8)
CONFIG = FindConfig(field_cells=48, templates=TemplateConfig(rays=1500), score=SCORE)


def scene() -> TableScene:
    return named_scene(2, NAMES)


@lru_cache(maxsize=1)
def evidence() -> tuple[Any, ...]:
    """Return what `find_objects` looks at."""
    views = views_of(scene())
    plane = find_table(views, NOISE).plane
    assert plane is not None
    return scene().intrinsics, scene().frames, views, plane, NOISE


def find(wanted: list[Wanted] | None, folder: Path, told: list[str] | None = None) -> SearchResult:
    tell = None if told is None else told.append
    return find_objects(*evidence(), scene().models, wanted, CONFIG, field_folder=folder, told=tell)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("models")


def nearest_errors(result: SearchResult) -> list[float]:
    """Per true object the distance to the nearest found one of its model [m]."""
    errors: list[float] = []
    for p in scene().truth:
        same = make_sameness(scene().models[p.obj_id])
        own = [q.T_world_obj for q in result.placed if q.obj_id == p.obj_id]
        errors.append(min([same.distance(p.T_world_obj, T) for T in own], default=np.inf))
    return errors


def test_from_nothing_with_two_of_one_model_and_one_that_is_not_there(folder: Path):
    wanted = [Wanted(obj_id=p.obj_id, instance=p.instance) for p in scene().truth]
    result = find([*wanted, Wanted(obj_id=99, instance=50)], folder)
    assert len(result.placed) == 4
    assert max(nearest_errors(result)) < 0.003
    assert [n.instance for n in result.not_placed] == [50]
    assert "99" in result.not_placed[0].reason
    assert {p.instance for p in result.placed} == {p.instance for p in scene().truth}
    assert all(p.agree > 0.9 and p.gain_per_pixel > 0.35 for p in result.placed)
    assert set(result.report["cpu_s"]) >= {"models", "fuse", "match", "select", "contrast"}


def test_what_is_there_is_found_out(folder: Path):
    told: list[str] = []
    result = find(None, folder, told)
    models = scene().models
    said = [f"searching model {n + 1} of {len(models)}: {m.name}"
            for n, (_, m) in enumerate(sorted(models.items()))]  # fmt: skip
    assert [words for words in told if words.startswith("searching model")] == said
    assert sorted(p.obj_id for p in result.placed) == sorted(p.obj_id for p in scene().truth)
    assert max(nearest_errors(result)) < 0.003
    assert not result.not_placed


def test_one_too_many_is_not_placed_and_says_why(folder: Path):
    shaft = next(p for p in scene().truth if scene().models[p.obj_id].name == "stepped_shaft")
    result = find([Wanted(obj_id=shaft.obj_id, instance=n) for n in (3, 8)], folder)
    # What lies in a neighbour's place explains little of it.
    best, *others = sorted(result.placed, key=lambda p: -p.gain_per_pixel)
    same = make_sameness(scene().models[shaft.obj_id])
    assert same.distance(shaft.T_world_obj, best.T_world_obj) < 0.003
    assert all(p.gain_per_pixel < 0.6 * best.gain_per_pixel for p in others), others
    assert len(result.placed) + len(result.not_placed) == 2
    for missing in result.not_placed:
        assert "explains" in missing.reason or "looks like" in missing.reason
        assert "start" not in missing.reason  # it has none


def test_bad_questions_are_refused():
    twice = [Wanted(obj_id=1, instance=0)] * 2
    refused("same instance", find_objects, *evidence(), scene().models, twice, CONFIG)
    refused("no models", find_objects, *evidence(), {}, None, CONFIG)
    camera, _, _, *rest = evidence()
    refused("needs both", find_objects, camera, [], [], *rest, scene().models, None, CONFIG)


# --- Near-symmetric poses told apart: a shape with one small feature, turned the wrong way.
LATTICE = ScoreConfig(columns=160, frames=10)
HALF_TURN, QUARTER = (se3.exp([0, 0, angle, 0, 0, 0]) for angle in (np.pi, np.pi / 2))


def marked_box(knob_m: float) -> Mesh:
    """A block of 90 x 40 x 30 mm about the origin with a cube of this edge near one end."""
    box, cube = part("box").mesh, part("cube").mesh
    size = np.array([0.09, 0.04, 0.03])
    block = replace(box, vertices=(box.vertices - box.bounds.mean(0)) / box.extent * size)
    small = replace(cube, vertices=(cube.vertices - cube.bounds.mean(0)) / cube.extent * knob_m)
    top = se3.from_translation([0.035, 0.0, 0.015 + knob_m / 2 - 1e-4])
    return merged([block, transformed(small, top)])


@lru_cache(maxsize=4)
def marked_scene(knob_m: float) -> tuple[TableScene, Sought]:
    model = ObjectModel(obj_id=1, name="marked box", mesh=marked_box(knob_m))
    T = se3.from_rt(se3.exp_so3([0, 0, 0.4]), [0.01, -0.02, 0.015])
    pose = ObjectPose(obj_id=1, instance=0, T_world_obj=T)
    lab, rng = replace(SMALL_LAB, views=10), np.random.default_rng(4)
    return table_scene({1: model}, [pose], lab, rng), sought_of(model, 64)


def sought_of(model: ObjectModel, cells: int, samples: int = 100) -> Sought:
    return Sought(body=body_at(model, cells, samples), sameness=make_sameness(model))


def decide(knob_m: float, start: np.ndarray, near: np.ndarray) -> Decision:
    made, sought = marked_scene(knob_m)
    cloud = fuse(views_of(made), NOISE, TABLE).fine
    canvas = make_canvas(made.intrinsics, made.frames, NOISE, TABLE, LATTICE)
    T = made.truth[0].T_world_obj @ start
    return decide_rivals(sought, T, canvas.table, (canvas, cloud, near))


def test_a_single_rival_that_is_right_replaces_a_wrong_pose():
    made, sought = marked_scene(0.012)
    got = decide(0.012, HALF_TURN, HALF_TURN[None])
    assert got.changed
    assert sought.sameness.distance(made.truth[0].T_world_obj, got.T_world_obj) < 0.003
    assert got.contrast is not None and got.contrast > 0.1
    assert got.T_rival is not None


def test_the_right_pose_stays_and_its_rival_is_named():
    made, sought = marked_scene(0.012)
    got = decide(0.012, np.eye(4), np.stack([HALF_TURN, QUARTER]))
    assert not got.changed
    assert sought.sameness.distance(made.truth[0].T_world_obj, got.T_world_obj) < 0.003
    assert got.contrast is not None and got.contrast > 0.1
    assert got.T_rival is not None
    assert sought.sameness.distance(made.truth[0].T_world_obj, got.T_rival) > 0.01


def test_what_cannot_be_seen_is_undecided():
    """The knob is 0.3 mm: both ways round explain the images alike."""
    got = decide(0.0003, np.eye(4), HALF_TURN[None])
    assert got.contrast is not None and got.contrast < 0.1


def test_a_fit_of_the_same_pose_that_ended_a_little_apart_is_no_rival():
    _, sought = marked_scene(0.012)
    turn = se3.from_rt(se3.exp_so3([0.0, 0.0, np.radians(1.5)]), np.zeros(3))
    assert sought.sameness.distance(np.eye(4), turn) < SAME_SHARE * 2.0 * sought.body.radius_m
    assert decide(0.012, np.eye(4), turn[None]).contrast is None


# --- What is left over: clusters of it, starts in it, and objects it makes suspect.


def surface(name: str, T: np.ndarray, rng: np.random.Generator) -> Cloud:
    points, normals = sample_surface(part(name).mesh, 900, rng)
    towards, sigmas = normals @ T[:3, :3].T, np.full(900, 5e-4)
    return Cloud(points=se3.transform(T, points), towards=towards, sigmas=sigmas)


def at(s: Sought, T: np.ndarray) -> tuple[Sought, Candidate]:
    nothing = Render(np.zeros(0, np.int32), np.zeros(0, np.float32))
    score = Score(gain=0.0, cells=0, agree=1.0)
    return s, Candidate(
        obj_id=s.obj_id, T_world_obj=T, rendered=nothing, alone=score, source="test"
    )  # fmt: skip


def test_an_object_in_the_wrong_turn_is_suspect_and_its_neighbour_is_not():
    rng = np.random.default_rng(0)
    shaft, mug = (sought_of(part(name), 48) for name in ("stepped_shaft", "mug"))
    T_shaft = se3.from_rt(se3.exp_so3([np.pi / 2, 0, 0]), [0.0, 0.0, 0.1])
    T_mug = se3.from_translation([0.25, 0.0, 0.05])
    parts = (("stepped_shaft", T_shaft), ("mug", T_mug))
    cloud = join_clouds([surface(name, T, rng) for name, T in parts])
    center = shaft.body.center(T_shaft)
    R = se3.exp_so3([0, 0, np.pi / 2])
    wrong = se3.from_rt(R, center - R @ center) @ T_shaft

    def worst(T: np.ndarray) -> list[int]:
        placed = [at(shaft, T), at(mug, T_mug)]
        rest = cloud.points[~explained_points(cloud, placed)]
        return suspects(cloud, clusters(rest, np.eye(4)), placed)

    assert worst(T_shaft) == []
    assert worst(wrong) == [0]


# --- Scores of rendered poses: laws of the z-buffers, and that the truth gains most.

SEED = 3


@lru_cache(maxsize=1)
def canvas() -> Canvas:
    scene = small_scene(SEED)
    return make_canvas(scene.intrinsics, scene.frames[:6], NOISE, TABLE, replace(SCORE, frames=6))


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
    rendered = [render(canvas(), b, P) for k, (b, P) in enumerate(bodies()) if k != n]
    others = compose(canvas().table, rendered)
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
    canvas = make_canvas(scene.intrinsics, scene.frames[:8], NOISE, TABLE, SCORE)
    right: list[Candidate] = []
    wrong: list[Candidate] = []
    for p in scene.truth:
        sought = sought_of(scene.models[p.obj_id], 24, 50)
        right.append(candidate(sought, canvas, p.T_world_obj, "right"))
        for q in scene.truth:  # everywhere else, turned at random
            shift = q.T_world_obj[:3, 3] - p.T_world_obj[:3, 3]
            turn = se3.from_rt(se3.random_rotation(rng), np.zeros(3))
            T = se3.from_translation(shift + 0.004 * rng.normal(size=3)) @ p.T_world_obj @ turn
            wrong.append(candidate(sought, canvas, T, "wrong"))
    pool = right + wrong
    return canvas, pool, [c.obj_id for c in pool]


def slots() -> list[Slot]:
    """One per object; the two wedges share theirs."""
    _, pool, ids = material()
    wanted = [pool[k].obj_id for k in range(len(CHOSEN))]
    return [frozenset(n for n, i in enumerate(ids) if i == obj_id) for obj_id in wanted]


def test_the_right_poses_are_chosen():
    canvas, pool, _ = material()
    got = select(canvas, pool, slots())
    assert set(got.chosen) == {0, 1, 2, 3}
    assert got.chosen[0] == 0 and got.chosen[2] == 2
    assert all(s is not None and s.agree > 0.9 for s in got.scores)


def test_two_of_one_model_never_share_a_pose():
    canvas, pool, _ = material()
    assert sorted(map(str, select(canvas, pool, [frozenset([1])] * 2).chosen)) == ["1", "None"]


def test_a_bad_first_choice_is_mended():
    canvas, pool, ids = material()
    bad = [n for n in range(len(pool)) if n >= 4 and ids[n] == pool[0].obj_id][1]
    assert select(canvas, pool, slots(), [bad, None, None, None]).chosen[0] == 0


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
    assert same.distances(T, T @ symmetry_transforms(model, 0.3)).max() < 1e-9
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
    # The twist is the turn that fits best in the mean, not at the worst corner.
    assert 0.9 * sampled - 3e-4 < same.distance(T, other) < 1.35 * sampled


def test_distinct_keeps_the_first_of_those_alike():
    model = part("gear")
    T = se3.from_translation([0.1, 0, 0])
    alike = T @ model.symmetries[5]
    apart = se3.from_translation([0.0, 0.01, 0]) @ T
    same = make_sameness(model)
    assert distinct(same, [T, alike, apart, apart @ model.symmetries[2]], 0.002) == [0, 2]
    assert distinct(same, [], 0.002) == []
