"""Laws of `realsim export` and of importing labels: what goes in comes out, nothing is mixed.

A registered session as a scene for simulators: what their own programs read back.
"""

import hashlib
import json
import shutil
import tarfile
from dataclasses import replace

import numpy as np
import pytest

from labelled_scenes import INTRINSICS, MODELS, labelled_scene, written_bop
from realsim import images
from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console
from realsim.formats.bop.labels import mask_of
from realsim.formats.bop.models import load_models
from realsim.formats.bop.opening import open_labelled_bop
from realsim.formats.graspit.scene import read_graspit_scene
from realsim.formats.graspnet.annotations import read_objects
from realsim.formats.graspnet.grasp_group import read_grasp_group
from realsim.formats.session_scene import open_session_scene
from realsim.geometry import se3
from realsim.geometry.metrics import mask_iou
from realsim.review import journal
from realsim.store import SessionStore, load_grasps, load_scene, save_grasps
from school_sessions import registered, scene
from shared_sessions import copy_of
from synthetic_scenes import captured_session
from tried_grasps import tried_set
from typed_commands import finished, refused


@pytest.fixture(scope="module")
def bop(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source")
    scene = labelled_scene(folder / "images", [2, 5, 9, 14])
    return written_bop(folder / "bop", scene)


def object_ids(root):
    """The ids of the objects in each scene of a BOP data set."""
    return [
        {row["obj_id"] for rows in json.loads(file.read_text()).values() for row in rows}
        for file in sorted(root.glob("*/*/scene_gt.json"))
    ]


def scene_files(root):
    folder = next(root.glob("*/*/scene_gt.json")).parent
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    return folder, names


def assert_same_scene(first, second):
    """Every number to the last digit, every pixel."""
    (a, names), (b, others) = scene_files(first), scene_files(second)
    assert names == others
    for name in names:
        one, other = a / name, b / name
        if name.endswith(".json"):
            mine, theirs = (json.loads(p.read_text(), parse_float=str) for p in (one, other))
            if name.endswith("coco.json"):  # it says when it was made
                mine, theirs = mine["annotations"], theirs["annotations"]
            assert mine == theirs, name
        else:
            assert np.array_equal(images.read_image(one), images.read_image(other)), name


def test_bop_to_the_store_and_back_is_the_same_to_the_last_digit(bop, tmp_path):
    finished("import", bop, tmp_path / "session", "--quiet")
    (tmp_path / "session/models/models_info.json").unlink()  # as of a kill: it is written last
    finished("import", bop, tmp_path / "session", "--quiet")
    finished("export", tmp_path / "session", "--to", "bop", "--out", tmp_path / "again", "--quiet")
    assert_same_scene(bop, tmp_path / "again")
    for name in ("models/obj_000007.ply", "models/models_info.json"):
        assert (bop / name).is_file() and (tmp_path / "again" / name).is_file()


def test_graspnet_to_the_store_and_back_keeps_every_digit_of_the_format(bop, tmp_path):
    first, second = tmp_path / "graspnet", tmp_path / "again"
    table = ("--table-is-world", "--quiet")
    finished("export", bop, "--to", "graspnet", "--out", first, *table)
    finished("import", first, tmp_path / "session", "--quiet")
    finished("export", tmp_path / "session", "--to", "graspnet", "--out", second, "--quiet")
    for part in ("annotations", "label", "depth", "rgb"):
        files = sorted(first.glob(f"scenes/*/*/{part}/*"))
        assert len(files) == 4
        for file in files:
            other = second / file.relative_to(first)
            if part == "annotations":
                for a, b in zip(read_objects(file), read_objects(other), strict=True):
                    assert a.number == b.number  # the meta files have single precision
                    np.testing.assert_allclose(a.T_cam_obj, b.T_cam_obj, rtol=0, atol=2e-7)
            else:
                assert np.array_equal(images.read_image(file), images.read_image(other))
    for name in ("camera_poses.npy", "cam0_wrt_table.npy", "camK.npy"):
        a, b = (np.load(next(root.glob(f"scenes/*/*/{name}"))) for root in (first, second))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def test_sources_that_number_their_objects_alike_share_one_count(bop, tmp_path):
    scene = labelled_scene(tmp_path / "images", [1, 3])
    models = dict(scene.models())
    changed = next(iter(models))
    mesh = models[changed].mesh
    models[changed] = replace(models[changed], mesh=replace(mesh, vertices=1.25 * mesh.vertices))
    other = written_bop(tmp_path / "other", replace(scene, models_by_id=models))
    finished("export", bop, other, "--to", "bop", "--out", tmp_path / "both", "--quiet")
    written = load_models(tmp_path / "both/models")
    assert set(written) == {*models, max(models) + 1}
    grown = written[max(models) + 1].mesh.vertices
    assert np.allclose(np.ptp(grown, axis=0), 1.25 * np.ptp(written[changed].mesh.vertices, axis=0))
    assert object_ids(tmp_path / "both") == [set(models), {*models, max(models) + 1} - {changed}]


def test_labels_that_came_along_become_starts_and_are_never_overwritten(bop, tmp_path):
    first = finished("import", bop, tmp_path / "session", "--quiet").output
    store = SessionStore.open(tmp_path / "session")
    starts = store.read_json("registration/starts.json")["starts"]
    scene = open_labelled_bop(bop)
    frame = scene.frame(scene.indices[0])
    for start, o in zip(starts, frame.objects, strict=True):
        np.testing.assert_allclose(start["T_world_obj"], frame.T_world_cam @ o.T_cam_obj, atol=1e-9)
    before = (tmp_path / "session/imported/scene_gt.json").read_bytes()
    assert store.verify() == []
    finished("import", bop, tmp_path / "session", "--quiet")
    assert (tmp_path / "session/imported/scene_gt.json").read_bytes() == before
    bare = finished("import", bop, tmp_path / "bare", "--no-depth", "--quiet").output
    assert "refines" in first and "refines" not in bare and "register` needs" in bare
    broken = shutil.copytree(bop, tmp_path / "broken")
    next(broken.glob("*/*/mask/000014_000001.png")).write_bytes(b"")
    said = refused("import", broken, tmp_path / "new", "--quiet")
    assert "truncated" in said and "Nothing was kept" in said and not (tmp_path / "new").exists()
    said = refused("import", broken, tmp_path / "session", "--overwrite", "--quiet")
    assert "stays as it was" in said
    assert (tmp_path / "session/imported/scene_gt.json").read_bytes() == before


def test_the_sums_and_counts_on_the_card_are_those_of_the_folder(bop, tmp_path):
    out = tmp_path / "out"
    finished("export", bop, "--to", "bop", "--out", out, "--licence", "CC BY 4.0", "--quiet")
    card = (out / "README.md").read_text()
    assert "| images and labels | CC BY 4.0 |" in card
    assert "| object models | not stated" in card
    assert "1 scene, 4 frames, 12 object poses in them, 3 object models" in card
    sums = dict(reversed(x.split("  ")) for x in (out / "SHA256SUMS").read_text().splitlines())
    files = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert set(sums) == files - {"SHA256SUMS", ".export.json", "provenance.run.json"}
    assert all(hashlib.sha256((out / f).read_bytes()).hexdigest() == d for f, d in sums.items())


def test_what_cannot_be_is_refused_and_leaves_nothing(bop, tmp_path):
    out = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    for source, target, to, words, told in (
        (bop, "colmap", out, ["--table-is-world"], "says nothing of COLMAP"),
        (bop, "bop", bop / "again", [], "lies inside the source"),
        (bop, "bop", out, ["--only-scenes", "4"], "it has 3"),
        (tmp_path / "no", "bop", out, [], "not there"),
        (tmp_path / "empty", "bop", out, [], "accepted are"),
    ):
        assert told in refused("export", source, "--to", target, "--out", to, *words)
    assert not out.exists()


BENT = replace(INTRINSICS, distortion=np.array([-0.08, 0.02, 0.001, -0.001, 0.0]))


@pytest.fixture(scope="module")
def ideal(tmp_path_factory):
    """What a camera without a lens sees of the bent data set's scene, without the hand."""
    return labelled_scene(tmp_path_factory.mktemp("ideal"), [0, 1, 2])


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """A BOP data set seen through a lens; a hand hides a corner of the first object."""
    folder = tmp_path_factory.mktemp("bent")
    scene = labelled_scene(folder / "images", [0, 1, 2], intrinsics=BENT)
    rows, columns = np.nonzero(scene.masks[1, 0, True])
    hand = scene.masks[1, 0, True].copy()
    hand[: int(np.median(rows)) + 1, : int(np.median(columns)) + 1] = False
    assert 0.1 < np.mean(~hand[scene.masks[1, 0, True]]) < 0.6
    scene.masks[1, 0, True] = hand
    return written_bop(folder / "bop", scene)


def masks_of(root, index, k, kind="mask_visib"):
    return images.read_grey(next(root.glob(f"*/*/{kind}/{index:06d}_{k:06d}.png"))) > 0


def test_bop_is_what_a_pinhole_reader_renders_of_its_poses(bent, ideal, tmp_path):
    finished("export", bent, "--to", "bop", "--out", tmp_path / "plain", "--quiet")
    row = json.loads(next(tmp_path.glob("plain/*/*/scene_camera.json")).read_text())["0"]
    assert "cam_distortion" not in row and row["cam_K"] == INTRINSICS.K.ravel().tolist()
    for kind, visible in (("mask", False), ("mask_visib", True)):
        ious = [
            mask_iou(masks_of(tmp_path / "plain", i, k, kind), ideal.masks[i, k, visible])
            for i, k in np.ndindex(3, 3) if visible is False or (i, k) != (1, 0)
        ]  # fmt: skip
        assert np.median(ious) >= 0.9999 and min(ious) >= 0.99
    # What the hand hides in the raw picture stays hidden, and nothing else.
    lost = ideal.masks[1, 0, True] & ~masks_of(tmp_path / "plain", 1, 0)
    raw = labelled_scene(tmp_path / "raw", [0, 1, 2], intrinsics=BENT)
    before = raw.masks[1, 0, True] & ~masks_of(bent, 1, 0)
    assert abs(lost.sum() - before.sum()) < 0.05 * before.sum()
    info = json.loads(next(tmp_path.glob("plain/*/*/scene_gt_info.json")).read_text())["1"][0]
    assert info["px_count_visib"] == masks_of(tmp_path / "plain", 1, 0).sum()
    assert info["px_count_all"] >= masks_of(tmp_path / "plain", 1, 0, "mask").sum()


def test_a_lens_that_is_kept_says_what_it_costs(bent, ideal, tmp_path):
    raw = tmp_path / "raw"
    finished("export", bent, "--to", "bop", "--out", raw, "--keep-distortion", "--quiet")
    assert_same_scene(bent, raw)
    said = (raw / "README.md").read_text()
    assert "the lens is kept" in said and "visible masks compared have an IoU below 0.99" in said
    args = ("export", bent, "--to", "graspnet", "--table-is-world", "--quiet", "--out")
    finished(*args, tmp_path / "g")
    assert "the lens is kept" not in (tmp_path / "g/README.md").read_text()
    # The straight edge of a box is straight again: its mask is that of an ideal camera.
    label = images.read_image(next((tmp_path / "g").glob("scenes/*/*/label/0000.png")))
    for k, obj_id in enumerate(MODELS):
        assert mask_iou(label == obj_id, ideal.mask(0, k, visible=True)) >= 0.9999
    assert "contradict" in refused(*args, tmp_path / "x", "--undistort", "--keep-distortion")


def test_masks_of_objects_without_a_mesh_are_resampled_and_said_to_be(bent, ideal, tmp_path):
    bare = shutil.copytree(bent, tmp_path / "bare")
    for name in ("models", "models_eval"):
        shutil.rmtree(bare / name)
    finished("export", bare, "--to", "bop", "--out", tmp_path / "out", "--quiet")
    assert "[1, 7, 30] have resampled masks" in (tmp_path / "out/README.md").read_text()
    assert mask_iou(masks_of(tmp_path / "out", 0, 1), ideal.masks[0, 1, True]) > 0.95


def test_cameras_go_out_and_come_back(bop, tmp_path):
    before = open_labelled_bop(bop)
    for target, options in (("colmap", ("--scale", "1")), ("nerfstudio", ())):
        out = tmp_path / target
        finished("export", bop, "--to", target, "--out", out, "--quiet")
        scene = next(p for p in out.iterdir() if p.is_dir())
        finished("import", scene, tmp_path / f"{target}_session", *options, "--quiet")
        views = SessionStore.open(tmp_path / f"{target}_session").session.views
        for v, i in zip(views, before.indices, strict=True):
            np.testing.assert_allclose(v.T_world_cam, before.frame(i).T_world_cam, atol=1e-9)


def test_labels_that_are_no_reference_say_so_wherever_they_go(bop, tmp_path):
    rough = shutil.copytree(bop, tmp_path / "rough")
    for file in rough.glob("*/*/scene_gt.json"):
        file.rename(file.with_name("scene_gt_approximate.json"))
    result = finished("import", rough, tmp_path / "session", "--quiet")
    assert "only a rough start" in " ".join(result.output.split())
    for source, out in ((tmp_path / "session", "a"), (rough, "b")):
        finished("export", source, "--to", "bop", "--out", tmp_path / out, "--quiet")
        assert "only a rough start" in (tmp_path / out / "README.md").read_text()


def test_an_import_makes_up_no_camera_pose_for_the_data_set(tmp_path):
    scene = labelled_scene(tmp_path / "images", [4]).change_frames(T_world_cam=None)
    source = written_bop(tmp_path / "bop", scene)
    finished("import", source, tmp_path / "session", "--quiet")
    finished("export", tmp_path / "session", "--to", "bop", "--out", tmp_path / "again", "--quiet")
    assert_same_scene(source, tmp_path / "again")
    assert "cam_R_w2c" not in next(tmp_path.glob("again/*/*/scene_camera.json")).read_text()


def test_sources_that_were_only_touched_are_the_same(bop, tmp_path):
    source, out = tmp_path / "source", tmp_path / "out"
    shutil.copytree(bop, source)
    words = ("export", source, "--to", "bop", "--out", out, "--quiet")
    finished(*words)
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file() and p.name[0] != "."}
    for path in source.rglob("*"):
        path.touch()
    for _ in range(2):
        finished(*words)
        assert {p: p.read_bytes() for p in before} == before
    (out / "README.md").write_text("a card of my own")
    finished(*words)
    written = next(out.glob("*/*/rgb/*.png"))
    whole = written.read_bytes()
    written.write_bytes(whole[:-1])
    assert f"{written.name}: other bytes than were written" in refused(*words)
    written.write_bytes(whole)
    file = next(source.glob("*/*/rgb/*.png"))
    file.write_bytes(file.read_bytes() + b"\0")
    assert "holds a finished export" in refused(*words)


