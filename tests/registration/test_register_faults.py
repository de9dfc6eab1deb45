"""What a registration makes of bad input: named per object or per view, the rest goes on."""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from realsim.geometry.metrics import mssd_symmetric
from realsim.geometry.parts import part
from realsim.records import Mesh, ObjectModel, ObjectPose
from realsim.registration.judging.scene_checks import SceneFinding
from realsim.registration.register import Registration, RegistrationConfig
from realsim.registration.registered import is_wrong, without_inventions
from realsim.registration.search.records import Wanted
from realsim.registration.simulated import TableScene
from refusals import refused
from table_faults import foreign, without_any_depth, without_depth_on
from table_scenes import QUICK, errors_mm, named_scene, register, starts_off_by

NAMES = ("wedge", "l_bracket", "elbow", "t_profile")
RIGHT_MM = 1.5


def scene() -> TableScene:
    return named_scene(3, NAMES, 8)


@cache
def starts() -> list[ObjectPose]:
    return starts_off_by(scene(), 10, 8)


def anywhere(*which: int) -> list[Wanted]:
    return [Wanted(obj_id=p.obj_id, instance=p.instance) for p in scene().truth
            if not which or p.instance in which]  # fmt: skip


def run(
    wanted: Sequence[ObjectPose | Wanted] | None, config: RegistrationConfig = QUICK, **other: Any
) -> Registration:
    result = register(scene(), wanted, config, **other)
    json.dumps(result.report)
    return result


def error_mm(result: Registration, instance: int) -> float:
    return errors_mm(scene(), result.scene.objects)[instance]


def all_right(result: Registration, *but: int) -> None:
    """Assert that all objects but some are accepted and right."""
    for p in scene().truth:
        if p.instance not in but:
            assert result.scene.object(p.instance).verdict == "accepted"
            assert error_mm(result, p.instance) < RIGHT_MM


# --- sound input ---------------------------------------------------------------------------------


def test_sound_input_is_accepted_and_consistent():
    result = run(starts())
    all_right(result)
    assert result.not_placed == () and result.findings == ()
    assert sorted(result.cameras) == list(range(8)) == sorted(result.seen)
    for number, T in result.cameras.items():
        for o in result.scene.objects:
            here = result.seen[number][o.instance]
            np.testing.assert_allclose(T @ here.T_cam_obj, o.T_world_obj, atol=1e-9)
            assert o.covariance is not None and np.linalg.eigvalsh(o.covariance).min() > 0


# --- objects -------------------------------------------------------------------------------------


def in_millimetres(model: ObjectModel) -> ObjectModel:
    mesh = Mesh(vertices=1e3 * model.mesh.vertices, faces=model.mesh.faces)
    return replace(model, mesh=mesh)


@pytest.mark.slow
def test_a_mesh_in_millimetres_is_named_and_the_rest_goes_on():
    one = scene().truth[1]
    models = {**scene().models, one.obj_id: in_millimetres(scene().models[one.obj_id])}
    result = run(anywhere(), models=models)
    (missing,) = result.not_placed
    assert (missing.obj_id, missing.instance) == (one.obj_id, one.instance)
    assert "millimetres and metres were mixed up" in missing.reason
    all_right(result, one.instance)


def test_no_model_in_metres_is_refused():
    models = {i: in_millimetres(m) for i, m in scene().models.items()}
    refused(r"none of the 4 models.*mixed up", run, None, models=models)
    # Those that were asked for are reported one by one.
    result = run(starts(), models=models)
    assert result.scene.objects == () and len(result.not_placed) == 4
    assert sorted(result.cameras) == list(range(8))


@pytest.mark.slow
def test_two_swapped_ids_are_named_and_the_objects_found():
    a, b, c, d = starts()
    a, c = replace(a, T_world_obj=c.T_world_obj), replace(c, T_world_obj=a.T_world_obj)
    result = run([a, b, c, d])
    all_right(result, 0, 2)
    said = [f for f in result.findings if f.kind == "swapped ids"]
    assert sorted(f.instances[0] for f in said) == [0, 2]
    for instance in (0, 2):
        assert error_mm(result, instance) < RIGHT_MM
        assert result.scene.object(instance).verdict == "doubtful"
    assert result.not_placed == ()


def test_an_object_without_depth_is_not_accepted_and_the_rest_is_right():
    result = run(starts(), frames=without_depth_on(scene(), 0))
    all_right(result, 0)
    missing = [n.reason for n in result.not_placed if n.instance == 0]
    placed = [o for o in result.scene.objects if o.instance == 0]
    assert missing or placed
    assert all(missing) and not (missing and placed)
    assert all(o.verdict != "accepted" and any(o.reasons) for o in placed)


