"""Records written and read are the same records, bit for bit."""

import json
import math
import re
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Meta

from begun_sessions import begun
from realsim import records
from realsim import store as stores
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records.calibration import RobotMap
from realsim.records.depth_bias import DepthBias
from realsim.robots.arm import UR5
from realsim.robots.hand_file import PadFile
from realsim.untrusted.own_json import OwnFile, Real, from_json, read_own, to_json
from refusals import refused
from tried_grasps import assert_same, tried_set


def through_text(value):
    return json.loads(json.dumps(value, allow_nan=False))


def camera(rng):
    fx, fy, cx, cy = rng.uniform(100, 1000, 4).tolist()
    return records.CameraIntrinsics(
        width=640, height=480, fx=fx, fy=fy, cx=cx, cy=cy, distortion=rng.normal(size=8)
    )


def hand_eye(rng):
    A = rng.normal(size=(6, 6))
    return records.HandEye(
        T_ee_cam=se3.random_transform(rng), covariance=A @ A.T,
        T_base_board=se3.random_transform(rng), intrinsics=camera(rng),
        intrinsics_sd=rng.random(12), view_indices=(0, 2, 5),
        view_rms_px=np.array([0.1, np.nan, np.inf]), held_out_px=float("nan"),
        rejected=((1, "blurred"),), method="joint", starts=(("park", 3.2), ("tsai", float("inf"))),
    )  # fmt: skip


def scene(rng):
    A = rng.normal(size=(6, 6))
    objects = tuple(
        records.ObjectPose(
            obj_id=3, instance=k, T_world_obj=se3.random_transform(rng),
            covariance=A @ A.T if k else None, verdict="doubtful", reasons=("hidden",),
            checks={"agree": float(rng.random()), "free": float("nan"), "gap": float("-inf")},
        )
        for k in range(3)
    )  # fmt: skip
    plane = records.SupportPlane(
        T_world_table=se3.random_transform(rng), rms_m=float(rng.random()), inliers=77
    )
    return records.Scene(name="table 1", objects=objects, plane=plane)


def views(rng):
    return records.View(
        index=4, T_base_ee=se3.random_transform(rng), joints=rng.normal(size=6),
        T_world_cam=se3.random_transform(rng), time_s=float(rng.random()),
    )  # fmt: skip


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("make", [camera, views, hand_eye, scene])
def test_reading_undoes_writing_bit_for_bit(make, seed):
    record = make(np.random.default_rng(seed))
    text = through_text(to_json(record))
    back = from_json(text, type(record), "the record")
    assert_same(record, back)
    assert through_text(to_json(back)) == text


ARM = records.ArmErrorMap(arm=UR5.bare(), errors=np.arange(24.0), T_flange_tool=np.eye(4))
POSES = records.RobotErrorMap(
    frame="base", mean=np.zeros(12), sd_m=np.nan, weights=np.ones((6, 12)), reach=np.ones((3, 12))
)


@pytest.mark.parametrize(
    "record",
    [
        records.TagBoard(rows=5, columns=7, tag_size_m=0.03, gap_m=0.009, first_id=3),
        records.View(index=1), records.Scene(name="empty", objects=()), DepthBias(),
        replace(hand_eye(np.random.default_rng(1)), robot_map=ARM),
        replace(hand_eye(np.random.default_rng(1)), robot_map=POSES),
    ],
    ids=lambda r: type(r).__name__,
)  # fmt: skip
def test_bare_records_and_either_error_map_come_back(record):
    assert_same(record, from_json(through_text(to_json(record)), type(record), "it"))


def test_numbers_that_json_lacks():
    values = np.array([[1.5, np.nan], [np.inf, -np.inf]])
    assert to_json(values) == [[1.5, None], ["inf", "-inf"]]
    np.testing.assert_array_equal(from_json(through_text(to_json(values)), Array, "it"), values)


def test_a_rotation_edited_by_hand_is_made_rigid_again():
    data = to_json(views(np.random.default_rng(0)))
    data["T_base_ee"] = np.round(data["T_base_ee"], 6).tolist()
    R = from_json(data, records.View, "the view").T_base_ee[:3, :3]
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-14


class Note(OwnFile, kw_only=True):
    format: Literal["note 1"] = "note 1"
    unit_m: Annotated[float, Meta(gt=0, le=0.02)]
    sigma: Real = math.nan
    scene: records.Scene | None = None
    map: RobotMap | None = None
    pad: PadFile | None = None


def in_scene(**pose):
    return {"unit_m": 0.01, "scene": {"name": "s", "objects": [pose]}}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, "missing required field `unit_m`; it has: nothing"),
        ({"unit_m": 1}, "`float` <= 0.02 - at `unit_m`"),
        ({"unit_m": 0.01, "unitt": 1}, "unknown field `unitt`; accepted: format, unit_m, "),
        ({"unit_m": 0.01, "format": "note 2"}, "'note 2' - at `format`"),
        ({"unit_m": 0.01, "sigma": "much"}, "at `sigma`"),
        (in_scene(obj_id="one", instance=0, T_world_obj=np.eye(4).tolist()),
         "expected `int`, got `str` - at `scene.objects[0].obj_id`"),
        (in_scene(obj_id=1), "missing required field `instance` - at `scene.objects[0]`"),
        ({"pad": {"widht_m": 1}}, "field `widht_m` - at `pad`; accepted: width_m, length_m"),
        ({"unit_m": 0.01, "map": {"kind": "guess"}}, "'guess' is not known; pose map, arm are"),
        ([], "expected `object`, got `array`"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_place(tmp_path, values, words):
    path = tmp_path / "note.json"
    path.write_text(json.dumps(values))
    assert refused(re.escape(words), read_own, path, Note).startswith(str(path))


@pytest.mark.parametrize("text", ['{"unit_m": 0.01, "unit_m": 0.02}', '{"unit_m": NaN}', "[" * 200])
def test_what_is_no_sound_json_is_refused_as_that_of_others(tmp_path, text):
    (tmp_path / "note.json").write_text(text)
    refused("run the step that writes it again", read_own, tmp_path / "note.json", Note)


def test_results_live_in_the_session(tmp_path):
    rng = np.random.default_rng(5)
    store, h, s = begun(tmp_path, camera(rng), unit_m=1e-3), hand_eye(rng), scene(rng)
    board = records.TagBoard(rows=5, columns=7, tag_size_m=0.03, gap_m=0.009)
    sets = [tried_set(rng, instance=2), tried_set(rng, n=0, instance=0)]
    stores.save_hand_eye(store, h)
    stores.save_scene(store, s)
    stores.save_board(store, board)
    for g in sets:
        stores.save_grasps(store, g)
    store = stores.SessionStore.open(tmp_path)
    assert_same(stores.load_hand_eye(store), h)
    assert_same(stores.load_scene(store), s)
    assert_same(stores.load_board(store), board)
    for where in (store, tmp_path, tmp_path / "grasps"):
        back = stores.load_grasps(where)
        assert [g.instance for g in back] == [0, 2]
        assert_same(back[1], sets[0])
        assert_same(back[0], sets[1])
    assert store.verify() == []
    refused("has the step that writes it been run", stores.load_scene, store, "registration/x.json")
    stores.save_hand_eye(store, replace(h, intrinsics_sd=np.full(12, np.nan)))
    refused("sd has NaN", stores.load_hand_eye, store)