def test_an_object_without_a_mesh_is_not_taken_for_another_sources_object(bop, tmp_path):
    other = written_bop(tmp_path / "other", labelled_scene(tmp_path / "images", [1]))
    for file in other.glob("models*/obj_000007*"):
        file.unlink()
    words = ("export", bop, other, "--to", "bop", "--out", tmp_path / "both", "--quiet")
    assert "no mesh of object 7 (here 31)" in " ".join(finished(*words).output.split())
    finished("export", other, bop, "--to", "bop", "--out", tmp_path / "again", "--quiet")
    for out in ("both", "again"):
        assert object_ids(tmp_path / out) == [{1, 7, 30}, {1, 30, 31}]


# --- What lies beside an export for machines: Croissant's description and BOP's tar shards.


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    home = tmp_path_factory.mktemp("release")
    source = written_bop(home / "source", labelled_scene(home / "images", [0, 7]))
    finished("export", source, "--to", "bop", "--shards", "--out", home / "out", "--quiet")
    return home / "out"


def test_shards_hold_every_image_with_its_rows_and_masks(release):
    keys = json.loads((release / "train_web/key_to_shard.json").read_text())
    assert keys == {"000003_000000": 0, "000003_000007": 0}
    scene = release / "train/000003"
    with tarfile.open(release / "train_web/shard-000000.tar") as tar:
        held = {m.name: tar.extractfile(m).read() for m in tar.getmembers()}
    endings = ("rgb.png", "depth.png", "camera.json", "gt.json", "gt_info.json", "mask.json",
               "mask_visib.json")  # fmt: skip
    assert set(held) == {f"{key}.{ending}" for key in keys for ending in endings}
    assert held["000003_000007.rgb.png"] == (scene / "rgb/000007.png").read_bytes()
    for name in ("camera", "gt", "gt_info"):
        rows = json.loads((scene / f"scene_{name}.json").read_text())
        assert json.loads(held[f"000003_000007.{name}.json"]) == rows["7"]
    for kind in ("mask", "mask_visib"):
        masks = json.loads(held[f"000003_000007.{kind}.json"])
        for k in range(3):
            file = scene / kind / f"000007_{k:06d}.png"
            assert np.array_equal(mask_of(masks[str(k)]), images.read_grey(file) > 0)


