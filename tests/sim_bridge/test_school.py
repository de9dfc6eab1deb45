"""Robot School as a whole: sets, resumption, and the objects that cannot be tried.

The School's summary: its rows sum exactly, and they are the paper's rows.
"""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import entropy, spearmanr

from realsim.formats.grasps.scene_grasps import untried_set
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.records.grasps import MEASURES
from realsim_sim_bridge.school import recompute_scores, run_school, run_school_results
from realsim_sim_bridge.school.measure_statistics import (
    LEAST_GRASPS,
    p_hold_entropy_bits,
    p_hold_spread,
    spearman,
)
from realsim_sim_bridge.school.summary import OUTCOMES, outcomes_of, summarise
from realsim_sim_bridge.slip.score import ScoreLimits, limits_of, score_paper, score_stages
from refusals import refused
from school_scenes import CONFIG, at, model, scene
from tried_grasps import assert_same, plain_grasps

NAN, INF, TEN = np.nan, np.inf, np.radians(10.0)


@pytest.fixture(scope="module")
def one_result():
    return run_school_results(scene(at(0, 0)), {1: model()}, CONFIG, workers=1)[0]


@pytest.fixture(scope="module")
def one_set(one_result):
    return one_result.grasp_set


def test_a_box_gets_good_grasps_and_scores_that_follow_from_the_set(one_set):
    assert len(one_set) == 6 and one_set.good.sum() >= 2
    base, scores = recompute_scores(one_set)
    assert np.array_equal(scores, one_set.scores) and np.array_equal(base, one_set.base_scores)
    assert all(bool(f) == (s < 1) for f, s in zip(one_set.failures, one_set.scores, strict=True))
    assert np.all(one_set.scores[~one_set.reachable] == 0)
    stand = one_set.parameters["stand"]
    assert stand["table_height_m"] == pytest.approx(0.0, abs=1e-9)
    assert stand["neighbour_parts"] == 0 and "lost or a finger" in one_set.parameters["score_rule"]


def test_the_same_scene_elsewhere_in_the_world_gives_the_same_grasps(one_set):
    T = se3.exp([0.3, -0.2, 1.0, 0.5, 0.1, 0.4])
    there = replace(at(0, 0), T_world_obj=T @ at(0, 0).T_world_obj)
    moved = replace(scene(there), plane=SupportPlane(T_world_table=T))
    again = run_school(moved, {1: model()}, CONFIG, workers=1)[0]
    assert np.allclose(again.Ts_obj_grasp, one_set.Ts_obj_grasp, atol=1e-9)
    assert np.array_equal(again.reachable, one_set.reachable)


def test_every_grasp_that_was_tested_has_a_trajectory_and_measures(one_result):
    grasp_set, trajectories = one_result.grasp_set, one_result.trajectories
    assert np.array_equal(trajectories.rows, np.flatnonzero(grasp_set.reachable))
    joints = np.array(grasp_set.parameters["joints_rad"], dtype=float)
    for row in trajectories.rows:
        ways = trajectories.joints_rad[trajectories.attempt(row)]
        assert np.abs(ways - joints[row]).max(axis=1).min() < 1e-6
    found = list(grasp_set.measures)
    assert found == [name for name in MEASURES if name in found]
    wanted = {"force_n", "duration_s", "ferrari_canny", "closure_friction", "dexnet_closure"}
    assert wanted | {"score_paper", "p_hold"} <= set(found)
    # What is sure was not simulated: its slip is exactly 0.
    executed = grasp_set.slip_m > 0
    assert np.all(grasp_set.measures["force_n"][executed & (grasp_set.slip_m < 1)] > 1)
    assert np.all(np.isnan(grasp_set.measures["duration_s"][~executed]))
    assert one_result.unfinished == ()


def test_a_second_run_takes_everything_from_the_cache(tmp_path, one_result):
    def run():
        seen = []
        result = run_school_results(
            scene(at(0, 0)), {1: model()}, CONFIG, workers=1, cache=tmp_path,
            progress=lambda *report: seen.append(report),
        )[0]  # fmt: skip
        return result, seen

    first, seen = run()
    assert seen[0] == (0, 6) and seen[-1] == (6, 6)
    files = sorted(p.name for p in tmp_path.glob("instance_*"))
    assert files == ["instance_000000.grasps.npz"]
    made = (tmp_path / files[0]).stat().st_mtime_ns
    again, seen = run()
    assert seen == [(6, 6)] and (tmp_path / files[0]).stat().st_mtime_ns == made
    for result in (first, again):
        assert_same(result, one_result)
        assert list(result.grasp_set.measures) == list(one_result.grasp_set.measures)


