"""A session with a camera in the hand and one that stands still, from register to BOP and back."""

import json
from pathlib import Path

import numpy as np
import pytest

import refusals
from begun_sessions import begun
from realsim.app.annotate.current import annotate_session, what_is_stale
from realsim.app.console import Console
from realsim.app.register.config import RegisterRequest
from realsim.app.register.results import claimed_cameras, load_cameras, load_registered
from realsim.app.register.run import run_register
from realsim.app.register.tables import camera_line
from realsim.app.stages import open_session, save_starts
from realsim.formats.bop.opening import open_labelled_bop
from realsim.formats.bop.scene import find_scenes, read_scene
from realsim.geometry import se3
from realsim.images import read_grey
from realsim.records import CameraIntrinsics, View
from realsim.store import SessionStore, load_scene
from realsim.store.cameras import camera_folder, camera_folders, open_cameras, session_of_camera
from registered_sessions import table_renderer, table_session, true_poses
from shared_sessions import copy_of
from typed_commands import finished, invoked, refused

CAMERA = CameraIntrinsics(
    width=300, height=260, fx=330.0, fy=331.0, cx=148.0, cy=131.0, distortion=np.array([-0.08])
)
T_TRUE = se3.look_at([0.3, -0.42, 0.4], [0.0, 0.0, 0.03])
IMAGES = 4
QUIET = Console(quiet=True)


def add_fixed(session: SessionStore, name: str, *, posed: bool = True) -> SessionStore:
    """Add a fixed camera that is said to stand 2.4 mm and 0.2 deg beside where it does."""
    seen = table_renderer().render(CAMERA, T_TRUE)
    rgb = np.where((seen.ids >= 0)[..., None], 190, 80).astype(np.uint8).repeat(3, -1)
    store = begun(camera_folder(session.folder, name), CAMERA, name=name, unit_m=2e-4)
    rng = np.random.default_rng(4)
    said = T_TRUE @ se3.exp(np.array([3e-3, -2e-3, 1e-3, 1e-3, 2e-3, -1e-3]))
    for k in range(IMAGES):
        depth = seen.depth_m + rng.normal(size=seen.depth_m.shape) * 0.003 * seen.depth_m**2
        depth = np.where(seen.depth_m > 0, depth, 0.0)
        store.add_view(View(index=k, T_world_cam=said if posed else None), rgb, depth)
    return store


