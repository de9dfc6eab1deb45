"""Whole scenes: objects found from nothing, from rough starts, known by name or not."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import merged, sample_surface, transformed
from realsim.geometry.parts import part
from realsim.records import Mesh, ObjectModel, ObjectPose
from realsim.registration.evidence import Cloud, join_clouds
from realsim.registration.find_table import find_table
from realsim.registration.search.candidates import Candidate, Sought, fuse, make_sameness
from realsim.registration.search.find import FindConfig, find_objects
from realsim.registration.search.peel import clusters, explained_points, suspects
from realsim.registration.search.polish import SAME_SHARE, Decision, decide_rivals
from realsim.registration.search.records import SearchResult, Wanted
from realsim.registration.search.scoring import Render, Score, ScoreConfig, make_canvas
from realsim.registration.search.templates import TemplateConfig
from realsim.registration.simulated import TableScene, table_scene
from refusals import refused
from table_scenes import NOISE, SMALL_LAB, TABLE, body_at, named_scene, views_of

NAMES = ("l_bracket", "wedge", "stepped_shaft", "wedge")
CONFIG = FindConfig(
    field_cells=48, templates=TemplateConfig(rays=1500), score=ScoreConfig(columns=80, frames=8)
)


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
    return find_objects(
        *evidence(), scene().models, wanted, CONFIG,
        field_folder=folder, told=None if told is None else told.append,
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("models")


def nearest_errors(result: SearchResult) -> list[float]:
    """Per true object the distance to the nearest found one of its model [m]."""
    errors: list[float] = []
    for p in scene().truth:
        same = make_sameness(scene().models[p.obj_id])
        errors.append(
            min([same.distance(p.T_world_obj, q.T_world_obj)
                 for q in result.placed if q.obj_id == p.obj_id], default=np.inf)
        )  # fmt: skip
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
    made = table_scene({1: model}, [pose], lab, rng)
    return made, sought_of(model, 64)


def sought_of(model: ObjectModel, cells: int) -> Sought:
    return Sought(body=body_at(model, cells, 100), sameness=make_sameness(model))


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
    size = 2.0 * sought.body.radius_m
    assert sought.sameness.distance(np.eye(4), turn) < SAME_SHARE * size
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
