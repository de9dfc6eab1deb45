"""`realsim upgrade`: what comes out, what stays as it was, which annotations are one thing."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

import typed_commands
import upgradable_datasets as datasets
from bop_scenes import edit
from plain_meshes import square
from realsim.app.console import Console
from realsim.app.upgrade.analytic import FOLDER, agreement_of
from realsim.app.upgrade.dataset import open_scene, scenes_of
from realsim.app.upgrade.files import NOTE
from realsim.app.upgrade.outcome import Outcome, decide
from realsim.app.upgrade.run import UpgradeConfig, run_upgrade
from realsim.app.upgrade.source import prepare, told_apart, world_starts
from realsim.app.upgrade.tables import notes_of
from realsim.formats.graspnet.grasp_labels import read_grasp_labels
from realsim.formats.grasps.hdf5 import read_grasps_hdf5
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import GraspSet, Mesh, ObjectPose, SupportPlane
from realsim.registration.body import make_body
from realsim.registration.judging.verdict import CONTRAST_DECIDED
from realsim.registration.near_rivals import print_duel
from realsim.registration.photo import Picture, shifted
from realsim.rendering.casting.pixel_caster import PixelCaster
from realsim.rendering.rays import PlacedMesh
from realsim.store import SessionStore, load_grasps
from refusals import refused
from tried_grasps import plain_grasps

OFF_M = 0.003
"""Annotations of the BOP scenes are off by this along the camera's x."""
GRASPS = ("--grasps", "2")
PAINTS = np.array([[200, 40, 40], [40, 60, 190], [120, 120, 110]], np.uint8)
"""Colours of the box, the wedge and, at -1, what lies behind."""


def upgrade(dataset: Path, out: Path, *more: str) -> Result:
    return typed_commands.invoked("upgrade", dataset, "--out", out, "--quiet", *GRASPS, *more)


def failed_with(dataset: Path, out: Path, *more: str) -> str:
    """Return what a run said that was refused."""
    return typed_commands.refused("upgrade", dataset, "--out", out, "--quiet", *GRASPS, *more)


@pytest.fixture(scope="module")
def upgraded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Result]:
    """A BOP scene of one image and one that is broken, upgraded."""
    root = tmp_path_factory.mktemp("upgrade")
    dataset = datasets.bop_dataset(root / "dataset", 2, off_m=OFF_M)
    file = dataset / "test/000002/depth/000003.png"
    file.write_bytes(file.read_bytes()[:200])
    before = datasets.content_and_times(dataset)
    done = upgrade(dataset, root / "out", "--workers", "1")
    assert datasets.content_and_times(dataset) == before, "the data set is only read"
    return dataset, root / "out", done


@pytest.fixture
def copies(upgraded, tmp_path: Path) -> tuple[Path, Path]:
    """The data set and the upgrade of it, to be changed; their times are kept."""
    dataset, out, _ = upgraded
    shutil.copytree(out, tmp_path / "out")
    return Path(shutil.copytree(dataset, tmp_path / "dataset")), tmp_path / "out"


# --- laws -------------------------------------------------------------------------------------


@pytest.mark.slow
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


@pytest.mark.slow
def test_one_broken_scene_stops_no_other_and_tables_say_how_far_each_object_moved(upgraded) -> None:
    _, out, done = upgraded
    assert done.exit_code == 1, done.output
    told = json.loads((out / "upgrade.json").read_text())
    assert [s["place"] for s in told["scenes"]] == ["test/000001"]
    assert "000003.png" in told["left_out"]["test/000002"]
    assert "test/000002 was left out" in done.output
    assert told["summary"]["scenes"] == 1 and told["summary"]["objects"] == 2
    rows = list(csv.DictReader((out / "upgrade.csv").open()))
    assert [r["name"] for r in rows] == ["box", "wedge"]
    for row in rows:
        assert float(row["moved_mm"]) == pytest.approx(1e3 * OFF_M, abs=0.3)
        assert row["verdict"] in done.output
    page = (out / "upgrade.html").read_text()
    assert page.count('aria-label="test/') >= 2 and "as given" in page


