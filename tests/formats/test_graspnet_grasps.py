"""GraspNet's grasps: the gripper frame, groups, labels, collisions, rectangles, broken files.

Tried grasps as its labels are read by a reader that shares no code with the writer.
"""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from labelled_scenes import PLACES, labelled_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet import gripper_frame as frame
from realsim.formats.graspnet import tried_labels
from realsim.formats.graspnet.grasp_group import (
    GraspGroup,
    grasp_group,
    read_grasp_group,
    write_grasp_group,
)
from realsim.formats.graspnet.grasp_labels import (
    GraspLabels,
    read_grasp_labels,
    write_collision_labels,
    write_grasp_labels,
)
from realsim.formats.graspnet.writing import GraspnetWriteConfig, rect_rows, write_graspnet_scene
from realsim.formats.grasps.scene_grasps import SceneGrasps, executed, untried_set
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.records.grasps import MEASURES
from refusals import refused
from tried_grasps import assert_same, tried_set

SINGLE = 2e-7
"""Rounding of numbers about 1 to single precision, both ways."""


def some_labels(seed=0, points=20, n=150):
    """Return labels of every level, some of them in the object, single precision throughout."""
    rng = np.random.default_rng(seed)
    grid = (points, frame.VIEWS, frame.ANGLES, frame.DEPTHS)
    flat = np.sort(rng.choice(int(np.prod(grid)), n, replace=False))
    index = np.stack(np.unravel_index(flat, grid), axis=1)
    return GraspLabels(
        points=rng.uniform(-0.1, 0.1, (points, 3)).astype(np.float32), index=index,
        angles_rad=frame.angles_rad()[index[:, 2]],
        depths_m=np.array(frame.DEPTHS_M)[index[:, 3]], openings_m=rng.uniform(0.01, 0.1, n),
        friction=rng.integers(1, 11, n) / 10, collision=rng.random(n) < 0.4,
    )  # fmt: skip


def matrix_as_documented(towards, angle):
    """Return graspnetAPI's rotation of a viewpoint, written out anew from its definition."""
    x = towards / np.sqrt(towards @ towards)
    y = np.array([-towards[1], towards[0], 0.0])
    y = y / np.sqrt(y @ y)
    z = np.array([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])
    c, s = np.cos(angle), np.sin(angle)
    return np.array([x, y, z]).T @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


# --- laws -------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_to_graspnets_gripper_and_back_is_the_same_grasp(seed):
    rng = np.random.default_rng(seed)
    Ts, depths = se3.random_transform(rng, 10), rng.uniform(0, 0.04, 10)
    there = frame.graspnet_poses(Ts, depths)
    back = frame.grasp_poses(there, depths)
    np.testing.assert_array_equal(back[:, :3, :3], Ts[:, :3, :3])  # signed permutations
    np.testing.assert_allclose(back, Ts, rtol=0, atol=1e-15 * (1 + np.abs(Ts).max()))
    np.testing.assert_allclose(np.linalg.det(there[:, :3, :3]), 1.0)
    distance = np.linalg.norm(Ts[:, None, :3, 3] - Ts[None, :, :3, 3], axis=-1)
    tips = there[:, :3, 3] + depths[:, None] * there[:, :3, 0]
    between_tips = np.linalg.norm(tips[:, None] - tips[None], axis=-1)
    np.testing.assert_allclose(between_tips, distance, atol=1e-12)


