"""The shipped parts are closed, painted, as large as they say, and as symmetric as they claim."""

import numpy as np
import pytest

from realsim.geometry import parts_solids as solids
from realsim.geometry import se3
from realsim.geometry.distance_field import raycasting_scene
from realsim.geometry.mesh import mass_properties, sample_surface
from realsim.geometry.parts import part, part_names
from refusals import refused, undetermined

NAMES = part_names()
GENUS = {"hex_nut": 1, "gear": 1, "tube": 1, "mug": 1, "pulley": 1, "elbow": 1, "flange": 7}
SAGITTA_M = 1.2e-4


def euler(mesh):
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return len(mesh.vertices) - len(np.unique(edges, axis=0)) + len(mesh.faces)


def distances(mesh, points):
    """Distance of points (N, 3) to the surface in double precision, by brute force."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    nearest = np.empty(len(points))
    for k, p in enumerate(points):
        inside, best = np.ones(len(a), dtype=bool), np.full(len(a), np.inf)
        for start, end in ((a, b), (b, c), (c, a)):
            edge, way = end - start, p - start
            t = np.einsum("ij,ij->i", way, edge) / np.einsum("ij,ij->i", edge, edge)
            gap = way - np.clip(t, 0, 1)[:, None] * edge
            best = np.minimum(best, np.einsum("ij,ij->i", gap, gap))
            inside &= np.einsum("ij,ij->i", np.cross(edge, way), normal) >= 0
        flat = np.einsum("ij,ij->i", p - a, normal) ** 2
        nearest[k] = np.sqrt(np.where(inside, flat, best).min())
    return nearest


@pytest.mark.parametrize("name", NAMES)
def test_every_part_is_a_closed_solid_of_the_right_genus(name):
    model = part(name)
    mass = mass_properties(model.mesh, model.density)
    assert mass.is_watertight
    assert mass.volume_m3 > 2e-5
    assert euler(model.mesh) == 2 - 2 * GENUS.get(name, 0)
    assert 0.03 <= model.mesh.extent.max() <= 0.16
    assert model.mesh.extent.min() <= 0.08


@pytest.mark.parametrize("name", ["mug", "gear", "pulley", "cube", "elbow"])
def test_normals_point_out_and_no_wall_passes_through_another(name):
    mesh = part(name).mesh
    points, normals = sample_surface(mesh, 1500, np.random.default_rng(3))
    scene, step = raycasting_scene(mesh), 2e-4
    rays = np.concatenate([points + step * normals, points - step * normals]).astype(np.float32)
    inside = scene.compute_occupancy(rays, nsamples=5).numpy() > 0.5
    # A corner sharper than the step may be crossed: a few samples in a thousand.
    assert inside[: len(points)].mean() < 0.004
    assert inside[len(points) :].mean() > 0.996


@pytest.mark.parametrize("name", ["mug", "gear", "pulley", "cube", "elbow"])
def test_symmetries_map_the_surface_onto_itself(name):
    model = part(name)
    np.testing.assert_array_equal(model.symmetries[0], np.eye(4))
    points, _ = sample_surface(model.mesh, 16, np.random.default_rng(1))
    for T in model.symmetries[1:]:
        assert distances(model.mesh, se3.transform(T, points)).max() < 1e-9
    for axis, _ in model.symmetry_axes:
        T = se3.from_rt(se3.exp_so3(0.777 * np.array(axis)), np.zeros(3))
        assert distances(model.mesh, se3.transform(T, points)).max() < SAGITTA_M


@pytest.mark.parametrize("name", ["mug", "gear", "pulley", "cube", "elbow"])
def test_no_further_turn_about_an_axis_is_a_symmetry(name):
    model = part(name)
    points, _ = sample_surface(model.mesh, 16, np.random.default_rng(1))
    known = model.symmetries[:, :3, :3]
    # About an axis of revolution only where z goes matters.
    part_that_matters = (slice(None), [2]) if model.symmetry_axes else (slice(None), slice(None))
    for axis in np.eye(3):
        for n in (2, 3, 4, 5, 6):
            R = se3.exp_so3(2 * np.pi / n * axis)
            if np.abs(known - R)[:, *part_that_matters].max((1, 2)).min() > 1e-9:
                assert distances(model.mesh, points @ R.T).max() > 5e-4, (axis, n)


def test_a_symmetry_that_is_not_one_is_noticed():
    mesh = part("l_bracket").mesh
    points, _ = sample_surface(mesh, 300, np.random.default_rng(1))
    assert distances(mesh, points @ se3.exp_so3([0, 0, np.pi]).T).max() > 0.01


def test_groups_close():
    for name, order in (("cube", 24), ("hex_nut", 12), ("gear", 32), ("box", 4), ("knob", 5)):
        S = part(name).symmetries
        assert len(S) == order
        for a in S:
            assert np.abs((a @ S)[:, None] - S[None]).max((2, 3)).min(1).max() < 1e-9


def test_ids_are_stable_and_unique():
    assert [part(n).obj_id for n in NAMES] == list(range(1, len(NAMES) + 1))
    assert len(NAMES) >= 14
    assert part("mug") is part("mug")
    refused("hex_nut", part, "spanner")


def volume(pieces):
    vertices, faces = solids.weld(pieces)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def test_volumes_are_the_analytic_ones():
    assert mass_properties(part("cube").mesh, 1.0).volume_m3 == pytest.approx(0.05**3, rel=1e-12)
    ring = solids.circle(0.02, 48)
    hole = solids.circle(0.004, 20, (0.008, 0.003))[::-1]
    area = solids.polygon_area(ring) + solids.polygon_area(hole)
    prism = solids.extrude(ring, -0.01, 0.03, [hole], bands=(0.0, 0.01))
    assert volume([prism]) == pytest.approx(area * 0.04, rel=1e-12)
    # Pappus for a body of n facets: the circle's area times sinc.
    n, r, h = 64, 0.03, 0.07
    facet = n / 2 * np.sin(2 * np.pi / n)
    cylinder = solids.revolve([[0, 0], [r, 0], [r, h], [0, h]], n)
    assert volume([cylinder]) == pytest.approx(facet * r * r * h, rel=1e-12)
    cone = solids.revolve([[0, 0], [r, 0], [0, h]], n)
    assert volume([cone]) == pytest.approx(facet * r * r * h / 3, rel=1e-12)
    c = 0.002
    block = solids.extrude(solids.rectangle(0.06, 0.04), 0, 0.03, chamfer=c)
    # The chamfered slices are prismatoids: the middle section is exact with Simpson's rule.
    middle = (0.06 - c) * (0.04 - c)
    frustum = c / 6 * (0.06 * 0.04 + 4 * middle + 0.056 * 0.036)
    assert volume([block]) == pytest.approx(0.06 * 0.04 * (0.03 - 2 * c) + 2 * frustum, rel=1e-12)


def test_capsule_and_tube_match_their_formulas_to_the_facets():
    r, h = 0.02, 0.052
    capsule = mass_properties(part("capsule").mesh, 1.0).volume_m3
    assert capsule == pytest.approx(np.pi * r * r * h + 4 / 3 * np.pi * r**3, rel=3e-3)
    assert capsule < np.pi * r * r * h + 4 / 3 * np.pi * r**3
    tube = mass_properties(part("tube").mesh, 1.0).volume_m3
    assert tube == pytest.approx(np.pi * (0.028**2 - 0.021**2) * 0.084, rel=0.02)


def star(n, rng):
    t = np.sort(rng.uniform(0, 2 * np.pi, n))
    return np.stack([np.cos(t), np.sin(t)], -1) * rng.uniform(0.03, 0.05, (n, 1))


@pytest.mark.parametrize("seed", range(4))
def test_ear_clipping_covers_random_stars_with_holes_exactly(seed):
    rng = np.random.default_rng(seed)
    outline = star(60, rng)
    # A star whose widest gap is more than half a turn does not hold the origin.
    holes = [
        solids.circle(0.002, int(rng.integers(3, 9)), (0.008 * np.cos(a), 0.008 * np.sin(a)))[::-1]
        for a in np.arange(5) * 2 * np.pi / 5
    ]
    points, triangles = solids.triangulate(outline, holes)
    areas = [solids.polygon_area(points[t]) for t in triangles]
    assert min(areas) > -1e-12
    wanted = sum(solids.polygon_area(r) for r in (outline, *holes))
    assert sum(areas) == pytest.approx(wanted, rel=1e-12)
    assert len(triangles) == len(points) + 2 * len(holes) - 2


def test_rings_the_wrong_way_round_and_open_surfaces_are_refused():
    square = solids.rectangle(0.02, 0.02)
    refused("clockwise", solids.triangulate, square[::-1])
    refused("axis", solids.revolve, [[0.01, 0], [0.02, 0.01]])
    undetermined("no partner", solids.weld, [solids.wall(square, 0, square, 0.01)])