@pytest.mark.slow
def test_a_second_run_does_nothing_again_and_takes_in_what_was_mended(copies) -> None:
    copy, again = copies
    before = datasets.content_and_times(again / "test")
    mended = copy / "test/000001/depth/000003.png"
    (copy / "test/000002/depth/000003.png").write_bytes(mended.read_bytes())
    # Of another scene: the objects lie elsewhere, so the pose is judged, the scene is not refused.
    done = upgrade(copy, again, "--workers", "1")
    assert done.exit_code == 0, done.output
    assert "1 of 2 scenes are upgraded already" in done.output
    after = datasets.content_and_times(again / "test")
    assert {k: after[k] for k in before} == before
    assert json.loads((again / "upgrade.json").read_text())["summary"]["scenes"] == 2
    (again / "test/000001/registration/review.json").write_text("{}")
    assert "registered from its review" in failed_with(copy, again, "--grasps", "1")


@pytest.mark.slow
def test_other_images_are_not_mixed_into_an_upgrade(copies) -> None:
    dataset, out = copies
    shutil.copy(dataset / "test/000002/rgb/000003.png", dataset / "test/000001/rgb/000003.png")
    assert "upgrade of other images" in failed_with(dataset, out, "--only-scenes", "1")


@pytest.mark.slow
def test_another_data_set_is_not_mixed_into_an_upgrade(upgraded, copies, tmp_path) -> None:
    dataset, out, _ = upgraded
    before = datasets.content_and_times(out)
    moved, unknown = copies

    def shift(rows: dict) -> None:
        rows["3"][0]["cam_t_m2c"][0] += 15.0

    edit(moved / "test/000001/scene_gt.json", shift)
    assert "upgrade of another data set: test/000001" in failed_with(moved, out)
    shutil.move(moved / "test/000001", moved / "test/000077")
    shutil.rmtree(moved / "test/000002")
    assert "upgrade of another data set" in failed_with(moved, out)
    assert datasets.content_and_times(out) == before
    # Where it is not known whose scene it is, its annotations tell.
    (unknown / "test/000001/imported/source.json").write_text("{}")
    assert upgrade(dataset, unknown, "--only-scenes", "1").exit_code == 0
    assert "of another folder" in failed_with(moved, unknown)


@pytest.mark.slow
def test_what_is_done_anew_is_told_where_it_was_reviewed_and_where_its_models_changed(
    copies,
) -> None:
    dataset, again = copies
    (again / "test/000001/review").mkdir()
    (again / "test/000001/review/journal.jsonl").write_text("")
    shutil.copytree(again / "test/000001", again / "test/000003")
    note = again / "test/000003" / NOTE
    note.write_text(note.read_text().replace("test/000001", "test/000003"))
    info = again / "test/000003/models/models_info.json"
    edit(info, lambda models: models["1"].update(diameter=1.0 + models["1"]["diameter"]))
    told = upgrade(dataset, again, "--only-scenes", "1", "--views", "1").output
    assert "test/000001 was reviewed" in told
    assert "object 1 of test/000003: another model" in told


@pytest.mark.slow
def test_a_camera_that_no_scene_of_a_bop_data_set_names_is_refused(upgraded) -> None:
    said = refused("no BOP scene", scenes_of, upgraded[0], UpgradeConfig(camera="kinect"))
    assert "of the camera 'kinect'" in said and "Leave --camera-name out" in said


# --- GraspNet ---------------------------------------------------------------------------------


def test_a_camera_and_a_number_of_images_can_be_asked_for(tmp_path) -> None:
    dataset = datasets.graspnet_dataset(tmp_path / "dataset")
    for place in (dataset, dataset / "scenes", dataset / "scenes/scene_0100/kinect"):
        assert [r.place for r in scenes_of(place, UpgradeConfig())] == ["test_kinect/000100"]
    other = UpgradeConfig(kind="graspnet", camera="realsense")
    refused("realsense", scenes_of, dataset, other)
    refused("keyframe_poses", UpgradeConfig, kind="graspnet", start="cosypose")


# --- which annotations are one thing ----------------------------------------------------------


def test_one_picture_with_two_camera_poses_is_told(tmp_path) -> None:
    dataset = datasets.bop_dataset(tmp_path / "dataset", views=2)
    (ref,) = scenes_of(dataset, config := UpgradeConfig())
    assert not any("same picture" in n for n in prepare(open_scene(ref), ref, config).notes)
    for what in ("rgb", "depth"):
        first, second = sorted((ref.folder / what).glob("*.png"))
        shutil.copy(first, second)
    assert any("same picture" in n for n in prepare(open_scene(ref), ref, config).notes)