def test_sets_in_a_view_and_back_are_the_same_grasps(tmp_path):
    rng = np.random.default_rng(2)
    plain = tuple(name for name in MEASURES if name != "p_hold")
    sets = [
        tried_set(rng, 30, obj_id=3, instance=0),
        tried_set(rng, 20, obj_id=9, instance=1, measures=plain),
        tried_set(rng, 20, obj_id=3, instance=2, measures=("p_hold",)),
    ]
    assert [s.label for s in sets] == ["p_hold", "score", "p_hold"]
    Ts_cam_obj = {s.instance: se3.random_transform(rng) for s in sets}
    group = grasp_group(sets, Ts_cam_obj)
    back = read_grasp_group(write_grasp_group(tmp_path / "g.npy", group))
    for s in sets:
        found = back.of_object(s.obj_id, Ts_cam_obj[s.instance], s.instance)
        rows = ~np.isnan(s.labels)
        assert 0 < rows.sum() < len(s)
        np.testing.assert_allclose(found.Ts_obj_grasp, s.Ts_obj_grasp[rows], rtol=0, atol=2e-6)
        np.testing.assert_allclose(found.parameters["openings_m"], s.widths_m[rows], rtol=SINGLE)
        scores = found.parameters["source"]["scores"]
        np.testing.assert_allclose(scores, s.labels[rows], rtol=SINGLE)
        assert np.isnan(found.scores).all()  # another's score is not ours
        np.testing.assert_array_equal(found.widths_m, s.widths_m[rows])
        for name, values in s.measures.items():
            np.testing.assert_array_equal(found.measures[name], values[rows])
    with np.load(tmp_path / "g.labels.npz") as beside:
        scores = np.concatenate([s.scores[~np.isnan(s.labels)] for s in sets])
        np.testing.assert_array_equal(beside["score"], scores)
    write_grasp_group(tmp_path / "few.npy", grasp_group(sets[:1], Ts_cam_obj))
    (tmp_path / "few.npy").replace(tmp_path / "g.npy")
    refused("shape", read_grasp_group, tmp_path / "g.npy")


def test_labels_that_are_written_are_read_to_the_last_bit(tmp_path):
    labels = some_labels()
    path = write_grasp_labels(tmp_path / "000_labels.npz", labels)
    assert_same(read_grasp_labels(path, with_collision=True), labels)
    few = read_grasp_labels(path, friction_at_most=0.4)
    rows = (labels.friction <= np.float32(0.4)) & ~labels.collision
    assert 0 < rows.sum() < len(labels)
    assert_same(few, labels.rows(rows))
    again = write_grasp_labels(tmp_path / "again.npz", read_grasp_labels(path, with_collision=True))
    assert again.read_bytes() == path.read_bytes()


def test_which_views_were_looked_at_is_kept(tmp_path):
    tried = np.arange(300) % 4 == 0
    labels = some_labels(5)
    labels = replace(labels.rows(tried[labels.index[:, 1]]), view_tried=tried)
    back = read_grasp_labels(write_grasp_labels(tmp_path / "l.npz", labels), with_collision=True)
    assert_same(back, labels)


def test_collisions_belong_to_the_labels_they_were_written_of(tmp_path):
    rng = np.random.default_rng(0)
    known = [some_labels(k, points=10 + 20 * k) for k in range(3)]
    objects = [(labels, rng.random(len(labels)) < 0.5) for labels in known]
    path = write_collision_labels(tmp_path / "collision_labels.npz", objects)
    with np.load(path) as file:
        for k, (labels, collides) in enumerate(objects):
            dense = file[f"arr_{k}"]
            np.testing.assert_array_equal(dense[tuple(labels.index.T)], collides)
            assert dense.sum() == dense.size - np.sum(~collides)
        assert file["arr_1"].shape == (30, 300, 12, 4) and file["arr_1"].dtype == np.bool_


# --- known answers ----------------------------------------------------------------------------


