"""Distance of poses modulo symmetry: zero for symmetric poses, the plain distance without."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import symmetry_transforms
from realsim.geometry.metrics import mssd
from realsim.geometry.parts import part
from realsim.registration.search.sameness import distinct, make_sameness
from table_scenes import part_models


@pytest.mark.parametrize("obj_id", sorted(part_models())[::6])
def test_symmetric_poses_are_the_same(obj_id: int):
    model = part_models()[obj_id]
    rng = np.random.default_rng(obj_id)
    same = make_sameness(model)
    T = se3.random_transform(rng)
    turned = T @ symmetry_transforms(model, 0.3)
    assert same.distances(T, turned).max() < 1e-9
    # Turned by any angle about the axis, not only by the sampled ones.
    for axis, point in model.symmetry_axes:
        p, a = np.array(point), np.array(axis) / np.linalg.norm(axis)
        R = se3.exp_so3(rng.uniform(-3, 3) * a)
        S = se3.from_rt(R, p - R @ p) @ model.symmetries[-1]
        assert same.distance(T, T @ S) < 1e-9
        assert same.angle_deg(T[:3, :3], (T @ S)[:3, :3]) < 1e-4


@pytest.mark.parametrize("name", ["gear", "bottle"])
def test_it_is_the_sampled_distance_with_the_sampling_gone(name: str):
    model = part(name)
    same = make_sameness(model)
    rng = np.random.default_rng(2)
    T = se3.random_transform(rng)
    other = T @ se3.exp(np.concatenate([0.05 * rng.normal(size=3), 0.004 * rng.normal(size=3)]))
    sampled = mssd(T, other, same.corners, symmetry_transforms(model, 0.005))
    got = same.distance(T, other)
    # The twist is the turn that fits best in the mean, not at the worst corner.
    assert 0.9 * sampled - 3e-4 < got < 1.35 * sampled


def test_distinct_keeps_the_first_of_those_alike():
    model = part("gear")
    T = se3.from_translation([0.1, 0, 0])
    alike = T @ model.symmetries[5]
    apart = se3.from_translation([0.0, 0.01, 0]) @ T
    same = make_sameness(model)
    assert distinct(same, [T, alike, apart, apart @ model.symmetries[2]], 0.002) == [0, 2]
    assert distinct(same, [], 0.002) == []
