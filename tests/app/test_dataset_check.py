"""`realsim check` of a data set: what agrees ends with 0, what was spoiled is named, with 1.

One damaged image among sound ones is found and named, whatever the median of all says.

`realsim check`: exit codes, the table, JSON, and the repair, also beside a running capture.
"""

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from begun_sessions import begun
from bop_scenes import edit, write_boxes
from realsim.app.check.agreement import ObjectAgreement, SceneAgreement
from realsim.app.check.checksums import check_checksums, checksum_list
from realsim.app.check.dataset import MaskOverlap, Tally, agreement_of, checked_scenes
from realsim.records import CameraIntrinsics, View
from realsim.store import SessionStore
from realsim.store.atomic import only_run_in
from refusals import refused
from typed_commands import complained, finished, invoked, realsim
from upgradable_datasets import bop_dataset, graspnet_dataset

SCENE = "test/000001"


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bop_dataset(tmp_path_factory.mktemp("check") / "dataset")


def moved(root: Path, offset_mm: tuple[float, float, float]) -> None:
    def move(rows: dict) -> None:
        rows["3"][0]["cam_t_m2c"] = np.add(rows["3"][0]["cam_t_m2c"], offset_mm).tolist()

    edit(root / SCENE / "scene_gt.json", move)


def swapped_masks(root: Path) -> None:
    for kind in ("mask", "mask_visib"):
        a, b = (root / SCENE / f"{kind}/000003_00000{k}.png" for k in (0, 1))
        a.rename(a.with_suffix(".tmp"))
        b.rename(a)
        a.with_suffix(".tmp").rename(b)


def eaten_mask(root: Path) -> None:
    path = root / SCENE / "mask_visib/000003_000000.png"
    mask = cv2.imread(str(path), 0)
    mask[:, np.flatnonzero(mask.any(0))[:20]] = 0
    cv2.imwrite(str(path), mask)


def wrong_counts(root: Path) -> None:
    """Counts that no mask has."""
    rows = [
        {"bbox_obj": [1, 1, 5, 5], "bbox_visib": [1, 1, 5, 5], "px_count_all": 77,
         "px_count_valid": 77, "px_count_visib": 77, "visib_fract": 1.0}
    ] * 2  # fmt: skip
    (root / SCENE / "scene_gt_info.json").write_text(json.dumps({"3": rows}))


SPOILED: dict[str, tuple[Callable[[Path], None], str]] = {
    "pose to the side": (lambda r: moved(r, (8.0, 0.0, 0.0)), "mask has the IoU"),
    "pose too far": (lambda r: moved(r, (0.0, 0.0, 40.0)), "from where its pose puts it"),
    "swapped masks": (swapped_masks, "mask has the IoU 0.00"),
    "eaten mask": (eaten_mask, "mask_visib has the IoU"),
    "wrong counts": (wrong_counts, "px_count_visib"),
}


def test_exact_labels_agree(pristine: Path) -> None:
    assert "1 of 1 scenes agree" in finished("check", pristine).output
    (found,) = checked_scenes(pristine)
    assert [o.name for o in found.objects] == ["box", "wedge"]
    for o in found.objects:
        # Masks and poses are exact; the table, which hides nothing here, is in neither.
        assert o.mask_iou == 1.0 and o.visible_iou == 1.0
        assert abs(o.depth_mm) < 0.1 and o.hidden == 0.0  # 0.1 mm is a count of depth


@pytest.mark.parametrize("case", SPOILED)
def test_what_was_spoiled_is_named(case: str, pristine: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(pristine, tmp_path / "dataset"))
    spoil, told = SPOILED[case]
    spoil(root)
    result = invoked("check", root)
    assert result.exit_code == 1, result.output
    assert told in " ".join(result.output.split())


def test_a_graspnet_tree_agrees_up_to_its_four_decimals(tmp_path: Path) -> None:
    root = graspnet_dataset(tmp_path / "dataset")
    finished("check", root)
    (found,) = checked_scenes(root)
    for o in found.objects:
        assert o.mask_iou is None, "GraspNet has no whole silhouettes"
        assert o.visible_iou is not None and o.visible_iou > 0.97
        assert o.depth_mm is not None and abs(o.depth_mm) < 1.0


def test_a_data_set_is_not_repaired(pristine: Path) -> None:
    assert "only sessions are repaired" in complained("check", pristine, "--repair")


