"""Limit analysis: laws of the safety factor, the same optimum as another solver, known answers."""

import time

import numpy as np
import pytest
from scipy.optimize import linprog

from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.grasping.limit_analysis import PadPatches, pad_patches, safety_factors
from trimesh_solids import box

HAND = find_hand()
EDGE = np.sqrt(2 * np.pi / (8 * np.sin(np.pi / 4)))  # polygon of the circle's area, at its corners


def patches(n, seed, tilt=0.3, points=9):
    """Return n grasps with random points and normals on either pad, some of them not there."""
    rng = np.random.default_rng(seed)
    at = rng.uniform(-0.01, 0.01, (n, 2, points, 3))
    at[..., 1] += np.array([-0.02, 0.02])[:, None]
    normals = rng.normal(scale=tilt, size=at.shape)
    normals[..., 1] += np.array([-1.0, 1.0])[:, None]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    there = rng.random((n, 2, points)) < 0.6
    there[..., 0] = True
    return PadPatches(points=at, normals=normals, there=there)


def flat(n=1, size=0.02, height=0.05):
    """Return flat pads of 3 x 3 points on two parallel faces, middles on the grasp's y."""
    x, z = np.meshgrid(*2 * [size * np.array([-1.0, 0.0, 1.0]) / 3])
    at = np.zeros((n, 2, 9, 3))
    at[..., 0], at[..., 2] = x.ravel(), z.ravel()
    at[..., 1] = np.array([-height / 2, height / 2])[:, None]
    normals = np.zeros_like(at)
    normals[..., 1] = np.array([-1.0, 1.0])[:, None]
    return PadPatches(points=at, normals=normals, there=np.ones((n, 2, 9), dtype=bool))


def borne(p, w, friction, force=1.0):
    """Return the factors of all grasps at one friction and one force."""
    n = len(w)
    return safety_factors(p, w, np.full(n, friction), np.full(n, force))


def loads(n, count, seed):
    rng = np.random.default_rng(seed)
    found = rng.normal(size=(n, count, 6))
    found[..., :3] *= 0.03
    return found


def edges_of(p, k, friction):
    """Return the wrenches (E, 6) of grasp k's edges, and how far each presses inward (E,)."""
    wrenches, inward = [], []
    for pad, sign in ((0, 1.0), (1, -1.0)):
        there = p.there[k, pad]
        for a, r in zip(p.normals[k, pad][there], p.points[k, pad][there], strict=True):
            axis = np.eye(3)[np.argmin(np.abs(a))]
            u = axis - (axis @ a) * a
            u /= np.linalg.norm(u)
            v = np.cross(a, u)
            for e in 2 * np.pi * np.arange(8) / 8:
                push = -a + friction * EDGE * (np.cos(e) * u + np.sin(e) * v)
                wrenches.append(np.concatenate([np.cross(r, push), push]))
                inward.append(sign * push[1])
    return np.array(wrenches), np.array(inward)


def by_linprog(p, k, load, friction, force):
    G, inward = edges_of(p, k, friction)
    scale = np.array([20.0] * 3 + [1.0] * 3)
    found = linprog(
        np.append(np.zeros(len(G)), -1.0),
        A_eq=np.vstack([np.c_[(G * scale).T, load * scale], np.append(inward, 0.0)]),
        b_eq=np.append(np.zeros(6), 2 * force),
    )
    return {0: -found.fun if found.status == 0 else 0.0, 2: 0.0, 3: np.inf}[found.status]


@pytest.mark.parametrize(("tilt", "friction"), [(0.02, 0.1), (0.3, 0.3), (0.3, 1.0), (0.8, 0.6)])
def test_another_solver_finds_the_same_optimum(tilt, friction):
    p, w, force = patches(12, seed=1, tilt=tilt), loads(12, 2, seed=2), np.linspace(5, 70, 12)
    found = safety_factors(p, w, np.full(12, friction), force)
    told = [[by_linprog(p, k, w[k, i], friction, force[k]) for i in range(2)] for k in range(12)]
    np.testing.assert_allclose(found, told, rtol=1e-6, atol=1e-7)
    assert (found > 0).any()


