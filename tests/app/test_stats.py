"""Laws of the statistics: parts add up, order does not matter, figures are counted by hand.

Two releases of a data set: what differs is told, and what is the same is not.
"""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bop_scenes import edit
from labelled_scenes import labelled_scene, written_bop, written_graspnet
from realsim import images
from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console
from realsim.app.stats.compare import diff_scenes
from realsim.app.stats.statistics import all_rows, same_content, session_facts, statistics_of
from realsim.formats.graspnet.grasp_labels import (
    GraspLabels,
    write_collision_labels,
    write_grasp_labels,
)
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.geometry import se3
from realsim.store import load_scene, save_grasps, save_scene
from synthetic_scenes import captured_session
from tried_grasps import plain_grasps, tried_set
from typed_commands import finished, refused

QUIET = Console(quiet=True)
#        (score, base score, reachable, closes at)
GRASPS = {
    0: [
        (1.0, 1.0, True, 0.2), (0.75, 0.75, True, 0.4), (0.25, 0.5, True, 0.6),
        (0.0, 0.0, False, np.nan),
    ],
    3: [(0.5, 0.5, True, np.inf), (0.2, 0.25, True, 0.2), (0.0, 0.0, True, 0.4)],
}  # fmt: skip


def grasp_set(instance, obj_id):
    score, base, reachable, friction = (np.array(x) for x in zip(*GRASPS[instance], strict=True))
    stage = np.arange(4) / 4
    slip = np.where(stage < base[:, None], 1e-3, np.where(stage == base[:, None], np.inf, np.nan))
    slip[~reachable.astype(bool)] = np.nan
    return plain_grasps(
        len(score), obj_id=obj_id, instance=instance, widths_m=np.full(len(score), 0.04),
        scores=score, base_scores=base, slip_m=slip, slip_rad=slip,
        reachable=reachable.astype(bool), measures={"closure_friction": friction},
    )  # fmt: skip


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    store = captured_session(tmp_path_factory.mktemp("stats") / "scene_000004", count=3)
    scene = load_scene(store)
    C = np.diag([4e-3, 2e-3, 1e-3, 3e-4, 2e-4, 1e-4]) ** 2
    judged = zip(scene.objects, ("accepted", "doubtful"), strict=True)
    objects = tuple(replace(o, covariance=C, verdict=v) for o, v in judged)
    save_scene(store, replace(scene, objects=objects))
    annotate_session(store, QUIET)
    for o in scene.objects:
        save_grasps(store, grasp_set(o.instance, o.obj_id))
    return store.folder


def rows_of(*folders):
    return {name: here for name, here, _ in all_rows(statistics_of(map(session_facts, folders)))}


def test_the_figures_are_those_counted_by_hand(session):
    rows = rows_of(session)
    assert rows["scenes"] == "1 simulated, 0 real"
    assert rows["annotated frames in all"] == "3"
    assert rows["objects per scene"] == "2.0 ± 0.0 (range 2 to 2)"
    assert rows["candidates"] == "7"
    assert rows["with trajectory"] == "6 (85.71 %)"
    assert rows["good (s >= 0.5)"] == "4 (57.14 %)"
    assert rows["nominal score: good"] == "3 (42.86 %)"
    assert rows["nominal score: penalized"] == "1 (14.29 %)"
    assert rows["penalized large slip (s < 0.5)"] == "0 (0.00 %)"
    assert rows["fail lift (s <= 0.25)"] == "1 (14.29 %)"
    assert rows["fail close (s = 0)"] == "1 (14.29 %)"
    assert rows["fail horizontal (s = 0.50)"] == "2 (28.57 %)"
    assert rows["full success (s = 1)"] == "1 (14.29 %)"
    mean = np.mean([g[0] for part in GRASPS.values() for g in part])
    assert rows["nominal score: mean"].startswith(f"{mean:.2f} ")
    mean = np.mean([g[1] for part in GRASPS.values() for g in part])
    assert rows["mean score"].startswith(f"{mean:.2f} ")
    assert rows["without a score"] == "0"
    # Of the six that were tried, one closes at no level.
    assert rows["closure_friction: closed at some level up to 0.6: good, bad"] == "2, 3"
    assert rows["poses accepted"] == rows["poses doubtful"] == "1 (50.0 %)"
    assert rows["pose uncertainty [mm], median, p90, most"].startswith(
        "0.300, 0.300, 0.300 (n = 2)"
    )
    sigma_deg = np.degrees(4e-3)
    assert rows["pose uncertainty [deg], median, p90, most"].startswith(f"{sigma_deg:.3f}")