def test_rejected_objects_are_obstacles_but_not_grasped():
    objects = scene(at(0, 0), at(0.06, 0, instance=1, verdict="rejected"))
    sets = run_school(objects, {1: model()}, CONFIG, workers=1)
    assert [s.instance for s in sets] == [0]
    assert sets[0].parameters["counts"]["hand_in_neighbour"] > 0
    stand = sets[0].parameters["stand"]
    assert stand["neighbour_parts"] == 1 and stand["neighbours_as_hulls"] == [1]


def test_objects_that_cannot_be_tried_say_why():
    boxes = model(1, density=1.0), model(2, density=1e6), model(3, size=0.3, density=100.0)
    models = {m.obj_id: m for m in boxes}
    objects = scene(at(0, 0), at(0.3, 0, 1, 2), at(-0.5, 0, 2, 3, 0.3))
    light, heavy, large = run_school(objects, models, CONFIG, workers=1)
    for grasp_set in (light, heavy):
        assert "kg is accepted" in grasp_set.parameters["not_tried"]
        assert len(grasp_set) and all("weighs" in f for f in grasp_set.failures)
        assert np.isnan(grasp_set.scores).all() and np.isnan(recompute_scores(grasp_set)[1]).all()
    assert len(large) == 0 and large.parameters["counts"]["too_wide"] > 0


def test_what_is_missing_is_named():
    bare = scene(at(0, 0), plane=False)
    refused("no supporting plane", run_school, bare, {1: model()}, CONFIG, workers=1)
    others = r"object 1 .* no model; there are: box2 \(2\)"
    refused(others, run_school, scene(at(0, 0)), {2: model(2)}, CONFIG, workers=1)


def scored_set(rng, n, *, obj_id=1, instance=0, **measures):
    """Return a set whose scores follow from its slips, as the School's do."""
    slip_m, slip_rad = rng.gamma(0.6, 0.012, (n, 4)), rng.gamma(0.6, 0.1, (n, 4))
    slip_m[rng.random((n, 4)) < 0.08] = np.inf
    slip_rad[np.isinf(slip_m)] = np.inf
    lost = np.cumsum(np.isinf(slip_m), axis=1) - np.isinf(slip_m) > 0
    reachable = rng.random(n) < 0.8
    slip_m[lost | ~reachable[:, None]] = slip_rad[lost | ~reachable[:, None]] = np.nan
    base, scores = score_stages(slip_m, slip_rad, np.ones(n, bool), ScoreLimits())
    return plain_grasps(
        se3.random_transform(rng, n) if n else 0, obj_id=obj_id, instance=instance, scores=scores,
        base_scores=base, slip_m=slip_m, slip_rad=slip_rad, reachable=reachable, measures=measures,
    )  # fmt: skip


def some_scenes(seed):
    rng = np.random.default_rng(seed)
    untried = untried_set(se3.random_transform(rng, 9), obj_id=9)
    return {
        "a": [scored_set(rng, int(rng.integers(0, 80)), obj_id=k, instance=k) for k in (1, 2, 3)],
        "b": [scored_set(rng, 50, obj_id=1), untried],
        "c": [],
    }


# --- laws -------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_every_candidate_is_in_exactly_one_row(seed):
    scenes = some_scenes(seed)
    sets = [s for part in scenes.values() for s in part]
    found = summarise(scenes)
    out = found.outcomes
    assert sum(out.values()) == found.candidates == sum(len(s) for s in sets)
    assert found.good == sum(int(s.good.sum()) for s in sets)
    assert found.good + found.bad + out["not_tried"] == found.candidates
    wrong = ("no_trajectory", "fail_close", "fail_lift", "penalized")
    assert found.bad == sum(out[name] for name in wrong)
    assert found.with_trajectory + out["no_trajectory"] == found.judged
    paper = found.by_paper
    assert sum(paper.outcomes.values()) == found.candidates and paper.outcomes["penalized"] == 0
    assert paper.with_trajectory == found.with_trajectory
    assert sum(found.penalized_by.values()) == out["penalized"]
    if found.judged:
        mean = found.share(found.good) * (found.score_good if found.good else 0)
        mean += found.share(found.bad) * (found.score_bad if found.bad else 0)
        assert mean == pytest.approx(found.score.mean)


# --- known answers ----------------------------------------------------------------------------


