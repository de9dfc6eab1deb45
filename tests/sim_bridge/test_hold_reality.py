"""p_hold: laws of its calibration, and of how it is judged by real trials."""

from dataclasses import replace
from unittest.mock import Mock, call

import numpy as np
import pytest

from graspa_folders import box_grasps, write_graspa
from realsim.formats.grasps.graspa import read_graspa
from realsim.untrusted.own_json import read_own
from realsim_sim_bridge.hold.calibration import (
    SHIPPED,
    Calibration,
    evidence_of,
    fitted_curve,
    left_out,
    shipped,
)
from realsim_sim_bridge.hold.draws import HoldConfig
from realsim_sim_bridge.hold.reality import (
    Judged,
    RealityConfig,
    calibrate,
    expected_calibration_error,
    judge_trials,
    reality_of,
)
from refusals import refused

# --- calibration ----------------------------------------------------------------------------------


def test_the_shipped_calibration_is_read_and_grows_with_evidence(tmp_path):
    found, evidence = shipped(), np.linspace(0.0, 1.0, 101)
    assert found.trials == 330 == sum(r.trials for r in found.reliability)
    assert len(found.objects) == 8 and found.held_share == pytest.approx(0.642, abs=1e-3)
    p = found.p_hold(evidence)
    assert np.all(np.diff(p) >= 0) and 0 < p[0] < p[50] < p[-1] < 1
    assert np.isnan(found.p_hold(np.array([np.nan]))).all()
    inside, h = np.linspace(0.1, 0.9, 9), 1e-4
    slope = (found.p_hold(inside + h) - found.p_hold(inside - h)) / (2 * h)
    np.testing.assert_allclose(found.error(inside, np.full(9, 0.01)), 0.01 * slope, rtol=0.03)
    ends = found.error(np.array([0.0, 1.0]), np.full(2, 1 / 17))
    assert np.all((ends > 0) & (ends < 0.1))  # sixteen draws alike are no reason for doubt
    found.write(tmp_path / "again.json")
    assert read_own(tmp_path / "again.json", Calibration) == found == read_own(SHIPPED, Calibration)
    np.testing.assert_allclose(evidence_of(np.array([0.5]), np.array([1.0]), 3), 0.625)


def synthetic(n, seed, intercept=0.8, slope=0.6):
    rng = np.random.default_rng(seed)
    evidence = rng.uniform(0.03, 0.97, n)
    p = 1 / (1 + np.exp(-intercept - slope * np.log(evidence / (1 - evidence))))
    return evidence, rng.random(n) < p


def test_a_known_curve_is_found_again():
    evidence, held = synthetic(20000, 0)
    np.testing.assert_allclose(fitted_curve(evidence, held), [0.8, 0.6], atol=0.06)


def test_a_left_out_object_has_no_say_in_its_own_curve():
    evidence, held = synthetic(400, 1)
    groups = np.array(["a", "b", "c", "d"])[np.arange(400) % 4]
    told, lies = left_out(evidence, held, groups), np.where(groups == "b", ~held, held)
    other = left_out(evidence, lies, groups)
    np.testing.assert_array_equal(other[groups == "b"], told[groups == "b"])
    assert np.all(other[groups != "b"] != told[groups != "b"])


def test_trials_that_cannot_calibrate_are_named():
    evidence, held = synthetic(200, 2)
    for alike in (np.ones(200, dtype=bool), np.zeros(200, dtype=bool)):
        refused("200 trials ended alike", fitted_curve, evidence, alike)
    refused("more evidence held less often", fitted_curve, 1 - evidence, held)
    refused("of 2 objects; 3 or more", calibrate, judged(held, evidence, kinds=2), "made up")
    fit = calibrate(judged(held, evidence, kinds=4), "made up")
    assert (fit.trials, len(fit.objects), fit.held_share) == (200, 4, held.mean())


# --- judged by trials -----------------------------------------------------------------------------


def judged(held, evidence, kinds=2, **columns):
    n = len(held)
    return Judged(
        held=held, objects=np.array([f"object {k % kinds}" for k in range(n)]), evidence=evidence,
        columns={"score_old": evidence, **columns}, shares={}, digest="none", engine="made up",
    )  # fmt: skip


def row_of(found, name):
    return next(row for row in found.rows if row.name == name)


def slow_auc(values, held):
    a, b = values[held][:, None], values[~held]
    return np.mean((a > b) + 0.5 * (a == b))


def slow_precision(values, held):
    levels, found, before = sorted(set(values), reverse=True), 0.0, 0.0
    for level in levels:
        chosen = values >= level
        recall = held[chosen].sum() / held.sum()
        found, before = found + (recall - before) * held[chosen].mean(), recall
    return found


