"""Measured lengths: read from text, found on the mesh, checked against a fit."""

import re
from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.geometry.mesh import box_mesh
from realsim.geometry.parts import part
from realsim.records import Mesh
from realsim.scanning.scale.measured import (
    Measurement,
    length_of,
    parse_measurement,
    scale_from,
    typo,
)
from realsim.scanning.scale.measured_check import (
    as_it_stands,
    compare,
    conditioned,
    with_measurements,
)
from refusals import refused
from scale_fits import SMALL, UNIT_M, fit_of, known_scan


def brick(*size: float) -> Mesh:
    """A box with a corner at the origin."""
    return box_mesh((0.0, 0.0, 0.0), size)


@pytest.fixture(scope="module")
def known():
    return known_scan("box", 3, SMALL)


@pytest.fixture(scope="module")
def fit(known):
    residual = 0.2 * np.random.default_rng(0).standard_normal(len(known.scan.vertices))
    return fit_of(known, 1.0, reasons=(), verdict="accepted", residual_mm=residual)


# --- reading ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "kind", "value_m", "sigma_m"),
    [
        ("longest=120.4mm", "longest", 0.1204, 0.0005),
        ("height=95mm+-0.5mm", "height", 0.095, 0.0005),
        ("height = 9.5 cm ± 1 mm", "height", 0.095, 0.001),
        ("X=0.12m+/-0.2mm", "x", 0.12, 0.0002),
        ("diameter=4in", "diameter", 0.1016, 0.0005),
        ("y=95+-0.3mm".replace("95", "95mm"), "y", 0.095, 0.0003),
        ("z=95mm+-0.3", "z", 0.095, 0.0003),
    ],
)
def test_lengths_are_read(text, kind, value_m, sigma_m):
    m = parse_measurement(text)
    assert m.kind == kind
    assert m.value_m == pytest.approx(value_m, rel=1e-12)
    assert m.sigma_m == pytest.approx(sigma_m, rel=1e-12)


def test_two_points_are_read():
    m = parse_measurement("between 0,0,0 0.3,-1e-1,.5=95mm")
    assert m.points == ((0, 0, 0), (0.3, -0.1, 0.5)) and m.kind == "between"


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("longest=120", UnitError, "no unit"),
        ("longest", InputError, "longest=120.4mm"),
        ("weight=3mm", InputError, "weight"),
        ("longest=-3mm", UnitError, "unit right"),
        ("longest=0.4mm", UnitError, "2 mm"),
        ("x=95mm+-90mm", InputError, "sigma"),
        ("x=95mm+-1mm+-1mm", InputError, "several"),
        ("between 0,0,0 0,0,0=95mm", InputError, "two different"),
        ("between 0,0 1,1=95mm", InputError, "no point"),
    ],
)
def test_what_cannot_be_read_is_named(text, error, said):
    refused(said, parse_measurement, text, error=error)


# --- on the mesh ------------------------------------------------------------------------------


def test_lengths_of_a_brick_are_known():
    mesh = brick(1.0, 2.0, 4.0)
    wanted = {"longest": 4, "x": 1, "y": 2, "z": 4, "height": 4, "diameter": np.sqrt(21)}
    for kind, length in wanted.items():
        m = Measurement(kind=kind, value_m=0.1, sigma_m=1e-3)
        assert length_of(mesh, m) == pytest.approx(length, rel=1e-9)
    R_up = se3.exp_so3([0, np.pi / 2, 0])  # x becomes -z
    m = Measurement(kind="height", value_m=0.1, sigma_m=1e-3)
    assert length_of(mesh, m, R_up) == pytest.approx(1)
    m = Measurement(kind="between", value_m=0.1, sigma_m=1e-3, points=((0, 0, 0), (3, 4, 12)))
    assert length_of(mesh, m) == pytest.approx(13)


@pytest.mark.parametrize("kind", ["longest", "diameter"])
def test_longest_and_diameter_do_not_depend_on_the_axes(kind):
    mesh = part("mug").mesh
    m = Measurement(kind=kind, value_m=0.1, sigma_m=1e-3)
    turned = mesh.vertices @ se3.random_rotation(np.random.default_rng(0)).T
    expected = pytest.approx(length_of(mesh, m), rel=2e-3)
    assert length_of(replace(mesh, vertices=turned), m) == expected


# --- several ----------------------------------------------------------------------------------


def test_several_lengths_are_weighed_by_their_sigmas():
    lengths = [parse_measurement(t) for t in ("x=100mm+-1mm", "y=202mm+-4mm")]
    scale, sigma, each = scale_from(brick(1, 2, 4), lengths)
    w = np.array([1 / 0.001**2, 1 / 0.002**2])
    assert scale == pytest.approx((0.1 * w[0] + 0.101 * w[1]) / w.sum())
    assert sigma == pytest.approx(w.sum() ** -0.5) and len(each) == 2


def test_the_odd_one_of_three_is_named_with_its_slip():
    lengths = [parse_measurement(t) for t in ("x=100mm", "y=200.2mm", "z=40mm")]
    odd = r"odd one is 'z = 40 .*400\.\d mm there.*10 times"
    assert "x = 100" in refused(odd, scale_from, brick(1, 2, 4), lengths)


