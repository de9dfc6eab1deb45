"""Two engines' verdicts on the same grasps, and the interval of their agreement."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from held_boxes import held_box, held_from_above
from realsim.robots.hand import find_hand
from realsim_sim_bridge.school.cross_check import agreement, cross_check, wilson_interval
from realsim_sim_bridge.slip.engines import make_engine, settings_of
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.world import SlipPhysics


def checked(off_m, **physics):
    """Return what MuJoCo says of Bullet's verdicts on grasps beside the middle of a bar."""
    trial = held_from_above(held_box(0.3, length=0.14), off_m)
    config = SlipConfig(physics=SlipPhysics(**physics))
    slips, engine = run_slip_test(trial, config), make_engine(settings_of("mujoco"))
    return cross_check(trial, slips, config, ScoreLimits(), find_hand(), engine)


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
    alone = found.both_held, found.only_first, found.only_second, found.both_lost
    assert found.count == 5 and alone == (1, 1, 1, 2)
    assert found.share == 0.6 and found.interval == wilson_interval(3, 5)
    assert found.same_score == 2
    assert found.mean_confidence == pytest.approx(np.mean([1, 0.5, 1, 0, 1 - 1 / 12]))


# --- the engines ----------------------------------------------------------------------------


def test_two_engines_agree_on_a_box_that_coulomb_s_law_decides():
    pytest.importorskip("mujoco")
    # 2 mu F against 2.9 N of weight: 28 N hold; with 0.4 N, and with all weight 6 cm beside the
    # pads, the box falls or turns.
    strong = checked([0.0, 0.02], force_n=70.0, friction=0.2)
    weak = checked([0.0, 0.055], force_n=1.0, friction=0.2)
    assert np.all(strong["second_score"] == 1.0) and np.all(strong["confidence"] == 1.0)
    assert np.all(weak["second_score"] < 0.5) and np.all(weak["confidence"] > 0.8)
