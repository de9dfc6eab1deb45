"""`realsim upgrade`: what comes out, what stays as it was, which annotations are one thing."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from realsim.app.upgrade.cli import upgrade_command
from realsim.app.upgrade.config import UpgradeConfig
from realsim.app.upgrade.dataset import scenes_of
from realsim.app.upgrade.instances import told_apart, world_starts
from realsim.app.upgrade.page import BEFORE_RGB, _cropped, notes_line
from realsim.app.upgrade.pool import remaining_s
from realsim.app.upgrade.scene import _grasp_counts
from realsim.errors import InputError, RealsimError
from realsim.formats.grasps.scene_grasps import executed
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.store import SessionStore, load_grasps
from realsim.store.lock import only_run_in
from upgradable_datasets import bop_dataset, content_and_times, graspnet_dataset, standing

OFF_M = 0.003
"""Annotations of the BOP scenes are off by this along the camera's x."""
GRASPS = ("--grasps", "2")


def upgrade(dataset: Path, out: Path, *more: str) -> Result:
    arguments = [str(dataset), "--out", str(out), "--quiet", *GRASPS, *more]
    return CliRunner().invoke(upgrade_command, arguments)


def failed_with(dataset: Path, out: Path, *more: str) -> str:
    """Return what a run said that was refused."""
    error = upgrade(dataset, out, *more).exception
    assert isinstance(error, RealsimError), error
    return str(error)


@pytest.fixture(scope="module")
def upgraded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Result]:
    """A BOP scene of one image and one that is broken, upgraded."""
    root = tmp_path_factory.mktemp("upgrade")
    dataset = bop_dataset(root / "dataset", 2, off_m=OFF_M)
    file = dataset / "test/000002/depth/000003.png"
    file.write_bytes(file.read_bytes()[:200])
    before = content_and_times(dataset)
    done = upgrade(dataset, root / "out", "--scene-workers", "2")
    assert content_and_times(dataset) == before, "the data set is only read"
    return dataset, root / "out", done


# --- laws -------------------------------------------------------------------------------------


def test_poses_end_where_the_parts_stand_and_the_originals_stay_beside(upgraded) -> None:
    dataset, out, _ = upgraded
    scene = "test/000001"
    given = (dataset / scene / "scene_gt.json").read_bytes()
    assert (out / scene / "imported/scene_gt.json").read_bytes() == given
    kept = out / scene / "imported/scene_camera.json"
    assert kept.read_bytes() == (dataset / scene / "scene_camera.json").read_bytes()
    rows = json.loads((out / scene / "scene_gt.json").read_text())["3"]
    for mine, theirs in zip(rows, json.loads(given)["3"], strict=True):
        assert mine["obj_id"] == theirs["obj_id"]
        truth = np.array(theirs["cam_t_m2c"]) - [1e3 * OFF_M, 0, 0]
        np.testing.assert_allclose(mine["cam_t_m2c"], truth, atol=0.3)
    assert SessionStore.open(out / scene).verify() == []


def test_one_broken_scene_does_not_stop_the_others(upgraded) -> None:
    _, out, done = upgraded
    assert done.exit_code == 1, done.output
    told = json.loads((out / "upgrade.json").read_text())
    assert [s["place"] for s in told["scenes"]] == ["test/000001"]
    assert "000003.png" in told["left_out"]["test/000002"]
    assert "test/000002 was left out" in done.output


def test_tables_say_how_far_each_object_moved(upgraded) -> None:
    _, out, done = upgraded
    told = json.loads((out / "upgrade.json").read_text())
    assert told["summary"]["scenes"] == 1 and told["summary"]["objects"] == 2
    rows = list(csv.DictReader((out / "upgrade.csv").open()))
    assert [r["name"] for r in rows] == ["box", "wedge"]
    for row in rows:
        assert float(row["moved_mm"]) == pytest.approx(1e3 * OFF_M, abs=0.3)
        assert row["verdict"] in done.output
    page = (out / "upgrade.html").read_text()
    assert page.count('aria-label="test/') >= 2 and "as given" in page