@pytest.fixture(scope="module")
def registered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session with the fixed camera 'left', registered and annotated."""
    store = table_session(tmp_path_factory.mktemp("cameras") / "table_000003", views=6)
    add_fixed(store, "left")
    save_starts(store, true_poses(), "test")
    run_register(store, QUIET, RegisterRequest())
    annotate_session(store, QUIET, maps="instance")
    return store.folder


@pytest.fixture(scope="module")
def exported(registered: Path) -> Path:
    out = registered.parent / "bop"
    finished("export", registered, "--to", "bop", "--out", out)
    return out


def test_register_takes_the_fixed_camera_and_leaves_it_where_it_stands(registered: Path) -> None:
    store = SessionStore.open(registered)
    report = store.read_json("registration/report.json")
    assert report["asked"]["fixed_cameras"] == ["left"]
    left = open_cameras(store)["left"]
    poses = [v.T_world_cam for v in left.session.views]
    assert all(T is not None and np.array_equal(T, poses[0]) for T in poses)
    change = load_cameras(left)
    assert change is not None and sorted(change.refined) == list(range(IMAGES))
    assert "left, which stands still, by " in camera_line(load_registered(store))
    # What it sees of the objects is what it saw.
    for o, true in zip(load_scene(store).objects, true_poses(), strict=True):
        assert o.verdict == "accepted"
        seen = se3.invert(T_TRUE) @ true.T_world_obj
        off = [
            1e3 * float(np.linalg.norm((se3.invert(T) @ o.T_world_obj)[:3, 3] - seen[:3, 3]))
            for T in (change.claimed[0], change.refined[0])
        ]
        assert off[0] > 0.8 and off[1] < 0.25, off
    # A second run starts from where it was said to be, and has nothing to do.
    np.testing.assert_allclose(claimed_cameras(left)[0], change.claimed[0], atol=1e-9)
    before = store.path("registration/scene.json").read_bytes()
    run_register(store, QUIET, RegisterRequest())
    assert store.path("registration/scene.json").read_bytes() == before


def test_labels_of_the_fixed_camera_are_those_of_the_scene(registered: Path) -> None:
    left = open_cameras(SessionStore.open(registered))["left"]
    truth = table_renderer().render(CAMERA, T_TRUE)
    for k, o in enumerate(true_poses()):
        mask = read_grey(left.path(f"mask_visib/000002_{k:06d}.png")) > 0
        real = truth.ids == o.instance
        assert np.count_nonzero(mask & real) > 0.97 * np.count_nonzero(mask | real)


def test_bop_has_a_suffix_for_every_camera_and_is_read_back(exported: Path) -> None:
    scene = exported / "train/000003"
    names = {p.name for p in scene.iterdir()}
    for camera in ("wrist", "left"):
        assert {f"{d}_{camera}" for d in ("rgb", "depth", "mask", "mask_visib")} <= names
        documents = ("scene_camera", "scene_gt", "scene_gt_info", "scene_gt_coco")
        assert {f"{d}_{camera}.json" for d in documents} <= names
        assert (exported / f"camera_{camera}.json").is_file()
    assert not names & {"rgb", "scene_camera.json", "scene_gt.json"}
    refs = {ref.camera: ref for ref in find_scenes(exported)}
    assert sorted(refs) == ["left", "wrist"]
    left, wrist = read_scene(refs["left"]), read_scene(refs["wrist"])
    assert len(left.session.views) == IMAGES and len(wrist.session.views) == 6
    assert left.session.depth_unit_m == pytest.approx(2e-4)
    assert (left.session.intrinsics.fx, wrist.session.intrinsics.fx) == (330.0, 300.0)
    # BOP's readers know no lens: the fixed camera's is taken out.
    assert not left.session.intrinsics.is_distorted
    world = [
        {a.obj_id: f.session.Ts_world_cam[k] @ a.T_cam_obj for a in f.ground_truth[k]}
        for f, k in ((left, 1), (wrist, 4))
    ]
    assert set(world[0]) == set(world[1]) == {o.obj_id for o in true_poses()}
    for o in true_poses():
        np.testing.assert_allclose(world[0][o.obj_id], world[1][o.obj_id], atol=1e-6)
    # The labelled reader holds poses, masks and depth against each other.
    assert len(open_labelled_bop(exported, camera="left").indices) == IMAGES


def test_one_camera_is_chosen_by_its_name(registered: Path, tmp_path: Path) -> None:
    words = ("export", registered, "--to", "bop", "--camera-name")
    finished(*words, "left", "--out", tmp_path / "o")
    assert [ref.camera for ref in find_scenes(tmp_path / "o")] == [""]
    wrong = refused(*words, "top", "--out", tmp_path / "p")
    assert "'top'" in wrong and "wrist, left" in wrong


def test_formats_of_one_camera_say_what_stays_out(registered: Path, tmp_path: Path) -> None:
    done = finished("export", registered, "--to", "nerfstudio", "--out", tmp_path / "o")
    assert "left stay" in done.output
    frames = json.loads(next((tmp_path / "o").glob("*/transforms.json")).read_text())["frames"]
    assert len(frames) == 6


def test_check_looks_at_every_camera(registered: Path, tmp_path: Path) -> None:
    folder = copy_of(registered, tmp_path / "s")
    finished("check", folder)
    (folder / "cameras/left/depth/000001.png").unlink()
    result = invoked("check", folder, "--json")
    assert result.exit_code == 1
    why = "cameras/left' is not as it was captured: depth/000001"
    refusals.refused(why, run_register, SessionStore.open(folder), QUIET, RegisterRequest())
    inner = [r for r in json.loads(result.output)["inner"] if r["folder"].endswith("left")]
    assert [f["path"] for f in inner[0]["findings"]] == ["depth/000001.png"]


def test_a_camera_is_never_taken_for_its_session(registered: Path, tmp_path: Path) -> None:
    folder = copy_of(registered, tmp_path / "data/s")
    left = camera_folders(folder)["left"]
    assert session_of_camera(left) == folder.resolve()
    assert session_of_camera(folder) is None
    refusals.refused("further camera of the session .*data/s'", open_session, left)
    export = ("export", left, "--to", "bop", "--out", tmp_path / "o")
    for words in (("register", left), ("annotate", left), export, ("stats", left)):
        assert "further camera" in refused(*words), words
    # A session that lost everything of its own is not replaced by what it holds.
    for name in ("session.json", "session.begun.json", "robot.jsonl", "manifest.jsonl",
                 "scene_camera.json"):  # fmt: skip
        (folder / name).unlink()
    assert "own files are lost" in refused("export", folder, "--to", "bop", "--out", tmp_path / "o")


def test_a_camera_added_later_makes_labels_stale(registered: Path, tmp_path: Path) -> None:
    store = SessionStore.open(copy_of(registered, tmp_path / "s"))
    assert what_is_stale(store) == ""
    add_fixed(store, "right")
    assert what_is_stale(store) == "camera right has none"


def test_cameras_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    store = table_session(tmp_path / "s", views=3)
    add_fixed(store, "left", posed=False)
    save_starts(store, true_poses()[:1], "test")
    result = run_register(store, QUIET, RegisterRequest())
    words = [r.words for r in result.remarks if "'left'" in r.words]
    assert len(words) == 1 and "--cameras wrist=hand,left=fixed" in words[0]
    assert "plan --board-views" in refused("calibrate", store.folder)
    moving = open_cameras(store)["left"]
    Ts = {k: T_TRUE @ se3.from_translation([0.001 * k, 0, 0]) for k in range(IMAGES)}
    moving.set_cameras(moving.session.intrinsics, Ts)
    why = "camera 'left' moves: .* up to 3 mm apart"
    refusals.refused(why, run_register, store, QUIET, RegisterRequest())
    refusals.refused("'a/b' is no name of a camera", camera_folder, store.folder, "a/b")
