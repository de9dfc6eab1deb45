"""Matching of height templates: found where they stand, moved with the world, kept in a region."""

import math
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.distance_field import raycasting_scene
from realsim.geometry.mesh import box_mesh, sample_surface, symmetry_transforms
from realsim.geometry.parts import part
from realsim.interop import import_open3d
from realsim.records import ObjectModel, SupportPlane
from realsim.registration.evidence import Cloud
from realsim.registration.search.height_grid import HeightGrid, height_grid
from realsim.registration.search.matching import MOST, MOST_IN_REGION, match_templates
from realsim.registration.search.near_symmetry import NearSymmetryConfig, near_symmetries
from realsim.registration.search.records import Region
from realsim.registration.search.templates import TemplateConfig, model_templates
from realsim.registration.views import world_cloud
from realsim.rendering.rays import PlacedMesh, RayScene
from table_scenes import NOISE, TABLE, named_scene, views_of

NAMES = ("mug", "box", "wedge", "gear", "elbow")


@lru_cache(maxsize=32)
def templates_of(name):
    return model_templates(part(name), TemplateConfig(), None)


@lru_cache(maxsize=2)
def measured(seed=3):
    """A simulated table with 5 parts, and the heights that 12 noisy views show."""
    scene = named_scene(seed, NAMES)
    return scene, height_grid(world_cloud(views_of(scene), NOISE), TABLE)


def exact_grid(model, T_world_obj, cells=140):
    """The heights of one mesh on an endless table, by ray casting: no noise, nothing missing."""
    cell, origin = 0.003, np.full(2, -0.0015 * cells)
    grid = HeightGrid(heights=np.zeros((cells, cells), np.float32), origin=origin, cell_m=cell)
    z = seen_from_above(model.mesh, T_world_obj, grid.centers().reshape(-1, 2))
    heights = np.where(np.isfinite(z), z, 0.0).reshape(cells, cells).astype(np.float32)
    return HeightGrid(heights=heights, origin=origin, cell_m=cell)


def seen_from_above(mesh, T_world_obj, xy):
    """The height of a placed mesh at places (N, 2); -inf beside it."""
    scene = RayScene([PlacedMesh(0, mesh, T_world_obj)], center=np.zeros(3))
    down = np.tile(np.float32([0, 0, -1]), (len(xy), 1))
    return 1.0 - scene.first_hits(np.c_[xy, np.ones(len(xy))], down)[0]


def error(model, T, truth):
    """Distance of the box centres [mm] and angle modulo symmetry [deg]."""
    S = symmetry_transforms(model, math.radians(2))[:, :3, :3]
    c = model.mesh.bounds.mean(0)[None]
    d = np.linalg.norm(se3.transform(T, c) - se3.transform(truth, c))
    return 1e3 * d, np.degrees(se3.angle(T[:3, :3].T @ truth[:3, :3] @ S)).min()


def is_near(model, T, truth):
    mm, deg = error(model, T, truth)
    return mm < 10 and deg < 15


@pytest.mark.parametrize("name", ["mug", "wedge"])
def test_alone_it_is_found_first_in_every_resting_pose(name):
    model, t = part(name), templates_of(name)
    put = se3.from_rt(se3.exp_so3([0, 0, math.radians(141.0)]), [0.031, -0.047, 0.0])
    for resting in se3.from_rt(t.rotations, t.offsets):
        truth = put @ resting
        found = match_templates(exact_grid(model, truth), t, plane=TABLE)
        near = [h for h in found if is_near(model, h.T_world_obj, truth)]
        assert near and near[0].score > 0.7
        assert near[0].score > found[0].score - 0.1
        assert error(model, near[0].T_world_obj, truth)[0] < 4


def test_every_part_of_a_noisy_clutter_is_among_the_hypotheses():
    scene, grid = measured()
    for p in scene.truth:
        model = scene.models[p.obj_id]
        found = match_templates(grid, templates_of(model.name), plane=TABLE)
        assert len(found) <= MOST
        assert all(a.score >= b.score for a, b in pairwise(found))
        assert any(is_near(model, h.T_world_obj, p.T_world_obj) for h in found[:8])


