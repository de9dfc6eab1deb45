"""`realsim register`: what it asks for, what it does not do twice, and its exit codes.

Pictures of a registration: their geometry by laws, and that all of them are drawn.
"""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from PIL import Image

import refusals
from plain_meshes import square
from realsim.app import stages
from realsim.app.console import Console
from realsim.app.register.config import RegisterRequest, config_of, load_depth_bias
from realsim.app.register.gain import camera_shifts_px, gain_picture, zoomed_camera
from realsim.app.register.inputs import read_inputs
from realsim.app.register.map import place_covariance_mm2
from realsim.app.register.page import page_bytes
from realsim.app.register.pictures import draw_pictures
from realsim.app.register.results import CameraChange, Registered, claimed_cameras, load_registered
from realsim.app.register.run import pixel_sigma, register_session
from realsim.formats.bop.models import save_models
from realsim.geometry import camera, se3
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose
from realsim.records.calibration import DepthBias
from realsim.registration.odometry.hand_held import hand_held_poses
from realsim.registration.views import SampleConfig
from realsim.store import SessionStore
from registered_sessions import CAMERA, models_of, registered_by_hand, table_session, true_poses
from shared_sessions import copy_of
from typed_commands import finished, invoked, refused

QUIET = Console(quiet=True)
MUG = RegisterRequest(objects=("mug",))
MODELS = models_of()


@pytest.fixture(scope="module")
def registered(few_views: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """A session of four views registered from rough starts, and what the command said."""
    folder = copy_of(few_views, tmp_path_factory.mktemp("registered") / "s")
    off = se3.exp(np.array([0.1, -0.1, 0.15, 0.006, -0.004, 0.005]))
    starts = [replace(o, T_world_obj=o.T_world_obj @ off) for o in true_poses()]
    stages.save_starts(SessionStore.open(folder), starts, "test")
    return folder, finished("register", folder, "--quiet")


@pytest.fixture
def session(table_views: Path, tmp_path: Path) -> SessionStore:
    """A session of eight views for one test, with nothing said of its objects."""
    return SessionStore.open(copy_of(table_views, tmp_path / "s"))


def test_objects_are_found_and_everything_is_written(registered: tuple[Path, Result]) -> None:
    folder, result = registered
    store = SessionStore.open(folder)
    found = load_registered(store)
    for o, true in zip(found.scene.objects, true_poses(), strict=True):
        corners = MODELS[o.obj_id].mesh.vertices
        gap = se3.transform(o.T_world_obj, corners) - se3.transform(true.T_world_obj, corners)
        assert np.linalg.norm(gap, axis=1).max() < 2e-3
        assert o.covariance is not None and o.verdict != "rejected"
    assert set(found.seen) == set(range(4)) == set(found.cameras.refined)
    for name in ("scene_table", "views", "cameras", "scene_gt", "scene_camera", "report"):
        assert store.has(f"registration/{name}.json"), name
    assert len(list((folder / "registration/pictures").iterdir())) == 4
    assert store.path("registration/register.html").stat().st_size > 50_000
    assert store.verify() == []
    for words in ("mug", "wedge", "together (hand-eye)", "table: RMS", "next "):
        assert words in result.output


def test_a_second_run_computes_nothing_and_starts_from_the_claimed_cameras(
    registered: tuple[Path, Result], few_views: Path
) -> None:
    folder, first = registered
    store = SessionStore.open(folder)
    claimed = SessionStore.open(few_views).session.Ts_world_cam
    assert all(np.array_equal(claimed_cameras(store)[k], claimed[k]) for k in claimed)
    refined = store.session.Ts_world_cam
    assert not np.array_equal(refined[0], claimed[0])
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*.json")}
    assert invoked("register", folder, "--quiet").output == first.output
    assert {p: p.stat().st_mtime_ns for p in folder.rglob("*.json")} == before
    # A calibration that sets the same claims again does not undo the refinement.
    store.set_cameras(store.session.intrinsics, claimed)
    register_session(SessionStore.open(folder), QUIET)
    now = SessionStore.open(folder).session.Ts_world_cam
    assert all(np.allclose(now[k], refined[k], rtol=0, atol=1e-14) for k in refined)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], ["--object", "starts.json", "--find-all"]),
        (["--find-all", "--object", "mug"], ["one of both"]),
        (["--object", "teapot"], ["teapot"]),
        (["--object", "mug", "--hand-held"], ["--hand-held"]),
        (["--object", "mug", "--depth-bias", "nowhere.json"], ["nowhere.json"]),
    ],
)
def test_what_cannot_be_used_is_named(
    session: SessionStore, options: list[str], words: list[str]
) -> None:
    said = refused("register", session.folder, *options)
    assert all(w in said for w in words)
    assert not session.path("registration").exists()