def test_the_description_names_files_with_their_checksums_and_sets_that_find_them(release):
    document = json.loads((release / "croissant.json").read_text())
    assert document["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    found = set()
    for part in document["distribution"]:
        if part["@type"] == "cr:FileObject":
            data = (release / part["contentUrl"]).read_bytes()
            assert hashlib.sha256(data).hexdigest() == part["sha256"]
            found.add(part["contentUrl"])
        else:
            files = {p.relative_to(release).as_posix() for p in release.glob(part["includes"])}
            assert part["description"] == f"{len(files)} files"
            found |= files
    sums = {x.split("  ")[1] for x in (release / "SHA256SUMS").read_text().splitlines()}
    assert sums - found <= {"README.md", "croissant.json", "provenance.json"}
    (records,) = document["recordSet"]
    assert [f["name"] for f in records["field"]] == ["path", "image"]


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return registered(tmp_path_factory.mktemp("scenes") / "scene_000007")


def exported(session, target, out):
    finished("export", session, "--to", target, "--out", out, "--quiet")
    return out / "scene_000007"


def test_mujoco_reads_the_poses(session, tmp_path):
    import mujoco

    folder = exported(session, "mjcf", tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    free = [b for b in range(model.nbody) if model.body_dofnum[b] == 6]
    for body, o in zip(free, scene().objects, strict=True):
        np.testing.assert_allclose(data.xpos[body], o.T_world_obj[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.xmat[body].reshape(3, 3), o.T_world_obj[:3, :3], atol=1e-9)


def test_the_authors_scene_is_read_back(session, tmp_path):
    folder = exported(session, "graspit", tmp_path / "out")
    back = read_graspit_scene(folder / "scene.yaml", order="wxyz")
    for a, b in zip(back.scene.objects, scene().objects, strict=True):
        np.testing.assert_allclose(a.T_world_obj, b.T_world_obj, atol=1e-9)


def test_a_scene_without_views_is_no_data_set(session, tmp_path):
    assert "no views" in refused("export", session, "--to", "bop", "--out", tmp_path / "o")
    assert not (tmp_path / "o").exists()


# --- Grasps of a session in other programs' formats.


@pytest.fixture(scope="module")
def tried(tmp_path_factory):
    store = captured_session(tmp_path_factory.mktemp("grasps") / "scene_000002", count=2)
    rng = np.random.default_rng(4)
    for o in load_scene(store).objects:
        save_grasps(store, tried_set(rng, 30, obj_id=o.obj_id, instance=o.instance))
    annotate_session(store, Console(quiet=True))
    return store.folder


def test_grasps_of_a_frame_are_in_its_camera(tried, tmp_path):
    finished("export", tried, "--to", "grasp-group", "--out", tmp_path / "out", "--quiet")
    store = SessionStore.open(tried)
    sets = load_grasps(store)
    scene = open_session_scene(store)
    for index in scene.indices:
        group = read_grasp_group(tmp_path / f"out/scene_000002/{index:06d}.npy")
        poses = {o.instance: o.T_cam_obj for o in scene.frame(index).objects}
        want = [
            (poses[s.instance] @ T, label)
            for s in sets
            for T, label in zip(s.Ts_obj_grasp, s.labels, strict=True)
            if np.isfinite(label)
        ]
        assert len(group) == len(want) > 10
        np.testing.assert_allclose(group.Ts_a_grasp, [T for T, _ in want], atol=2e-6)
        np.testing.assert_allclose(group.scores, [label for _, label in want], atol=1e-6)


def test_grasps_of_what_is_another_object_stay_out_and_moves_are_told(tried, tmp_path):
    store = SessionStore.open(copy_of(tried, tmp_path / "s"))
    scene = load_scene(store)
    first, *others = scene.objects
    anew = replace(scene, objects=(replace(first, obj_id=first.obj_id + 90), *others))
    seen, grasps = open_session_scene(store, anew), open_session_scene(store, anew).grasps()
    assert first.instance not in {s.instance for s in grasps.sets} and len(grasps.sets) > 0
    assert any("of 1 object stay out" in note for note in seen.notes)
    (tried_there,) = (s for s in load_grasps(store) if s.instance == first.instance)
    there = {"T_table_obj": (se3.invert(scene.plane.T_world_table) @ first.T_world_obj).tolist()}
    save_grasps(store, replace(tried_there, parameters={"inputs": there}))
    said = finished("export", store.folder, "--to", "isaac", "--out", tmp_path / "a").output
    assert "no longer stand" not in said
    moved = first.T_world_obj @ se3.from_translation([0.06, 0, 0])
    entry = journal.new_entry("move", first, "ada", pose=moved)
    journal.append(store.path(journal.JOURNAL_FILE), entry)
    said = finished("export", store.folder, "--to", "isaac", "--out", tmp_path / "b").output
    assert "no longer stand (moved by up to 60.0 mm)" in said and "1 unchecked" in said


def test_grasps_are_of_sessions(tried, tmp_path):
    finished("export", tried, "--to", "bop", "--out", tmp_path / "bop", "--quiet")
    hdf5 = ("--to", "hdf5", "--out", tmp_path / "o")
    assert "is no session" in refused("export", tmp_path / "bop", *hdf5)
    assert not (tmp_path / "o").exists()
    assert "says nothing of realsim HDF5" in refused("export", tried, *hdf5, "--least-score", "0.5")
