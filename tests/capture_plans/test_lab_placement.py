"""Objects rest on the table as physics would have it, apart from each other, in the disc."""

import numpy as np
import pytest

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties
from realsim.geometry.parts import part, part_names
from realsim.records import Mesh
from realsim_capture_plans.lab.placement import (
    footprint,
    footprint_gap,
    place_objects,
    stable_rests,
)
from refusals import refused

CENTER = np.array([0.4, -0.1, 0.02])


def scene(seed, n=6, radius_m=0.17):
    rng = np.random.default_rng(seed)
    models = [part(name) for name in rng.choice(part_names(), n, replace=False)]
    return models, place_objects(models, CENTER, rng, radius_m)


@pytest.mark.parametrize("name", ["mug", "gear"])
def test_the_center_of_mass_stands_over_the_contact_polygon(name):
    mesh = part(name).mesh
    center = mass_properties(mesh, 1.0).center_of_mass
    down, probability = stable_rests(mesh)
    assert probability.sum() == pytest.approx(1)
    assert np.all(probability > 0)
    for n in down:
        depth = mesh.vertices @ n
        touching = mesh.vertices[depth > depth.max() - 1e-6]
        assert len(touching) >= 3
        # In the contact plane the centre must not be beyond the touching points in any direction.
        rng = np.random.default_rng(0)
        for _ in range(30):
            axis = np.cross(n, rng.normal(size=3))
            axis /= np.linalg.norm(axis)
            assert (touching @ axis).max() >= center @ axis + 3.9e-4


def test_a_box_falls_on_its_faces_by_their_solid_angles():
    down, probability = stable_rests(part("box").mesh)
    assert len(down) == 6
    size = part("box").mesh.extent
    for n, p in zip(down, probability, strict=True):
        k = int(np.argmax(np.abs(n)))
        a, b = np.delete(size, k) / 2
        h = size[k] / 2
        # Solid angle of a rectangle 2a x 2b from a height h over its middle.
        omega = 4 * np.arcsin(a * b / np.sqrt((a * a + h * h) * (b * b + h * h)))
        assert p == pytest.approx(omega / (4 * np.pi), rel=1e-6)


def test_what_rolls_for_ever_is_refused():
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) * 1e-4
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    refused("roll", stable_rests, Mesh(vertices=square, faces=faces), error=DegenerateError)


def test_layouts_touch_the_table_stay_in_the_disc_and_keep_their_distance():
    models, Ts = scene(0)
    outlines = []
    for m, T in zip(models, Ts, strict=True):
        p = se3.transform(T, m.mesh.vertices)
        assert p[:, 2].min() == pytest.approx(CENTER[2], abs=1e-12)
        assert np.linalg.norm(p[:, :2] - CENTER[:2], axis=1).max() < 0.17 + 1e-9
        outlines.append(footprint(m.mesh, T))
    for i, a in enumerate(outlines):
        for b in outlines[:i]:
            assert footprint_gap(a, b) >= 0.008 - 1e-9


def test_too_many_objects_are_refused_with_the_number_that_fits():
    refused(r"only \d+ of 12 objects fit", scene, 0, n=12, radius_m=0.1)


def square(x, y, side=0.02, turn=0.0):
    R = se3.exp_so3([0, 0, turn])[:2, :2]
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2
    return corners @ R.T + [x, y]
