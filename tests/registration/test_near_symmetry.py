"""Near symmetries: what must be found, and what must not."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.distance_field import raycasting_scene
from realsim.geometry.mesh import sample_surface, symmetry_transforms
from realsim.geometry.parts import part
from realsim.interop import import_open3d
from realsim.records import ObjectModel
from realsim.registration.search.near_symmetry import NearSymmetryConfig, near_symmetries

CONFIG = NearSymmetryConfig()


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def gap(model, T, Ts):
    """Least over the motions and all symmetries of the greatest shift of a corner of the box."""
    low, high = model.mesh.bounds
    box = low + np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low)
    S = symmetry_transforms(model, np.radians(1))
    images = se3.transform((Ts[:, None] @ S[None]).reshape(-1, 4, 4), box)
    shifts = np.linalg.norm(images - se3.transform(T, box), axis=2)
    return float(shifts.max(1).min())


def about_z(deg, x=0.0):
    R = se3.exp_so3([0, 0, np.radians(deg)])
    c = np.array([x, 0.0, 0.0])
    return se3.from_rt(R, c - R @ c)


def test_a_gear_turned_by_half_a_tooth_is_found():
    gear = part("gear")
    steps = np.degrees(se3.angle(gear.symmetries))
    tooth = steps[steps > 1].min()
    Ts = near_symmetries(gear, CONFIG, None)
    assert gap(gear, about_z(tooth / 2), Ts) < 0.002
    bare = ObjectModel(obj_id=1, name="gear", mesh=gear.mesh)  # nothing declared
    assert len(near_symmetries(bare, CONFIG, None)) > 0


def test_a_shaft_end_for_end_and_a_mugs_half_turn_are_found():
    shaft, mug = part("stepped_shaft"), part("mug")
    flips = near_symmetries(shaft, CONFIG, None)
    axis = np.asarray(shaft.symmetry_axes[0][0])
    assert np.any(flips[:, :3, :3] @ axis @ axis < -0.999)
    low = mug.mesh.bounds[0]  # the handle is at +x, so the body's axis is one radius from the left
    assert gap(mug, about_z(180, low[0] - low[1]), near_symmetries(mug, CONFIG, None)) < 0.005


def test_they_fit_most_of_the_surface_but_are_no_symmetries(rng):
    model = part("gear")
    Ts = near_symmetries(model, CONFIG, None)
    assert 0 < len(Ts) <= CONFIG.most
    se3.check_rigid(Ts, "near symmetries")
    points, _ = sample_surface(model.mesh, 500, rng)
    scene = raycasting_scene(model.mesh)
    near = max(CONFIG.near_m, CONFIG.near_share_of_size * model.mesh.extent.max())
    for T in Ts:
        moved = np.float32(se3.transform(T, points))
        d = scene.compute_distance(import_open3d().core.Tensor(moved), 1).numpy()
        assert np.mean(d < near) > CONFIG.far_least_share - 0.06  # another sample, another distance
        assert d.max() > CONFIG.true_m * 0.7
        assert gap(model, np.eye(4), T[None]) > 0.03 * model.mesh.extent.max()


def test_a_body_whose_symmetries_are_all_declared_has_none():
    assert len(near_symmetries(part("pulley"), CONFIG, None)) == 0