def test_copies_are_told(session, tmp_path):
    folders = [Path(shutil.copytree(session, tmp_path / n)) for n in ("first", "again", "third")]
    assert same_content(statistics_of([session_facts(session)])) == []
    photograph = folders[2] / "rgb/000000.png"
    photograph.write_bytes(photograph.read_bytes() + b"\0")  # another capture
    statistics = statistics_of(map(session_facts, folders))
    (note,) = same_content(statistics)
    assert "first" in note and "again" in note and "third" not in note
    assert note.endswith("counts twice.")


def test_tables_and_page_say_the_same(session, tmp_path):
    out = tmp_path / "out"
    finished("stats", session, "--out", out, "--quiet")
    document = json.loads((out / "statistics.json").read_text())
    with (out / "statistics.csv").open(newline="") as file:
        table = {row["property"]: row["here"] for row in csv.DictReader(file)}
    assert table == document["statistics"] == rows_of(session)
    with (out / "objects.csv").open(newline="") as file:
        objects = list(csv.DictReader(file))
    assert [int(o["candidates"]) for o in objects] == [4, 3]
    assert sum(o["good"] for o in document["objects"]) == document["sessions"][0]["good"] == 3
    page = (out / "statistics.html").read_text()
    assert page.count('src="data:') == 6
    assert all(here in page for here in (table["mean score"], table["objects per scene"]))