def test_a_grasp_straight_down_on_a_box_in_graspnets_numbers(tmp_path):
    """A box of 40 mm at (0.1, 0, 0.5) in a camera that looks down on it, closed along image x."""
    row = np.zeros((1, 17))
    row[0, :4] = [0.9, 0.06, 0.02, 0.03]  # score, width, height, depth
    # Columns: approach = camera z, closing = camera x, height = approach x closing = camera y.
    row[0, 4:13] = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]).ravel()
    row[0, 13:16] = [0.1, 0.0, 0.48]  # on the box's upper face
    row[0, 16] = 4
    np.save(tmp_path / "g.npy", row.astype(np.float32))
    group = read_grasp_group(tmp_path / "g.npy")
    T = group.Ts_a_grasp[0]
    np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-7)  # approach
    np.testing.assert_allclose(T[:3, 1], [1, 0, 0], atol=1e-7)  # closing
    np.testing.assert_allclose(T[:3, 3], [0.1, 0.0, 0.51], atol=1e-7)  # 30 mm in
    assert group.obj_ids[0] == 5 and group.openings_m[0] == pytest.approx(0.06)
    T_cam_obj = se3.from_translation([0.1, 0.0, 0.5])
    found = group.of_object(5, T_cam_obj)
    np.testing.assert_allclose(found.Ts_obj_grasp[0, :3, 3], [0, 0, 0.01], atol=1e-7)
    assert len(group.of_object(4, T_cam_obj)) == 0


def test_the_views_and_turns_are_graspnets():
    for i in (0, 1, 150, 299):
        z = (2 * i + 1) / 300 - 1
        turn = 2 * np.pi * i * (np.sqrt(5) - 1) / 2
        view = [np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
        np.testing.assert_allclose(frame.views()[i], view, atol=1e-12)
        for k in (0, 5, 11):
            R = matrix_as_documented(-np.array(view), k * np.pi / 12)
            mine = frame.rotations(-frame.views()[i], frame.angles_rad()[k])
            np.testing.assert_allclose(mine, R, atol=1e-12)
    upright = frame.rotations([0.0, 0.0, -2.0], 0.0)  # no level axis is defined: y
    np.testing.assert_allclose(upright, np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]).T, atol=1e-15)
    assert np.abs(np.linalg.norm(frame.views(), axis=1) - 1).max() < 1e-12


def test_labels_are_read_as_graspnets_own_loader_reads_them(tmp_path):
    """The steps of graspnetAPI's loadGrasp on the raw arrays give the same group."""
    labels = some_labels(6)
    path = write_grasp_labels(tmp_path / "004_labels.npz", labels)
    with np.load(path) as file:
        points, offsets, fric = file["points"], file["offsets"], file["scores"]
        keep = (fric <= 0.4 + 1e-6) & (fric > 0) & ~file["collision"]
    point, view, _, _ = np.nonzero(keep)
    rows = []
    for p, v, (angle, depth, width), mu in zip(point, view, offsets[keep], fric[keep], strict=True):
        R = matrix_as_documented(-frame.views()[v], angle)
        rows.append([1.1 - mu, width, 0.02, depth, *R.ravel(), *points[p], 4])
    np.save(tmp_path / "theirs.npy", np.array(rows, dtype=np.float32))
    few = read_grasp_labels(path, friction_at_most=0.4)
    known = untried_set(
        few.Ts_obj_grasp(), obj_id=5, measures={"closure_friction": few.friction.astype(float)},
        parameters={"openings_m": few.openings_m.tolist(), "depths_m": [0.0] * len(few)},
    )  # fmt: skip
    ours = grasp_group([known], {0: np.eye(4)}, scores="friction")
    theirs = read_grasp_group(tmp_path / "theirs.npy")
    assert len(ours) == len(theirs) > 10
    np.testing.assert_allclose(ours.Ts_a_grasp, theirs.Ts_a_grasp, rtol=0, atol=1e-6)
    for name in ("scores", "openings_m", "obj_ids"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6)


