"""Antipodal pairs of closed, open, noisy and double surfaces."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from realsim.geometry import se3
from realsim.records import Mesh
from realsim_sim_bridge.grasping.antipodal import CandidateConfig, RaySurface, antipodal_pairs
from trimesh_solids import cup, solid

CONFIG = CandidateConfig(surface_points=500)


def pairs_of(mesh, config=CONFIG, max_width=0.078, seed=0):
    counts = {}
    rng = np.random.default_rng(seed)
    return antipodal_pairs(RaySurface(mesh), config, max_width, rng, counts), counts


def sphere(radius=0.03):
    return solid(trimesh.creation.icosphere(subdivisions=5, radius=radius))


def test_both_ends_lie_on_the_surface_and_the_line_is_inside_both_cones():
    pairs, _ = pairs_of(sphere())
    assert np.allclose(np.linalg.norm(pairs.points, axis=-1), 0.03, atol=1e-4)
    line = pairs.points[:, 1] - pairs.points[:, 0]
    line = line / pairs.widths_m[:, None]
    for end, sign in ((0, -1.0), (1, 1.0)):
        assert np.all(np.sum(pairs.normals[:, end] * line, axis=1) * sign > np.sqrt(0.5) - 1e-2)


def test_pairs_turn_with_the_mesh():
    mesh, T = cup(), se3.exp([0.4, -1.0, 0.7, 0.1, 0.2, -0.3])
    # Only the rays along the normal: the random ones start from axes of the frame.
    first = replace(CONFIG, rays_per_point=1)
    a, b = (
        pairs_of(m, first)[0]
        for m in (mesh, Mesh(vertices=se3.transform(T, mesh.vertices), faces=mesh.faces))
    )
    # Rays have single precision: of pairs at the edge of a triangle a few may differ.
    assert abs(len(a) - len(b)) <= 0.02 * len(a)
    moved = se3.transform(T, a.points.reshape(-1, 3)).reshape(-1, 6)
    gap = np.linalg.norm(moved[:, None] - b.points.reshape(1, -1, 6), axis=2).min(axis=1)
    assert np.mean(gap < 1e-5) > 0.97


def test_a_mesh_whose_triangles_all_face_inwards_has_the_same_pairs():
    mesh = cup()
    inside_out = Mesh(vertices=mesh.vertices, faces=mesh.faces[:, ::-1])
    (a, _), (b, counts) = pairs_of(mesh), pairs_of(inside_out)
    assert abs(len(b) - len(a)) < 0.05 * len(a)
    assert counts["antipodal_points"] > 400


def test_an_open_mesh_with_triangles_of_either_orientation_keeps_its_pairs():
    rng = np.random.default_rng(3)
    mesh = solid(trimesh.creation.icosphere(subdivisions=4, radius=0.03))
    whole, _ = pairs_of(mesh)
    faces = mesh.faces[rng.random(len(mesh.faces)) > 0.03].copy()
    turned = rng.random(len(faces)) < 0.4
    faces[turned] = faces[turned][:, ::-1]
    scan = Mesh(vertices=mesh.vertices, faces=faces)
    assert not RaySurface(scan).is_closed
    found, _ = pairs_of(scan)
    assert len(found) > 0.9 * len(whole)
    out = np.sum(found.normals * found.points, axis=-1) > 0
    assert np.mean(out) > 0.97


def noisy(mesh, sigma, seed=0):
    rng = np.random.default_rng(seed)
    return Mesh(
        vertices=mesh.vertices + rng.normal(scale=sigma, size=mesh.vertices.shape), faces=mesh.faces
    )


def test_averaged_normals_are_nearer_to_the_truth_on_a_noisy_scan():
    scan = noisy(sphere(), 1e-4)
    errors = {}
    for radius in (0.0, CONFIG.normal_radius_m):
        pairs, _ = pairs_of(scan, replace(CONFIG, normal_radius_m=radius))
        true = pairs.points / np.linalg.norm(pairs.points, axis=-1, keepdims=True)
        cos = np.clip(np.sum(pairs.normals * true, axis=-1), -1, 1)
        errors[radius] = np.degrees(np.median(np.arccos(cos)))
    assert errors[CONFIG.normal_radius_m] < 0.6 * errors[0.0]


def test_a_double_surface_gives_no_pair_across_its_layers_and_one_exit_per_wall():
    outer = trimesh.creation.box((0.05, 0.05, 0.05))
    inner = trimesh.creation.box((0.0494, 0.0494, 0.0494))
    scan = solid(trimesh.util.concatenate([outer, inner]))
    first = replace(CONFIG, rays_per_point=1)
    pairs, counts = pairs_of(scan, first)
    assert np.all(pairs.widths_m > 0.049)
    assert counts["exits"] == CONFIG.surface_points


@pytest.mark.parametrize("friction", [0.2, 1.0])
def test_a_wedge_closes_only_where_friction_exceeds_the_tangent_of_its_half_angle(friction):
    a = np.radians(20)
    outline = np.array([[0.0, -0.002], [0.06, -0.002 - 0.06 * np.tan(a)]])
    outline = np.concatenate([outline, outline[::-1] * [1, -1]])
    prism = trimesh.creation.extrude_triangulation(
        outline, np.array([[0, 1, 2], [0, 2, 3]]), height=0.04
    )
    # Rays along the normals only: from one slope to the other they are 40 deg off there.
    config = replace(CONFIG, friction=friction, rays_per_point=4)
    pairs, _ = pairs_of(solid(prism), config)
    slopes = np.abs(pairs.normals[:, :, 1]) > 0.5
    slope_pairs = np.sum(slopes.all(axis=1))
    assert slope_pairs == 0 if friction < np.tan(a) else slope_pairs > 50
