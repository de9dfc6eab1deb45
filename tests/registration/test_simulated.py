"""The simulated table: what it calls true is true, its errors are those asked for, faults are."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull, KDTree

from realsim.geometry import se3
from realsim.geometry.depth import points_from_depth
from realsim.geometry.distance_field import raycasting_scene
from realsim.geometry.mesh import to_trimesh
from realsim.geometry.parts import part
from realsim.interop import import_open3d
from realsim.records import Mesh, ObjectPose
from realsim.registration.simulated import (
    Scattered,
    TableLabConfig,
    resized,
    scatter_objects,
    table_scene,
)
from realsim.registration.simulated_lab import camera_of, sensor_of
from realsim.rendering.depth_sensors.model import DepthSensorModel
from refusals import refused
from table_faults import seen_instances
from table_scenes import part_models, scene_of

NO_ERRORS = {"hand_eye_mm": 0.0, "hand_eye_deg": 0.0, "arm_mm": 0.0, "arm_deg": 0.0}
TINY = resized(TableLabConfig(sensor=DepthSensorModel.noiseless()), 64)
"""Images that cost nothing: poses do not depend on them."""


# --- layout --------------------------------------------------------------------------------------


def scattered(
    seed: int, n: int = 14
) -> tuple[dict[int, Mesh], list[int], TableLabConfig, Scattered]:
    rng = np.random.default_rng(seed)
    meshes = {i: m.mesh for i, m in part_models().items()}
    wanted = [int(i) for i in rng.choice(sorted(meshes), n, replace=False)]
    config = TableLabConfig()
    return meshes, wanted, config, scatter_objects(meshes, wanted, config, rng)


def test_objects_stand_on_the_table_in_the_disc_and_do_not_touch():
    meshes, wanted, config, result = scattered(5)
    assert len(result.objects) + len(result.left_out) == len(wanted)
    assert len(result.objects) >= 13
    placed = [se3.transform(o.T_world_obj, meshes[o.obj_id].vertices) for o in result.objects]
    for v in placed:
        assert abs(v[:, 2].min()) < 1e-9
        assert np.linalg.norm((v.min(0) + v.max(0))[:2] / 2) <= config.disc_m + 1e-9
    # Footprints as polygons, their distance by brute force over finely sampled edges.
    t = np.linspace(0, 1, 30)[:, None, None]
    outlines: list[Any] = []
    for v in placed:
        p = v[ConvexHull(v[:, :2]).vertices, :2]
        outlines.append(((1 - t) * p + t * np.roll(p, -1, axis=0)).reshape(-1, 2))
    nearest = [KDTree(a).query(b)[0].min() for i, a in enumerate(outlines) for b in outlines[:i]]
    assert min(nearest) >= config.gap_m - 1e-9
    # Tight: some pairs are nearer to each other than 6 mm.
    assert np.sum(np.array(nearest) < 0.006) >= 2


def test_resting_objects_are_stable():
    """The centre of mass is over the support polygon: it would not tip."""
    meshes, _, _, result = scattered(6)
    for o in result.objects:
        v = se3.transform(o.T_world_obj, meshes[o.obj_id].vertices)
        mass = se3.transform(o.T_world_obj, to_trimesh(meshes[o.obj_id]).center_mass[None])[0]
        hull = ConvexHull(v[v[:, 2] < 1e-3, :2])
        beyond = hull.equations[:, :2] @ mass[:2] + hull.equations[:, 2]
        assert beyond.max() < 1e-3, part_models()[o.obj_id].name


def test_a_seed_gives_a_layout_and_what_finds_no_room_is_named():
    a, b = (scattered(7, 6)[-1] for _ in range(2))
    for x, y in zip(a.objects, b.objects, strict=True):
        np.testing.assert_array_equal(x.T_world_obj, y.T_world_obj)
    small = replace(TableLabConfig(), disc_m=0.02)
    mesh = part("bowl").mesh
    result = scatter_objects({12: mesh}, [12, 12, 12], small, np.random.default_rng(0))
    assert [o.instance for o in result.objects] == [0]
    assert [(o.obj_id, o.instance) for o in result.left_out] == [(12, 1), (12, 2)]
    refused(r"ids \[99\]", scatter_objects, {12: mesh}, [99], small, np.random.default_rng(0))


# --- cameras -------------------------------------------------------------------------------------


def test_the_errors_are_those_asked_for_and_stored_consistently():
    scene = scene_of([part("mug").obj_id], replace(TINY, views=600), np.random.default_rng(3))
    claimed = np.stack([f.T_world_cam for f in scene.frames])
    np.testing.assert_allclose(claimed, scene.Ts_base_ee @ scene.T_ee_cam)
    hand_eye = se3.invert(scene.T_ee_cam) @ scene.T_ee_cam_true
    assert np.linalg.norm(hand_eye[:3, 3]) == pytest.approx(0.5e-3)
    assert np.degrees(se3.angle(hand_eye[:3, :3])) == pytest.approx(0.1)
    # Where the hand is said to be, seen from where it was: T_world_cam inv(T_ee_cam), both true.
    xi = se3.log(scene.T_ee_cam_true @ se3.invert(scene.Ts_world_cam) @ scene.Ts_base_ee)
    spread = 4 / np.sqrt(2 * 1800)
    assert np.degrees(xi[:, :3].std()) == pytest.approx(0.03, rel=spread)
    assert 1e3 * xi[:, 3:].std() == pytest.approx(0.2, rel=spread)
    assert np.abs(np.corrcoef(xi.T) - np.eye(6)).max() < 4.5 / np.sqrt(600)


# --- depth ---------------------------------------------------------------------------------------


def test_exact_depth_lies_on_the_true_surfaces():
    config = replace(resized(TINY, 320), views=3, **NO_ERRORS)
    ids = [part(n).obj_id for n in ("mug", "l_bracket", "capsule")]
    scene = scene_of(ids, config, np.random.default_rng(2))
    seen = seen_instances(scene, range(3))
    for k, frame in enumerate(scene.frames):
        points, pixels = points_from_depth(frame.depth_m, scene.intrinsics, 1)
        world = se3.transform(frame.T_world_cam, points)
        which = seen[k][frame.depth_m > 0]
        assert len(points) == len(which), pixels
        for p in scene.truth:
            q = se3.transform(se3.invert(p.T_world_obj), world[which == p.instance])
            assert len(q) > 100
            surface: Any = raycasting_scene(scene.models[p.obj_id].mesh)
            apart = surface.compute_distance(import_open3d().core.Tensor(np.float32(q)), 1)
            assert apart.numpy().max() < 1e-4  # rounded to 0.1 mm along the ray
        assert np.abs(world[which < 0, 2]).max() < 1e-4


def test_a_small_image_has_the_noise_and_the_information_of_a_large_one():
    """Depth of a plane: sigma_z is the D405's, and so is that of the mean over a patch."""
    width = 320
    config = resized(TableLabConfig(), width)
    camera, sensor = camera_of(config), sensor_of(config)
    sensor = replace(sensor, blobs_per_megapixel=0.0, occlusion=False, grazing_from_deg=90.0)
    rng = np.random.default_rng(0)
    flat = np.full((camera.height, camera.width), 0.4, np.float32)
    rows = camera.height // 12 * 12
    dz = np.concatenate([sensor.measure(flat, camera, rng)[:rows] - 0.4 for _ in range(3)])
    sigma = 0.4**2 * 0.08 / (648 * 0.018)
    assert dz.std() == pytest.approx(sigma, rel=0.03)
    n = width // 32  # 40 px of the full image, 20 sigma of the correlation
    tiles = dz[: len(dz) // n * n, : width // n * n].reshape(len(dz) // n, n, -1, n)
    means = tiles.mean(axis=(1, 3))
    # A tile of a Gaussian-correlated field has pixels / (4 pi correlation^2) independent values.
    independent = 40**2 / (4 * np.pi * 2.0**2)
    assert means.std() == pytest.approx(sigma / np.sqrt(independent), rel=0.15)


def test_a_seed_gives_the_same_bytes_whether_images_are_kept_or_made(tmp_path: Path):
    config = replace(resized(TableLabConfig(), 160), views=3)
    pose = ObjectPose(obj_id=10, instance=4, T_world_obj=np.eye(4))

    def made(seed: int, keep: Path | None = None, lab: TableLabConfig = config):
        rng = np.random.default_rng(seed)
        return table_scene({10: part("mug")}, [pose], lab, rng, keep), rng.random()

    (a, x), (b, y), (c, z) = made(1), made(1, tmp_path), made(1, tmp_path)
    assert x == y == z and len(list(tmp_path.iterdir())) == 1
    for f, g, h in zip(a.frames, b.frames, c.frames, strict=True):
        assert f.depth_m.tobytes() == g.depth_m.tobytes() == h.depth_m.tobytes()
        np.testing.assert_array_equal(f.T_world_cam, h.T_world_cam)
    made(2, tmp_path)
    made(1, tmp_path, replace(config, bias_px=0.01))
    files = sorted(tmp_path.iterdir())
    assert len(files) == 3
    for file in files:
        file.write_bytes(file.read_bytes()[:1000])
    d, _ = made(1, tmp_path)
    assert d.frames[0].depth_m.tobytes() == a.frames[0].depth_m.tobytes()


def test_what_is_no_scene_is_refused():
    rng = np.random.default_rng(0)
    pose = ObjectPose(obj_id=10, instance=0, T_world_obj=np.eye(4))
    refused("at least one object", table_scene, {10: part("mug")}, [], TINY, rng)
    refused(r"ids \[10\]; there are: box", table_scene, {1: part("box")}, [pose], TINY, rng)
    refused("same instance", table_scene, {10: part("mug")}, [pose, pose], TINY, rng)
    refused("make no lab", TableLabConfig, views=0)