def test_two_things_of_one_model_stay_two_in_every_order() -> None:
    model = part("box")
    T_a, T_b = se3.from_translation([0, 0, 0.5]), se3.from_translation([0.2, 0, 0.5])
    rows = {0: [(1, None, T_a), (1, None, T_b)], 1: [(1, None, T_b), (1, None, T_a)]}
    seen, notes = told_apart(rows, dict.fromkeys(rows, np.eye(4)), {1: model})
    assert [s.instance for s in seen[0]] == [0, 1] and [s.instance for s in seen[1]] == [1, 0]
    assert notes == []
    starts = world_starts(seen, dict.fromkeys(rows, np.eye(4)))
    np.testing.assert_array_equal(starts[1].T_world_obj, T_b)


def test_equal_notes_are_one_and_what_all_scenes_share_comes_last() -> None:
    box = {"name": "box", "grasps": {"why_none": ""}, "reasons": ["hidden"]}
    scene = {"plane": {}, "objects": [box]}
    records = [scene | {"place": f"{k}", "notes": ["no reference", f"{k}"]} for k in range(40)]
    objects, scenes = notes_of(records)
    assert objects == ["0 box and 39 more: hidden"] and len(scenes) == 41
    assert scenes[-1] == "scene 0 and 39 more: no reference"


# --- what becomes of an annotation ------------------------------------------------------------


SURE = np.diag([1e-6] * 3 + [4e-8] * 3)
"""Covariance of poses that are known to 0.06 deg and 0.2 mm."""


def judged(
    off_m: float, found_off_m: float, hidden: bool = False, far_m: float = 0.0
) -> list[Outcome]:
    """Return what becomes of annotations and new poses that are off along the camera's x.

    All of the depth is too far by `far_m`, and the new poses with it.
    """
    placed, (T,) = datasets.standing(0.5), datasets.cameras(1)
    # A board between the camera and the parts.
    board = se3.from_translation([0.0, -0.2, 0.2]) @ se3.exp([0.8, 0, 0, 0, 0, 0])
    (labels,) = datasets.looks([*placed, *[PlacedMesh(-1, square(0.5), board)] * hidden], 1)
    depth_m = np.where(labels.depth_m > 0, labels.depth_m + far_m, 0).astype(np.float32)
    picture = Picture(
        intrinsics=datasets.CAMERA, depth_m=depth_m, T_world_cam=T, rgb=datasets.grey_of(labels)
    )

    models = {part(n).obj_id: part(n) for n in datasets.NAMES}

    def at(off: float, far: float = 0.0) -> list[ObjectPose]:
        step = T @ se3.from_translation([off, 0, far]) @ se3.invert(T)
        return [
            ObjectPose(obj_id=obj_id, instance=p.instance, verdict="accepted",
                       T_world_obj=step @ p.T_world_obj, covariance=SURE)
            for obj_id, p in zip(models, placed, strict=True)
        ]  # fmt: skip

    table = SupportPlane(T_world_table=np.eye(4))
    return decide([picture], models, at(off_m), at(found_off_m, far_m), table)


@pytest.mark.parametrize("off_m", [-0.02, -0.004, 0.002, 0.008])
def test_a_right_annotation_stays_whatever_is_proposed(off_m: float) -> None:
    for outcome in judged(0.0, off_m):
        assert outcome.kind != "improved" and not outcome.looks_wrong, outcome.words
        # What was not taken can be shown beside what stays.
        assert outcome.T_proposed is not None and "T_world_obj_proposed" in outcome.as_json()


@pytest.mark.parametrize("off_m", [0.004, -0.008])
def test_a_wrong_annotation_is_replaced_by_the_right_pose(off_m: float) -> None:
    for outcome, right in zip(judged(off_m, 0.0), datasets.standing(0.5), strict=True):
        assert outcome.kind == "improved", outcome.words
        off = se3.transform(outcome.T_world_obj, right.mesh.vertices)
        off -= se3.transform(right.T_world_obj, right.mesh.vertices)
        assert np.linalg.norm(off, axis=1).max() < 0.001


