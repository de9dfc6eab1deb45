"""Fingers are moved together in free air only."""

import numpy as np

from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.slip.mujoco_approach import CLEARANCE_M, advanced_fingers, surface_triangles
from trimesh_solids import box

HAND = find_hand()


def advanced(parts, Ts, opening=0.08):
    return advanced_fingers(surface_triangles(parts), Ts, np.full(len(Ts), opening), HAND)


def scattered(n, seed=0):
    rng = np.random.default_rng(seed)
    return se3.from_rt(se3.random_rotation(rng, n), rng.uniform(-0.03, 0.03, (n, 3)))


def test_no_point_of_the_surface_is_nearer_than_the_clearance_and_one_is_as_near():
    rng = np.random.default_rng(1)
    parts = (rng.uniform(-0.03, 0.03, (20, 3)), box([0.06, 0.01, 0.02], [0.02, 0.0, 0.0]).vertices)
    triangles, Ts = surface_triangles(parts), scattered(40)
    weights = rng.dirichlet(np.ones(3), size=(len(triangles), 3000))
    points = np.einsum("tnc,tcd->tnd", weights, triangles).reshape(-1, 3)
    _, _, (low, high) = HAND.boxes(0.0)[0]
    found, exact = advanced(parts, Ts), 0
    for T, y in zip(Ts, found, strict=True):
        p = se3.transform(se3.invert(T), points)
        across = p[:, [0, 2]]
        within = np.all((low[[0, 2]] < across) & (across < high[[0, 2]]), axis=1)
        between = np.abs(p[within & (np.abs(p[:, 1]) < 0.04), 1])
        if len(between) and between.max() + CLEARANCE_M < 0.04:
            assert between.max() <= y - CLEARANCE_M + 1e-12
            exact += y - CLEARANCE_M - between.max() < 0.5e-3
    assert exact > 10


def test_the_fingers_never_open_and_stay_where_nothing_is_between_them():
    small = (box([0.02, 0.02, 0.02]).vertices,)
    Ts = scattered(40, 3)
    assert (advanced(small, Ts, 0.03) <= 0.015).all()
    away = se3.from_translation([0.0, 0.0, -0.2])[None]
    assert advanced(small, away) == 0.04


def test_a_face_that_passes_through_the_sweep_counts_although_no_corner_is_inside():
    beam = (box([0.3, 0.03, 0.3]).vertices,)
    assert np.allclose(advanced(beam, np.eye(4)[None]), 0.015 + CLEARANCE_M)