@pytest.mark.parametrize("seed", range(4))
def test_auc_and_average_precision_are_those_of_slow_formulas_with_ties(seed):
    rng = np.random.default_rng(seed)
    held = rng.random(60) < 0.6
    values = np.round(rng.normal(size=60) + held, 0)
    values[rng.random(60) < 0.2] = -np.inf
    values[rng.random(60) < 0.1] = np.inf
    shuffle = rng.permutation(60)
    for order in (np.arange(60), shuffle, np.argsort(held), np.roll(shuffle, 7)):
        found = reality_of(judged(held[order], np.full(60, 0.5), some=values[order]))
        row = row_of(found, "some")
        assert row.auc == pytest.approx(slow_auc(values, held))
        assert row.average_precision == pytest.approx(slow_precision(values, held))
    halves = [np.flatnonzero(np.arange(60) % 2 == k) for k in (0, 1)]  # the last order's objects
    v, h = values[order], held[order]
    weights = [h[rows].sum() * (~h[rows]).sum() for rows in halves]
    pairs = zip(halves, weights, strict=True)
    told = [slow_auc(v[rows], h[rows]) if weight else 0.0 for rows, weight in pairs]
    assert row.within == pytest.approx(np.average(told, weights=weights))
    always = row_of(found, "always holds")
    assert always.auc == 0.5 and always.average_precision == pytest.approx(held.mean())
    assert np.isnan(always.within)


def test_the_identity_predictor_knows_an_objects_other_trials_alone():
    """Object 0 held in 3 of 4 trials, object 1 in 1 of 4: each trial is told by the other three."""
    held = np.array([1, 0, 1, 0, 1, 1, 0, 0], dtype=bool)  # objects by turns
    found = reality_of(judged(held, np.full(8, 0.5)))
    row = row_of(found, "object")
    told = np.array([2, 1, 2, 1, 2, 0, 3, 1]) / 3
    assert row.auc == pytest.approx(slow_auc(told, held))


def test_the_calibration_error_is_the_bins_distance():
    p, held = np.array([0.05, 0.15, 0.18, 1.0]), np.array([False, True, False, True])
    told = (0.05 * 1 + abs(0.165 - 0.5) * 2 + 0.0) / 4
    assert expected_calibration_error(p, held) == pytest.approx(told)
    # Told by a calibration that is true, nothing is left but chance.
    evidence, held = synthetic(20000, 3)
    p = 1 / (1 + np.exp(-0.8 - 0.6 * np.log(evidence / (1 - evidence))))
    assert expected_calibration_error(p, held) < 0.02


def test_intervals_are_by_object_and_need_three():
    evidence, held = synthetic(120, 4)
    few = reality_of(judged(held, evidence, kinds=2))
    assert np.isnan([few.rows[0].auc_low, few.gain_low]).all() and np.isfinite(few.rows[0].auc)
    many = reality_of(judged(held, evidence, kinds=6))
    row = many.rows[0]
    assert row.auc_low < row.auc < row.auc_high
    rng, aucs = np.random.default_rng(0), []
    for _ in range(2000):  # whole objects, drawn with replacement
        rows = np.concatenate([np.arange(k, 120, 6) for k in rng.integers(0, 6, 6)])
        aucs.append(slow_auc(evidence[rows], held[rows]))
    np.testing.assert_allclose([row.auc_low, row.auc_high], np.percentile(aucs, (2.5, 97.5)))
    assert (many.gain, many.gain_low, many.gain_high) == (0.0, 0.0, 0.0)  # the same predictor
    own = replace(shipped(), digest="none")
    data = judged(held, evidence, kinds=6)
    inside = reality_of(data, own)
    assert inside.in_sample and not many.in_sample
    np.testing.assert_array_equal(inside.p_hold, left_out(evidence, held, data.objects))


def test_good_and_bad_grasps_of_a_box_are_told_apart(tmp_path):
    write_graspa(tmp_path, "wooden_box", *box_grasps())
    objects, progress = read_graspa(tmp_path), Mock()
    found = judge_trials(objects, RealityConfig(hold=HoldConfig(draws=4)), progress=progress)
    assert progress.mock_calls == [call(8, 8)] and found.engine == "pybullet"
    reality = reality_of(found)
    auc = {row.name: row.auc for row in reality.rows}
    assert {row.within for row in reality.rows if row.name == "score"} == {1.0}
    assert auc["p_hold"] == auc["score"] == auc["draws"] == auc["safety"] == 1.0
    assert np.isnan(reality.gain_low)
    told = found.evidence + 4 / 5 * sum(found.shares[f"share_{n}"] for n in
                                        ("blocked", "missed", "skewed", "overloaded"))  # fmt: skip
    np.testing.assert_allclose(told, (4 + found.columns["score"]) / 5)
    (note,) = found.notes
    assert "wooden_box was not weighed: 1000 kg/m^3 make 0.096 kg" in note and "--weighed" in note

    flipped = [replace(objects[0], held=~objects[0].held)]
    config = RealityConfig(hold=HoldConfig(draws=2))
    assert judge_trials(flipped, config).digest != found.digest
    refused("no trials to judge by", judge_trials, [], config)
