"""Matching of height templates: found where they stand, moved with the world, kept in a region."""

import math
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import symmetry_transforms
from realsim.geometry.parts import part
from realsim.records import SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.registration.search.height_grid import GridConfig, HeightGrid, height_grid
from realsim.registration.search.matching import MatchConfig, match_templates
from realsim.registration.search.records import Region
from realsim.registration.search.templates import TemplateConfig, model_templates
from realsim.registration.views import SampleConfig, sample_views, world_cloud
from table_scenes import named_scene

PLANE = SupportPlane(T_world_table=np.eye(4))
NAMES = ("mug", "box", "wedge", "gear", "elbow")


@lru_cache(maxsize=32)
def templates_of(name):
    return model_templates(part(name), TemplateConfig(), None)


@lru_cache(maxsize=2)
def measured(seed=3):
    """A simulated table with 5 parts, and the heights that 12 noisy views show."""
    scene = named_scene(seed, NAMES)
    noise = DepthNoise(per_m=0.0069, floor_m=2e-4)
    views = sample_views(scene.intrinsics, scene.frames, noise, SampleConfig(stride=1))
    return scene, height_grid(world_cloud(views, noise), PLANE, GridConfig())


def exact_grid(model, T_world_obj, cells=140):
    """The heights of one mesh on an endless table, by ray casting: no noise, nothing missing."""
    from realsim.rendering.rays import PlacedMesh, RayScene

    cell, origin = 0.003, np.full(2, -0.0015 * cells)
    grid = HeightGrid(heights=np.zeros((cells, cells), np.float32), origin=origin, cell_m=cell)
    xy = grid.centers().reshape(-1, 2)
    scene = RayScene([PlacedMesh(0, model.mesh, T_world_obj)], center=np.zeros(3))
    down = np.tile(np.float32([0, 0, -1]), (len(xy), 1))
    t, _ = scene.first_hits(np.c_[xy, np.ones(len(xy))], down)
    heights = np.where(np.isfinite(t), 1.0 - t, 0.0).reshape(cells, cells).astype(np.float32)
    return HeightGrid(heights=heights, origin=origin, cell_m=cell)


def error(model, T, truth):
    """Distance of the box centres [mm] and angle modulo symmetry [deg]."""
    S = symmetry_transforms(model, math.radians(2))[:, :3, :3]
    c = model.mesh.bounds.mean(0)[None]
    d = np.linalg.norm(se3.transform(T, c) - se3.transform(truth, c))
    return 1e3 * d, np.degrees(se3.angle(T[:3, :3].T @ truth[:3, :3] @ S)).min()


def is_near(model, T, truth):
    mm, deg = error(model, T, truth)
    return mm < 10 and deg < 15


def resting(name, pose, yaw_deg, xy):
    t = templates_of(name)
    turn = se3.from_rt(se3.exp_so3([0, 0, math.radians(yaw_deg)]), [*xy, 0.0])
    return turn @ se3.from_rt(t.rotations[pose], t.offsets[pose])


@pytest.mark.parametrize("name", ["mug", "wedge"])
def test_alone_it_is_found_first_in_every_resting_pose(name):
    model, t = part(name), templates_of(name)
    for pose in range(len(t.rotations)):
        truth = resting(name, pose, 141.0, (0.031, -0.047))
        found = match_templates(exact_grid(model, truth), t, MatchConfig(), plane=PLANE)
        near = [h for h in found if is_near(model, h.T_world_obj, truth)]
        assert near and near[0].score > 0.7
        assert near[0].score > found[0].score - 0.1
        assert error(model, near[0].T_world_obj, truth)[0] < 4


def test_every_part_of_a_noisy_clutter_is_among_the_hypotheses():
    scene, grid = measured()
    for p in scene.truth:
        model = scene.models[p.obj_id]
        found = match_templates(grid, templates_of(model.name), MatchConfig(), plane=PLANE)
        assert len(found) <= MatchConfig().most
        assert all(a.score >= b.score for a, b in pairwise(found))
        assert any(is_near(model, h.T_world_obj, p.T_world_obj) for h in found[:8])


def test_hypotheses_stand_on_the_table_and_move_with_it():
    scene, grid = measured()
    T = se3.random_transform(np.random.default_rng(1))
    model = scene.models[scene.truth[0].obj_id]
    t = templates_of(model.name)
    here = match_templates(grid, t, MatchConfig(), plane=PLANE)
    there = match_templates(grid, t, MatchConfig(), plane=SupportPlane(T_world_table=T))
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
            radius_m=0.045,
            R_world_obj=p.T_world_obj[:3, :3] @ turn,
            turn_deg=38.0,
        )
        found = match_templates(
            grid, templates_of(model.name), MatchConfig(), plane=PLANE, region=region
        )
        assert 0 < len(found) <= MatchConfig().most_in_region
        assert any(is_near(model, h.T_world_obj, p.T_world_obj) for h in found)
        start = se3.from_rt(region.R_world_obj, np.zeros(3))
        for h in found:
            center = se3.transform(h.T_world_obj, c)[0]
            assert np.linalg.norm((center - region.center_world)[:2]) < 0.045 + 0.02
            only_turned = se3.from_rt(h.T_world_obj[:3, :3], np.zeros(3))
            assert error(model, only_turned, start)[1] < 38 + 4  # sampled symmetries


def test_a_flat_plate_is_found():
    box = part("box").mesh
    low, high = box.bounds
    scaled = (box.vertices - low) / (high - low) * [0.08, 0.05, 0.003]
    plate = replace(part("box"), mesh=replace(box, vertices=scaled))
    truth = se3.from_rt(se3.exp_so3([0, 0, 0.6]), [0.03, -0.04, 0.0])
    grid = exact_grid(plate, truth)
    noise = np.random.default_rng(0).normal(scale=3e-4, size=grid.heights.shape)
    heights = (grid.heights + noise).astype(np.float32)
    noisy = HeightGrid(heights=heights, origin=grid.origin, cell_m=grid.cell_m)
    t = model_templates(plate, TemplateConfig(), None)
    found = match_templates(noisy, t, MatchConfig(), plane=PLANE)
    assert any(is_near(plate, h.T_world_obj, truth) for h in found[:8])