def test_a_flat_model_is_named_and_stays_out_of_the_session(
    session: SessionStore, tmp_path: Path
) -> None:
    save_models(tmp_path / "lib", {50: ObjectModel(obj_id=50, name="sheet", mesh=square(0.05))})
    said = refused("register", session.folder, "--library", tmp_path / "lib", "--object", 50)
    assert "object 50" in said and "flat" in said
    assert not list(session.folder.glob("models/*000050*"))


def test_a_wrong_number_of_views_is_refused(session: SessionStore) -> None:
    for views in ("0", "-3", "some", "1.5"):
        result = invoked("register", session.folder, "--object", "mug", "--views", views)
        assert result.exit_code == 2 and views in result.output


def test_views_and_models_that_take_part_are_chosen(session: SessionStore) -> None:
    inputs = read_inputs(session, replace(MUG, views=3))
    assert inputs.views == (0, 4, 7) and list(inputs.models) == [part("mug").obj_id]
    for frame in inputs.frames(session):
        assert np.array_equal(frame.depth_m, session.depth_m(frame.index))
    both = read_inputs(session, RegisterRequest(find_all=True))
    assert both.wanted is None and len(both.models) == 2 and len(both.views) == 8


def test_models_that_are_not_sought_are_named(session: SessionStore, tmp_path: Path) -> None:
    mug, wedge = (part(n).obj_id for n in ("mug", "wedge"))
    others = {mug: replace(MODELS[mug], name="jug"), 77: replace(MODELS[mug], obj_id=77)}
    save_models(tmp_path / "lib", others)
    session.path(f"models/obj_{wedge:06d}.ply").unlink()
    request = RegisterRequest(find_all=True, library=tmp_path / "lib")
    inputs = read_inputs(session, request)
    assert sorted(inputs.models) == sorted([mug, 77]) and inputs.models[mug].name == "mug"
    clash, lost = inputs.models_out
    assert f"model {mug} of the library, 'jug', is not used" in clash
    assert lost.endswith(f"without a mesh, which are not sought: {wedge}.")
    save_models(tmp_path / "own", {mug: MODELS[mug]})
    again = read_inputs(session, replace(request, library=tmp_path / "own"))
    assert len(again.models_out) == 1 and again.key != inputs.key
    (tmp_path / f"lib/obj_{77:06d}.ply").unlink()
    last = read_inputs(session, request).models_out[-1]
    assert last.startswith("lib/models_info.json") and last.endswith(": 77.")


def test_a_scene_that_no_registration_made_is_kept(
    registered: tuple[Path, Result], tmp_path: Path
) -> None:
    folder = copy_of(registered[0], tmp_path / "s")
    exact = (folder / "registration/scene.json").read_bytes()
    (folder / "stages/register.json").unlink()  # one that was ended before its last note
    finished("register", folder, "--quiet")
    assert not (folder / "registration/earlier").exists()
    for _ in range(2):  # and the same once more: it is kept once
        for name in ("stages/register.json", "registration/views.json"):
            (folder / name).unlink()
        finished("register", folder, "--quiet")
        assert (folder / "registration/earlier/scene_001.json").read_bytes() == exact
    assert len(list((folder / "registration/earlier").iterdir())) == 1


def test_the_key_changes_with_everything_that_matters(session: SessionStore) -> None:
    key = read_inputs(session, MUG).key
    assert read_inputs(SessionStore.open(session.folder), MUG).key == key
    others: list[dict[str, Any]] = [
        {"objects": ("mug", "wedge")}, {"objects": (), "find_all": True}, {"views": 4},
        {"method": "top-down"}, {"refine_cameras": False}, {"depth_bias": "off"},
        {"odometry": True},
    ]  # fmt: skip
    keys = {read_inputs(session, replace(MUG, **other)).key for other in others}
    assert len(keys) == len(others) and key not in keys
    mug = MODELS[part("mug").obj_id]
    larger = replace(mug, mesh=replace(mug.mesh, vertices=1.0001 * mug.mesh.vertices))
    for file in session.path("models").iterdir():
        file.unlink()  # linked to those of the other tests
    save_models(session.path("models"), MODELS | {larger.obj_id: larger})
    keys.add(read_inputs(session, MUG).key)
    moved = session.session.Ts_world_cam[0] @ se3.from_translation([1e-4, 0, 0])
    session.set_cameras(session.session.intrinsics, {0: moved})
    keys.add(read_inputs(session, MUG).key)
    assert len(keys) == len(others) + 2 and key not in keys


