"""Whole scenes: objects found from nothing, from rough starts, known by name or not."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.registration.evidence import DepthNoise
from realsim.registration.find_table import TableSearchConfig, find_table
from realsim.registration.search.candidates import CandidateConfig
from realsim.registration.search.find import FindConfig, find_objects
from realsim.registration.search.records import SearchResult, Wanted
from realsim.registration.search.sameness import make_sameness
from realsim.registration.search.scoring import ScoreConfig
from realsim.registration.search.templates import TemplateConfig
from realsim.registration.simulated import TableScene
from realsim.registration.views import SampleConfig, ViewPoints, sample_views
from refusals import refused
from table_scenes import named_scene

NAMES = ("l_bracket", "wedge", "stepped_shaft", "wedge")
NOISE = DepthNoise(per_m=0.08 / (648 * 0.018), floor_m=2e-4)
CONFIG = FindConfig(
    field_cells=48,
    templates=TemplateConfig(rays=1500),
    score=ScoreConfig(columns=80, frames=8),
    refine=CandidateConfig(refined=3),
)


def scene() -> TableScene:
    return named_scene(2, NAMES)


@lru_cache(maxsize=1)
def views() -> tuple[ViewPoints, ...]:
    return sample_views(scene().intrinsics, scene().frames, NOISE, SampleConfig(stride=1))


def find(wanted: list[Wanted] | None, folder: Path, told: list[str] | None = None) -> SearchResult:
    plane = find_table(views(), NOISE, TableSearchConfig()).plane
    assert plane is not None
    return find_objects(
        scene().intrinsics, scene().frames, views(), plane, NOISE, scene().models, wanted, CONFIG,
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
    plane = find_table(views(), NOISE, TableSearchConfig()).plane
    assert plane is not None
    twice = [Wanted(obj_id=1, instance=0), Wanted(obj_id=1, instance=0)]
    rest = (scene().intrinsics, scene().frames, views(), plane, NOISE)
    refused("same instance", find_objects, *rest, scene().models, twice, CONFIG)
    refused("no models", find_objects, *rest, {}, None, CONFIG)
    with pytest.raises(InputError, match="needs both"):
        find_objects(scene().intrinsics, [], [], plane, NOISE, scene().models, None, CONFIG)