def test_tried_are_the_grasps_that_physics_has_seen(upgraded) -> None:
    _, out, _ = upgraded
    sets = {s.instance: s for s in load_grasps(out / "test/000001")}
    rows = list(csv.DictReader((out / "upgrade.csv").open()))
    for row in rows:
        s = sets[int(row["instance"])]
        assert int(row["candidates"]) == len(s)
        assert int(row["tried"]) == executed(s).sum() <= np.isfinite(s.scores).sum()
        unreached = replace(s, reachable=np.zeros(len(s), bool), slip_m=s.slip_m * np.nan)
        assert _grasp_counts(unreached)["tried"] == 0


def test_notes_stand_below_the_pictures_under_one_banner(upgraded) -> None:
    _, out, _ = upgraded
    page = (out / "upgrade.html").read_text()
    assert page.count('class="note') == 1
    titles = [page.index(f"<h2>{title}") for title in ("Before and after", "Objects", "Notes")]
    assert titles == sorted(titles)
    assert page.index("000003.png", titles[2]) > titles[2]


def test_the_banner_counts_notes_and_scenes() -> None:
    notes = [("test/1", "a"), ("test/1", "b"), ("test/2", "c")]
    assert notes_line(notes, 0) == ["3 notes on 2 scenes: see below."]
    assert notes_line(notes[:1], 1) == ["1 scene left out; 1 note on 1 scene: see below."]
    assert notes_line([], 0) == []


def test_both_outlines_are_right_of_the_handle_and_the_given_one_left() -> None:
    rgb = np.full((200, 200, 3), 128, np.uint8)
    masks = [np.full((200, 200), -1, np.int32) for _ in range(2)]
    masks[0][60:120, 60:120] = masks[1][70:130, 70:130] = 0
    green = (10, 200, 30)
    given, both = (
        _cropped(rgb, masks, [BEFORE_RGB, green][:n]) for n in (1, 2)
    )  # fmt: skip
    assert given.shape == both.shape
    has = [[np.all(p == c, axis=-1).sum() for c in (BEFORE_RGB, green)] for p in (given, both)]
    assert has[0][0] > 500 and has[0][1] == 0
    assert has[1][0] > 0.8 * has[0][0] and has[1][1] > 1.5 * has[0][0]


def test_the_root_is_a_bop_data_set(upgraded) -> None:
    _, out, _ = upgraded
    targets = json.loads((out / "test_targets_bop19.json").read_text())
    assert {(t["scene_id"], t["im_id"]) for t in targets} == {(1, 3)}
    assert [r.place for r in scenes_of(out, UpgradeConfig())] == ["test/000001"]
    models = json.loads((out / "models/models_info.json").read_text())
    assert sorted(map(int, models)) == sorted(part(n).obj_id for n in ("box", "wedge"))


@pytest.mark.slow
def test_a_second_run_does_nothing_again_and_takes_in_what_was_mended(upgraded, tmp_path) -> None:
    dataset, out, _ = upgraded
    copy, again = tmp_path / "dataset", tmp_path / "out"
    shutil.copytree(dataset, copy)  # keeps the times
    shutil.copytree(out, again)
    before = content_and_times(again / "test")
    mended = dataset / "test/000001/depth/000003.png"
    (copy / "test/000002/depth/000003.png").write_bytes(mended.read_bytes())
    # Of another scene: the objects lie elsewhere, so the pose is judged, the scene is not refused.
    done = upgrade(copy, again, "--scene-workers", "1")
    assert done.exit_code == 0, done.output
    assert "1 of 2 scenes are upgraded already" in done.output
    after = content_and_times(again / "test")
    assert {k: after[k] for k in before} == before
    assert json.loads((again / "upgrade.json").read_text())["summary"]["scenes"] == 2


def test_two_runs_at_once_are_refused(upgraded) -> None:
    dataset, out, _ = upgraded
    with only_run_in(out):
        assert "another run is working" in failed_with(dataset, out)