@pytest.mark.slow
def test_unknown_ids_are_found_among_more_models():
    more = [part(name) for name in ("mug", "gear", "bowl", "flange", "tube")]
    models = {m.obj_id: m for m in more} | dict(scene().models)
    assert len(models) == 9
    result = run(None, models=models)
    found = [o for o in result.scene.objects if o.verdict == "accepted"]
    assert sorted(o.obj_id for o in found) == sorted(p.obj_id for p in scene().truth)
    for p in scene().truth:
        (o,) = [o for o in found if o.obj_id == p.obj_id]
        model = scene().models[p.obj_id]
        assert 1e3 * mssd_symmetric(p.T_world_obj, o.T_world_obj, model) < RIGHT_MM
    assert len({o.instance for o in result.scene.objects}) == len(result.scene.objects)
    assert all(o.verdict != "rejected" for o in result.scene.objects)


def test_what_nobody_named_and_was_rejected_is_told_and_stays_out_of_the_scene():
    asked = one_view()
    first, second, *rest = asked.scene.objects
    bad = [replace(o, verdict="rejected", reasons=("it floats",)) for o in (first, second)]
    # The second place of a model that is there as well; the first of one that is not.
    bad[1] = replace(bad[1], obj_id=rest[0].obj_id)
    scene_ = replace(asked.scene, objects=(*bad, *rest))
    said = tuple(
        SceneFinding(kind="not in the scene", words="gone", instances=(o.instance,))
        for o in (first, rest[0])
    )
    kept = without_inventions(replace(asked, scene=scene_, findings=said))
    assert kept.findings == said[1:] and len(kept.report["findings"]) == 1
    left = {o.instance for o in rest}
    assert {o.instance for o in kept.scene.objects} == left
    assert {o.instance for o in kept.single_view.objects} <= left
    assert {r["instance"] for r in kept.report["objects"]} == left
    (missing,) = kept.not_placed
    assert missing.obj_id == first.obj_id and "it floats" in missing.reason
    assert kept.report["rejected_places"] == {str(first.obj_id): 1, str(rest[0].obj_id): 1}
    assert len(kept.report["not_placed"]) == 1
    none = without_inventions(asked)
    assert none.scene.objects == asked.scene.objects and none.not_placed == ()


# --- views ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_foreign_view_is_named_and_does_no_harm():
    other = named_scene(4, ("mug", "gear"), 8).frames[2]
    frames = [foreign(f, other) if f.index == 2 else f for f in scene().frames]
    result = run(starts(), frames=frames)
    all_right(result)
    assert any("view 2" in f.words for f in result.findings)
    assert sorted(result.cameras) == [k for k in range(8) if k != 2]


def test_what_fits_and_is_overlapped_is_judged_again_without_what_does_not_fit():
    o = replace(one_view().scene.objects[0], verdict="rejected")
    overlapped = replace(o, checks={**o.checks, "probability": 0.97, "penetration_mm": 14.2})
    invented = replace(o, checks={**o.checks, "probability": 0.01, "penetration_mm": 14.2})
    sunk = replace(o, checks={**o.checks, "probability": 0.97, "penetration_mm": 0.0})
    assert [is_wrong(x) for x in (overlapped, invented, sunk)] == [False, True, True]


@cache
def one_view() -> Registration:
    return run(starts(), frames=scene().frames[:1])


def test_one_view_only_is_worse_and_says_so():
    result = one_view()
    assert sorted(result.cameras) == [0] and result.seen == {}
    np.testing.assert_array_equal(result.cameras[0], scene().frames[0].T_world_cam)
    for p in scene().truth:
        found = result.scene.object(p.instance)
        # One view is judged by bounds; the probability tells the worse ones.
        assert error_mm(result, p.instance) < 3 or found.checks["probability"] < 0.9
        assert error_mm(result, p.instance) < 8 and found.covariance is not None


# --- the paper's way -----------------------------------------------------------------------------


def test_top_down_needs_starts_and_says_so():
    config = replace(QUICK, method="top-down")
    refused("rough poses", run, None, config=config)
    first = starts()[0]
    rough = Wanted(obj_id=first.obj_id, instance=0, T_start=first.T_world_obj)
    result = run([rough, *anywhere(1, 2, 3)], config=config)
    assert [o.instance for o in result.scene.objects] == [0]
    assert {n.instance for n in result.not_placed} == {1, 2, 3}
    assert result.report["method"] == "top-down" and result.seen == {}
    for f in scene().frames:
        np.testing.assert_array_equal(result.cameras[f.index], f.T_world_cam)
    assert all("rough poses only" in n.reason for n in result.not_placed)


# --- nothing to do -------------------------------------------------------------------------------


def test_what_cannot_be_registered_is_refused_by_name():
    refused("at least one", run, starts(), frames=[])
    refused("same number", run, starts(), frames=[*scene().frames, scene().frames[0]])
    refused("no start poses", run, [])
    refused("same instance", run, [starts()[0], starts()[0]])
    refused("no object models", run, None, models={})
    refused("object 99, which is not among the models", run, [replace(starts()[0], obj_id=99)])
    best = replace(QUICK, method="best")  # pyright: ignore[reportArgumentType]
    refused("'best'; joint or top-down", run, starts(), best)
    small = replace(scene().frames[0], depth_m=np.zeros((5, 5), np.float32))
    refused("shape", run, starts(), frames=[small])
    refused("all zero", run, starts(), frames=[without_any_depth(f) for f in scene().frames])
