"""The signed distance field against closed forms."""

import numpy as np
import pytest
import trimesh

from realsim.geometry import distance_field, se3
from realsim.geometry.distance_field import DistanceField
from realsim.geometry.parts import object_model
from realsim.records import Mesh
from refusals import refused
from trimesh_solids import solid

HALF = np.array([0.03, 0.04, 0.05])
RADIUS = 0.04


@pytest.fixture(scope="module")
def box():
    return DistanceField.from_mesh(solid(trimesh.creation.box(2 * HALF)), 48)


@pytest.fixture(scope="module")
def sphere():
    return DistanceField.from_mesh(solid(trimesh.creation.icosphere(4, RADIUS)), 48)


def box_distance(p):
    q = np.abs(p) - HALF
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)


def shell(rng, n, low, high):
    u = rng.normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True) * rng.uniform(low, high, (n, 1))


def test_box_distance_is_exact_on_flat_faces(box):
    p = np.random.default_rng(0).uniform(-1, 1, (4000, 3)) * (HALF + 4 * box.cell)
    error = np.abs(box.distance(p) - box_distance(p))
    near = np.abs(box_distance(p)) < (distance_field.NEAR_CELLS - 2) * box.cell
    # Away from edges and the medial axis the field is linear; at them half a cell is missed.
    assert np.median(error[near]) < 1e-6
    assert error[near].max() < 0.6 * box.cell
    # Far inside, where four cells are bridged, the ridge of the field is cut off.
    assert error.max() < 0.6 * distance_field.FAR_STEP * box.cell


@pytest.mark.parametrize("name", ["blob_000", "teddy"])
def test_neighbours_off_the_surface_of_touching_bodies_differ_by_their_distance(name):
    # Bodies that share walls mislead rays: whole regions were on the wrong side.
    f = DistanceField.from_mesh(object_model(name).mesh, 48)
    most = (distance_field.NEAR_CELLS - 1) * f.cell
    off = (np.abs(f.grid) > 0.51 * f.cell) & (np.abs(f.grid) < most)
    for axis in range(3):
        both = np.delete(off, 0, axis) & np.delete(off, -1, axis)
        assert (np.abs(np.diff(f.grid, axis=axis))[both] <= 1.001 * f.cell).all()
    edge = np.ones_like(off)
    edge[1:-1, 1:-1, 1:-1] = False
    assert (f.grid[edge] > 0).all()


def test_sphere_distance_and_gradient(sphere):
    p = shell(np.random.default_rng(1), 4000, 0.8 * RADIUS, 1.1 * RADIUS)
    d, g = sphere.distance_gradient(p)
    r = np.linalg.norm(p, axis=1)
    # Facets of the icosphere (0.05 mm sagitta at most) plus cell^2 / 8R of interpolation.
    assert np.abs(d - (r - RADIUS)).max() < 1e-4 + sphere.cell**2 / RADIUS
    np.testing.assert_allclose(np.linalg.norm(g, axis=1), 1.0, atol=0.05)
    # The length is off by up to cell / R = 4 % within a cell; the direction by far less.
    direction = g / np.linalg.norm(g, axis=1, keepdims=True)
    assert np.sum(direction * p / r[:, None], axis=1).min() > 0.995


def test_gradient_is_the_derivative_of_the_value(sphere):
    p = shell(np.random.default_rng(2), 500, 0.5 * RADIUS, 2.5 * RADIUS)
    _, g = sphere.distance_gradient(p)
    steps = 1e-7 * np.eye(3)
    rises = np.stack([sphere.distance(p + e) - sphere.distance(p - e) for e in steps], -1)
    assert np.mean(np.abs(rises / 2e-7 - g).max(1) < 1e-3) > 0.99


def test_outside_the_grid_distance_grows_and_points_away(box):
    p = np.array([[0.5, 0.0, 0.0], [0.3, 0.4, 0.5]])
    d, g = box.distance_gradient(p)
    assert np.all(d >= box_distance(p) - 1e-6)
    assert np.all(d < 1.2 * box_distance(p) + 0.01)
    np.testing.assert_allclose(g[0], [1, 0, 0], atol=1e-6)


def test_a_moved_mesh_has_the_moved_field():
    rng = np.random.default_rng(3)
    mesh = solid(trimesh.creation.box(2 * HALF))
    T = se3.random_transform(rng, spread=0.1)
    elsewhere = Mesh(vertices=se3.transform(T, mesh.vertices), faces=mesh.faces)
    moved = DistanceField.from_mesh(elsewhere, 48)
    p = rng.uniform(-1.2, 1.2, (500, 3)) * HALF
    still = DistanceField.from_mesh(mesh, 48)
    assert np.abs(moved.distance(se3.transform(T, p)) - still.distance(p)).max() < moved.cell
    mapped = still.distance(se3.transform(T, p), se3.invert(T))
    np.testing.assert_allclose(mapped, still.distance(p), atol=1e-9)


def test_a_hole_does_not_turn_the_inside_out():
    shape = trimesh.creation.icosphere(3, RADIUS)
    holed = Mesh(vertices=np.array(shape.vertices), faces=np.array(shape.faces[3:], np.int32))
    p = shell(np.random.default_rng(4), 800, 0.3 * RADIUS, 0.9 * RADIUS)
    assert np.mean(DistanceField.from_mesh(holed, 32).distance(p) < 0) > 0.99


def test_a_field_is_computed_once_and_kept_in_the_folder(tmp_path, monkeypatch):
    mesh = solid(trimesh.creation.box(HALF))
    first = DistanceField.from_mesh(mesh, 16, tmp_path)
    copy = Mesh(vertices=mesh.vertices.copy(), faces=mesh.faces.copy())
    assert DistanceField.from_mesh(copy, 16, tmp_path) is first
    assert DistanceField.from_mesh(copy, 20) is not first
    monkeypatch.setattr(distance_field, "_memory", type(distance_field._memory)())
    again = DistanceField.from_mesh(mesh, 16, tmp_path)
    assert again is not first
    np.testing.assert_array_equal(again.grid, first.grid)
    refused(".", DistanceField.from_mesh, mesh, 2)