IMAGES = (1, 5, 9, 13, 17, 21)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene with visible masks only and no scene_gt_info.json."""
    folder = write_boxes(tmp_path / "dataset", count=len(IMAGES))
    for file in folder.glob("mask/*"):
        file.unlink()
    (folder / "mask").rmdir()
    (folder / "scene_gt_info.json").unlink()
    return folder


def checked(scene: Path) -> SceneAgreement:
    (found,) = checked_scenes(scene)
    return found


def faulty(found: SceneAgreement) -> dict[int, ObjectAgreement]:
    return {o.obj_id: o for o in found.objects if o.faults}


def test_sound_images_give_no_finding(scene: Path) -> None:
    found = checked(scene)
    assert found.agrees, (found.findings, faulty(found))
    assert found.frames == len(IMAGES) and all(o.visible_iou is not None for o in found.objects)


def test_an_object_that_one_image_sees_elsewhere_is_found(scene: Path) -> None:
    def shift(rows: dict) -> None:
        rows["9"][1]["cam_t_m2c"][2] += 12.0  # along the view: no mask tells

    edit(scene / "scene_gt.json", shift)
    found = faulty(checked(scene))
    assert set(found) == {7}
    told = "image 9: object 7 stands 12.0 mm from where the other 5 images see it"
    assert told in " ".join(found[7].faults)


def test_one_shifted_mask_is_found(scene: Path) -> None:
    path = scene / "mask_visib/000013_000001.png"
    cv2.imwrite(str(path), np.roll(cv2.imread(str(path), 0), 6, axis=1))
    found = faulty(checked(scene))
    assert set(found) == {7} and len(found[7].faults) >= 1
    assert "mask_visib of image 13 has the IoU 0." in found[7].faults[0]


def test_one_scaled_depth_image_is_found(scene: Path) -> None:
    path = scene / "depth/000005.png"
    cv2.imwrite(str(path), np.round(cv2.imread(str(path), -1) * 0.97).astype(np.uint16))
    (told,) = checked(scene).findings
    assert told.startswith("depth of image 5 is ") and "mm nearer than that of the others" in told
    assert told.endswith("scale 0.970")


def test_a_hand_in_front_is_no_damage(scene: Path) -> None:
    """What has no model but is measured in front hides an object, as BOP's masks say."""
    visible = scene / "mask_visib/000009_000001.png"
    mask = cv2.imread(str(visible), 0)
    columns = np.flatnonzero(mask.any(0))
    hand = np.zeros(mask.shape, bool)
    hand[:, columns[: len(columns) // 2]] = True
    for file in scene.glob("mask_visib/000009_*.png"):
        cv2.imwrite(str(file), np.where(hand, 0, cv2.imread(str(file), 0)))
    depth = cv2.imread(str(scene / "depth/000009.png"), -1)
    cv2.imwrite(str(scene / "depth/000009.png"), np.where(hand, depth // 2, depth))
    assert faulty(checked(scene)) == {}
    cv2.imwrite(str(scene / "depth/000009.png"), depth)
    assert 7 in faulty(checked(scene)), "half a mask that nothing hides is damage"


def test_table_json_and_exit_code_say_the_same(scene: Path) -> None:
    edit(scene / "scene_gt.json", lambda rows: rows["9"][1]["cam_t_m2c"].__setitem__(0, 400.0))
    result = invoked("check", scene, "--json")
    told = json.loads(result.output)
    assert result.exit_code == 1 and told["agrees"] is False and told["checksums"] is None
    by_id = {o["obj_id"]: o["faults"] for o in told["scenes"][0]["objects"]}
    # Also what the format's own check finds of an object stands with the object.
    assert any(f.startswith("scene_gt.json, image 9, object 1 (id 7)") for f in by_id[7])
    assert any("stands" in f for f in by_id[7])
    lines = invoked("check", scene).output.splitlines()
    table = [line for line in lines if "│" in line and " 7 " in line]
    assert table and table[0].rstrip(" │").endswith("no")


# --- laws of the comparison of images -------------------------------------------------------------


def seen_at(points_mm: np.ndarray) -> Tally:
    tally = Tally()
    for k, p in enumerate(points_mm):
        tally.note_places(k, [0], [1e-3 * np.asarray(p, float)])
    return tally


def strays(tally: Tally) -> tuple[str, ...]:
    return agreement_of(8, "", tally).faults


def test_images_that_all_differ_have_no_stray_among_them() -> None:
    rng = np.random.default_rng(0)
    spread = rng.normal(0, 8.0, (40, 3))
    assert strays(seen_at(spread)) == ()
    spread[7] += [150.0, 0, 0]
    (told,) = strays(seen_at(spread))
    assert told.startswith("image 7:")


@pytest.mark.parametrize(("outline_px", "strays_told"), [(0.6, 0), (2.4, 1)])
def test_a_half_hidden_thing_is_all_outline(outline_px: float, strays_told: int) -> None:
    """The same IoU is a rounded pose of a sliver, or a wrong mask of something large."""
    sound = [MaskOverlap(image=k, iou=0.98, outline_px=0.2) for k in range(6)]
    tally = Tally(visible=[*sound, MaskOverlap(image=6, iou=0.8, outline_px=outline_px)])
    assert len(strays(tally)) == strays_told


# --- checksums ------------------------------------------------------------------------------------


def summed(root: Path) -> Path:
    """Write SHA256SUMS of a folder, as `realsim export` does."""
    files = sorted(p for p in root.rglob("*") if p.is_file())
    lines = [f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(root)}" for p in files]
    (root / "SHA256SUMS").write_text("\n".join(lines) + "\n")
    return root


def test_files_are_held_against_their_checksums(scene: Path) -> None:
    root = summed(scene.parents[1])
    for folder in (root, scene.parent, scene):
        told = json.loads(invoked("check", folder, "--json").output)
        assert told["agrees"] and told["checksums"]["listed"] > 0
    colour = scene / "rgb/000009.png"
    colour.write_bytes(colour.read_bytes() + b"\0")
    (scene / "rgb/000013.png").unlink()
    result = invoked("check", scene, "--json")
    report = json.loads(result.output)["checksums"]
    assert result.exit_code == 1
    assert report["changed"] == ["test/000003/rgb/000009.png"]
    assert report["missing"] == ["test/000003/rgb/000013.png"]
    shown = " ".join(invoked("check", root).output.split())
    assert "rgb/000009.png: other bytes" in shown and "rgb/000013.png: the file is" in shown
    # What lies beside the given folder is not its matter.
    finished("check", root / "models")


@pytest.mark.parametrize("line", ["a" * 64 + "  ../secret", "no sum"])
def test_a_list_that_is_none_or_leads_out_is_refused(tmp_path: Path, line: str) -> None:
    (tmp_path / "file").write_text("x")
    (summed(tmp_path) / "SHA256SUMS").open("a").write(line + "\n")
    path = checksum_list(tmp_path)
    assert path is not None
    refused("line 2 of", check_checksums, path, tmp_path)


CAMERA = CameraIntrinsics(width=40, height=30, fx=40, fy=40, cx=19.5, cy=14.5)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    folder = tmp_path / "table"
    for place, views in ((folder, 4), (folder / "calibration/capture", 2)):
        store = begun(place, CAMERA)
        store.write_json("plan.json", {"content": {"joints": [[0.0] * 6] * 5}})
        for index in range(views):
            rgb = np.random.default_rng(index).integers(0, 256, (30, 40, 3), dtype=np.uint8)
            store.add_view(View(index=index), rgb, np.full((30, 40), 0.3, np.float32))
    return folder


def test_a_sound_session_ends_with_0(session: Path) -> None:
    result = finished("check", session)
    assert "4 of 5 planned" in result.output and "sound: every listed file" in result.output
    told = json.loads(invoked("check", session, "--json").output)
    assert told["sound"] and told["views_not_captured"] == [4]
    assert [r["views"] for r in told["inner"]] == [2]


def test_damage_ends_with_1_and_a_repair_takes_it_out(session: Path) -> None:
    path = session / "calibration/capture/depth/000001.png"
    path.write_bytes(path.read_bytes()[:-20])
    (session / "rgb/000002.png").unlink()
    result = invoked("check", session)
    assert result.exit_code == 1
    assert "rgb/000002.png" in result.output and "depth/000001.png" in result.output
    assert "--repair" in result.output
    told = json.loads(invoked("check", session, "--json").output)
    assert told["views_damaged"] == [2] and told["inner"][0]["views_damaged"] == [1]
    repaired = finished("check", session, "--repair")
    assert "views 2 count as not captured" in repaired.output
    assert "damaged/depth/000002.png" in repaired.output
    finished("check", session)
    again = json.loads(invoked("check", session, "--repair", "--json").output)
    assert again["moved"] == [] and again["dropped_views"] == []
    assert SessionStore.open(session).completed == {0, 1, 3}
    finished("check", session, "--decode")


def test_what_is_no_session_ends_with_2(session: Path) -> None:
    for folder, told in (
        (session / "rgb", "is not a session"),
        (session.parent, "Did you mean"),
        (session / "nowhere", "is not a session"),
    ):
        done = realsim("check", folder)
        assert done.returncode == 2 and told in done.stderr


def test_files_without_a_checksum_are_named_and_those_of_others_explained(session: Path) -> None:
    (session / "models").mkdir()
    (session / "models/obj_000001.ply").write_text("ply")
    path = session / "manifest.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if "rgb/000001" not in line))
    result = finished("check", session)
    assert "1: rgb/000001.png" in result.output and "models/ 1 (no checksum" in result.output
    assert "1 files of the session have no checksum" in result.output
    told = json.loads(invoked("check", session, "--json").output)
    assert told["files_without_checksum"] == ["rgb/000001.png"]
    assert told["files_beside"] == {"models/": 1}
    assert {f["path"]: f["kind"] for f in told["findings"]} == {"rgb/000001.png": "unproven"}
    repaired = finished("check", session, "--repair")
    assert "rgb/000001.png" in repaired.output
    assert "nothing can tell" in repaired.output
    assert json.loads(invoked("check", session, "--json").output)["files_without_checksum"] == []


def test_a_running_capture_is_not_repaired(session: Path) -> None:
    with only_run_in(session):
        done = realsim("check", session, "--repair")
        assert done.returncode == 2 and "another run is working" in done.stderr
        finished("check", session)