def test_other_images_are_not_mixed_into_an_upgrade(upgraded, tmp_path) -> None:
    dataset, out, _ = upgraded
    copy, again = tmp_path / "dataset", tmp_path / "out"
    shutil.copytree(dataset, copy)
    shutil.copytree(out, again)
    other = dataset / "test/000002/rgb/000003.png"
    (copy / "test/000001/rgb/000003.png").write_bytes(other.read_bytes())
    assert "upgrade of other images" in failed_with(copy, again, "--scenes", "1")


# --- GraspNet ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_graspnet_tree_becomes_a_bop_data_set(tmp_path) -> None:
    dataset = graspnet_dataset(tmp_path / "dataset")
    before = content_and_times(dataset)
    done = upgrade(dataset, tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert content_and_times(dataset) == before
    scene = tmp_path / "out/test_kinect/000100"
    xml = "annotations/0001.xml"
    home = dataset / "scenes/scene_0100/kinect"
    assert (scene / "imported" / xml).read_bytes() == (home / xml).read_bytes()
    store = SessionStore.open(scene)
    registered = json.loads((scene / "registration/scene.json").read_text())
    assert len(registered["objects"]) == 2
    for o, p in zip(registered["objects"], standing(), strict=True):
        # The world is the table's frame, as GraspNet has it; depth is in whole millimetres.
        np.testing.assert_allclose(np.array(o["T_world_obj"])[:3, 3], p.T_world_obj[:3, 3],
                                   atol=1.5e-3)  # fmt: skip
    assert sorted(store.completed) == [0, 1] and store.verify() == []


def test_a_camera_and_a_number_of_images_can_be_asked_for(tmp_path) -> None:
    dataset = graspnet_dataset(tmp_path / "dataset")
    for place in (dataset, dataset / "scenes", dataset / "scenes/scene_0100/kinect"):
        assert [r.place for r in scenes_of(place, UpgradeConfig())] == ["test_kinect/000100"]
    with pytest.raises(InputError, match="realsense"):
        scenes_of(dataset, UpgradeConfig(kind="graspnet", camera="realsense"))
    with pytest.raises(InputError, match="keyframe_poses"):
        UpgradeConfig(kind="graspnet", start="cosypose")


# --- which annotations are one thing ----------------------------------------------------------


def test_two_things_of_one_model_stay_two_in_every_order() -> None:
    model = part("box")
    T_a, T_b = se3.from_translation([0, 0, 0.5]), se3.from_translation([0.2, 0, 0.5])
    rows = {0: [(1, None, T_a), (1, None, T_b)], 1: [(1, None, T_b), (1, None, T_a)]}
    seen, notes = told_apart(rows, dict.fromkeys(rows, np.eye(4)), {1: model})
    assert [s.instance for s in seen[0]] == [0, 1] and [s.instance for s in seen[1]] == [1, 0]
    assert notes == []
    starts = world_starts(seen, dict.fromkeys(rows, np.eye(4)))
    np.testing.assert_array_equal(starts[1].T_world_obj, T_b)


def test_a_single_thing_stays_one_however_far_its_annotations_are_off() -> None:
    rows = {k: [(1, None, se3.from_translation([0.1 * k, 0, 0.5]))] for k in range(3)}
    seen, notes = told_apart(rows, dict.fromkeys(rows, np.eye(4)), {1: part("box")})
    assert {s.instance for row in seen.values() for s in row} == {0}
    assert len(notes) == 1 and "200 mm apart" in notes[0]


def test_instances_of_the_source_are_believed() -> None:
    T = se3.from_translation([0, 0, 0.5])
    rows = {0: [(1, 7, T)], 1: [(1, 8, T)], 2: [(1, 7, T)]}
    seen, _ = told_apart(rows, dict.fromkeys(rows, np.eye(4)), {1: part("box")})
    assert [seen[k][0].instance for k in rows] == [0, 1, 0]


def test_the_remaining_time_is_that_of_the_rest_at_the_rate_so_far() -> None:
    assert remaining_s(10.0, 0, 4) is None
    assert remaining_s(10.0, 1, 4) == 30.0
    assert remaining_s(40.0, 4, 4) == 0.0
