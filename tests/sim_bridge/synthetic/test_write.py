"""Synthetic views as a session: labels against a fresh render, exact poses, what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from realsim import Mesh
from realsim.app.console import Console
from realsim.app.school.inputs import SchoolRequest, session_inputs
from realsim.formats.bop.models import load_models
from realsim.geometry import se3
from realsim.rendering.labels import LabelRenderer
from realsim.store import SessionStore, load_scene
from realsim_sim_bridge.synthetic.config import SyntheticConfig
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
