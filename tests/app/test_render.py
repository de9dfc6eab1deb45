"""`realsim render`: twins of real frames, new views, and what it refuses."""

import json
from dataclasses import replace

import numpy as np
import pytest

from realsim import CameraIntrinsics, Mesh
from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console
from realsim.app.render.compare import label_ids, rim_distances_px
from realsim.app.render.light import neutral_environment, upright
from realsim.app.render.request import RenderRequest, resized
from realsim.app.render.run import notes_of, run_render, twin_scene
from realsim.geometry import camera
from realsim.geometry.colors import light_of_bytes
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.photo import PhotoRenderer
from realsim.store import SessionStore, save_scene
from refusals import refused
from synthetic_scenes import INTRINSICS, MODELS, captured_session, rejected, two_boxes
from typed_commands import finished

QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    store = captured_session(tmp_path_factory.mktemp("real") / "s", 3)
    annotate_session(store, QUIET)
    return store


@pytest.fixture(scope="module")
def twin(real):
    return run_render(real.folder, RenderRequest(), QUIET)


@pytest.mark.slow
def test_the_twins_masks_are_those_annotated_in_the_real_frames(real, twin):
    seen = 0
    assert twin.real == (0, 2, 4)
    for made, shot in enumerate(twin.real):
        mine = twin.twin.session.view(made).T_world_cam
        assert np.array_equal(mine, real.session.view(shot).T_world_cam)
        for k in range(2):
            name = f"mask_visib/{{:06d}}_{k:06d}.png"
            ours = twin.twin.read_image(name.format(made))
            assert np.array_equal(ours, real.read_image(name.format(shot)))
            seen += int(np.count_nonzero(ours))
    assert seen > 1000
    assert twin.figures.mask_iou == twin.figures.mask_iou_least == 1.0
    assert 0.5 < twin.figures.noise_ratio < 2.0
    # Light and table match the photographs.
    look = twin.look.look
    assert look.has_colors
    assert look.object_error < 0.02 and look.table_error < 0.02
    for made, shot in enumerate(twin.real):
        ours, theirs = (light_of_bytes(s.rgb(k)) for s, k in ((twin.twin, made), (real, shot)))
        assert np.abs(ours.mean((0, 1)) - theirs.mean((0, 1))).max() < 0.05
    # The result is a sound session with sheet and page.
    assert twin.twin.folder == real.folder / "synthetic/real-embedded-disparity"
    assert twin.twin.verify() == []
    assert twin.sheet.is_file() and b"<html" in twin.page.read_bytes()[:200].lower()
    annotate_session(twin.twin, QUIET)
    assert real.verify() == []


def test_new_views_see_the_objects_at_the_asked_size(real, tmp_path):
    model = DepthSensorModel.noiseless()
    (tmp_path / "fit.json").write_text(json.dumps(model.document()))
    finished("render", real.folder, "--views", "2", "--size", "120x100", "--radius", "0.3-0.4",
             "--material", "table=cork", "--depth-model", tmp_path / "fit.json",
             "--workers", "1", "--quiet", "--out", tmp_path / "new")  # fmt: skip
    store = SessionStore.open(tmp_path / "new")
    assert (store.session.intrinsics.width, store.session.intrinsics.height) == (120, 100)
    center = np.mean([o.T_world_obj[:3, 3] for o in two_boxes().objects], axis=0)
    for view in store.session.views:
        assert 0.3 <= np.linalg.norm(view.T_world_cam[:3, 3] - center) <= 0.4
        assert len(np.unique(store.read_image(f"labels/instance/{view.index:06d}.png"))) == 3
        exact = store.read_image(f"labels/depth/{view.index:06d}.png").astype(int)
        measured = store.read_image(f"depth/{view.index:06d}.png").astype(int)
        assert np.median(np.abs(measured - exact)[measured > 0]) <= 1  # as the model says
    page = (tmp_path / "new/reports/synthetic.html").read_text()
    assert all(f'data-layer="{name}"' in page for name in ("normals", "object coordinates"))


def test_a_rejected_object_is_named(real, tmp_path):
    store = captured_session(tmp_path / "s", 1, two_boxes())
    save_scene(store, rejected(two_boxes(), 3))
    outcome = run_render(store.folder, RenderRequest(depth="clean"), QUIET)
    page = outcome.page.read_bytes()
    again = run_render(store.folder, RenderRequest(depth="clean"), QUIET)
    assert again.summary.rendered == 0 and again.page.read_bytes() == page
    assert any("flat (instance 3) is rejected" in note for note in notes_of(outcome))
    assert set(np.unique(outcome.twin.read_image("labels/instance/000000.png"))) == {0, 1}


def test_a_session_that_is_not_registered_is_told_the_command(tmp_path):
    store = captured_session(tmp_path / "s", 1)
    store.remove("registration/scene.json")
    refused("realsim register", run_render, store.folder, RenderRequest(), QUIET)