def test_hypotheses_stand_on_the_table_and_move_with_it():
    scene, grid = measured()
    T = se3.random_transform(np.random.default_rng(1))
    model = scene.models[scene.truth[0].obj_id]
    t = templates_of(model.name)
    here = match_templates(grid, t, plane=TABLE)
    there = match_templates(grid, t, plane=SupportPlane(T_world_table=T))
    assert len(here) == len(there) > 0
    for a, b in zip(here, there, strict=True):
        assert np.allclose(T @ a.T_world_obj, b.T_world_obj, atol=1e-9)
        assert abs(se3.transform(a.T_world_obj, model.mesh.vertices)[:, 2].min()) < 1e-9


def test_a_region_bounds_place_and_turn():
    scene, grid = measured()
    rng = np.random.default_rng(2)
    for p in scene.truth:
        model = scene.models[p.obj_id]
        c = model.mesh.bounds.mean(0)[None]
        shift, axis = rng.normal(size=(2, 3))
        turn = se3.exp_so3(math.radians(20) * axis / np.linalg.norm(axis))
        region = Region(
            center_world=se3.transform(p.T_world_obj, c)[0] + 0.03 * shift / np.linalg.norm(shift),
            radius_m=0.045, R_world_obj=p.T_world_obj[:3, :3] @ turn, turn_deg=38.0,
        )  # fmt: skip
        found = match_templates(grid, templates_of(model.name), plane=TABLE, region=region)
        assert 0 < len(found) <= MOST_IN_REGION
        assert any(is_near(model, h.T_world_obj, p.T_world_obj) for h in found)
        start = se3.from_rt(region.R_world_obj, np.zeros(3))
        for h in found:
            center = se3.transform(h.T_world_obj, c)[0]
            assert np.linalg.norm((center - region.center_world)[:2]) < 0.045 + 0.02
            only_turned = se3.from_rt(h.T_world_obj[:3, :3], np.zeros(3))
            assert error(model, only_turned, start)[1] < 38 + 4  # sampled symmetries


def test_a_flat_plate_is_found():
    plate = replace(part("box"), mesh=box_mesh(np.zeros(3), np.array([0.08, 0.05, 0.003])))
    truth = se3.from_rt(se3.exp_so3([0, 0, 0.6]), [0.03, -0.04, 0.0])
    grid = exact_grid(plate, truth)
    noise = np.random.default_rng(0).normal(scale=3e-4, size=grid.heights.shape)
    noisy = replace(grid, heights=(grid.heights + noise).astype(np.float32))
    found = match_templates(noisy, model_templates(plate, TemplateConfig(), None), plane=TABLE)
    assert any(is_near(plate, h.T_world_obj, truth) for h in found[:8])


# --- Height grids and height templates: laws and known answers on real meshes.
FEW = TemplateConfig(rays=1000)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_the_table_is_zero_and_the_block_has_its_height(rng):
    """A table of 30 cm with a block of 6 x 4 cm, 5 cm high, about (0.05, 0.02)."""
    n = 60_000
    xy = rng.uniform(-0.15, 0.15, (n, 2))
    on = np.all(np.abs(xy - [0.05, 0.02]) < [0.03, 0.02], axis=1)
    points = np.c_[xy, np.where(on, 0.05, 0.0) + rng.normal(0, 3e-4, n)]
    towards = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    grid = height_grid(Cloud(points=points, towards=towards, sigmas=np.full(n, 1e-3)), TABLE)
    xy = grid.centers()
    inside = np.all(np.abs(xy - [0.05, 0.02]) < [0.027, 0.017], axis=-1)
    outside = np.any(np.abs(xy - [0.05, 0.02]) > [0.033, 0.023], axis=-1)
    assert np.nanmax(np.abs(grid.heights[inside] - 0.05)) < 1e-3
    assert np.nanmax(np.abs(grid.heights[outside])) < 1e-3


@pytest.mark.parametrize("name", ["mug", "wedge"])
def test_template_heights_are_those_of_the_placed_mesh(name):
    model = part(name)
    templates = model_templates(model, FEW, None)
    poses = se3.from_rt(templates.rotations, templates.offsets)
    for T, points in zip(poses, templates.points, strict=True):
        seen = seen_from_above(model.mesh, T, points[:, :2].astype(float))
        assert np.median(np.abs(points[:, 2] - seen)) < 1e-5
        placed = se3.transform(T, model.mesh.vertices)
        assert abs(placed[:, 2].min()) < 1e-9  # stands on the table
        # the reference point is the middle of the footprint's box
        assert np.allclose(placed.min(0)[:2], -placed.max(0)[:2], atol=1e-9)