def test_a_damaged_session_of_many_is_named_and_left_out(session, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(session, tmp_path / name)
    (tmp_path / "b/session.json").write_text("{")
    (tmp_path / "b/session.begun.json").unlink()
    result = finished("stats", tmp_path, "--quiet")
    assert "b is left out" in result.output.replace("\n", " ")
    assert "│ 7 " in result.output or " 7 │" in result.output


def test_what_is_no_session_is_refused(session, tmp_path):
    assert "holds no session" in refused("stats", tmp_path)
    assert "given twice" in refused("stats", session, session)
    (tmp_path / "file").write_text("")
    assert "is a file" in refused("stats", session, "--out", tmp_path / "file")


MOVE = se3.from_rt(se3.exp_so3([0.0, 0.0, np.radians(0.5)]), [0.002, 0.0, 0.0])


def with_grasps(plain, tried):
    """Return a scene of whose grasps one set is known."""
    return replace(plain, tried=SceneGrasps(sets=(tried,)))


def moved(frame):
    first, *others = frame.objects
    return (replace(first, T_cam_obj=first.T_cam_obj @ MOVE), *others)


@pytest.fixture(scope="module")
def releases(tmp_path_factory):
    home = tmp_path_factory.mktemp("releases")
    old = labelled_scene(home / "a", [0, 1, 2])
    new = labelled_scene(home / "b", [0, 1, 2])
    new.change_frames(objects=lambda f: moved(f) if f.index == 1 else f.objects)
    del new.frames[2]
    return written_bop(home / "old", old), written_bop(home / "new", new, ninth(home / "c"))


def ninth(folder):
    """Return a scene with another number."""
    scene = labelled_scene(folder, [0])
    scene.number, scene.name = 9, "train-000009"
    return scene


def compared(new, old, *options):
    result = finished("stats", new, "--compare", old, "--json", *options)
    return json.loads(result.stdout)["comparison"]


def test_scenes_frames_objects_and_motions_are_told(releases):
    old, new = releases
    kept, added = compared(new, old)
    assert (kept["scene"], kept["state"]) == ("000003", "kept")
    assert (added["scene"], added["state"]) == ("000009", "added")
    assert (kept["frames"], kept["frames_added"], kept["frames_lost"]) == (2, 0, 1)
    (motion,) = kept["moved"]
    assert motion["object"] == "tall"
    assert motion["mm"] == pytest.approx(2.0, abs=1e-6)
    assert motion["deg"] == pytest.approx(0.5, abs=1e-6)
    assert [row["state"] for row in compared(old, new)] == ["kept", "lost"]


def test_a_release_is_the_same_as_itself(releases):
    for row in compared(releases[0], releases[0]):
        assert row["frames"] == 3 and row["state"] == "kept"
        assert not (row["moved"] or row["objects_added"] or row["objects_lost"])
        assert not (row["frames_added"] or row["frames_lost"])
        assert not (row["cameras_changed"] or row["images_changed"] or row["masks_changed"])


def test_grasps_are_added_lost_and_changed(tmp_path):
    plain = labelled_scene(tmp_path / "s", [0])
    whole = tried_set(np.random.default_rng(3), 12, obj_id=7, instance=1, measures=())
    before, after = np.full(12, 0.5), np.where(np.arange(12) == 3, 0.8, 0.5)

    def scene(rows, scores):
        s = replace(whole, scores=scores)
        arrays = "Ts_obj_grasp widths_m scores base_scores slip_m slip_rad reachable"
        picked = {name: getattr(s, name)[rows] for name in arrays.split()}
        return with_grasps(plain, replace(s, **picked, failures=tuple(s.failures[k] for k in rows)))

    found = diff_scenes("s", scene(np.arange(10), before), scene(np.arange(2, 12), after))
    assert (found.grasps_lost, found.grasps_added) == (2, 2)
    assert (found.grasps_changed, found.grasps_kept) == (1, 7)
    assert not found.is_same


# --- what is easily overlooked -----------------------------------------------------------------


def changed_copy(releases, tmp_path, change):
    """Return what --compare says of a copy of a release in which one thing was changed."""
    copy = shutil.copytree(releases[0], tmp_path / "copy")
    change(copy / "train/000003")
    (row,) = compared(copy, releases[0])
    return row


def repaint(file):
    image = images.read_image(file).copy()
    image[7, 9] = 255 - image[7, 9]
    file.write_bytes(images.png_bytes(image))


def test_a_moved_camera_and_another_focal_length_are_told(releases, tmp_path):
    def shift(rows):
        rows["1"]["cam_t_w2c"][0] += 5.0
        rows["2"]["cam_K"][0] += 1.0

    row = changed_copy(releases, tmp_path, lambda f: edit(f / "scene_camera.json", shift))
    assert row["cameras_changed"] == 2
    assert row["images_changed"] == row["masks_changed"] == 0 and not row["moved"]


def test_other_pixels_are_told_and_another_packing_is_not(releases, tmp_path):
    def repaint_all(folder):
        repaint(folder / "rgb/000000.png")
        repaint(folder / "depth/000001.png")
        repaint(folder / "mask_visib/000002_000001.png")
        file = folder / "rgb/000002.png"
        bgr = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        before = file.read_bytes()
        cv2.imwrite(str(file), bgr, [cv2.IMWRITE_PNG_COMPRESSION, 0])
        assert file.read_bytes() != before

    row = changed_copy(releases, tmp_path, repaint_all)
    assert (row["images_changed"], row["masks_changed"]) == (2, 1)


def test_a_label_that_is_gone_from_one_frame_is_told(releases, tmp_path):
    def drop(folder):
        for name in ("scene_gt", "scene_gt_info"):
            edit(folder / f"{name}.json", lambda rows: rows["1"].pop())
        for kind in ("mask", "mask_visib"):
            (folder / kind / "000001_000002.png").unlink()

    row = changed_copy(releases, tmp_path, drop)
    assert (row["labels_lost"], row["labels_added"]) == (1, 0)
    assert not row["objects_lost"]
    assert row["files_changed"] == ["scene_gt.json", "scene_gt_info.json"]


def test_other_models_and_tables_are_told(releases, tmp_path):
    copy = shutil.copytree(releases[0], tmp_path / "copy")
    mesh = copy / "models/obj_000007.ply"
    mesh.write_bytes(mesh.read_bytes()[:-1] + b"\1")
    (copy / "camera.json").write_text("{}")
    edit(copy / "models/models_info.json", lambda rows: rows["30"].update(diameter=1.0))
    files = json.loads(finished("stats", copy, "--compare", releases[0], "--json").stdout)["files"]
    assert files == ["camera.json", "models/flat.ply", "models/models_info.json"]


def test_renumbered_models_are_the_same_objects(releases, tmp_path):
    def renumber(folder):
        new = {1: 4, 7: 2, 30: 9}

        def ids(rows):
            for row in (o for many in rows.values() for o in many):
                row["obj_id"] = new[row["obj_id"]]

        edit(folder / "scene_gt.json", ids)
        models = folder.parents[1] / "models"
        info = json.loads((models / "models_info.json").read_text())
        info = {str(new[int(k)]): row for k, row in info.items()}
        (models / "models_info.json").write_text(json.dumps(info))
        for k, n in new.items():
            (models / f"obj_{k:06d}.ply").rename(models / f"obj_{n:06d}.ply")

    row = changed_copy(releases, tmp_path, renumber)
    assert not (row["objects_added"] or row["objects_lost"] or row["moved"])


def test_another_instance_of_the_same_model_is_the_same_object(tmp_path):
    plain = labelled_scene(tmp_path / "s", [0, 1])

    def with_instances(*numbers):
        def renamed(frame):
            pairs = zip(frame.objects, numbers, strict=True)
            return tuple(replace(o, instance=n) for o, n in pairs)

        return replace(plain, frames=dict(plain.frames)).change_frames(objects=renamed)

    found = diff_scenes("s", with_instances(0, 1, 2), with_instances(5, 1, 9))
    assert found.is_same
    fewer = with_instances(5, 1, 9).change_frames(objects=lambda f: f.objects[:2])
    found = diff_scenes("s", with_instances(0, 1, 2), fewer)
    assert found.objects_lost == [("30", 2)] and not found.objects_added and not found.moved


@pytest.mark.parametrize(
    ("name", "by"), [("widths_m", 0.01), ("scores", 0.3), ("base_scores", 0.25)]
)
def test_a_width_or_a_score_alone_is_a_change(tmp_path, name, by):
    plain = labelled_scene(tmp_path / "s", [0])
    before = tried_set(np.random.default_rng(3), 6, obj_id=7, instance=1, measures=("p_hold",))
    before = replace(before, **{name: np.full(6, 0.02 if name == "widths_m" else 0.5)})
    values = getattr(before, name).copy()
    values[2] += by
    after = replace(before, **{name: values})
    found = diff_scenes("s", *(with_grasps(plain, s) for s in (before, after)))
    assert (found.grasps_changed, found.grasps_kept) == (1, 5)


def test_labels_of_graspnets_format_are_compared(tmp_path):
    scene = labelled_scene(tmp_path / "s", [0])
    for name in ("old", "new"):
        written_graspnet(tmp_path / name, scene)
    labels = GraspLabels(
        points=np.array([[0.01, 0.0, 0.02], [0.0, 0.01, 0.02]]),
        index=np.array([[0, 3, 1, 2], [0, 5, 0, 0], [1, 3, 1, 2]], np.int32),
        angles_rad=np.zeros(3, np.float32), depths_m=np.full(3, 0.02, np.float32),
        openings_m=np.full(3, 0.05, np.float32), friction=np.full(3, 0.4, np.float32),
        collision=np.zeros(3, np.bool_),
    )  # fmt: skip
    write_grasp_labels(tmp_path / "old/grasp_label/006_labels.npz", labels)
    other = replace(labels, depths_m=np.array([0.02, 0.03, 0.02], np.float32))
    write_grasp_labels(tmp_path / "new/grasp_label/006_labels.npz", other.rows(np.arange(2)))
    (row,) = compared(tmp_path / "new", tmp_path / "old")
    assert (row["grasps_lost"], row["grasps_added"]) == (1, 0)
    assert (row["grasps_changed"], row["grasps_kept"]) == (1, 1)
    collisions = "collision_label/scene_0003/collision_labels.npz"
    write_collision_labels(tmp_path / "new" / collisions, [(labels, np.zeros(3, np.bool_))])
    (row,) = compared(tmp_path / "new", tmp_path / "old")
    assert row["files_changed"] == [collisions]


def test_two_data_sets_without_a_scene_in_common_are_told_so(releases, tmp_path):
    written_bop(tmp_path / "other", ninth(tmp_path / "c"))
    result = finished("stats", tmp_path / "other", "--compare", releases[0])
    assert "no scene is in both: 000009 beside 000003" in result.output