@pytest.mark.parametrize(("off_m", "far_m", "most_m"), [(0.008, 0.003, 0.0025), (0.01, 0.0, 0.001)])
def test_one_view_takes_little_distance_from_depth_that_may_be_off_as_a_whole(
    off_m: float, far_m: float, most_m: float
) -> None:
    for outcome, right in zip(judged(off_m, 0.0, far_m=far_m), datasets.standing(0.5), strict=True):
        assert outcome.kind == "improved" and "mm are sure" in outcome.words, outcome.words
        step = outcome.T_world_obj[:3, 3] - right.T_world_obj[:3, 3]
        assert np.linalg.norm(step) < most_m


def test_a_hidden_thing_keeps_its_annotation_and_says_how_little_is_seen() -> None:
    for outcome in judged(0.008, 0.0, hidden=True):
        assert outcome.kind == "kept" and "in sight" in outcome.words


def test_poses_follow_a_photograph_that_lies_beside_its_depth() -> None:
    placed, (T,) = datasets.standing(0.5), datasets.cameras(1)
    (labels,) = datasets.looks(placed, 1)
    off_px = 3
    picture = Picture(
        intrinsics=datasets.CAMERA, depth_m=labels.depth_m.astype(np.float32), T_world_cam=T,
        rgb=np.roll(PAINTS[labels.ids], off_px, axis=1),
    )  # fmt: skip
    poses = [p.T_world_obj for p in placed]
    moved = shifted(picture, [p.mesh for p in placed], poses)
    for before, after in zip(poses, moved, strict=True):
        a, b = (se3.invert(T) @ X for X in (before, after))
        px = datasets.CAMERA.fx * (b[:3, 3] - a[:3, 3]) / a[2, 3]
        np.testing.assert_allclose(px, [off_px, 0, 0], atol=0.5)


# --- by its print -----------------------------------------------------------------------------