def test_a_rectangle_has_the_grippers_opening_and_height_in_pixels():
    """Seen from 0.5 m with f = 600 px: the palm's face, 20 mm nearer, is drawn."""
    camera = CameraIntrinsics(width=640, height=480, fx=600, fy=600, cx=320, cy=240)
    T = np.eye(4)[None].repeat(2, axis=0)
    T[:, :3, 3] = [0.0, 0.0, 0.52]  # approach = camera z, closing = camera y
    T[1] = T[1] @ se3.from_rt(se3.exp_so3([0.3, 0, 0]), [0, 0, 0])  # 17 deg: no rectangle
    group = GraspGroup(
        Ts_a_grasp=T, scores=np.array([0.7, -0.3]), openings_m=np.full(2, 0.08),
        heights_m=np.full(2, 0.02), depths_m=np.full(2, 0.02), obj_ids=np.array([1, 2]),
    )  # fmt: skip
    (row,) = rect_rows(group, camera)
    side, high = 600 * 0.04 / 0.48, 600 * 0.02 / 0.48
    expected = [320, 240, 320, 240 - side, high, group.scores[0], 0]
    np.testing.assert_allclose(row, expected, rtol=1e-12, atol=1e-9)


# --- files that are broken ----------------------------------------------------------------------


def put(at, value):
    def change(rows):
        rows[at] = value
        return rows

    return change


@pytest.mark.parametrize(("change", "says"), [
    (put((1, 13), np.nan), "grasp 1 has nan"),
    (put((2, 4), 2.0), "grasp 2 are no rotation"),
    (put((0, 1), 80.0), "metres"),
    (put((0, 16), 0.5), "no object id"),
    (put((0, 1), -0.1), "negative"),
    (lambda rows: rows[:, :16], "a GraspGroup is"),
    (lambda rows: rows.astype(object), "never objects"),
])  # fmt: skip
def test_a_broken_group_is_refused_with_the_reason(tmp_path, change, says):
    rows = np.zeros((3, 17), dtype=np.float32)
    rows[:, 4:13] = np.eye(3).ravel()
    np.save(tmp_path / "g.npy", change(rows), allow_pickle=True)
    refused(says, read_grasp_group, tmp_path / "g.npy")


def small_file(path, **changes):
    """Write the labels of two points, with some arrays exchanged (None = left out)."""
    grid = (2, 300, 12, 4)
    arrays = {
        "points": np.zeros((2, 3), np.float32), "offsets": np.full((*grid, 3), 0.01, np.float32),
        "scores": np.full(grid, 0.5, np.float32), "collision": np.zeros(grid, bool),
    }  # fmt: skip
    arrays |= {name: a for name, a in changes.items() if a is not None}
    np.savez_compressed(path, **{n: a for n, a in arrays.items() if changes.get(n, 0) is not None})
    return path


@pytest.mark.parametrize(("changes", "says"), [
    ({"points": np.full((2, 3), 80.0)}, "millimetres"),
    ({"scores": None}, "no array 'scores'"),
    ({"scores": np.full((2, 300, 12, 4), 90.0)}, "scores reach 90"),
    ({"offsets": np.full((2, 300, 12, 4, 3), 3.0)}, "in the order angle, depth, width"),
    ({"view_tried": np.ones(299, bool)}, "the shape"),
])  # fmt: skip
def test_broken_labels_are_refused_with_the_reason(tmp_path, changes, says):
    refused(says, read_grasp_labels, small_file(tmp_path / "l.npz", **changes))


# --- tried grasps as labels -----------------------------------------------------------------------


TWO_TALL = (*PLACES, (1, 0.1, -0.1, 0.4))
"""Instance 3 is a second thing of object 1."""


@pytest.fixture(scope="module")
def load_grasp():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
        return importlib.import_module("campaign_graspnet").load_grasp


def scene_with(folder, number, sets):
    scene = labelled_scene(folder, [0, 1], places=TWO_TALL)
    scene.number, scene.tried = number, SceneGrasps(sets=sets)
    return scene


