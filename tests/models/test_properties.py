"""Mass and inertia: known solids, laws, and what the figures are of."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import UnitError
from realsim.geometry import se3
from realsim.geometry.mesh import transformed
from realsim.geometry.parts import part
from realsim.models.model_records import ConvexParts
from realsim.models.properties import physical_properties
from realsim.records import Mesh
from refusals import refused
from trimesh_solids import box


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
    with pytest.raises(UnitError, match=r"Were grams given\? 125 g would be 1000 kg/m\^3"):
        physical_properties(mesh, mass_kg=125.0)
    refused("mesh too large", physical_properties, mesh, error=UnitError, mass_kg=1e-4)
    refused(r"Were grams given", physical_properties, mesh, error=UnitError, mass_kg=1e9)
    for wrong in (0.0, -1.0, float("nan")):
        refused("positive number", physical_properties, mesh, density=wrong)
        refused("positive number", physical_properties, mesh, mass_kg=wrong)
    refused("flat", physical_properties, Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]])))