def test_a_box_rests_on_three_sides_and_looks_the_same_after_half_a_turn():
    size = np.array([0.04, 0.06, 0.10])
    plain = ObjectModel(obj_id=1, name="b", mesh=box_mesh(np.zeros(3), size))
    half = np.stack([np.diag(d) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])])
    S = se3.from_rt(half.astype(float), (size - half @ size) / 2)
    known = model_templates(replace(plain, symmetries=S), FEW, None)
    unknown = model_templates(plain, FEW, None)
    assert (len(known.rotations), len(unknown.rotations)) == (3, 6)
    assert set(known.yaw_counts) == {12} and set(unknown.yaw_counts) == {24}
    assert np.isclose(known.probabilities.sum(), unknown.probabilities.sum())
    assert np.allclose(sorted(float(p[:, 2].mean()) for p in known.points), size, atol=1e-6)


def test_kept_templates_are_the_same_and_a_damaged_file_is_computed_again(tmp_path):
    model = part("knob")
    first = model_templates(model, FEW, tmp_path)
    (path,) = tmp_path.glob("templates_*.npz")
    written = path.read_bytes()
    again = model_templates(model, FEW, tmp_path)
    path.write_bytes(written[: len(written) // 2])
    mended = model_templates(model, FEW, tmp_path)
    assert path.read_bytes() == written
    for other in (again, mended):
        for name in ("rotations", "offsets", "points", "outside", "yaw_counts", "symmetries"):
            assert np.array_equal(getattr(first, name), getattr(other, name))
    model_templates(model, TemplateConfig(rays=1001), tmp_path)
    assert len(list(tmp_path.iterdir())) == 2  # another config is another file


# --- Near symmetries: what must be found, and what must not.

NEAR = NearSymmetryConfig()


def gap(model, T, Ts):
    """Least over the motions and all symmetries of the greatest shift of a corner of the box."""
    box = box_mesh(*model.mesh.bounds).vertices
    S = symmetry_transforms(model, np.radians(1))
    images = se3.transform((Ts[:, None] @ S[None]).reshape(-1, 4, 4), box)
    return float(np.linalg.norm(images - se3.transform(T, box), axis=2).max(1).min())


def about_z(deg, x=0.0):
    R = se3.exp_so3([0, 0, np.radians(deg)])
    c = np.array([x, 0.0, 0.0])
    return se3.from_rt(R, c - R @ c)


def test_a_gear_turned_by_half_a_tooth_is_found():
    gear = part("gear")
    steps = np.degrees(se3.angle(gear.symmetries))
    tooth = steps[steps > 1].min()
    assert gap(gear, about_z(tooth / 2), near_symmetries(gear, NEAR, None)) < 0.002
    bare = ObjectModel(obj_id=1, name="gear", mesh=gear.mesh)  # nothing declared
    assert len(near_symmetries(bare, NEAR, None)) > 0


def test_a_shaft_end_for_end_and_a_mugs_half_turn_are_found():
    shaft, mug = part("stepped_shaft"), part("mug")
    flips = near_symmetries(shaft, NEAR, None)
    axis = np.asarray(shaft.symmetry_axes[0][0])
    assert np.any(flips[:, :3, :3] @ axis @ axis < -0.999)
    low = mug.mesh.bounds[0]  # the handle is at +x, so the body's axis is one radius from the left
    assert gap(mug, about_z(180, low[0] - low[1]), near_symmetries(mug, NEAR, None)) < 0.005


def test_they_fit_most_of_the_surface_but_are_no_symmetries(rng):
    model = part("gear")
    Ts = near_symmetries(model, NEAR, None)
    assert 0 < len(Ts) <= NEAR.most
    se3.check_rigid(Ts, "near symmetries")
    points, _ = sample_surface(model.mesh, 500, rng)
    scene = raycasting_scene(model.mesh)
    near = max(NEAR.near_m, NEAR.near_share_of_size * model.mesh.extent.max())
    for T in Ts:
        moved = np.float32(se3.transform(T, points))
        d = scene.compute_distance(import_open3d().core.Tensor(moved), 1).numpy()
        assert np.mean(d < near) > NEAR.far_least_share - 0.06  # another sample, another distance
        assert d.max() > NEAR.true_m * 0.7
        assert gap(model, np.eye(4), T[None]) > 0.03 * model.mesh.extent.max()


def test_a_body_whose_symmetries_are_all_declared_has_none():
    assert len(near_symmetries(part("pulley"), NEAR, None)) == 0
