"""Simplified meshes stay closed, keep their colours, and how far they are off is measured."""

import re
from dataclasses import replace

import numpy as np
import pytest

from bounded_memory import alone, own_kb
from realsim.errors import UnitError
from realsim.geometry import se3
from realsim.geometry.mesh import ply_bytes, transformed
from realsim.geometry.parts import object_model, part
from realsim.models.inspect import inspect_mesh
from realsim.models.mesh_topology import topology
from realsim.models.model_records import ConvexParts
from realsim.models.properties import physical_properties
from realsim.models.reading import read_scan
from realsim.models.repair import RepairConfig, repaired
from realsim.models.simplify import clustered, deviation, simplified
from realsim.records import Mesh
from refusals import refused
from trimesh_solids import ball, box


def bent_torus(faces):
    """A closed surface of about so many faces with bumps."""
    n = int(np.sqrt(faces / 2))
    u, v = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    a, b = 2 * np.pi * u / n, 2 * np.pi * v / n
    r = 0.03 * (1 + 0.05 * np.sin(5 * a) * np.cos(7 * b))
    w = 0.1 + r * np.cos(b)
    p, q = (u + 1) % n, (v + 1) % n
    i, j, k, m = u * n + v, p * n + v, p * n + q, u * n + q
    return Mesh(
        vertices=np.stack([w * np.cos(a), w * np.sin(a), r * np.sin(b)], -1),
        faces=np.concatenate([np.stack([i, j, k], -1), np.stack([i, k, m], -1)]),
    )