def by_hand(rows):
    """Return a set of (reachable, base, score, executed stages)."""
    reachable, base, scores, stages = (np.array(column) for column in zip(*rows, strict=True))
    slip = np.where(np.arange(4) < stages[:, None], 0.001, np.nan)
    return plain_grasps(
        len(rows), scores=scores, base_scores=base, slip_m=slip, slip_rad=slip, reachable=reachable
    )


def test_each_outcome_is_told_by_base_and_score():
    s = by_hand(
        [
            (False, NAN, NAN, 0), (False, 0.0, 0.0, 0), (True, 0.0, 0.0, 1), (True, 0.25, 0.0, 2),
            (True, 0.25, 0.25, 2), (True, 0.5, 0.5 - 1 / 12, 3), (True, 1.0, 0.25, 4),
            (True, 0.5, 0.5, 3), (True, 0.75, 0.75 - 2 / 12, 4), (True, 1.0, 1.0, 4),
            (False, 0.75, 0.75, 4),
        ]
    )  # fmt: skip
    named = [OUTCOMES[k] for k in outcomes_of(s)]
    assert named == [
        "not_tried", "no_trajectory", "fail_close", "fail_lift", "fail_lift", "penalized",
        "penalized", "fail_horizontal", "fail_pendulum", "full_success", "fail_pendulum",
    ]  # fmt: skip
    found = summarise([s])
    assert found.penalized_by == {"close": 0, "lift": 0, "oscillate": 1, "pendulum": 0, "none": 1}
    assert (found.judged, found.with_trajectory, found.good, found.bad) == (10, 9, 4, 6)
    assert found.score.mean == pytest.approx(np.nanmean(s.scores))
    assert found.score.sd == pytest.approx(np.nanstd(s.scores))


def test_impossible_scores_are_named():
    refused("at most its base score", outcomes_of, by_hand([(True, 0.5, 0.75, 3)]))
    refused("both are known or neither", outcomes_of, by_hand([(True, NAN, 0.75, 3)]))
    refused("a base score", outcomes_of, by_hand([(True, 0.6, 0.5, 3)]))


def test_rows_and_json_say_the_same():
    found = summarise(some_scenes(5))
    rows = {label: here for label, here, _ in found.to_rows()}
    data = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert rows["candidates"] == f"{data['candidates']:,}"
    for row, of in (("good (s >= 0.5)", data["by_paper"]), ("nominal score: good", data)):
        assert rows[row] == f"{of['good']:,} ({100 * of['shares']['good']:.2f} %)"
    published = {label: theirs for label, _, theirs in found.to_rows()}
    assert published["with trajectory"] == "2,014,689 (88.54 %)"
    assert published["good (s >= 0.5)"] == "1,887,185 (82.94 %)"
    assert published["full success (s = 1)"] == "835,903 (36.74 %)"
    assert published["fail close (s = 0)"] == "-"


# --- what was measured beside -----------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.integers(LEAST_GRASPS, 60))
@settings(max_examples=10, deadline=None)
def test_the_rank_correlation_is_scipys_ties_and_infinities_included(seed, n):
    rng = np.random.default_rng(seed)
    x = rng.integers(0, 5, n) / 4
    y = np.where(rng.random(n) < 0.2, np.inf, x + rng.normal(size=n).round(1))
    rho = spearman(x, y, np.random.default_rng(0))[0]
    ranks = np.where(np.isinf(y), 1e6, y)  # scipy drops no infinity, but its own ranks want numbers
    assert rho == pytest.approx(spearmanr(x, ranks).statistic, abs=1e-12, nan_ok=True)


def test_the_interval_holds_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(1)
    truth = 6 / np.pi * np.arcsin(0.6 / 2)  # Spearman's of a normal pair with correlation 0.6
    hits = 0
    for _ in range(30):
        x = rng.normal(size=40)
        y = 0.6 * x + 0.8 * rng.normal(size=40)
        _, low, high = spearman(x, y, rng)
        hits += low <= truth <= high
    assert hits >= 25  # 28.5 expected; 25 is below the 2nd percentile of a 95 % interval