def test_a_folder_that_holds_something_else_is_refused_before_anything_is_rendered(real, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    refused("not empty", run_render, real.folder, RenderRequest(out=tmp_path), QUIET)
    refused("the session itself", run_render, real.folder, RenderRequest(out=real.folder), QUIET)
    refused("is a file", run_render, real.folder, RenderRequest(out=tmp_path / "mine.txt"), QUIET)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_views_of_other_options_go_into_another_folder(tmp_path):
    hdri = tmp_path / "my studio.hdr"
    hdri.touch()
    others = (
        {}, {"views": "8"}, {"views": "16"}, {"views": "8", "size": "64x48"},
        {"views": "8", "radius": "0.4-0.7"}, {"sensor": "d435"}, {"seed": 3}, {"hdri": hdri},
        {"materials": ("table=painted wood",)}, {"depth": "clean"},
    )  # fmt: skip
    folders = [RenderRequest(**o).folder(tmp_path) for o in others]
    assert len(set(folders)) == len(others)
    names = {f.name for f in folders}
    assert {"real-embedded-disparity", "new8-embedded-disparity-0.4-0.7m"} <= names
    assert {"real-embedded-disparity-my_studio", "real-embedded-clean"} <= names


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"views": "some"}, "--views"), ({"radius": "0.4-0.5"}, "--radius"),
        ({"views": "3", "radius": "400-700"}, "--radius"), ({"views": "3", "size": "64"}, "--size"),
        ({"sensor": "d999"}, "--sensor"), ({"depth_model": "none.json"}, "none.json"),
        ({"depth_model": "fit.json", "depth": "stereo"}, "--depth-model"),
    ],
)  # fmt: skip
def test_options_that_cannot_be_are_named(options, named):
    refused(named, RenderRequest, **options)


def test_a_missing_panorama_and_an_unknown_material_are_named(real, tmp_path):
    refused("--hdri", RenderRequest, hdri=tmp_path / "none.hdr")
    for text in ("table=jelly", "chair=oak", "oak"):
        request = RenderRequest(materials=(text,))
        refused("table=KIND", twin_scene, real, two_boxes(), MODELS, request)


def test_a_resized_camera_sees_the_same_rays():
    big = CameraIntrinsics(width=640, height=480, fx=600, fy=601, cx=318.2, cy=241.7)
    rays = camera.ray_table(big)
    half = camera.ray_table(resized(big, 320, 240))
    # A pixel of half the resolution is the middle of four.
    mean = rays.reshape(240, 2, 320, 2, 3).mean((1, 3))
    assert np.abs(half - mean).max() < 1e-5
    taller = resized(big, 640, 500)
    assert np.abs(camera.ray_table(taller)[10:-10] - rays).max() < 1e-6


def test_a_model_without_colours_is_painted_as_the_photographs_show_it(real):
    mesh = MODELS[7].mesh
    colorless = replace(MODELS[7], mesh=Mesh(vertices=mesh.vertices, faces=mesh.faces))
    made = twin_scene(real, two_boxes(), {**MODELS, 7: colorless}, RenderRequest())
    assert any("painted in the mean colour" in note for note in made.notes)
    instance = 3  # of model 7
    assert set(made.synthetic.materials) == {instance}
    view = real.session.view(2)
    renderer = PhotoRenderer(made.synthetic.placed(), environment=made.synthetic.environment)
    shown = light_of_bytes(renderer.render(INTRINSICS, view.T_world_cam).rgb)
    seen = label_ids(real, 2) == instance
    ours, theirs = shown[seen].mean(0), light_of_bytes(real.rgb(2))[seen].mean(0)
    assert np.ptp(theirs) > 0.1 and np.array_equal(np.argsort(ours), np.argsort(theirs))


def test_the_rims_of_a_picture_of_the_labels_lie_on_its_edges():
    ids = np.full((60, 80), -1, np.int32)
    ids[20:40, 30:60] = 2
    picture = np.where(ids[..., None] >= 0, 200, 60).astype(np.uint8).repeat(3, -1)
    away = rim_distances_px(ids, picture)
    assert len(away) > 90 and away.max() <= 1.5
    assert rim_distances_px(np.roll(ids, 5, axis=1), picture).max() >= 4
    assert np.isinf(rim_distances_px(ids, np.zeros_like(picture))).all()


def test_surroundings_turn_with_the_up_of_the_world():
    room = neutral_environment()
    assert upright(room, np.array([0.0, 0.0, 1.0])) is room
    up = np.array([0.6, 0.0, -0.8])
    turned = upright(room, up)
    rows = room.panorama.shape[0]
    polar, around = (np.pi * (np.arange(n) + 0.5) / rows for n in (rows, 2 * rows))
    along = 0.6 * np.sin(polar)[:, None] * np.cos(around) - 0.8 * np.cos(polar)[:, None]
    expected = np.where(along > 0, 0.45 + 0.35 * along, 0.45 + 0.25 * along)
    assert np.abs(turned.panorama[..., 0] - expected).max() < 0.02
    before, after = np.array(room.sun_direction), np.array(turned.sun_direction)
    assert after @ up == pytest.approx(before[2])
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before))
