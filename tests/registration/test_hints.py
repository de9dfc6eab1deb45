"""Hints lead to regions that hold the object; what cannot be meant is an error with its row."""

import json
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from begun_sessions import begun
from realsim.errors import InputError, NotRigidError, UnitError
from realsim.geometry import se3
from realsim.records import View
from realsim.registration.hint_regions import SLACK_M
from realsim.registration.hints import (
    Box,
    Click,
    Hint,
    HintScene,
    Marked,
    RoughPose,
    parse_object,
    read_hints,
    read_starts,
    region_of,
)
from refusals import refused
from table_faults import seen_instances, without_any_depth
from table_scenes import TABLE, part_models, small_scene


@lru_cache(maxsize=1)
def setting():
    """A simulated scene, its hint scene, and (F, H, W) which instance is seen where."""
    scene = small_scene(1, 6, 8)
    frames = {f.index: f for f in scene.frames}
    shown = seen_instances(scene, range(8))
    return scene, HintScene(intrinsics=scene.intrinsics, frames=frames, plane=TABLE), shown


def seen_well(least: int = 150):
    """Return (view, pose, model, rows, columns) of every object that a view sees well."""
    scene, _, shown = setting()
    for view in range(8):
        for pose in scene.truth:
            rows, columns = np.nonzero(shown[view] == pose.instance)
            if len(rows) >= least:
                yield view, pose, scene.models[pose.obj_id], rows, columns


def middle_of(pose, model):
    return se3.transform(pose.T_world_obj, model.mesh.bounds.mean(0))[0]


def check_region(region, model, pose):
    """Hold that a region holds the middle of the object."""
    assert region is not None
    assert np.linalg.norm(region.center_world - middle_of(pose, model)) <= region.radius_m


def test_any_click_on_an_object_leads_to_it():
    _, scene, _ = setting()
    rng, count, tried = np.random.default_rng(1), 0, 0
    for view, pose, model, rows, columns in seen_well():
        for i in rng.integers(0, len(rows), 4):
            click = Click(view=view, pixel=(float(columns[i]), float(rows[i])))
            hint = Hint(obj_id=pose.obj_id, instance=pose.instance, where=click)
            region = region_of(hint, model, scene)
            assert region is not None and region.R_world_obj is None
            assert region.radius_m < 0.75 * np.linalg.norm(model.mesh.extent) + SLACK_M
            gap = np.linalg.norm(region.center_world - middle_of(pose, model))
            # At an outline the 5 x 5 pixels may lie on what is behind.
            count += gap > region.radius_m
            tried += 1
    assert tried > 60 and count <= 0.03 * tried


def test_boxes_and_masks_lead_to_the_object():
    _, scene, shown = setting()
    tried = 0
    for view, pose, model, rows, columns in seen_well():
        x, y = float(columns.min()), float(rows.min())
        xywh = (x - 3, y - 3, float(np.ptp(columns)) + 7, float(np.ptp(rows)) + 7)
        box = Hint(obj_id=pose.obj_id, instance=0, where=Box(view=view, xywh=xywh))
        check_region(region_of(box, model, scene), model, pose)
        # A network's mask: too fat by 4 px, so that it holds table and neighbours.
        exact = (shown[view] == pose.instance).astype(np.uint8)
        fat = np.asarray(cv2.dilate(exact, np.ones((9, 9), np.uint8))) > 0
        mask = Hint(obj_id=pose.obj_id, instance=0, where=Marked(view=view, inside=fat))
        check_region(region_of(mask, model, scene), model, pose)
        tried += 1
    assert tried > 15


def test_without_depth_the_table_tells():
    scene_, scene, _ = setting()
    blind = replace(scene, frames={k: without_any_depth(f) for k, f in scene.frames.items()})
    for view, pose, model, rows, columns in seen_well():
        click = Click(view=view, pixel=(float(np.median(columns)), float(np.median(rows))))
        hint = Hint(obj_id=pose.obj_id, instance=0, where=click)
        check_region(region_of(hint, model, blind), model, pose)
        refused("no depth is measured", region_of, hint, model, replace(blind, plane=None))
    assert len(scene_.truth) == 6


@pytest.mark.parametrize(
    ("where", "words"),
    [
        (Click(view=99, pixel=(1, 1)), "view 99"),
        (Click(view=0, pixel=(320.0, 5.0)), "320x180"),
        (Box(view=0, xywh=(400, 10, 20, 20)), "outside"),
        (Marked(view=0, inside=np.ones((90, 160), dtype=bool)), "160x90"),
        (Marked(view=0, inside=np.zeros((180, 320), dtype=bool)), "empty"),
    ],
)
def test_places_that_cannot_be_meant_are_errors(where, words):
    scene, hints, _ = setting()
    pose = scene.truth[0]
    hint = Hint(obj_id=pose.obj_id, instance=0, where=where)
    refused(words, region_of, hint, scene.models[pose.obj_id], hints)


# --- typed ------------------------------------------------------------------------------------