def held_set(rng, obj_id, instance, n=40):
    """Return a set in which a half holds; one that holds closes at no friction."""
    s = tried_set(rng, n, obj_id=obj_id, instance=instance, measures=("closure_friction",))
    scores = np.where(executed(s), rng.uniform(0, 1, n), np.nan)
    friction = rng.choice([0.2, 0.6, np.inf, 1.2], n)
    return replace(s, scores=scores, measures={"closure_friction": friction})


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    home, rng = tmp_path_factory.mktemp("tried"), np.random.default_rng(5)
    scenes = [
        scene_with(home / f"{k}", k, tuple(held_set(rng, *of) for of in ((1, 0), (7, 1), (1, 3))))
        for k in (0, 4)
    ]  # fmt: skip
    folder = ExportFolder.begin(home / "out", {})
    written = [write_graspnet_scene(s, folder, GraspnetWriteConfig()) for s in scenes]
    told = tried_labels.write_tried_labels(folder, ((s.number, s.grasps()) for s in scenes))
    folder.finish({})
    return home / "out", scenes, written, told


def held_in(scene, index):
    poses = {o.instance: o.T_cam_obj for o in scene.frame(index).objects}
    sets = scene.grasps().sets
    return np.concatenate([poses[s.instance] @ s.Ts_obj_pads[s.good & executed(s)] for s in sets])


def test_what_held_comes_back_in_its_own_scene_and_on_its_own_thing(tree, load_grasp):
    root, scenes, written, told = tree
    assert told == ()
    for scene, one in zip(scenes, written, strict=True):
        for image, index in enumerate(scene.indices):
            Ts = held_in(scene, index)
            places, rotations = load_grasp(root, root / f"scenes/scene_{scene.number:04d}", image)
            assert len(places) == len(Ts) == one.counts["grasps"] > 20
            far = np.linalg.norm(Ts[:, None, :3, 3] - places[None], axis=2)
            near = far.argmin(axis=1)
            assert sorted(near.tolist()) == list(range(len(Ts)))
            assert far.min(axis=1).max() < 1e-6
            cos = np.einsum("na,na->n", Ts[:, :3, 2], rotations[near, :, 0])
            assert np.degrees(np.arccos(cos.min())) < 8.9
            turned = np.abs(np.einsum("na,na->n", Ts[:, :3, 1], rotations[near, :, 1]))
            assert np.degrees(np.arccos(turned.min())) < 8.9
        (note,) = [n for n in one.notes if "300 directions" in n]
        assert f"{one.counts['grasps']} of " in note


def test_frictions_are_graspnets_and_an_object_without_grasps_has_empty_labels(tree):
    root, scenes, _, _ = tree
    labels = np.load(root / "grasp_label/000_labels.npz")
    of_one = [s for x in scenes for s in x.grasps().sets if s.obj_id == 1]
    count = sum(int((s.good & executed(s)).sum()) for s in of_one)
    scores = labels["scores"]
    assert scores.shape == (count, 300, 12, 4) and (scores > 0).sum() == count
    np.testing.assert_allclose(np.unique(scores), [-1.0, 0.2, 0.6, 1.0], atol=1e-6)
    assert np.load(root / "grasp_label/029_labels.npz")["scores"].shape == (0, 300, 12, 4)
    assert len(np.load(root / "collision_label/scene_0004/collision_labels.npz")) == 4


def test_every_image_has_its_rectangles(tree):
    root, _, _, _ = tree
    files = sorted(root.glob("scenes/*/realsense/rect/*.npy"))
    assert len(files) == 4
    for file in files:
        scores, objects = np.load(file)[:, 5:].T
        assert set(objects.tolist()) <= {0, 6}
        assert np.all((scores > 0.05) & (scores < 1.1))


def test_more_than_a_file_holds_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(tried_labels, "MOST_POINTS", 3)
    scene = scene_with(tmp_path / "s", 0, (held_set(np.random.default_rng(1), 7, 1),))
    folder = ExportFolder.begin(tmp_path / "out", {})
    write_graspnet_scene(scene, folder, GraspnetWriteConfig())
    (told,) = tried_labels.write_tried_labels(folder, [(0, scene.grasps())])
    assert "object 006" in told and "a label file holds 3" in told
    assert np.load(tmp_path / "out/grasp_label/006_labels.npz")["points"].shape == (3, 3)
