"""Camera poses read wrongly are found out: by labelled objects and by depth; so is their unit."""

import numpy as np
import pytest

from realsim.formats.evidence import (
    depth_evidence,
    objects_evidence,
    readings,
    require_direction,
    require_scale,
    scale_evidence,
)
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.rendering.rays import PlacedMesh, RayScene, rotated
from refusals import refused
from tests.support.synthetic_scenes import INTRINSICS, MODELS, cameras, table, two_boxes

WRONG = ("inverted", "other axes", "inverted, other axes")


def labels(Ts, rng, noise_mm=2.0):
    """Return five static objects as seen from every camera, with errors of public labels."""
    things = []
    for T_world_obj in se3.random_transform(rng, 5, 0.3):
        rows = []
        for k, T in enumerate(Ts):
            xi = rng.normal(size=6) * np.r_[np.full(3, 0.01), np.full(3, noise_mm / 1e3)]
            rows.append((k, se3.invert(T) @ T_world_obj @ se3.exp(xi)))
        things.append(rows)
    return things


def depths_of(Ts):
    things = two_boxes().objects
    meshes = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in things]
    scene = RayScene([*meshes, table()])
    rays = ray_table(INTRINSICS).reshape(-1, 3)
    found = []
    for T in Ts:
        hit = scene.cast(T[:3, 3], rotated(rays, T[:3, :3])).t
        found.append(np.where(np.isfinite(hit), hit, 0).astype(np.float32).reshape(120, 160))
    return found


@pytest.fixture(scope="module")
def scanned():
    Ts = np.stack(cameras(8, seed=2))
    depths = depths_of(Ts)
    return Ts, lambda k: (depths[k], INTRINSICS)


def test_objects_agree_only_under_the_right_reading():
    rng = np.random.default_rng(1)
    Ts = np.stack(cameras(12, seed=3))
    things = labels(Ts, rng)
    right = objects_evidence(Ts, things)
    assert right.decisive and right.best == "as stated" and not right.contradicts
    assert right.spreads["as stated"].mm < 6 and right.spreads["as stated"].deg < 3
    assert "5 objects in 12 views" in require_direction(right, "x")
    for name in WRONG:
        wrong = objects_evidence(readings(Ts)[name], things)
        assert wrong.contradicts and wrong.decisive
        said = r"not what they are said to be.*as stated: \d+"
        refused(said, require_direction, wrong, "scene 3")


def test_the_verdict_does_not_depend_on_the_world():
    """Equivariance: another world frame changes no spread."""
    rng = np.random.default_rng(2)
    Ts = np.stack(cameras(6, seed=4))
    things = labels(Ts, rng)
    plain, moved = (objects_evidence(x, things) for x in (Ts, se3.random_transform(rng) @ Ts))
    a, b = (found.spreads["as stated"].mm for found in (moved, plain))
    assert a == pytest.approx(b, rel=0.5) and moved.decisive


def test_a_camera_that_hardly_moves_decides_nothing():
    rng = np.random.default_rng(3)
    first = cameras(1, seed=5)[0]
    Ts = np.stack([first @ se3.from_translation([0.0004 * k, 0.0, 0.0]) for k in range(6)])
    things = labels(Ts, rng)
    for T in readings(Ts).values():
        evidence = objects_evidence(T, things)
        assert not evidence.decisive and not evidence.contradicts
        assert "moves too little" in require_direction(evidence, "x")
    depths = depths_of(Ts)
    by_depth = depth_evidence(readings(Ts)["inverted"], lambda k: (depths[k], INTRINSICS))
    assert not by_depth.decisive and not by_depth.contradicts


def test_depth_agrees_only_under_the_right_reading(scanned):
    Ts, depth_of = scanned
    right = depth_evidence(Ts, depth_of)
    assert right.decisive and right.best == "as stated" and right.spreads["as stated"].mm < 3
    for name in WRONG:
        wrong = depth_evidence(readings(Ts)[name], depth_of)
        assert wrong.contradicts, (name, wrong.numbers)


def test_depth_tells_the_unit_of_the_poses(scanned):
    Ts, depth_of = scanned
    halved = se3.from_rt(Ts[:, :3, :3], Ts[:, :3, 3] / 2)
    evidence = scale_evidence(halved, depth_of)
    assert evidence.decisive and evidence.best == pytest.approx(2.0, rel=0.04)
    refused("--scale", require_scale, evidence, "x")
