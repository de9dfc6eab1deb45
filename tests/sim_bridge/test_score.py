"""The score: the paper's formula, and that it follows from what is stored alone."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.records import GraspSet
from realsim_sim_bridge.school import ScoreLimits, recompute_scores
from realsim_sim_bridge.slip.score import score_stages

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
        ((0.021, NAN, NAN, NAN), (0, NAN, NAN, NAN), 0.0, 0.0),
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
    n = len(slip_m)
    return GraspSet(
        obj_id=1,
        instance=0,
        Ts_obj_grasp=np.tile(np.eye(4), (n, 1, 1)),
        widths_m=np.full(n, 0.05),
        scores=scores,
        base_scores=scores,
        slip_m=slip_m,
        slip_rad=np.where(np.isnan(slip_m), NAN, 0.0),
        reachable=reachable,
        failures=("",) * n,
        parameters={"config": {"score": asdict(ScoreLimits())}},
    )


def test_a_set_from_elsewhere_is_refused():
    grasp_set = replace(stored([[0, 0, 0, 0]], [True], [1.0]), parameters={})
    with pytest.raises(InputError, match=r"config\.score"):
        recompute_scores(grasp_set)