def test_the_print_tells_which_way_round_a_box_stands() -> None:
    paints = np.array([[200, 40, 40], [40, 60, 190], [120, 120, 110], [230, 220, 60],
                       [30, 30, 30], [240, 240, 240]], np.uint8)  # fmt: skip
    bare = part("box").mesh
    corners = bare.vertices[bare.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    along = np.argmax(np.abs(normals), axis=1)
    side = 2 * along + (normals[np.arange(len(along)), along] > 0)
    mesh = Mesh(
        vertices=bare.vertices[bare.faces].reshape(-1, 3),
        faces=np.arange(3 * len(side), dtype=np.int32).reshape(-1, 3),
        colors=np.repeat(paints[side], 3, axis=0),
    )
    T, (T_cam,) = datasets.standing(0.5)[0].T_world_obj, datasets.cameras(1)
    hits = PixelCaster([PlacedMesh(0, mesh, T)]).cast(datasets.CAMERA, T_cam)
    rgb = np.where(hits.geometry[..., None] == 0, paints[side[hits.face]], 90).astype(np.uint8)
    picture = Picture(intrinsics=datasets.CAMERA, depth_m=hits.depth_m, T_world_cam=T_cam, rgb=rgb)
    half = T @ se3.exp([0, 0, np.pi, 0, 0, 0])
    for paint, expected in ((mesh, True), (bare, False)):
        model = replace(part("box"), mesh=paint)
        body = make_body(ObjectPose(obj_id=1, instance=0, T_world_obj=T), model, 32, 100)
        right = print_duel([body], [T], 0, [half], [picture])
        wrong = print_duel([body], [half], 0, [T], [picture])
        if not expected:
            assert right is None and wrong is None
            continue
        assert right is not None and wrong is not None
        assert (right.contrast or 0) > CONTRAST_DECIDED
        assert (wrong.contrast or 0) < -CONTRAST_DECIDED
        np.testing.assert_array_equal(wrong.T_rival, T)


# --- Analytic grasps of an upgrade: tried by the School, kept beside its own, compared with labels.

QUIET = Console(quiet=True)


def tried(friction: list[float], scores: list[float]) -> GraspSet:
    """Return a set of which physics has said something."""
    n = len(scores)
    return plain_grasps(
        n, scores=np.array(scores), base_scores=np.zeros(n), slip_m=np.zeros((n, 4)),
        slip_rad=np.zeros((n, 4)), measures={"closure_friction": np.array(friction)},
    )  # fmt: skip


def test_labels_and_scores_that_rank_alike_have_the_correlation_minus_one() -> None:
    friction = [0.1 * k for k in range(1, 11)] * 2
    found = agreement_of([tried(friction, [1.05 - f for f in friction])])
    assert found is not None and found["score_vs_friction"]["rho"] == pytest.approx(-1.0)
    assert [level["tried"] for level in found["levels"]] == [2] * 10
    assert found["good"] == 2 * 5
    again = agreement_of([tried(friction, friction)])
    assert again is not None and again["score_vs_friction"]["rho"] == pytest.approx(1.0)


@pytest.mark.slow
def test_analytic_grasps_are_tried_and_kept_beside_the_schools_own(tmp_path: Path) -> None:
    dataset, out = datasets.bop_dataset(tmp_path / "dataset"), tmp_path / "out"
    config = UpgradeConfig(grasps_per_object=2, where=1)
    run_upgrade(config, dataset, out, QUIET)
    scene = out / "test/000001"
    own = datasets.content_and_times(scene / "grasps")
    result = run_upgrade(replace(config, analytic=8), dataset, out, QUIET)
    assert datasets.content_and_times(scene / "grasps").keys() == own.keys()
    assert [len(s) for s in load_grasps(scene)] == [2, 2]
    sets = load_grasps(scene / FOLDER)
    assert [s.obj_id for s in sets] == [part(n).obj_id for n in datasets.NAMES]
    for s in sets:
        assert 0 < len(s) <= 8
        labels = read_grasp_labels(out / f"grasp_label/{s.obj_id - 1:03d}_labels.npz")
        index = [tuple(row) for row in labels.index.tolist()]
        chosen = s.parameters["analytic"]["label_index"]
        for row, friction in zip(chosen, s.measures["closure_friction"], strict=True):
            assert labels.friction[index.index(tuple(row))] == pytest.approx(friction)
        # Every grasp is its label's, moved at most along the closing axis and back.
        Ts = labels.Ts_obj_grasp()[[index.index(tuple(r)) for r in chosen]]
        np.testing.assert_allclose(Ts[:, :3, :3], s.Ts_obj_grasp[:, :3, :3], atol=1e-6)
        along_x = (se3.invert(Ts) @ s.Ts_obj_grasp)[:, 0, 3]
        np.testing.assert_allclose(along_x, 0, atol=1e-6)
        assert np.isfinite(s.scores).all()
    assert len(read_grasps_hdf5(scene / FOLDER / "grasps.h5").sets) == 2
    assert result.analytic is not None
    assert result.analytic["grasps"] == sum(len(s) for s in sets)
    told = json.loads((out / "upgrade.json").read_text())
    assert told["analytic"]["levels"] == result.analytic["levels"]
    assert "Analytic grasps, tried" in (out / "upgrade.html").read_text()
    kept = datasets.content_and_times(scene / FOLDER)
    (scene / "stages/upgrade.json").unlink()  # gone through again: what is finished stays
    run_upgrade(replace(config, analytic=8), dataset, out, QUIET)
    assert datasets.content_and_times(scene / FOLDER) == kept
    _a_graspnet_roots_own_labels_are_taken(tmp_path, out / "grasp_label")


def _a_graspnet_roots_own_labels_are_taken(tmp_path: Path, labels: Path) -> None:
    dataset = datasets.graspnet_dataset(tmp_path / "graspnet")
    shutil.copytree(labels, dataset / "grasp_label")
    before, out = datasets.content_and_times(dataset), tmp_path / "from_graspnet"
    run_upgrade(UpgradeConfig(grasps_per_object=2, analytic=4, where=1), dataset, out, QUIET)
    assert datasets.content_and_times(dataset) == before
    scene = out / "test_kinect/000100"
    xml = "annotations/0001.xml"
    home = dataset / "scenes/scene_0100/kinect"
    assert (scene / "imported" / xml).read_bytes() == (home / xml).read_bytes()
    placed = json.loads((scene / "registration/scene.json").read_text())["objects"]
    for o, p in zip(placed, datasets.standing(), strict=True):
        # The world is the table's frame, as GraspNet has it; depth is in whole millimetres.
        T = np.array(o["T_world_obj"])
        np.testing.assert_allclose(T[:3, 3], p.T_world_obj[:3, 3], atol=1.5e-3)
    assert not (out / "grasp_label").exists()
    sets = load_grasps(scene / FOLDER)
    assert {s.parameters["analytic"]["from"] for s in sets} <= {p.name for p in labels.glob("*")}
    source = json.loads((scene / "imported/source.json").read_text())
    assert source["grasp_labels"] == sorted(f"grasp_label/{p.name}" for p in labels.glob("*.npz"))
