"""Synthetic views as a session: labels against a fresh render, exact poses, what is refused.

Their cameras: where they stand, where they look, how evenly they are spread.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from realsim import Mesh
from realsim.app.console import Console
from realsim.app.school.inputs import SchoolRequest, session_inputs
from realsim.formats.bop.models import load_models
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.rendering.appearance import Material
from realsim.rendering.depth_camera import DepthCamera
from realsim.rendering.depth_sensors.loss import look_of
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import SessionStore, load_scene
from realsim_sim_bridge.synthetic.config import SyntheticConfig, hemisphere_cameras
from realsim_sim_bridge.synthetic.write import cameras_inside, write_session
from refusals import refused
from shared_sessions import copy_of
from started_scripts import started
from synthetic_scenes import (
    INTRINSICS,
    MODELS,
    cameras,
    captured_session,
    content,
    placed,
    sky,
    synthetic_scene,
    table,
    two_boxes,
)


def write(folder, count=2, config=None, seed=0, **more):
    synthetic = more.pop("synthetic", None) or synthetic_scene()
    Ts = more.pop("Ts", cameras(count))
    config = config or SyntheticConfig(maps=("instance",))
    return write_session(folder, synthetic, INTRINSICS, Ts, config, seed, **more)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("written") / "session"
    return write(folder, 3), SessionStore.open(folder)


@pytest.fixture(scope="module")
def fresh(written):
    models = load_models(written[1].folder / "models")
    renderer = LabelRenderer(synthetic_scene(models=models).placed())
    return [renderer.render(INTRINSICS, T) for T in cameras(3)]


def test_the_written_instances_are_those_of_a_fresh_label_render(written, fresh):
    store = written[1]
    for k, labels in enumerate(fresh):
        ids = store.read_image(f"labels/instance/{k:06d}.png").astype(int) - 1
        assert np.array_equal(ids, labels.ids)
        for row in store.read_json(f"annotations/{k:06d}.json")["objects"]:
            mask = store.read_image(f"mask_visib/{k:06d}_{row['mask']:06d}.png") > 0
            assert np.array_equal(mask, labels.ids == row["instance"])
    assert {0, 3} <= set(np.unique([x.ids for x in fresh]))


def test_clean_depth_is_exact_to_half_a_unit(written, fresh):
    store = written[1]
    unit = store.session.depth_unit_m
    for k, labels in enumerate(fresh):
        clean = store.read_image(f"labels/depth/{k:06d}.png").astype(float) * unit
        known = labels.depth_m < 65535 * unit
        assert np.abs(clean - labels.depth_m)[known].max() <= 0.51 * unit
        measured = store.depth_m(k)
        assert not np.array_equal(measured, clean.astype(np.float32))
        both = (measured > 0) & (labels.ids >= 0)
        assert np.median(np.abs(measured - clean)[both]) < 0.02


def test_a_clean_depth_camera_reports_the_clean_depth(tmp_path, written):
    config = SyntheticConfig(maps=("instance",), depth="clean")
    write(tmp_path / "s", config=config, Ts=cameras(3)[:1])
    store = SessionStore.open(tmp_path / "s")
    counts = store.read_image("depth/000000.png").astype(int)
    clean = store.read_image("labels/depth/000000.png").astype(int)
    # Another depth camera leaves the photograph as it is.
    photograph, there = (content(s.folder)["rgb/000000.png"] for s in (store, written[1]))
    assert photograph == there
    # Photograph and labels cast their rays by two libraries: a rim pixel may fall to either side.
    assert np.mean(np.abs(counts - clean) > 1) < 1e-3


def test_poses_are_exact_and_accepted(written):
    _, store = written
    scene = load_scene(store)
    for pose, wanted in zip(scene.objects, two_boxes().objects, strict=True):
        assert np.array_equal(pose.T_world_obj, wanted.T_world_obj)
        assert pose.verdict == "accepted" and pose.covariance is None
    for view, T in zip(store.session.views, cameras(3), strict=True):
        assert np.array_equal(view.T_world_cam, T)
    about = store.read_json("synthetic/scene.json")
    assert about["provenance"] == {"poses": "simulated", "made by": "a test"}


def test_the_session_is_sound_and_the_school_opens_it(written):
    _, store = written
    assert store.verify() == []
    found = session_inputs(store, SchoolRequest(), Console(quiet=True))
    assert [o.instance for o in found.scene.objects] == [0, 3]
    assert {m.name for m in found.models.values()} == {"tall", "flat"}


def test_an_interrupted_run_ends_with_the_bytes_of_an_uninterrupted_one(tmp_path, written):
    def stop(done, total):
        assert total == 6
        if done >= 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "cut", 3, progress=stop)
    write(tmp_path / "cut", 3)
    assert content(tmp_path / "cut") == content(written[1].folder)


def test_more_views_are_added_without_touching_the_first(tmp_path, written):
    more = np.concatenate([cameras(3), cameras(1, seed=7)])
    copy_of(written[1].folder, tmp_path / "s")
    first = content(tmp_path / "s")
    assert write(tmp_path / "s", Ts=more).rendered == 1
    after = content(tmp_path / "s")
    for name in ("rgb/000000.png", "depth/000000.png", "annotations/000000.json"):
        assert after[name] == first[name]
    refused("has view 3 already", write, tmp_path / "s", Ts=cameras(3))


def test_the_seed_is_of_the_noise_and_not_of_the_labels(tmp_path, written):
    write(tmp_path / "b", seed=1, Ts=cameras(3)[:1])
    a, b = content(written[1].folder), content(tmp_path / "b")
    for noisy in ("rgb/000000.png", "depth/000000.png"):
        assert a[noisy] != b[noisy]
    for exact in ("mask_visib/000000_000000.png", "labels/depth/000000.png"):
        assert a[exact] == b[exact]


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"seed": 1}, "seed"),
        ({"config": SyntheticConfig(profile="d435")}, "profile"),
        ({"synthetic": synthetic_scene(environment=sky(0.3))}, "environment"),
        ({"synthetic": synthetic_scene(scene=two_boxes(placed(7, 5, 0, 0.1)))}, "objects"),
        ({"synthetic": synthetic_scene(materials={0: table().material})}, "materials"),
        ({"Ts": cameras(2, seed=1)}, "camera pose of view 0"),
    ],
)
def test_two_scenes_are_never_mixed_in_one_folder(written, changed, named):
    folder = written[1].folder
    before = content(folder)
    assert "other inputs" in refused(named, write, folder, **{"count": 3} | changed)
    assert content(folder) == before


def test_foreign_folders_are_left_alone(tmp_path):
    store = captured_session(tmp_path / "real", 1)
    refused("not synthetic", write, store.folder)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("mine")
    refused("not empty", write, tmp_path / "full")
    refused("is a file", write, tmp_path / "full/mine.txt")


def test_cameras_inside_an_object_or_without_one_in_sight_are_named_and_written(tmp_path):
    origin = two_boxes().objects[0].T_world_obj[:3, 3]
    offs = (0.0005, 0.02)
    inside = [
        se3.look_at(at, np.add(at, [0.1, 0.02, 0.01])) for at in origin + np.outer(offs, [0, 0, 1])
    ]
    away = se3.look_at([0.5, 0, 0.6], [1.5, 0, 0.9])
    summary = write(tmp_path / "s", Ts=np.stack([*cameras(1), *inside, away]))
    assert summary.camera_inside == {1: (0,), 2: (0,)} and summary.empty_views == (3,)
    about = json.loads((tmp_path / "s/synthetic/scene.json").read_text())
    assert about["camera_inside"] == {str(k): [0] for k in (1, 2)}
    rows = json.loads((tmp_path / "s/scene_gt.json").read_text())
    for view, off in enumerate(offs, start=1):
        (row,) = [row for row in rows[str(view)] if row["obj_id"] == 1]
        assert np.linalg.norm(row["cam_t_m2c"]) == pytest.approx(1e3 * off, abs=1e-6)
        part = json.loads((tmp_path / f"s/annotations/{view:06d}.json").read_text())
        assert part["camera_inside"] == [0]
    assert len(SessionStore.open(tmp_path / "s").session.views) == 4


def test_a_camera_in_the_box_around_an_object_but_outside_it_is_not_inside():
    pyramid = Mesh(
        vertices=0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]),
        faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
    )
    scene = synthetic_scene(models={**MODELS, 1: replace(MODELS[1], mesh=pyramid)})
    T = scene.scene.object(0).T_world_obj

    def inside(*at):
        return cameras_inside(scene, (T @ se3.from_translation(at))[None])

    assert inside(0.02, 0.02, 0.02) == {0: (0,)}
    assert inside(0.08, 0.08, 0.08) == inside(0.05, 0.05, 0.01) == inside(0.2, 0, 0) == {}


def test_what_cannot_be_rendered_is_refused(tmp_path):
    refused("without a model", synthetic_scene, models={1: MODELS[1]})
    refused("surroundings", synthetic_scene, surroundings=(replace(table(), instance=4),))
    refused(r"\(N, 4, 4\)", write, tmp_path / "s", Ts=np.eye(4))
    refused("no depth 'laser'", SyntheticConfig, depth="laser")
    refused("no depth camera", SyntheticConfig, profile="d999")


# --- several processes, and processes that are killed ---------------------------------------------

SCRIPT = """
import sys
from synthetic_scenes import INTRINSICS, cameras, synthetic_scene
from realsim_sim_bridge.synthetic.write import write_session