def test_of_two_contradicting_lengths_none_is_blamed():
    lengths = [parse_measurement(t) for t in ("x=100mm", "y=210mm")]
    refused("Which one is wrong cannot be told", scale_from, brick(1, 2, 4), lengths)
    refused("at least one", scale_from, brick(1, 2, 4), [])


@pytest.mark.parametrize(
    ("ratio", "said"),
    [(0.1, "cm"), (25.4, "inch"), (1000, "m typed|typed as m"), (1.0, "^$"), (1.3, "^$")],
)
def test_slips_of_the_unit_are_named(ratio, said):
    assert re.search(said, typo(ratio * 1.01))


# --- against a fit ----------------------------------------------------------------------------


def measured(known, kind, off=1.0, sigma_m=5e-4):
    """A measurement of the real thing, off by a factor."""
    m = Measurement(kind=kind, value_m=1.0, sigma_m=sigma_m)
    R_up = as_it_stands(fit_of(known)) if kind == "height" else None
    return replace(m, value_m=off * UNIT_M * length_of(known.scan, m, R_up))


@pytest.mark.parametrize("kind", ["diameter", "height"])
def test_a_right_length_agrees(known, fit, kind):
    check = compare(fit, known.scan, measured(known, kind))
    assert check.agrees and abs(check.difference_percent) < 1e-6
    assert "they agree" in check.text


def test_a_wrong_unit_is_guessed(known, fit):
    check = compare(fit, known.scan, measured(known, "longest", 0.1))
    assert not check.agrees and "cm" in check.text


def test_a_length_that_disagrees_makes_it_doubtful_and_changes_nothing(known, fit):
    wrong = measured(known, "longest", 1.06)
    joined, checks = with_measurements(fit, known.scan, [wrong])
    assert joined.verdict == "doubtful" and joined.scale == fit.scale
    assert any("measured" in r and "fitted" in r for r in joined.reasons)
    assert not checks[0].agrees
    rejected, _ = with_measurements(replace(fit, verdict="rejected"), known.scan, [wrong])
    assert rejected.verdict == "rejected"
    assert with_measurements(fit, known.scan, []) == (fit, ())


def test_fit_and_measurement_are_weighed_by_their_variances(known, fit):
    m = measured(known, "longest", 1.002, 1e-4)
    exact = replace(fit, residual_mm=np.zeros_like(fit.residual_mm))
    joined, (check,) = with_measurements(exact, known.scan, [m])
    w = [exact.sigma**-2, check.sigma**-2]
    mean = (w[0] * exact.scale + w[1] * check.scale) / sum(w)
    assert joined.scale == pytest.approx(mean, rel=1e-5)
    assert joined.sigma == pytest.approx(sum(w) ** -0.5, rel=1e-2)
    assert joined.verdict == "accepted" and "moved the scale" in joined.notes[-1]
    np.testing.assert_allclose(joined.extent_mm / fit.extent_mm, joined.scale / fit.scale)


def test_the_pose_follows_the_scale_by_its_covariance(known, fit):
    centre = known.scan.bounds.mean(0)
    bare = replace(fit, covariance=np.diag([1e-6] * 3 + [4e-8] * 3 + [4e-6]))
    joined = conditioned(bare, known.scan, 1.003 * fit.scale, 1e-3 * fit.scale)
    where = [se3.transform(f.T_world_obj, f.scale * centre).reshape(3) for f in (bare, joined)]
    np.testing.assert_allclose(where[0], where[1], atol=1e-12)  # uncorrelated: it grows in place
    tied = conditioned(fit, known.scan, 1.003 * fit.scale, 1e-3 * fit.scale)
    moved = se3.transform(tied.T_world_obj, tied.scale * centre).reshape(3) - where[0]
    step = np.log(tied.scale / fit.scale) * fit.covariance[3:6, 6] / fit.covariance[6, 6]
    np.testing.assert_allclose(fit.T_world_obj[:3, :3].T @ moved, step, atol=1e-9)
    assert np.linalg.eigvalsh(tied.covariance)[0] > 0
    assert tied.covariance[6, 6] < fit.covariance[6, 6]


@pytest.mark.slow
def test_right_pairs_are_rarely_called_wrong_and_wrong_ones_are_seen(known, fit):
    rng = np.random.default_rng(0)
    exact = replace(fit, residual_mm=np.zeros_like(fit.residual_mm))
    right, seen, draws = 0, 0, 200
    for _ in range(draws):
        off = 1 + exact.sigma / exact.scale * rng.standard_normal()
        m = measured(known, "x")
        noisy = replace(m, value_m=m.value_m + m.sigma_m * rng.standard_normal())
        drawn = replace(exact, scale=off * exact.scale)
        right += compare(drawn, known.scan, noisy).agrees
        seen += not compare(drawn, known.scan, replace(noisy, value_m=1.05 * noisy.value_m)).agrees
    assert 0.97 <= right / draws <= 1.0 and right < draws  # 99 % expected
    assert seen / draws > 0.9
