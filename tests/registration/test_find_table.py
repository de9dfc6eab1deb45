"""The table is found without any object's pose, and moves with the world."""

from dataclasses import replace

import numpy as np

from realsim.geometry import se3
from realsim.registration.evidence import DepthNoise
from realsim.registration.find_table import TableSearchConfig, find_table
from realsim.registration.views import SampleConfig, ViewPoints, sample_views
from table_scenes import small_scene

CONFIG = TableSearchConfig()
NOISE = DepthNoise(per_m=0.008, floor_m=2e-4)


def views_of(seed: int, views: int = 12) -> tuple[ViewPoints, ...]:
    scene = small_scene(seed, views=views)
    return sample_views(
        scene.intrinsics, scene.frames, NOISE, SampleConfig(stride=2, edge_reach_px=1)
    )


def moved(views, T):
    return [replace(v, T_world_cam=T @ v.T_world_cam) for v in views]


def sheet(plane_z: float, half: float, n: int, rng, middle=(0.0, 0.0)):
    xy = rng.uniform(-half, half, (n, 2)) + middle
    return np.concatenate([xy, np.full((n, 1), plane_z)], axis=1)


def view_of_points(index: int, eye, points_world) -> ViewPoints:
    """A view that holds just these points, wherever they are in its image."""
    T = se3.look_at(np.array(eye), [0.0, 0.0, 0.0])
    p = se3.transform(se3.invert(T), points_world)
    pixels = np.rint(p[:, :2] / p[:, 2:] * 400 + [320, 240]).astype(np.int32)
    return ViewPoints(
        index=index, T_world_cam=T, points=p.astype(np.float32), pixels=pixels, area_px=16.0,
        measured_share=0.9,
    )  # fmt: skip


def test_the_true_table_is_found():
    found = find_table(views_of(1), NOISE, CONFIG)
    assert found.plane is not None and found.reason == ""
    T = found.plane.T_world_table
    # The hand-eye is off by 0.5 mm and 0.1 deg, the arm by a little more.
    assert abs(T[2, 3]) < 0.0015
    assert np.degrees(np.arccos(T[2, 2])) < 0.3
    # x along world x; the origin under what the cameras look at.
    assert T[0, 0] > 0.999 and np.linalg.norm(T[:2, 3]) < 0.03
    assert found.seen_by == tuple(range(12))
    assert max(v.tilt_deg for v in found.views) < 1.0
    assert max(abs(v.height_m) for v in found.views) < 0.003


def test_the_table_moves_with_the_world():
    views = views_of(1)
    rng = np.random.default_rng(3)
    T = se3.from_rt(se3.exp_so3([0.3, -0.4, 1.1]), rng.normal(size=3))
    a, b = (find_table(v, NOISE, CONFIG).plane for v in (views, moved(views, T)))
    assert a is not None and b is not None
    normal = T[:3, :3] @ a.T_world_table[:3, 2]
    assert np.degrees(np.arccos(np.clip(normal @ b.T_world_table[:3, 2], -1, 1))) < 0.05
    assert np.allclose(se3.transform(T, a.T_world_table[:3, 3]), b.T_world_table[:3, 3], atol=2e-4)


def test_the_lid_of_a_large_box_is_not_the_table():
    # More points on the lid, 80 mm above, than on the table around it.
    rng = np.random.default_rng(0)
    lid = sheet(0.08, 0.12, 2500, rng)
    table = sheet(0.0, 0.3, 4000, rng)
    table = table[np.abs(table[:, :2]).max(1) > 0.17][:1800]
    points = np.concatenate([lid, table]) + rng.normal(0, 3e-4, (2500 + len(table), 3))
    views = [
        view_of_points(k, (0.3 * np.cos(a), 0.3 * np.sin(a), 0.6), points)
        for k, a in enumerate(np.arange(6.0))
    ]
    plane = find_table(views, NOISE, CONFIG).plane
    assert plane is not None and abs(plane.T_world_table[2, 3]) < 0.002


def test_gravity_chooses_the_floor_of_a_shelf():
    rng = np.random.default_rng(1)
    floor, wall = sheet(0.0, 0.2, 1500, rng), sheet(0.0, 0.2, 4000, rng)
    wall = np.stack([np.full(len(wall), -0.2), wall[:, 0], wall[:, 1] + 0.2], axis=1)
    points = np.concatenate([floor, wall]) + rng.normal(0, 3e-4, (5500, 3))
    views = [view_of_points(k, (0.6, y, 0.25), points) for k, y in enumerate((-0.2, 0, 0.2))]
    blind = find_table(views, NOISE, CONFIG).plane
    told = find_table(views, NOISE, CONFIG, gravity_up_world=[0, 0, 1]).plane
    assert blind is not None and abs(blind.T_world_table[0, 2]) > 0.99  # the wall is larger
    assert told is not None and told.T_world_table[2, 2] > 0.999


def test_reasons_are_given_where_there_is_no_table():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-0.15, 0.15, (4000, 3))
    found = find_table([view_of_points(0, (0.0, 0.1, 0.6), cloud)], NOISE, CONFIG)
    assert found.plane is None and "largest plane" in found.reason
    empty = replace(
        views_of(1)[0], points=np.zeros((0, 3), np.float32), pixels=np.zeros((0, 2), np.int32)
    )
    found = find_table([empty], NOISE, CONFIG)
    assert found.plane is None and "0 trusted points" in found.reason
