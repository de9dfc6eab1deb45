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
figures = load("scale_figures")
NAMES = tuple(shapes.SHAPES)


def test_there_are_the_hard_ones():
    assert len(NAMES) >= 24
    assert {"cup", "disc", "pipe", "pipe2", "banana", "torus", "sphere", "motor"} < set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_shape_is_closed_and_of_its_size(name: str):
    mesh = shapes.SHAPES[name]()
    solid = to_trimesh(mesh)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert solid.body_count == 1
    assert 0.06 - 1e-9 <= mesh.extent.max() <= 0.18


@pytest.mark.parametrize("name", ["box", "cup", "motor", "bunny"])
def test_a_resting_object_does_not_topple(name: str):
    mesh = shapes.SHAPES[name]()
    center = to_trimesh(mesh).center_mass
    for seed in range(10):
        R = shapes.resting_rotation(mesh, np.random.default_rng(seed))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1)
        v = mesh.vertices @ R.T
        foot = v[v[:, 2] < v[:, 2].min() + 1e-3][:, :2]
        middle = (R @ center)[:2]
        assert np.all(foot.min(0) < middle + 1e-3)
        assert np.all(foot.max(0) > middle - 1e-3)


def test_resting_poses_are_drawn_by_their_probability():
    rng = np.random.default_rng(0)
    mesh = shapes.SHAPES["bowl"]()
    upright = [shapes.resting_rotation(mesh, rng)[2, 2] > 0 for _ in range(300)]
    assert 0.5 < np.mean(upright) < 0.85


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


def test_depth_is_kept_in_the_sensors_unit_and_comes_back_the_same(case: Any, tmp_path: Path):
    first = cases.make_case("knob", 3, 160, tmp_path)
    again = cases.make_case("knob", 3, 160, tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    for frames in zip(case.views.frames, first.views.frames, again.views.frames, strict=True):
        assert len({f.depth_m.tobytes() for f in frames}) == 1
        assert len({f.T_world_cam.tobytes() for f in frames}) == 1
        units = frames[0].depth_m.astype(np.float64) / 1e-4
        assert np.abs(units - np.round(units)).max() < 1e-2


def test_a_failure_counts_against_every_figure():
    Row = figures.Row
    good = [Row(name=f"o{i}", seed=0, kind=k, error_pct=0.1, sigma_pct=0.2, verdict="accepted",
                cpu_s=1.0) for i in range(3) for k in figures.KINDS]  # fmt: skip
    bad = [Row(name="x", seed=0, kind=k, failure="boom") for k in figures.KINDS]
    clean, _ = figures.figures_of(good)
    hurt, _ = figures.figures_of([*good, *bad])
    assert clean["within1pct_exact"] == 1 and hurt["within1pct_exact"] == 0.75
    assert clean["worst_pct"] == pytest.approx(0.1) and hurt["worst_pct"] == figures.FAILED_PCT
    assert hurt["cold_within2pct"] == 0.75
    assert hurt["interval_coverage"] == pytest.approx(9 / 11)  # a failed cold fit has no interval
    assert clean["failures"] == 0 and hurt["failures"] == 3


def test_a_wrong_result_that_is_accepted_is_not_flagged():
    Row = figures.Row
    rows = [
        Row(name="a", seed=0, kind="cold", error_pct=-30.0, sigma_pct=0.5, verdict="accepted"),
        Row(name="b", seed=0, kind="cold", error_pct=9.0, sigma_pct=0.5, verdict="doubtful"),
        Row(name="c", seed=0, kind="cold", error_pct=1.0, sigma_pct=0.6, verdict="accepted"),
        Row(name="d", seed=0, kind="cold", error_pct=1.0, sigma_pct=0.4, verdict="rejected"),
    ]
    found, over = figures.figures_of(rows)
    assert found["cold_flagged_share"] == 0.5
    assert found["false_alarm_share"] == 0.5
    assert found["interval_coverage_cold"] == 0.5
    assert over["cold_flagged_share"].startswith("2 ")