@pytest.mark.parametrize("name", ["gear", "duck"])
def test_a_closed_surface_stays_closed(name):
    mesh = replace(object_model(name).mesh, colors=None, uv=None, texture=None)
    small = simplified(mesh, max(len(mesh.faces) // 5, 4))
    report = inspect_mesh(small)
    assert report.is_watertight and report.is_outward
    assert len(small.faces) <= 2.5 * len(mesh.faces) / 5


def test_the_deviation_grows_as_faces_go_and_is_small_at_first():
    mesh = ball()
    off = [deviation(mesh, simplified(mesh, len(mesh.faces) // k)) for k in (2, 8, 32)]
    assert off == sorted(off)
    assert off[0] < 3e-4 and off[2] < 5e-3
    assert simplified(mesh, len(mesh.faces)) is mesh


def test_the_deviation_of_two_balls_is_the_difference_of_their_radii():
    a, b = ball(0.05, 5), ball(0.052, 5)
    assert deviation(a, b) == pytest.approx(0.002, abs=3e-5)
    assert deviation(a, b) == pytest.approx(deviation(b, a), abs=3e-5)
    assert deviation(a, a) < 1e-8
    assert deviation(a, b, quantile=0.95) <= deviation(a, b)


def test_the_deviation_sees_what_one_surface_has_and_the_other_has_not():
    whole = ball(0.05, 4)
    half = replace(whole, faces=whole.faces[whole.vertices[whole.faces].mean(axis=1)[:, 2] < 0])
    expected = np.sqrt(2) * 0.05  # from the pole to the rim
    for a, b in ((whole, half), (half, whole)):
        assert deviation(a, b) == pytest.approx(expected, rel=0.03)


def test_colours_are_carried_over():
    mesh = ball(0.05, 5)
    rgb = np.clip(255 * (mesh.vertices / 0.1 + 0.5), 0, 255).astype(np.uint8)
    small = simplified(replace(mesh, colors=rgb), 2000)
    expected = np.clip(255 * (small.vertices / 0.1 + 0.5), 0, 255)
    assert np.abs(small.colors - expected).max() < 4


def test_the_result_does_not_depend_on_the_unit():
    mesh = part("elbow").mesh
    small = simplified(mesh, 1000)
    large = simplified(replace(mesh, vertices=mesh.vertices * 1024.0), 1000)
    np.testing.assert_array_equal(large.faces, small.faces)
    np.testing.assert_allclose(large.vertices / 1024.0, small.vertices, atol=1e-12)


def test_nonsense_is_refused():
    refused("3 faces", simplified, ball(), 3)
    refused("quantile", deviation, ball(), ball(), quantile=0.0)


def test_a_mesh_of_too_many_faces_is_simplified_by_its_repair():
    mesh = bent_torus(20_000)
    repair = repaired(mesh, RepairConfig(max_faces=5_000))
    assert 3_000 < len(repair.mesh.faces) <= 5_000
    assert repair.after.is_watertight and "simplified from" in repair.actions[-1]
    assert deviation(repair.mesh, mesh) < 5e-4
    assert repaired(repair.mesh, RepairConfig(max_faces=5_000)).actions == ()


@pytest.mark.slow
def test_two_million_faces_are_read_and_repaired_within_the_memory(tmp_path):
    mesh = bent_torus(2_000_000)
    rgb = np.clip(255 * (mesh.vertices / 0.3 + 0.5), 0, 255).astype(np.uint8)
    (tmp_path / "a.ply").write_bytes(ply_bytes(replace(mesh, colors=rgb), "m"))
    alone(measured, tmp_path / "a.ply")


def measured(path):
    repair = repaired(read_scan(path, "m").mesh)
    assert [p.kind for p in repair.before.problems] == ["gigantic"]
    assert own_kb("VmHWM") < 2.0e6
    assert 900_000 < len(repair.mesh.faces) <= 1_000_000
    assert repair.after.is_watertight and repair.after.is_outward
    off = float(re.search(r"by at most ([\d.e-]+) % of the extent", repair.actions[-1])[1])
    assert off < 0.2
    expected = np.clip(255 * (repair.mesh.vertices / 0.3 + 0.5), 0, 255)
    assert np.abs(repair.mesh.colors - expected).max() < 4


def test_sheets_nearer_than_a_cell_are_clustered_closed_or_not_at_all():
    import trimesh

    sheet = trimesh.creation.box((0.1, 0.1, 0.00015))
    v, f = trimesh.remesh.subdivide_to_size(sheet.vertices, sheet.faces, 0.002)
    topo = topology(Mesh(vertices=v, faces=f))
    assert topo.is_watertight
    coarse = clustered(topo, len(f) // 4, 0.05)
    assert coarse is None or topology(coarse).is_watertight


# --- Mass and inertia: known solids, laws, and what the figures are of.


def opened(mesh):
    return replace(mesh, faces=mesh.faces[1:])


def test_a_box_is_as_the_books_say():
    a, b, c = 0.04, 0.06, 0.1
    p = physical_properties(box((0.04, 0.06, 0.1), (1.0, 2.0, -0.5)), density=700.0)
    m = 700 * a * b * c
    assert p.volume_m3 == pytest.approx(a * b * c) and p.mass_kg == pytest.approx(m)
    assert (p.volume_of, p.mass_from) == ("mesh", "density")
    assert p.hull_volume_fraction == pytest.approx(1.0)
    assert np.allclose(p.extent_m, [a, b, c])
    assert p.diameter_m == pytest.approx(np.sqrt(a * a + b * b + c * c))
    assert np.allclose(p.centroid, [1, 2, -0.5]) and np.allclose(p.center_of_mass, [1, 2, -0.5])
    expected = m / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    assert np.allclose(p.inertia, expected, rtol=1e-9, atol=1e-15)


def test_a_weighed_mass_gives_the_density_and_a_density_the_mass():
    weighed = physical_properties(part("mug").mesh, mass_kg=0.35)
    assert weighed.mass_from == "weighed" and weighed.mass_kg == pytest.approx(0.35)
    again = physical_properties(part("mug").mesh, density=weighed.density)
    assert again.mass_kg == pytest.approx(0.35)
    assert np.allclose(again.inertia, weighed.inertia, rtol=1e-12)


@pytest.mark.parametrize("name", ["mug", "l_bracket"])
def test_inertia_turns_with_the_object_and_does_not_care_where_it_lies(name):
    mesh = part(name).mesh
    T = se3.random_transform(np.random.default_rng(8), 1)[0]
    p, q = physical_properties(mesh), physical_properties(transformed(mesh, T))
    R = T[:3, :3]
    assert np.allclose(q.inertia, R @ p.inertia @ R.T, rtol=1e-6, atol=1e-12)
    assert np.allclose(q.center_of_mass, se3.transform(T, p.center_of_mass[None])[0], atol=1e-9)
    assert np.allclose(q.centroid, se3.transform(T, p.centroid[None])[0], atol=1e-9)
    moments = np.sort(np.linalg.eigvalsh(p.inertia))
    assert moments[0] > 0 and moments[0] + moments[1] >= moments[2]


def test_steiner_two_boxes_side_by_side_are_one_long_box():
    left, right = box((0.05, 0.06, 0.1), (-0.025, 0, 0)), box((0.05, 0.06, 0.1), (0.025, 0, 0))
    parts = ConvexParts(parts=(left.vertices, right.vertices), volume_ratio=1.0, method="coacd")
    whole = box((0.1, 0.06, 0.1))
    p = physical_properties(opened(whole), parts=parts)
    exact = physical_properties(whole)
    assert p.volume_of == "convex parts"
    assert p.volume_m3 == pytest.approx(exact.volume_m3)
    assert np.allclose(p.center_of_mass, 0, atol=1e-12)
    assert np.allclose(p.inertia, exact.inertia, rtol=1e-9, atol=1e-15)


def test_an_open_mesh_says_whose_volume_it_is_given():
    mesh = part("l_bracket").mesh
    closed, hull = physical_properties(mesh), physical_properties(opened(mesh))
    assert (closed.volume_of, hull.volume_of) == ("mesh", "hull")
    assert hull.hull_volume_fraction == pytest.approx(1.0) and hull.volume_m3 > closed.volume_m3


def test_two_answers_and_wrong_units_are_refused():
    mesh = part("cube").mesh
    refused("one follows from the other", physical_properties, mesh, density=1000, mass_kg=0.1)
    grams = r"Were grams given\? 125 g would be 1000 kg/m\^3"
    refused(grams, physical_properties, mesh, error=UnitError, mass_kg=125.0)
    refused("mesh too large", physical_properties, mesh, error=UnitError, mass_kg=1e-4)
    refused(r"Were grams given", physical_properties, mesh, error=UnitError, mass_kg=1e9)
    for wrong in (0.0, -1.0, float("nan")):
        refused("positive number", physical_properties, mesh, density=wrong)
        refused("positive number", physical_properties, mesh, mass_kg=wrong)
    refused("flat", physical_properties, Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]])))