def test_a_start_brings_how_far_off_it_may_be(session: SessionStore) -> None:
    near, far = true_poses()
    rows = [
        {"obj_id": o.obj_id, "instance": o.instance, "T_world_obj": o.T_world_obj.tolist()}
        for o in (near, far)
    ]
    rows[1] |= {"radius_mm": 80.0, "turn_deg": 120.0}
    session.write_json("registration/starts.json", {"source": "test", "starts": rows})
    wanted = read_inputs(session, RegisterRequest()).wanted
    assert wanted is not None
    usual, told = (w.region for w in wanted)
    assert usual is not None and told is not None
    assert (told.radius_m, told.turn_deg) == (0.08, 120.0)
    assert usual.radius_m < 0.08 and usual.turn_deg < 120.0
    for w, o in zip(wanted, (near, far), strict=True):
        assert w.T_start is not None
        np.testing.assert_allclose(w.T_start, o.T_world_obj, atol=1e-15)


def test_the_depth_bias_is_that_of_the_calibration_unless_it_is_off(session: SessionStore) -> None:
    C = [[1e-6, -2e-7], [-2e-7, 3e-6]]
    known = {
        "known": True, "scale": 1.002, "offset_per_m": -0.004, "covariance": C,
        "noise_per_m": None, "range_m": [0.2, "inf"], "separable": True,
    }  # fmt: skip
    session.write_json("calibration/depth_bias.json", known)
    config = config_of(session, RegisterRequest())
    assert (config.bias.scale, config.bias.offset_per_m) == (1.002, -0.004)
    assert np.array_equal(config.bias.covariance, C) and config.bias.range_m[1] == float("inf")
    off = config_of(session, RegisterRequest(depth_bias="off"))
    assert off.bias.is_none and not off.refine.fit_bias and config.refine.fit_bias
    session.write_json("calibration/depth_bias.json", {"known": False, "why": "one distance"})
    assert config_of(session, RegisterRequest()).bias.is_none
    other = session.folder / "other.json"
    other.write_text(json.dumps(known | {"scale": 0.999}))
    assert config_of(session, RegisterRequest(depth_bias=str(other))).bias.scale == 0.999
    assert isinstance(load_depth_bias(other), DepthBias)
    other.write_text('{"scale": 1.0}')
    refusals.refused("no depth bias: its entries are others", load_depth_bias, other)


def test_a_session_without_cameras_names_both_remedies(tmp_path: Path) -> None:
    store = table_session(tmp_path / "s", views=2, posed=False)
    assert "--hand-held" in refusals.refused("calibrate", read_inputs, store, MUG)


@pytest.mark.slow
def test_hand_held_cameras_are_found_once_and_kept(tmp_path: Path) -> None:
    store = table_session(tmp_path / "s", views=5, posed=False)
    request = RegisterRequest(objects=("mug", "wedge"), hand_held=True)
    inputs = read_inputs(store, request)
    depths = [store.depth_m(k) for k in range(5)]
    found = hand_held_poses(store.session.intrinsics, depths, SampleConfig())
    for k, T in enumerate(found.Ts_world_cam):
        np.testing.assert_allclose(inputs.claimed[k], T, atol=1e-12)
    again = SessionStore.open(store.folder)
    assert read_inputs(again, request).key == inputs.key
    assert set(again.session.Ts_world_cam) == set(range(5))


@pytest.fixture(scope="module")
def store(few_views: Path) -> SessionStore:
    return SessionStore.open(few_views)


@pytest.fixture(scope="module")
def result(store: SessionStore) -> Registered:
    """Its registration."""
    return registered_by_hand(store)


def test_every_picture_is_drawn_and_stands_on_the_page(
    store: SessionStore, result: Registered
) -> None:
    pictures = draw_pictures(store, result, MODELS)
    assert set(pictures) == {"overlay.jpg", "cameras.jpg", "residuals.jpg", "map.png"}
    for data in pictures.values():
        with Image.open(io.BytesIO(data)) as picture:
            picture.load()  # it can be read
            assert min(picture.size) > 400
    page = page_bytes(store, result, MODELS, pictures).decode()
    assert page.count("data:image/jpeg;base64,") == 3 and page.count("data:image/png") == 1
    assert "half of it is hidden." in page and "nothing there looks like it." in page
    moved = "cameras moved by 0.47 mm / 0.11 deg together (hand-eye), 0.19 mm / 0.03 deg each"
    assert moved in page
    assert "http" not in page.replace("http-equiv", "")  # nothing is loaded from elsewhere


