"""Which view to take next: laws, known answers, statistics, proposals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from hand_views import BOARD, Array, board_at, hand_at, measured, random_hands, report_of, solved
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import Chessboard
from realsim_calibration.planning.next_view import (
    board_geometry,
    choose_next_views,
    displacement_metric,
    predicted_boards,
    rank_next_views,
)
from realsim_calibration.planning.view_proposals import ViewLimits, describe_move, propose_views
from realsim_calibration.results import HandEyeReport
from refusals import refused


@pytest.fixture(scope="module")
def few() -> HandEyeReport:
    return report_of(random_hands(np.random.default_rng(0), 5))


# ---- laws


def test_the_prediction_is_what_the_added_view_really_brings(few: HandEyeReport) -> None:
    rng = np.random.default_rng(2)
    hands = np.stack([v.T_base_ee for v in few.views])
    for A in random_hands(rng, 3):
        (expected,) = rank_next_views(few, A[None])
        after = report_of(np.concatenate([hands, A[None]]))
        assert expected.sigma_mm == pytest.approx(after.sigma_mm, rel=0.02)
        assert expected.sigma_deg == pytest.approx(after.sigma_deg, rel=0.02)


@pytest.fixture(params=["as informed", "worse", "both"])
def report(few: HandEyeReport, request: pytest.FixtureRequest) -> HandEyeReport:
    """Return a calibration that knows X as well as its information, worse or better."""
    rng = np.random.default_rng(3)
    shake = rng.normal(size=(6, 6)) * np.sqrt(np.diag(few.X_covariance))[:, None]
    known = {
        "as informed": few,
        "worse": replace(few, X_covariance=3 * few.X_covariance + 0.3 * shake @ shake.T),
        "both": replace(few, X_covariance=0.6 * few.X_covariance + 0.3 * shake @ shake.T),
    }
    return known[request.param]


def plan_of(report: HandEyeReport, rng: np.random.Generator, n: int) -> Array:
    """Return poses (n, 4, 4) around those of the report."""
    captured = np.stack([v.T_base_ee for v in report.used])
    spread = rng.normal(size=(n, 6)) * [0.15, 0.15, 0.15, 0.03, 0.03, 0.03]
    return captured[rng.integers(len(captured), size=n)] @ se3.exp(spread)


def test_a_view_never_increases_the_covariance(report: HandEyeReport) -> None:
    rng = np.random.default_rng(3)
    now = 1e3 * np.sqrt(np.trace(displacement_metric(report) @ report.X_covariance))
    rows = rank_next_views(report, plan_of(report, rng, 40))
    assert any(v.visible for v in rows)
    assert all(v.rms_mm <= now * (1 + 1e-9) and v.gain >= -1e-9 for v in rows)
    assert all(v.sigma_mm <= report.sigma_mm * (1 + 1e-9) for v in rows)
    assert all(v.sigma_deg <= report.sigma_deg * (1 + 1e-9) for v in rows)
    steps = choose_next_views(report, plan_of(report, rng, 20), 8)
    assert len(steps) == 8 and np.all(np.diff([v.rms_mm for v in steps]) < 0)
    assert np.all(np.diff([v.sigma_mm for v in steps]) <= 1e-12)


def test_ranking_does_not_depend_on_the_base_frame(few: HandEyeReport) -> None:
    rng = np.random.default_rng(4)
    plan, B = random_hands(rng, 15), se3.random_transform(rng)
    moved = replace(
        few, Z=B @ few.Z, views=tuple(replace(v, T_base_ee=B @ v.T_base_ee) for v in few.views)
    )
    for function in (rank_next_views, lambda r, T: choose_next_views(r, T, 5)):
        a, b = function(few, plan), function(moved, B @ plan)
        assert [v.plan_index for v in a] == [v.plan_index for v in b]
        np.testing.assert_allclose([v.rms_mm for v in a], [v.rms_mm for v in b], rtol=1e-8)


# ---- known answers


def test_new_roll_ranks_above_a_repeat() -> None:
    captured = [board_at(25, a, 0) for a in (0, 90, 180, 270)] + [board_at(0, 0, 0, 0.5)]
    report = report_of(np.stack([hand_at(T) for T in captured]))
    plan = np.stack([hand_at(T) for T in (captured[0], captured[4], board_at(25, 0, 90))])
    rows = rank_next_views(report, plan)
    assert rows[0].plan_index == 2
    assert rows[0].gain > 1.5 * rows[1].gain and rows[0].sigma_deg < rows[1].sigma_deg
    assert rows[0].roll_deg != pytest.approx(rows[1].roll_deg, abs=45)


def test_unseen_poses_say_why_and_come_last(few: HandEyeReport) -> None:
    aside = se3.from_rt(se3.exp_so3([0.0, 1.2, 0.0]), [0, 0, 0]) @ board_at(10, 0, 0)
    half = se3.from_translation([0.38, 0.0, 0.0]) @ board_at(0, 0, 0)
    back = board_at(10, 0, 0) @ se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0, BOARD.size_m[1], 0])
    wanted = [board_at(20, 0, 30), aside, half, board_at(75, 0, 0), board_at(0, 0, 0, 3.0), back]
    rows = rank_next_views(few, np.stack([hand_at(T) for T in wanted]))
    assert {v.plan_index for v in rows[:2]} == {0, 2} and not any(v.visible for v in rows[2:])
    assert not rows[0].reason and not rows[1].reason
    by_index = {v.plan_index: v for v in rows}
    for k, word in ((1, "0% of the target"), (3, "75 deg off"), (4, "3.00 m away"), (5, "deg off")):
        assert not by_index[k].visible and word in by_index[k].reason
        assert by_index[k].gain == pytest.approx(0.0, abs=1e-9)
    assert by_index[2].visible and 0.4 < by_index[2].visible_share < 0.9
    chess = replace(few, target=Chessboard(rows=6, columns=9, square_m=0.018))
    cut = {v.plan_index: v for v in rank_next_views(chess, np.stack([hand_at(T) for T in wanted]))}
    assert cut[0].visible and not cut[2].visible  # a chessboard is found whole or not at all
    assert choose_next_views(few, hand_at(aside)[None], 3) == ()


def test_bad_input_is_refused(few: HandEyeReport) -> None:
    refused("at least one", rank_next_views, few, np.zeros((0, 4, 4)))
    refused("at least 1", choose_next_views, few, np.eye(4)[None], 0)
    blind = replace(few, information=np.zeros((29, 29)))
    with pytest.raises(DegenerateError, match="no information about X"):
        rank_next_views(blind, np.eye(4)[None])


# ---- statistics


@pytest.mark.slow
def test_greedy_beats_random_in_expected_and_actual_error() -> None:
    """Four captured views without roll, four more out of 24: greedy against random subsets."""
    rng = np.random.default_rng(7)
    start = np.stack(
        [hand_at(board_at(t, a, 0)) for t, a in ((5, 0), (20, 0), (20, 90), (20, 200))]
    )
    plan = np.concatenate([random_hands(rng, 16, tilt=15, roll=10), random_hands(rng, 8)])
    report = report_of(start)
    M = displacement_metric(report)
    greedy = [v.plan_index for v in choose_next_views(report, plan, 4)]
    others = [rng.choice(len(plan), 4, replace=False) for _ in range(12)]

    def expected(pick: Sequence[int]) -> float:
        after = report_of(np.concatenate([start, plan[list(pick)]]))
        return float(np.sqrt(np.trace(M @ after.X_covariance)))

    assert expected(greedy) < min(expected(pick) for pick in others)

    def actual(pick: Sequence[int], seed: int) -> float:
        noise = np.random.default_rng(seed)
        hands = np.concatenate([start, plan[list(pick)]])
        theta, _, _ = solved(hands, [measured(noise, A) for A in hands])
        return float(theta[:6] @ M @ theta[:6])

    ours = np.mean([actual(greedy, 100 + s) for s in range(24)])
    theirs = np.mean([actual(others[s % 12], 100 + s) for s in range(24)])
    assert np.sqrt(ours) < 0.8 * np.sqrt(theirs)
    # and the expectation is honest
    assert np.sqrt(ours) == pytest.approx(expected(greedy), rel=0.4)


# ---- proposals


@pytest.mark.parametrize("mode", ["eye_in_hand", "eye_to_hand"])
def test_proposals_look_at_the_board(mode: str) -> None:
    rng = np.random.default_rng(8)
    hands = [hand_at(board_at(rng.uniform(5, 40), a, 3 * a), mode) for a in (0, 70, 140, 220, 300)]
    report = report_of(np.stack(hands), mode=mode)
    limits = ViewLimits(tilts_deg=(0.0, 30.0), distances_m=(0.35, 0.45))
    Ts = propose_views(report, limits)
    assert len(Ts) == 2 * (1 + 8) * 6
    for T in predicted_boards(report, Ts):
        g = board_geometry(T, BOARD)
        assert min(abs(g.distance_m - d) for d in limits.distances_m) < 1e-9
        assert min(abs(g.tilt_deg - t) for t in limits.tilts_deg) < 1e-4
    rows = rank_next_views(report, Ts)
    assert sum(v.visible for v in rows) > 0.9 * len(rows)


def test_proposals_keep_the_limits(few: HandEyeReport) -> None:
    limits = ViewLimits(height_m=(0.3, 0.45), reach_m=(0.3, 0.75), max_turn_deg=120.0)
    Ts = propose_views(few, limits)
    assert 0 < len(Ts) < len(propose_views(few))
    assert np.all(Ts[:, 2, 3] >= 0.3) and np.all((Ts @ few.X)[:, 2, 3] <= 0.45)
    assert np.all(np.linalg.norm(Ts[:, :3, 3], axis=-1) <= 0.75)
    with pytest.raises(DegenerateError, match="none of"):
        propose_views(few, replace(limits, height_m=(3.0, 4.0)))
    refused("millimetres", ViewLimits, distances_m=(300.0,))


def test_moves_are_told_in_words() -> None:
    say = lambda a, b: describe_move(a, b, BOARD)  # noqa: E731
    assert say(board_at(5, 0, 0), board_at(5, 0, 60)).startswith("roll by 60 deg")
    assert say(board_at(0, 0, 0, 0.5), board_at(0, 0, 0, 0.4)) == "move 10 cm closer"
    assert "from its right side, tilted by 40 deg" in say(board_at(0, 0, 0), board_at(40, 0, 0))
    assert "square on" in say(board_at(40, 0, 0), board_at(0, 0, 0))
    assert say(board_at(9, 0, 0), board_at(9, 0, 0)) == "shift the board in the image"