def test_the_factor_is_force_over_load_and_grows_with_friction():
    p, w = patches(30, seed=3), loads(30, 4, seed=4)
    found = borne(p, w, 0.5, 10)
    assert (found > 0).mean() > 0.5
    np.testing.assert_allclose(borne(p, w, 0.5, 70), 7 * found, rtol=1e-9)
    np.testing.assert_allclose(borne(p, 4 * w, 0.5, 10), found / 4)
    last = np.zeros_like(found)
    for friction in (0.1, 0.3, 0.5, 0.8, 1.2):
        now = borne(p, w, friction, 10)
        assert np.all(now >= last * (1 - 1e-6))
        last = now


def test_a_turned_problem_has_the_same_factors_but_for_the_polygons_corners():
    """A turn about y keeps what is inward; it turns the cones' corners, by 5.4 % at most."""
    p, w = patches(20, seed=5), loads(20, 3, seed=6)
    found = borne(p, w, 0.6)
    R = se3.exp_so3([0.0, np.pi, 0.0])  # by half: the corners fall on corners
    turned = PadPatches(points=p.points @ R.T, normals=p.normals @ R.T, there=p.there)
    w_turned = np.concatenate([w[..., :3] @ R.T, w[..., 3:] @ R.T], axis=-1)
    np.testing.assert_allclose(borne(turned, w_turned, 0.6), found, rtol=1e-6)
    # Mirrored through the plane between the fingers: pads change sides, torques their sign.
    M = np.diag([1.0, -1.0, 1.0])
    swapped = PadPatches(
        points=p.points[:, ::-1] @ M, normals=p.normals[:, ::-1] @ M, there=p.there[:, ::-1]
    )
    w_swapped = np.concatenate([-w[..., :3] @ M, w[..., 3:] @ M], axis=-1)
    np.testing.assert_allclose(borne(swapped, w_swapped, 0.6), found, rtol=1e-6)


def test_the_point_that_wrenches_are_about_does_not_matter():
    p, w = patches(20, seed=7), loads(20, 3, seed=8)
    found = borne(p, w, 0.6)
    shift = np.array([0.03, -0.01, 0.02])
    moved = PadPatches(points=p.points + shift, normals=p.normals, there=p.there)
    about = w.copy()
    about[..., :3] += np.cross(shift, w[..., 3:])
    np.testing.assert_allclose(borne(moved, about, 0.6), found, rtol=1e-6)


def test_coulombs_cube_holds_twice_mu_times_the_force():
    p, force, angle = flat(), 20.0, np.radians(np.arange(0.0, 360.0, 7.5))
    w = np.zeros((1, len(angle), 6))
    w[0, :, 3], w[0, :, 5] = np.cos(angle), np.sin(angle)  # 1 N across the closing axis
    for friction in (0.05, 0.4, 1.0):
        found, exact = borne(p, w, friction, force)[0], 2 * friction * force
        assert np.all((found > 0.973 * exact) & (found < 1.0541 * exact))
        assert np.ptp(found) > 0  # the polygon's corners and sides


def test_torsion_of_flat_pads_is_between_all_in_the_corners_and_an_even_pressure():
    """About the closing axis a pad bears mu F times where it presses; the best is the corners."""
    p, w = flat(), np.zeros((1, 1, 6))
    w[0, 0, 1] = 1.0
    corner = 2 * 0.5 * 10.0 * 0.02 / 3 * np.sqrt(2)
    assert 0.97 * corner < borne(p, w, 0.5, 10.0)[0, 0] < 1.055 * corner
    # A single point on either pad bears none, about any axis through both.
    point = PadPatches(points=p.points, normals=p.normals, there=p.there & (np.arange(9) == 4))
    assert borne(point, w, 0.5, 10.0)[0, 0] == 0


