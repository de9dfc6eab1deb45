"""Figures of a report, and limits on them."""

import math
from pathlib import Path

import numpy as np
import pytest

from realsim.app.register.uncertainty import held, sigmas
from realsim.app.report.figures import (
    Figure,
    count,
    figures_from_json,
    figures_to_json,
    share,
    shown,
)
from realsim.app.report.run import broken, limit_of, read_limits
from realsim.geometry.parts import part
from refusals import refused

NAME = "calibration.held_out_px"


def test_figures_survive_the_round_trip_through_json() -> None:
    figures = {
        f.name: f
        for f in (
            Figure(name=NAME, value=0.1 + 0.2, sigma=1e-3),
            Figure(name="plan.tour_s", value=33.0),
            count("capture.views", 24),
        )
    }
    assert figures_from_json(figures_to_json(figures)) == figures


def test_a_figure_that_nobody_knows_or_that_is_no_number_is_refused() -> None:
    refused("no figure", Figure, name="calibration.nonsense", value=1.0)
    refused("a number is needed", Figure, name=NAME, value=math.nan)
    for given, why in (
        ({NAME: {"value": "much", "sigma": None}}, rf"figures.{NAME}'.value is 'much'"),
        ({NAME: {"value": 1, "sigma": None, "unit": "mm"}}, "unit 'mm'; 'px' is expected"),
        ({"a": {"b": 1}}, r"'figures\.a'\.value"),
    ):
        refused(why, figures_from_json, given)
    # A name of a newer version is no reason to refuse the rest.
    assert figures_from_json({"future.figure": {"value": 1, "sigma": None}}) == {}


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (646.835, 0.0111, "646.835 ± 0.011"), (24.0, 0.0, "24"), (0.12345678, None, "0.1235"),
        (1234.5, 23.0, "1234 ± 23"), (-0.000268, 8.7e-6, "-0.0002680 ± 0.0000087"),
    ],
)  # fmt: skip
def test_a_value_is_shown_to_the_digits_its_sigma_allows(
    value: float, sigma: float | None, text: str
) -> None:
    assert shown(value, sigma) == text


def test_the_sigma_of_a_share_is_the_spread_of_such_shares() -> None:
    rng = np.random.default_rng(3)
    n, p = 200, 0.3
    seen = rng.binomial(n, p, 4000)
    mean = np.mean([share("school.good_share", int(k), n).sigma or 0.0 for k in seen])
    assert mean == pytest.approx(np.std(seen / n), rel=0.04)
    # Where all did, the next one may not: the sigma is not 0.
    assert (share("school.good_share", 5, 5).sigma or 0.0) > 0.1


# --- limits -----------------------------------------------------------------------------------


def test_a_limit_that_is_exactly_met_is_kept_and_the_next_number_breaks_it() -> None:
    at = {NAME: Figure(name=NAME, value=0.25)}
    for rule, beyond in ((f"{NAME}>0.25", np.nextafter(0.25, 1)), (f"{NAME}<0.25", 0.2499)):
        assert not list(broken([limit_of(rule)], at))
        told = list(broken([limit_of(rule)], {NAME: Figure(name=NAME, value=float(beyond))}))
        assert len(told) == 1 and NAME in told[0]


def test_a_limit_on_what_is_not_there_is_broken() -> None:
    assert "not there" in next(broken([limit_of("registration.accepted<1")], {}))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("nonsense = {max = 1}", "calibration.held_out_px"),  # the known ones are listed
        ("calibration.held_out_px = 3", "no limit"),
        ('calibration.held_out_px = {max = "much"}', "no number"),
        ("calibration.held_out_px = {min = 2, max = 1}", "min above max"),
        ("calibration.held_out_px = {most = 2}", "no figure"),
        ("", "names no figure"), ("= 3", "not TOML"),
    ],
)  # fmt: skip
def test_a_file_of_limits_that_says_something_else_is_refused(
    tmp_path: Path, text: str, named: str
) -> None:
    path = tmp_path / "limits.toml"
    path.write_text(text)
    refused(named, read_limits, path)


@pytest.mark.parametrize("rule", ["held_out", "plan.views<=3", "nothing<3", "plan.views<inf"])
def test_a_rule_that_cannot_be_read_is_refused(rule: str) -> None:
    refused(".", limit_of, rule)


# --- uncertainty ------------------------------------------------------------------------------


def test_holding_is_conditioning_and_never_adds_uncertainty() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    C, u = A @ A.T, np.array([1.0, 2.0, 2.0]) / 3
    tight = held(C, [u])
    assert np.linalg.eigvalsh(C - tight)[0] > -1e-9
    np.testing.assert_allclose(np.concatenate([u, np.zeros(3)]) @ tight, 0, atol=1e-9)
    np.testing.assert_allclose(held(C, [u, 2 * u]), tight, atol=1e-9)  # the same axis twice
    np.testing.assert_allclose(held(C, []), C)
    # Of a ball nothing is left of the rotation; the place, given the rotation, remains.
    ball = held(C, [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(ball[:3], 0, atol=1e-9)
    given = C[3:, 3:] - C[3:, :3] @ np.linalg.inv(C[:3, :3]) @ C[:3, 3:]
    np.testing.assert_allclose(ball[3:, 3:], given, atol=1e-9)


def covariance(rng: np.random.Generator, axis: np.ndarray, free_rad: float) -> np.ndarray:
    """A well-known pose (0.1 mm, 0.05 deg) but for a turn about an axis."""
    small = np.concatenate([np.full(3, np.radians(0.05)), np.full(3, 1e-4)])
    Q, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    C = np.diag(small) @ Q @ np.diag(rng.uniform(0.5, 1.0, 6)) @ Q.T @ np.diag(small)
    free = np.concatenate([axis, np.zeros(3)])
    return C + free_rad**2 * np.outer(free, free)


def test_a_free_turn_is_set_aside_even_where_the_declared_axis_is_two_degrees_off() -> None:
    rng = np.random.default_rng(0)
    declared = np.array([0.0, 0.0, 1.0])
    for _ in range(20):
        tilt = np.radians(2.0)
        a = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)])
        C = covariance(rng, axis, free_rad=0.5)
        tight = held(C, [declared])
        worst = np.degrees(np.sqrt(np.linalg.eigvalsh(tight[:3, :3])[-1]))
        assert worst < 0.06, worst
        # The projection of the marginal leaves sin(2 deg) of the free turn's 29 deg.
        P = np.eye(3) - np.outer(declared, declared)
        assert np.degrees(np.sqrt(np.linalg.eigvalsh(P @ C[:3, :3] @ P)[-1])) > 0.5


def test_a_free_turn_is_no_uncertainty_and_what_is_unknown_is_nan() -> None:
    C = np.diag([1e-3, 2e-3, 0.5, 1e-4, 2e-4, 3e-4]) ** 2
    tube = part("tube")  # turns about its z axis
    assert sigmas(C, tube) == pytest.approx((0.3, np.degrees(2e-3)))
    assert sigmas(C, None)[1] == pytest.approx(np.degrees(0.5))
    assert np.isnan([*sigmas(None, tube), *sigmas(np.full((6, 6), np.nan), None)]).all()
