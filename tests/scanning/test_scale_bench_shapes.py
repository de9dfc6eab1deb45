"""The objects and cases of the scale benchmark are what they say they are."""

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import to_trimesh

BENCHMARKS = str(Path(__file__).parents[2] / "benchmarks")


def load(name: str) -> Any:
    """Import a file of the benchmarks' folder, which is no package."""
    sys.path.insert(0, BENCHMARKS)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(BENCHMARKS)


shapes = load("scale_shapes")
cases = load("scale_cases")
NAMES = tuple(shapes.SHAPES)


@pytest.mark.parametrize("name", NAMES)
def test_a_shape_is_closed_and_of_its_size(name: str):
    mesh = shapes.SHAPES[name]()
    solid = to_trimesh(mesh)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert solid.body_count == 1
    assert 0.06 - 1e-9 <= mesh.extent.max() <= 0.18


@pytest.fixture(scope="module")
def case() -> Any:
    return cases.make_case("knob", 3, 160)


def test_the_truth_of_a_case_maps_the_given_mesh_onto_the_true_one(case: Any):
    world = se3.transform(case.T_world_given, case.true_scale * case.given_exact.vertices)
    true = se3.transform(case.views.T_world_obj, case.true_mesh.vertices)
    np.testing.assert_allclose(world, true, atol=1e-12)
    assert cases.FACTOR[0] <= case.true_scale <= cases.FACTOR[1]
    assert world[:, 2].min() == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("kind", ["exact", "distorted"])
def test_a_start_is_off_by_what_it_says(case: Any, kind: str):
    mesh, start = getattr(case, f"given_{kind}"), getattr(case, f"start_{kind}")
    middle = mesh.bounds.mean(0)[None]
    true = se3.transform(case.T_world_given, case.true_scale * middle)
    there = se3.transform(start.T_world_obj, start.scale * middle)
    assert np.linalg.norm(there - true) == pytest.approx(0.010)
    turned = case.T_world_given[:3, :3].T @ start.T_world_obj[:3, :3]
    assert np.degrees(se3.angle(turned)) == pytest.approx(10)
    assert min(abs(start.scale / case.true_scale - f) for f in (0.87, 1.15)) < 1e-12