if __name__ == "__main__":
    write_session(
        sys.argv[1], synthetic_scene(), INTRINSICS, cameras(3), workers=2,
        progress=lambda done, of: print(done, of, flush=True),
    )
"""


@pytest.mark.slow
def test_a_killed_run_of_two_processes_ends_with_the_bytes_of_one_that_was_not(tmp_path):
    write(tmp_path / "whole", 3, SyntheticConfig())
    for steps in (2, 4):
        process = started(tmp_path, SCRIPT, tmp_path / "s")
        assert process.stdout is not None
        for _ in range(steps):
            process.stdout.readline()
        process.kill()
        process.wait()
    write(tmp_path / "s", 3, SyntheticConfig(), workers=2)
    assert content(tmp_path / "s") == content(tmp_path / "whole")


# --- cameras --------------------------------------------------------------------------------------


CENTER = np.array([0.4, -0.2, 0.1])


def spread(count=200, seed=0, elevation_deg=(15.0, 85.0)):
    rng = np.random.default_rng(seed)
    return hemisphere_cameras(CENTER, (0.5, 0.8), count, rng, elevation_deg)


def directions(Ts):
    away = Ts[:, :3, 3] - CENTER
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def test_cameras_stand_within_the_asked_distances_and_elevations():
    Ts = spread()
    away = np.linalg.norm(Ts[:, :3, 3] - CENTER, axis=1)
    assert away.min() >= 0.5 and away.max() <= 0.8
    assert away.min() < 0.53 and away.max() > 0.77
    elevation = np.degrees(np.arcsin(directions(Ts)[:, 2]))
    assert elevation.min() >= 15 - 1e-9 and elevation.max() <= 85 + 1e-9


def test_the_picture_stands_upright_and_the_center_is_ahead():
    Ts = spread()
    assert np.abs(Ts[:, 2, 0]).max() < 1e-12  # x axis level
    assert (Ts[:, 2, 1] < 0).all()  # y axis down
    to_center = -directions(Ts)
    angle = np.degrees(np.arccos(np.sum(Ts[:, :3, 2] * to_center, axis=1)))
    assert angle.max() < 10 and angle.mean() > 1


def test_equal_areas_of_the_band_get_equal_numbers():
    found = directions(spread(2000))
    height = found[:, 2]
    low, high = np.sin(np.radians([15, 85]))
    counts, _ = np.histogram(height, np.linspace(low, high, 11))
    assert counts.min() >= 190 and counts.max() <= 210
    azimuth = np.arctan2(*found[:, 1::-1].T)
    counts, _ = np.histogram(azimuth, np.linspace(-np.pi, np.pi, 9))
    assert counts.min() > 225 and counts.max() < 275


def test_the_same_seed_gives_the_same_cameras_and_another_one_others():
    assert np.array_equal(spread(20, 3), spread(20, 3))
    assert not np.allclose(spread(20, 3), spread(20, 4))


def test_what_cannot_be_is_refused():
    for radius, count, elevation in (
        ((0.5, 0.4), 5, (15, 85)), ((0, 1), 5, (15, 85)), ((0.4, 0.5), 0, (15, 85)),
        ((0.4, 0.5), 5, (50, 20)),
    ):  # fmt: skip
        rng = np.random.default_rng(0)
        refused("accepted", hemisphere_cameras, CENTER, radius, count, rng, elevation)


# --- The simulated depth camera of synthetic views: exact shadows, lossy materials, fitted figures.

FAULTLESS = DepthSensorModel.noiseless()
WITH_SHADOWS = replace(FAULTLESS, occlusion=True, border=False, baseline_m=0.05)
BLACK = Material(base_color=(0.002, 0.002, 0.002), name="black")
WHITE = Material(base_color=(0.9, 0.9, 0.9), name="white")
MIRROR = Material(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.05, name="mirror")
T = cameras(1)[0]


def exact(scene):
    return LabelRenderer(scene.placed()).render(INTRINSICS, T)


def measured(scene, model, seed=0, material_loss=True):
    camera = DepthCamera(scene.placed(), model, exact_shadows=True, material_loss=material_loss)
    return camera.measure(INTRINSICS, T, np.random.default_rng(seed), exact(scene))


def test_the_shadows_are_what_the_second_eye_cannot_see():
    scene = synthetic_scene()
    labels = exact(scene)
    lost = (
        (measured(scene, WITH_SHADOWS, material_loss=False) == 0)
        & (labels.depth_m > 0)
        & (labels.depth_m < WITH_SHADOWS.max_z_m)
    )
    T_world_right = T @ se3.from_translation([WITH_SHADOWS.baseline_m, 0, 0])
    right = LabelRenderer(scene.placed()).render(INTRINSICS, T_world_right)
    rows, columns = np.nonzero(labels.depth_m > 0)
    # By the second eye's own picture: a point is hidden where that picture shows something nearer.
    points = ray_table(INTRINSICS)[rows, columns] * labels.depth_m[rows, columns, None]
    uv = project(INTRINSICS, points - [WITH_SHADOWS.baseline_m, 0, 0])
    at = np.round(uv).astype(int)
    inside = np.all((at >= 1) & (at < [INTRINSICS.width - 1, INTRINSICS.height - 1]), axis=1)
    around = [right.depth_m[at[inside, 1] + j, at[inside, 0] + i] for i in (-1, 0, 1)
              for j in (-1, 0, 1)]  # fmt: skip
    z, hidden = points[inside, 2], lost[rows[inside], columns[inside]]
    assert not np.any(hidden & (z < np.min(around, axis=0) + 1e-4))
    clearly = np.max(around, axis=0) < z - 0.01
    assert clearly.sum() > 20 and np.all(hidden[clearly])


@pytest.mark.parametrize(("material", "least", "most"), [
    (WHITE, 0.0, 0.0), (BLACK, 0.9, 1.0), (MIRROR, 0.4, 0.65),
])  # fmt: skip
def test_dark_and_mirroring_surfaces_lose_pixels(material, least, most):
    looks, white_table = {0: material, 3: WHITE}, replace(table(), material=WHITE)
    scene = synthetic_scene(materials=looks, surroundings=(white_table,))
    labels = exact(scene)
    found = np.mean([
        measured(scene, FAULTLESS, seed)[labels.ids == 0] == 0 for seed in range(4)
    ])  # fmt: skip
    assert least <= found <= most
    assert np.all(measured(scene, FAULTLESS)[labels.ids == 3] > 0)
    assert np.all(measured(scene, FAULTLESS, material_loss=False)[labels.ids == 0] > 0)


def test_the_mean_look_of_a_mesh_is_its_own():
    v, f = np.eye(4)[:, :3], np.array([[0, 1, 2]], np.int32)
    grey = np.full((4, 3), 188, np.uint8)  # sRGB 188 is half of the light
    colored = PlacedMesh(0, Mesh(vertices=v, faces=f, colors=grey), np.eye(4))
    assert look_of(colored).base_color == pytest.approx((0.5, 0.5, 0.5), abs=0.01)
    image = np.stack([np.zeros((8, 3), np.uint8), np.full((8, 3), 255, np.uint8)])
    own = Material(base_color=(0.5, 1.0, 1.0), base_color_image=image, metallic=1.0, roughness=0.2)
    seen = look_of(PlacedMesh(BACKGROUND, Mesh(vertices=v, faces=f), np.eye(4), own))
    assert seen.base_color == pytest.approx((0.25, 0.5, 0.5), abs=0.01)
    assert (seen.metallic, seen.roughness, seen.base_color_image) == (1.0, 0.2, None)
    plain = look_of(PlacedMesh(0, Mesh(vertices=v, faces=f), np.eye(4)))
    assert plain.base_color == Material().base_color


def test_a_fitted_model_with_another_kind_of_depth_is_refused():
    refused("'disparity'", SyntheticConfig, depth="stereo", depth_model=FAULTLESS)