def test_a_load_off_the_middle_is_borne_up_to_the_pads_torsion():
    p, force, friction = flat(), 10.0, 0.5
    w = np.zeros((1, 4, 6))
    w[0, :, 5] = -1.0  # 1 N down, beside the pads
    w[0, :, 1] = [0.0, 0.01, 0.03, 0.1]
    found = borne(p, w, friction, force)[0]
    assert np.all(np.diff(found) < 0)
    torsion = 2 * friction * force * 0.02 / 3 * np.sqrt(2)
    assert found[3] == pytest.approx(torsion / 0.1, rel=0.1)


def test_a_wedge_steeper_than_its_friction_is_squeezed_out():
    p = flat()
    for degrees, friction, balanced in ((15, 0.3, True), (20, 0.3, False), (20, 0.4, True)):
        tilt = np.radians(degrees)
        normals = p.normals.copy()
        normals[..., 0] = np.sin(tilt)
        normals[..., 1] *= np.cos(tilt)
        wedge = PadPatches(points=p.points, normals=normals, there=p.there)
        w = np.zeros((1, 2, 6))
        w[0, 1, 3] = -1.0  # against the way it would slip
        idle, pushed = borne(wedge, w, friction, 10.0)[0]
        assert idle == (np.inf if balanced else 0.0)
        assert (pushed > 0) == balanced


def test_hands_on_an_object_beside_it_and_half_on_it():
    surface = RaySurface(box((0.05, 0.05, 0.05)))
    places = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.032, 0.0, 0.0]])
    Ts = se3.from_rt(np.tile(np.eye(3), (3, 1, 1)), places)
    p = pad_patches(surface, Ts, np.full(3, 0.07), HAND, 0.001)
    np.testing.assert_array_equal(p.both, [True, False, True])
    np.testing.assert_array_equal(p.there.sum(axis=2), [[9, 9], [0, 0], [3, 3]])
    np.testing.assert_allclose(p.points[0, :, :, 1], [[-0.025] * 9, [0.025] * 9], atol=1e-7)
    np.testing.assert_allclose(p.normals[0, :, 4], [[0, -1, 0], [0, 1, 0]], atol=1e-7)
    w = np.zeros((3, 1, 6))
    w[..., 5] = -1.0
    found = borne(p, w, 0.5, 10.0)[:, 0]
    assert found[1] == 0 and found[0] == pytest.approx(10.0, rel=0.055)
    none = pad_patches(surface, Ts[:0], np.empty(0), HAND, 0.001)
    assert none.both.shape == (0,)
    assert safety_factors(none, w[:0], np.empty(0), np.empty(0)).shape == (0, 1)


def test_degenerate_patches_end_at_the_optimum():
    """Points in a line, in one place, almost so, and turned: ties and rounding everywhere."""
    rng, n = np.random.default_rng(9), 160
    p = flat(n)
    points, there = p.points.copy(), rng.random((n, 2, 9)) < 0.5
    there[..., 0] = True
    points[:40, ..., 0] = 0.0
    points[40:80] = points[40:80, :, :1]
    points[80:120] = points[80:120, :, :1] + 1e-8 * points[80:120]
    R = se3.exp_so3([0.2, -0.3, 0.1])
    turned = PadPatches(points=points @ R.T, normals=p.normals @ R.T, there=there)
    w = np.round(rng.uniform(-1, 1, (n, 6, 6))) * np.array([0.01] * 3 + [1.0] * 3)
    w = np.concatenate([w[..., :3] @ R.T, w[..., 3:] @ R.T], axis=-1)
    found = borne(turned, w, 0.5, 10.0)
    for k in range(0, n, 4):
        told = by_linprog(turned, k, w[k, 0], 0.5, 10.0) if np.any(w[k, 0]) else np.inf
        assert found[k, 0] == pytest.approx(told, rel=1e-6, abs=1e-6), k


def test_two_hundred_grasps_of_eight_loads_take_less_than_a_second():
    p, w = patches(200, seed=10), loads(200, 8, seed=11)
    borne(p, w, 1.0)  # compiled
    began = time.process_time()
    borne(p, w, 1.0)
    assert time.process_time() - began < 1.0
