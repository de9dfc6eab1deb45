"""Texts of others are read as json, ruamel and ElementTree read them, or refused by name.

Records of our own, written as such a text and read, are the same records, bit for bit.
"""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import Meta
from ruamel.yaml import YAML

from begun_sessions import begun
from realsim import records
from realsim import store as stores
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records.calibration import DepthBias, RobotMap
from realsim.robots.arm import UR5
from realsim.robots.robot_files import PadFile
from realsim.untrusted import values
from realsim.untrusted.json_text import parsed_json, read_json
from realsim.untrusted.own_json import OwnFile, Real, from_json, read_own, to_json
from realsim.untrusted.xml_tree import read_xml
from realsim.untrusted.yaml_text import parsed_yaml, read_yaml
from refusals import refused
from tried_grasps import assert_same, tried_set

READERS = {".json": read_json, ".yaml": read_yaml, ".xml": read_xml}


# --- JSON -----------------------------------------------------------------------------------------


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=("Cs", "Cc"))),
    lambda inner: st.lists(inner) | st.dictionaries(st.text("abc", min_size=1), inner),
    max_leaves=20,
)  # fmt: skip


@given(value=VALUES)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_what_json_wrote_is_read_back(value: object) -> None:
    assert parsed_json(json.dumps(value), "there") == value


def test_the_mark_of_windows_editors_is_no_character(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_json(tmp_path / "a.json") == {"a": 1}


def test_escaped_characters_of_two_halves_and_escaped_backslashes_are_text() -> None:
    assert parsed_json('["\\ud83d\\ude00", "C:\\\\u0000"]', "x") == ["\U0001f600", "C:\\u0000"]


def test_other_encodings_folders_and_nothing_are_refused(tmp_path: Path) -> None:
    (tmp_path / "latin.json").write_bytes(b'["\xe9"]')
    refused("UTF-8", read_json, tmp_path / "latin.json")
    refused("is a folder", read_json, tmp_path)
    for name in ("none.json", "a\0b"):
        refused("does not exist", read_json, tmp_path / name)


# --- YAML -----------------------------------------------------------------------------------------


YAML_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**12), 10**12) | st.floats(-1e9, 1e9)
    | st.text("abyesno0.1:-#'\" \n~é", max_size=8),
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.text("abc", min_size=1), inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


@given(value=YAML_VALUES)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_what_a_yaml_writer_wrote_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, value: Any
) -> None:
    path = tmp_path_factory.getbasetemp() / "a.yaml"
    writer = YAML(typ="safe", pure=True)
    writer.default_flow_style = False  # in flow style it writes {a: :0}, which it cannot read
    writer.dump(value, path)
    assert read_yaml(path) == value


@given(value=YAML_VALUES)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_json_is_yaml(value: Any) -> None:
    assert parsed_yaml(json.dumps(value), "there") == value


def test_plain_values_are_those_of_yaml_1_2() -> None:
    text = "[1, -2, 0x1f, 0o17, 1e3, 1.5, .5, yes, off, true, ~, null, 2020-01-01, 1_000, '1', 0b1]"
    assert parsed_yaml(text, "x") == [
        1, -2, 31, 15, 1000.0, 1.5, 0.5, "yes", "off", True, None, None, "2020-01-01", "1_000",
        "1", "0b1",
    ]  # fmt: skip


def test_an_alias_is_what_it_stands_for() -> None:
    assert parsed_yaml("{a: &x [1, 2], b: *x}", "x") == {"a": [1, 2], "b": [1, 2]}


ALIASES = "a0: &a0 [ha, ha]\n" + "".join(
    f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 9)}]\n" for k in range(30)
)


# --- XML ------------------------------------------------------------------------------------------


SCENE = (
    '<?xml version="1.0" encoding="utf-8"?><scene n="1"><!-- no --><obj><obj_id>0</obj_id>'
    '<pos>0.1 0.2 0.3</pos> tail</obj><u:x xmlns:u="urn:u" u:k="&lt;"/></scene>'
)


def test_xml_is_read_as_elementtree_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(SCENE)
    theirs = ElementTree.fromstring(SCENE)
    assert ElementTree.tostring(read_xml(path)) == ElementTree.tostring(theirs)


LAUGHS = '<!DOCTYPE a [<!ENTITY a0 "ha">' + "".join(
    f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(20)
)


