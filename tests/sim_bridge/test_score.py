"""The score: the paper's formula, and that it follows from what is stored alone."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim_sim_bridge.school import ScoreLimits, recompute_scores
from realsim_sim_bridge.slip.score import limits_of, score_paper, score_stages
from tried_grasps import plain_grasps

NAN, INF = np.nan, np.inf
TEN = np.radians(10.0)


def one(slip_m, slip_rad=(0.0, 0.0, 0.0, 0.0), tried=True):
    base, score = score_stages(
        np.array([slip_m], dtype=float),
        np.array([slip_rad], dtype=float),
        np.array([tried]),
        ScoreLimits(),
    )
    return float(base[0]), float(score[0])


@pytest.mark.parametrize(
    ("slip_m", "slip_rad", "base", "score"),
    [
        ((0, 0, 0, 0), (0, 0, 0, 0), 1.0, 1.0),
        ((0.02, 0.02, 0.02, 0.02), (TEN,) * 4, 1.0, 1.0),
        ((0.021, 0, 0, 0), (3.0, 0, 0, 0), 1.0, 1.0),
        ((INF, NAN, NAN, NAN), (INF, NAN, NAN, NAN), 0.0, 0.0),
        ((0, 0.03, NAN, NAN), (0, 0, NAN, NAN), 0.25, 0.25 - 1 / 12),
        ((0, INF, NAN, NAN), (0, INF, NAN, NAN), 0.25, 0.25 - 2 / 12),
        ((0, 0, 0.03, NAN), (0, 0, TEN * 1.1, NAN), 0.5, 0.5 - 2 / 12),
        ((0, 0, 0, 0.03), (0, 0, 0, 0), 0.75, 0.75 - 1 / 12),
        ((0, 0, 0, 0), (0, 0, 0, TEN * 1.1), 0.75, 0.75 - 1 / 12),
        ((NAN,) * 4, (NAN,) * 4, 0.0, 0.0),
    ],
)
def test_the_formula_at_known_slips(slip_m, slip_rad, base, score):
    assert one(slip_m, slip_rad) == pytest.approx((base, score))


def test_the_papers_rule_has_limits_in_closing_and_no_penalty_besides():
    """0.25 a stage in a row, so the table's 0.50 occurs; what a stricter limit hides is unknown."""
    slip_m = np.array(
        [(0, 0, 0, 0), (0, 0, 0, INF), (0, 0, 0.03, NAN), (0, INF, NAN, NAN), (0.021, 0, 0, 0),
         (0, 0, 0, 0), (NAN,) * 4, (0, 0.006, NAN, NAN)]
    )  # fmt: skip
    slip_rad = np.where(np.isfinite(slip_m), 0.0, slip_m)
    slip_rad[5, 0] = 1.1 * TEN
    tried = np.ones(len(slip_m), dtype=bool)
    expected = [1.0, 0.75, 0.5, 0.25, 0.0, 0.0, 0.0, NAN]
    np.testing.assert_array_equal(score_paper(slip_m, slip_rad, tried), expected)
    assert np.isnan(score_paper(slip_m, slip_rad, ~tried)).all()
    asked = replace(ScoreLimits(), close_slip_m=0.02)
    assert score_stages(slip_m, slip_rad, tried, asked)[1][4:6].tolist() == [0.0, 1.0]


def test_old_files_are_scored_by_the_rule_that_made_them():
    new = ScoreLimits(slip_m=0.01)
    stored = {"config": {"score": asdict(new)}}
    assert limits_of(stored) == new
    for name in ("close_slip_m", "close_slip_deg"):
        del stored["config"]["score"][name]
    assert limits_of(stored) == replace(new, close_slip_m=0.01, close_slip_deg=10.0)
    assert "closing only where" in new.rule() and "0.01 m" in limits_of(stored).rule()


def test_a_grasp_that_was_not_tried_has_no_score():
    assert all(np.isnan(x) for x in one((NAN,) * 4, (NAN,) * 4, tried=False))


def test_scores_lie_in_the_unit_interval_and_never_rise_with_slip():
    rng = np.random.default_rng(0)
    slip_m, slip_rad = rng.exponential(0.01, (500, 4)), rng.exponential(TEN / 2, (500, 4))
    tried = np.ones(500, dtype=bool)
    _, score = score_stages(slip_m, slip_rad, tried, ScoreLimits())
    _, worse = score_stages(2 * slip_m, slip_rad, tried, ScoreLimits())
    assert np.all((score >= 0) & (score <= 1))
    assert np.all(worse <= score) and np.any(worse < score)


def stored(slip_m, reachable, scores):
    return plain_grasps(
        len(slip_m),
        scores=scores,
        base_scores=scores,
        slip_m=slip_m,
        slip_rad=np.where(np.isnan(slip_m), NAN, 0.0),
        reachable=reachable,
        parameters={"config": {"score": asdict(ScoreLimits())}},
    )


def test_a_set_from_elsewhere_is_refused():
    grasp_set = replace(stored([[0, 0, 0, 0]], [True], [1.0]), parameters={})
    with pytest.raises(InputError, match=r"config\.score"):
        recompute_scores(grasp_set)