def test_typed_objects_are_understood():
    models = part_models()
    name = models[5].name
    for text in ("5", name):
        (hint,) = parse_object(text, models)
        assert (hint.obj_id, hint.instance, hint.where) == (5, 0, None)
    assert [h.instance for h in parse_object(f"{name}x3", models)] == [0, 1, 2]
    (click,) = parse_object("5@view3:640,360.5", models)
    assert isinstance(click.where, Click)
    assert (click.where.view, click.where.pixel) == (3, (640.0, 360.5))
    (box,) = parse_object(f"{name}@view12:100,80,60x40", models)
    assert isinstance(box.where, Box)
    assert (box.where.view, box.where.xywh) == (12, (100.0, 80.0, 60.0, 40.0))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("999", "no object '999'"),
        ("5@view3", "does not name"),
        ("5x0", "1 to 100"),
        ("5x99999", "1 to 100"),
        ("5x2@view0:1,2", "one place"),
    ],
)
def test_typed_nonsense_is_an_error(text, words):
    refused(words, parse_object, text, part_models())


# --- files ------------------------------------------------------------------------------------


@pytest.fixture
def store(tmp_path):
    scene, _, _ = setting()
    store = begun(tmp_path / "session", scene.intrinsics)
    grey = np.zeros((180, 320, 3), np.uint8)
    for f in scene.frames:
        store.add_view(View(index=f.index, T_world_cam=f.T_world_cam), grey, f.depth_m)
    return store


def test_hints_are_read_from_the_file(store):
    scene, _, shown = setting()
    a, b, c, d, e = (p.obj_id for p in scene.truth[:5])
    inside = shown[0] == scene.truth[4].instance
    T = scene.truth[0].T_world_obj
    rows = [
        {"obj_id": a, "instance": 0, "T_world_obj": T.tolist(), "radius_mm": 30, "turn_deg": 20},
        {"obj_id": b, "instance": 1, "click": {"view": 0, "pixel": [160.0, 90.0]}},
        {"obj_id": c, "instance": 2, "box": {"view": 1, "xywh": [100.0, 50.0, 60.0, 40.0]}},
        {"obj_id": d, "instance": 3},
        {"obj_id": e, "instance": 7, "mask": {"view": 0, "file": "masks/7.png"}},
    ]
    store.write_image("registration/masks/7.png", inside.astype(np.uint8) * np.uint8(255))
    store.write_json("registration/starts.json", {"starts": rows})
    path = store.path("registration/starts.json")
    back = read_hints(path, part_models())
    assert [(h.obj_id, h.instance) for h in back] == [(a, 0), (b, 1), (c, 2), (d, 3), (e, 7)]
    kinds = [RoughPose, Click, Box, type(None), Marked]
    assert [type(h.where) for h in back] == kinds and store.verify() == []
    pose, click, box, _, mask = (h.where for h in back)
    assert isinstance(pose, RoughPose) and np.array_equal(pose.T_world_obj, T)
    assert (pose.radius_m, pose.turn_deg) == (pytest.approx(0.03), 20.0)
    assert isinstance(click, Click) and click.pixel == (160.0, 90.0)
    assert isinstance(box, Box) and box.xywh == (100.0, 50.0, 60.0, 40.0)
    assert isinstance(mask, Marked) and np.array_equal(mask.inside, inside)
    wanted = read_starts(path, part_models(), store)
    assert [w.region is None for w in wanted] == [False, False, False, True, False]
    check_region(wanted[4].region, scene.models[e], scene.truth[4])


EYE = np.eye(4).tolist()
FAR = se3.from_translation([400.0, 100.0, 50.0]).tolist()
SHEARED = (np.eye(4) + np.eye(4, k=1) * 0.3).tolist()


@pytest.mark.parametrize(
    ("row", "error", "words"),
    [
        ({"obj_id": 5, "clik": {}}, InputError, "row 1 has the key 'clik'. Did you mean click[?]"),
        ({"obj_id": 999}, InputError, "row 1: obj_id is 999"),
        ({"obj_id": 5, "instance": 0}, InputError, "row 1: instance 0 is there twice"),
        ({"obj_id": 5, "T_world_obj": FAR}, UnitError, "row 1.*millimetres"),
        ({"obj_id": 5, "T_world_obj": SHEARED}, NotRigidError, "^starts.json, row 1: T_world_obj"),
        ({"obj_id": 5, "T_world_obj": EYE, "radius_mm": -3}, InputError, "radius_mm is -3; more"),
        ({"obj_id": 5, "radius_mm": 3}, InputError, "belong to T_world_obj"),
        ({"obj_id": 5, "box": {"view": 0, "xywh": [1, 2, "a", 4]}}, InputError, "4 finite"),
        ({"obj_id": 5, "mask": {"view": 0, "file": "none.png"}}, InputError, "no mask"),
        (
            {"obj_id": 5, "T_world_obj": EYE, "click": {"view": 0, "pixel": [1, 2]}},
            InputError, "twice: T_world_obj and click",
        ),
    ],
)  # fmt: skip
def test_a_wrong_row_is_named(tmp_path, row, error, words):
    path = tmp_path / "starts.json"
    path.write_text(json.dumps({"starts": [{"obj_id": 5, "instance": 0}, row]}))
    refused(words, read_hints, path, part_models(), error=error)