def test_only_tried_grasps_are_compared_with_force_closure():
    rng = np.random.default_rng(3)
    s = scored_set(rng, 300)
    n = len(s)
    tried = ~np.isnan(s.slip_m[:, 0])
    closed = (rng.random(n) < 0.7).astype(float)
    closed[:10] = np.nan
    margin = np.where(tried, np.nan_to_num(s.scores) ** 2, np.nan)
    friction = np.where(rng.random(n) < 0.5, np.inf, 0.4)
    measures = {"margin": margin, "dexnet_closure": closed, "closure_friction": friction}
    s = replace(s, measures=measures)
    found = summarise([s])
    pair = next(c for c in found.correlations if (c.first, c.second) == ("score", "margin"))
    assert pair.rho == pytest.approx(1.0) and pair.grasps == int(tried.sum())
    known = tried & ~np.isnan(closed)
    c = found.closures[0]
    assert c.closure == "dexnet_closure" and c.grasps == int(known.sum())
    assert c.closed_good == int(np.sum(known & (closed == 1) & s.good))
    assert c.agree == pytest.approx(np.mean(s.good[known] == (closed[known] == 1)))
    closed_good, closed_bad = found.closures[1].closed_good, found.closures[1].closed_bad
    assert closed_good + closed_bad == int(np.sum(tried & np.isfinite(friction)))
    assert [c.friction for c in found.closures] == [None, 0.4]
    names = [name for name, _, _ in found.to_rows()]
    assert "dexnet_closure: closed: good, bad" in names
    assert "closure_friction: closed at some level up to 0.4: good, bad" in names
    assert found == summarise([s])  # the same draws


def test_the_entropy_of_p_hold_is_that_of_ten_equal_bins():
    rng = np.random.default_rng(0)
    s = scored_set(rng, 400)
    assert p_hold_spread([s]) is None and np.isnan(p_hold_entropy_bits([s]))

    def told(p):
        return replace(s, measures={"p_hold": np.asarray(p, dtype=np.float64)})

    assert p_hold_entropy_bits([told(np.full(400, 0.83))]) == 0.0
    assert p_hold_entropy_bits([told(np.arange(400) % 2)]) == pytest.approx(1.0)  # two bars
    even = told((np.arange(400) % 10) / 10 + 0.05)
    assert p_hold_entropy_bits([even, s]) == pytest.approx(np.log2(10))  # sets without one: none
    some = np.where(np.arange(400) < 100, np.nan, rng.random(400))
    spread = p_hold_spread([told(some)])
    assert spread.grasps == sum(spread.tenths) == 300
    assert spread.mean == pytest.approx(np.nanmean(some))
    counts = np.histogram(some[100:], 10, (0, 1))[0]
    assert spread.tenths == tuple(counts)
    assert spread.entropy_bits == pytest.approx(entropy(counts, base=2))
    rows = {name: here for name, here, _ in summarise([told(some)]).to_rows()}
    assert rows["p_hold: grasps, of few draws"] == "300, 0"
    assert rows["p_hold: grasps by tenths from 0"] == " ".join(map(str, counts))


def test_objects_of_one_number_and_other_meshes_are_different_objects():
    rng = np.random.default_rng(0)
    scenes = {
        name: [replace(scored_set(rng, 5, obj_id=1), parameters={"inputs": {"mesh": mesh}})]
        for name, mesh in zip("abc", ("one", "other", "one"), strict=True)
    }
    assert summarise(scenes).objects == 2


def test_hands_are_compared_on_the_objects_that_all_of_them_tried():
    rng = np.random.default_rng(1)

    def tried(hand, obj_id, n):
        of = {"config": {"hand": {"name": hand, "digest": ""}}}
        return replace(scored_set(rng, n, obj_id=obj_id), parameters=of)

    franka = [tried("franka_hand", i, 30) for i in (1, 2)]
    robotiq = [tried("robotiq_2f85", i, 20) for i in (2, 3)]
    assert summarise({"a": franka}).hands == ()
    found = summarise({"a": franka, "b": robotiq})
    assert [(h.hand, h.objects) for h in found.hands] == [("franka_hand", 1), ("robotiq_2f85", 1)]
    for h, s in zip(found.hands, (franka[1], robotiq[0]), strict=True):
        scores = s.scores[~np.isnan(s.scores)]
        assert (h.judged, h.good) == (len(scores), int(np.sum(scores >= 0.5)))
        assert h.score == pytest.approx(scores.mean())
    assert any(name.startswith("robotiq_2f85, on the 1 objects") for name, _, _ in found.to_rows())


# --- The score: the paper's formula, and that it follows from what is stored alone.


def one(slip_m, slip_rad, tried=True):
    slips = np.array([[slip_m], [slip_rad]], dtype=float)
    (base,), (score,) = score_stages(*slips, np.array([tried]), ScoreLimits())
    return base, score


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


def test_a_set_from_elsewhere_is_refused():
    still, held = np.zeros((1, 4)), np.ones(1)
    own = plain_grasps(1, scores=held, base_scores=held, slip_m=still, slip_rad=still)
    refused(r"config\.score", recompute_scores, own)