@pytest.mark.parametrize(("name", "text", "says"), [
    ("a.json", '{"starts": [{"x": 1}, {"T": [[0, NaN]]}]}', "has NaN at starts[1].T[0][1]: "),
    ("a.json", "[1e999]", "double precision"),
    ("a.json", "[-" + "9" * 1_000_000 + "]", "1000001 digits"),
    ("a.json", "[" * 100_000 + "]" * 100_000, "deeper"),
    ("a.json", '{"a":' * 300 + "1" + "}" * 300, "deeper"),
    ("a.json", '{"a": 1, "b": 2, "a": 3}', "'a' is there twice"),
    ("a.json", '["\\ud800"]', "half a character"),
    ("a.json", '["a\\u0000b"]', "zero"),
    ("a.json", "[1, 2", "not valid JSON"),
    ("a.yaml", ALIASES, "unfolds"),
    ("a.yaml", "&a [*a]", "inside of what it stands for"),
    ("a.yaml", "[" * 2_000, "deeper"),
    ("a.yaml", "!!python/object/apply:os.system ['true']", "tag"),
    ("a.yaml", "a: .nan", "finite"),
    ("a.yaml", "a: 1e999", "finite"),
    ("a.yaml", "a: " + "9" * 1_000_000, "digits"),
    ("a.yaml", "a: 1\nb: 2\na: 3", "'a' twice"),
    ("a.yaml", "a: &x {b: 1}\nc: {<<: *x}", "<<"),
    ("a.yaml", "? [1]\n: 2", "as a key"),
    ("a.yaml", "--- 1\n--- 2", "several documents"),
    ("a.yaml", "a: [1, 2", "not valid YAML"),
    ("a.yaml", "a: \x07", "not valid YAML"),
    ("a.yaml", "!!int x", "as int"),
    ("a.xml", f"{LAUGHS}]><a>&a20;</a>", "doctype"),
    ("a.xml", '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>', "doctype"),
    ("a.xml", '<!DOCTYPE a SYSTEM "http://localhost/a.dtd"><a/>', "doctype"),
    ("a.xml", "<a>&x;</a>", "not XML"),
    ("a.xml", "<a>" * 1_000_000, "deeper"),
    ("a.xml", "<a><b></a></b>", "not XML"),
    ("a.xml", '<?xml version="1.0" encoding="zlib_codec"?><a/>', "not XML"),
    ("a.xml", b"<a>\xff</a>", "not XML"),
])  # fmt: skip
def test_what_unfolds_runs_or_is_no_number_is_refused(
    tmp_path: Path, name: str, text: str | bytes, says: str
) -> None:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    said = refused(re.escape(name), READERS[path.suffix], path)
    assert says in said
    assert len(said) < 600


def test_an_empty_file_of_yaml_is_nothing_and_a_number_alone_is_one(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("")
    assert read_yaml(tmp_path / "a.yaml") is None
    assert parsed_yaml("1.0", "x") == 1.0


@pytest.mark.parametrize(("name", "text", "most", "limit", "says"), [
    ("a.json", "[[1], [2], [3]]", 10, ("json_text.MOST_CONTAINERS", 3), "4 arrays"),
    ("a.yaml", "a: 1", 2, None, ""),
    ("a.xml", SCENE, 10, ("xml_tree.MOST_ELEMENTS", 2), "more than 2 elements"),
])  # fmt: skip
def test_every_limit_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str, most: int,
    limit: tuple[str, int] | None, says: str,
) -> None:  # fmt: skip
    path = tmp_path / name
    path.write_text(text)
    read = READERS[path.suffix]
    refused("MB", read, path, most_bytes=most)
    if limit:
        monkeypatch.setattr(f"realsim.untrusted.{limit[0]}", limit[1])
        refused(says, read, path)


# --- plain values: taken as they are, or refused with their name ----------------------------------


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_finite_number_is_itself(x: float) -> None:
    assert values.number(x, "x") == x
    assert values.numbers([x, 1], 2, "x").tolist() == [x, 1.0]


@pytest.mark.parametrize(
    "value", [None, True, "1", [1], {}, float("nan"), float("inf"), 10**400, 1j, np.float64("nan")]
)
def test_what_is_no_number_is_refused(value: Any) -> None:
    refused("'fx' is", values.number, value, "'fx'")
    refused("'fx'", values.numbers, [1.0, value], 2, "'fx'")


def test_whole_numbers_may_be_written_as_floats_but_not_round_ones() -> None:
    assert values.whole(640.0, "n") == 640
    for wrong in (640.5, 1e300, True, "3"):
        refused("n is", values.whole, wrong, "n")


def test_ranges_hold_their_ends() -> None:
    assert values.number(1, "x", 1, 2) == 1.0 and values.whole(2, "x", 1, 2) == 2
    for wrong in (0.999, 2.001):
        refused("1 to 2", values.number, wrong, "x", 1, 2)
    refused("more than 40 digits; 2 or less", values.whole, 10**500, "x", high=2)
    refused("0 or more", values.whole, -1, "x", low=0)


@pytest.mark.parametrize("value", [[1, 2], [1, 2, 3, 4], 3, "123", {"a": 1}, None])
def test_lists_have_their_length(value: Any) -> None:
    refused("t is", values.numbers, value, 3, "t")


def test_texts_and_mappings() -> None:
    assert values.text("a b", "name") == "a b"
    assert values.mapping({"a": 1, 2: 3}, "m") == {"a": 1, "2": 3}
    for wrong in ("", " ", "a\0b", "\x1b[2J", 3, None, "x" * 10_001):
        refused("name", values.text, wrong, "name")
    for bad in ([], None, {None: 1}, {True: 1}, {1: 1, "1": 2}):
        refused("m ", values.mapping, bad, "m")


@pytest.mark.parametrize(
    "name", ["../x", "a/../../x", "/etc/passwd", "C:\\x", "..\\x", "a\0b", "link/x", "\u8336" * 86]
)
def test_paths_stay_inside(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    assert values.path_inside(folder, "a/b.png", "'rgb'") == folder / "a/b.png"
    refused("'rgb'", values.path_inside, folder, name, "'rgb'")


# --- records of our own ---------------------------------------------------------------------------


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