def test_what_cannot_be_drawn_is_left_out(store: SessionStore, result: Registered) -> None:
    claimed = result.cameras.claimed
    still = replace(result, cameras=CameraChange(claimed=claimed, refined=dict(claimed)))
    assert "cameras.jpg" not in draw_pictures(store, still, MODELS)
    nothing = replace(result, scene=replace(result.scene, objects=()), seen={})
    assert draw_pictures(store, nothing, MODELS) == {}
    assert b"Not placed" in page_bytes(store, nothing, MODELS, {})


def test_the_gain_is_shown_on_the_object_that_moved_most(
    store: SessionStore, result: Registered
) -> None:
    refined = result.cameras.refined
    claimed = {k: T.copy() for k, T in refined.items()}
    assert set(camera_shifts_px(_with(result, claimed), MODELS, CAMERA).values()) == {0.0}
    claimed[2] = refined[2] @ se3.exp(np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0]))
    shifts = camera_shifts_px(_with(result, claimed), MODELS, CAMERA)
    assert {k for (k, _), px in shifts.items() if px > 1e-9} == {2}
    # A turn of 10 mrad about y moves what is near the middle by 3 px at f = 300.
    assert all(px == pytest.approx(3.0, rel=0.12) for (k, _), px in shifts.items() if k == 2)
    assert gain_picture(store, _with(result, claimed), MODELS) is not None


def _with(result: Registered, claimed: dict[int, np.ndarray]) -> Registered:
    """Return a registration with other claims."""
    return replace(result, cameras=CameraChange(claimed=claimed, refined=result.cameras.refined))


def test_a_zoomed_camera_sees_the_same_points_enlarged() -> None:
    lens = np.array([-0.05, 0.06, 3e-4, -2e-4, 0.0])
    raw = CameraIntrinsics(
        width=1280, height=720, fx=645.0, fy=643.0, cx=640.3, cy=358.7, distortion=lens
    )
    points = np.random.default_rng(0).uniform([-0.2, -0.1, 0.4], [0.2, 0.1, 0.6], (50, 3))
    uv = camera.project(raw, points)
    zoomed = zoomed_camera(raw, (300, 200), 64, 10)
    # A pixel's area, from its centre -1/2 to +1/2, becomes ten pixels.
    expected = (uv - [300, 200] + 0.5) * 10 - 0.5
    np.testing.assert_allclose(camera.project(zoomed, points), expected, atol=1e-9)
    assert (zoomed.width, zoomed.height) == (640, 640)


def test_pixel_sigma_is_what_random_poses_show() -> None:
    rng = np.random.default_rng(4)
    T_cam_obj = se3.exp(np.array([0.4, -0.2, 0.9, 0.02, -0.03, 0.45]))
    A = rng.normal(size=(6, 6)) * np.repeat([2e-3, 3e-4], 3)[:, None]
    points = part("mug").mesh.vertices[::50]
    there = camera.project(CAMERA, se3.transform(T_cam_obj, points))
    seen = [
        camera.project(CAMERA, se3.transform(T_cam_obj @ se3.exp(A @ rng.normal(size=6)), points))
        for _ in range(2000)
    ]
    spread = np.sqrt(np.mean(np.sum((np.array(seen) - there) ** 2, axis=-1)))
    assert pixel_sigma(CAMERA, T_cam_obj, A @ A.T, points) == pytest.approx(spread, rel=0.06)
    assert np.isnan(pixel_sigma(CAMERA, T_cam_obj, np.full((6, 6), np.nan), points))


def test_the_ellipse_is_where_random_poses_put_the_middle() -> None:
    rng = np.random.default_rng(5)
    model = part("mug")
    A = rng.normal(size=(6, 6)) * np.repeat([3e-3, 5e-4], 3)[:, None]
    T, T_map_world = se3.exp(rng.normal(size=6) * 0.5), se3.exp(rng.normal(size=6) * 0.5)
    pose = ObjectPose(obj_id=model.obj_id, instance=0, T_world_obj=T, covariance=A @ A.T)
    middle = model.mesh.bounds.mean(0)[None]
    places = [
        1e3 * se3.transform(T_map_world @ T @ se3.exp(A @ rng.normal(size=6)), middle)[0, :2]
        for _ in range(4000)
    ]
    C = place_covariance_mm2(pose, model, T_map_world)
    assert C is not None
    np.testing.assert_allclose(C, np.cov(np.array(places).T), atol=0.08 * np.trace(C))
