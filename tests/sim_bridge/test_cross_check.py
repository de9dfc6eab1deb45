"""Two engines' verdicts on the same grasps, and the interval of their agreement."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from held_boxes import held_box, held_from_above
from realsim.geometry.hand import HandGeometry
from realsim.records import MEASURES, GraspSet
from realsim_sim_bridge.school.cross_check import (
    agreement,
    agreement_of,
    cross_check,
    wilson_interval,
)
from realsim_sim_bridge.slip.engines import make_engine, settings_of
from realsim_sim_bridge.slip.score import ScoreLimits, score_stages
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.world import SlipPhysics


def trial(off_m, mass=0.3):
    return held_from_above(held_box(mass, length=0.14), off_m)


def checked(t, physics, second):
    config = SlipConfig(physics=physics)
    slips = run_slip_test(t, config)
    engine = make_engine(settings_of(second))
    return slips, cross_check(t, slips, config, ScoreLimits(), HandGeometry(), engine)


# --- the interval ---------------------------------------------------------------------------


@given(st.integers(1, 2000), st.data())
def test_an_interval_holds_its_share_and_mirrors_with_the_label(n, data):
    k = data.draw(st.integers(0, n))
    low, high = wilson_interval(k, n)
    assert 0.0 <= low <= k / n <= high <= 1.0
    mirrored = wilson_interval(n - k, n)
    assert mirrored == pytest.approx((1 - high, 1 - low), abs=1e-12)


def test_known_intervals():
    # Newcombe, Statistics in Medicine 17 (1998), table I: Wilson's method without correction.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson_interval(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson_interval(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_the_interval_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(0)
    for p in (0.5, 0.9, 0.97):
        k = rng.binomial(120, p, 2000)
        inside = [low <= p <= high for low, high in (wilson_interval(int(i), 120) for i in k)]
        assert 0.92 < np.mean(inside) < 0.98


# --- the agreement of labels ----------------------------------------------------------------


def test_labels_are_counted_and_what_one_did_not_judge_is_left_out():
    first = np.array([1.0, 1.0, 0.25, 0.0, np.nan, 1.0, 2 / 3])
    second = np.array([1.0, 0.5, 0.25, 1.0, 1.0, np.nan, 7 / 12])
    found = agreement(first, second)
    assert (found.count, found.both_held, found.only_first, found.only_second, found.both_lost) == (
        5, 1, 1, 1, 2,
    )  # fmt: skip
    assert found.share == 0.6 and found.interval == wilson_interval(3, 5)
    assert found.same_score == 2
    assert found.mean_confidence == pytest.approx(np.mean([1, 0.5, 1, 0, 1 - 1 / 12]))


def test_agreement_does_not_depend_on_which_engine_is_first():
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 13, (2, 200)) / 12
    there, back = agreement(a, b), agreement(b, a)
    assert there.share == back.share and there.mean_confidence == back.mean_confidence
    assert (there.only_first, there.only_second) == (back.only_second, back.only_first)


def test_nothing_to_compare_is_no_agreement():
    found = agreement(np.zeros(0), np.zeros(0))
    assert found.count == 0 and np.isnan(found.share) and found.interval == (0.0, 1.0)


def test_the_sets_that_were_checked_are_put_together():
    def a_set(scores, second):
        n = len(scores)
        return GraspSet(
            obj_id=1, instance=0, Ts_obj_grasp=np.repeat(np.eye(4)[None], n, 0),
            widths_m=np.full(n, 0.05), scores=scores, base_scores=np.floor(scores * 4) / 4,
            slip_m=np.zeros((n, 4)), slip_rad=np.zeros((n, 4)), reachable=np.ones(n, dtype=bool),
            failures=("",) * n, measures={} if second is None else {"second_score": second},
        )  # fmt: skip

    sets = [
        a_set(np.array([1.0, 0.0]), np.array([1.0, 1.0])),
        a_set(np.array([1.0]), np.array([1.0])),
        a_set(np.array([1.0]), None),
    ]
    assert agreement_of(sets) == agreement(np.array([1.0, 0, 1]), np.array([1.0, 1, 1]))


# --- the engines ----------------------------------------------------------------------------


def test_an_engine_agrees_with_itself():
    slips, found = checked(trial([0.0, 0.055]), SlipPhysics(force_n=5.0, friction=0.4), "pybullet")
    tried = np.ones(2, dtype=bool)
    base, score = score_stages(slips.slip_m, slips.slip_rad, tried, ScoreLimits())
    assert np.array_equal(found["second_score"], score)
    assert np.array_equal(found["second_base_score"], base)
    assert np.array_equal(found["second_slip_m"], slips.slip_m, equal_nan=True)
    assert np.all(found["confidence"] == 1.0)
    assert 0.0 <= score[1] < score[0] == 1.0  # both labels occur


def test_two_engines_agree_on_a_box_that_coulomb_s_law_decides():
    mujoco = pytest.importorskip("mujoco")
    assert mujoco
    # 2 mu F against 2.9 N of weight: 28 N hold; with 0.4 N, and with all weight 6 cm beside the
    # pads, the box falls or turns.
    strong = checked(trial([0.0, 0.02]), SlipPhysics(force_n=70.0, friction=0.2), "mujoco")[1]
    weak = checked(trial([0.0, 0.055]), SlipPhysics(force_n=1.0, friction=0.2), "mujoco")[1]
    assert np.all(strong["second_score"] == 1.0) and np.all(strong["confidence"] == 1.0)
    assert np.all(weak["second_score"] < 0.5) and np.all(weak["confidence"] > 0.8)


def test_every_measure_has_its_name_and_shape():
    found = checked(trial([0.0, 0.01, 0.02]), SlipPhysics(), "pybullet")[1]
    for name, values in found.items():
        assert values.shape == ((3, 4) if MEASURES[name].by_stage else (3,)), name
