"""Goals in words: met where the words say so, and nowhere else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.app.school.files import stored_grasps
from realsim.geometry import se3
from realsim_sim_bridge.demonstrations.front_view import FrontView, wrist_camera
from realsim_sim_bridge.demonstrations.place_source import PlacingSource
from realsim_sim_bridge.demonstrations.placing import (
    FREE,
    PHRASES,
    PlaceGoal,
    Standing,
    distance,
    goals_of,
    unmet,
)
from realsim_sim_bridge.demonstrations.records import ALL_PHASES

MUG, BOWL = 3, 7
NAMES = {MUG: "mug", BOWL: "bowl"}
OPPOSITE = {"left": "right", "right": "left", "front": "behind", "behind": "front"}
MIRRORED = {"left": [0, 1], "right": [0, -1], "front": [-1, 0], "behind": [1, 0]}
"""Directions of the relations for a robot that looks along x."""


def box(x: float, y: float, half: float, height: float = 0.1) -> np.ndarray:
    corners = [[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (0, 1)]
    return np.array(corners) * [half, half, height] + [x, y, 0.0]


def standing(turn: float = 0.0, gap: float = 0.02) -> Standing:
    """A mug before the robot and a bowl left of it, the whole scene turned."""
    R = se3.exp_so3([0.0, 0.0, turn])
    return Standing(
        corners={MUG: box(0.0, 0.0, 0.03) @ R.T, BOWL: box(0.02, 0.08 + gap, 0.05) @ R.T},
        names=NAMES,
        ahead=(R @ [1.0, 0.0, 0.0])[:2],
    )


def put(goal: PlaceGoal) -> np.ndarray:
    return se3.from_translation([*goal.shift_m, 0.0])


@pytest.mark.parametrize("turn", (0.0, 0.9, 2.8))
def test_goals_are_met_where_they_lead_and_not_where_they_do_not(turn: float) -> None:
    there = standing(turn)
    goals = list(goals_of(there, MUG, 0))
    assert {g.relation for g in goals} == set(PHRASES) - {"right"}  # it is there already
    for goal in goals:
        assert unmet(goal, there, MUG, np.eye(4), put(goal)) == ""
        moved = se3.transform(put(goal), there.corners[MUG])
        assert distance(moved, [there.corners[BOWL]]) >= 0.02
        if goal.relation == FREE:
            continue
        for other in goals:
            if other.relation == OPPOSITE[goal.relation]:
                assert "is not" in unmet(goal, there, MUG, np.eye(4), put(other))
        assert "is not" in unmet(goal, there, MUG, np.eye(4), np.eye(4))
        # Where the words lead, by hand.
        R = se3.exp_so3([0.0, 0.0, turn])
        apart = moved.mean(axis=0) - there.corners[BOWL].mean(axis=0)
        x, y, _ = R.T @ apart
        assert np.dot(MIRRORED[goal.relation], [x, y]) > 0.05


def test_what_leans_hangs_or_is_too_near_does_not_meet_its_goal() -> None:
    there = standing()
    goal = next(g for g in goals_of(there, MUG, 0) if g.relation == "left")
    tipped = se3.from_rt(se3.exp_so3([np.pi / 2, 0.0, 0.0]), [0.0, 0.03, 0.03])
    assert "leans 90 deg" in unmet(goal, there, MUG, np.eye(4), put(goal) @ tipped)
    hanging = se3.from_translation([0.0, 0.0, 0.02]) @ put(goal)
    assert "on the table" in unmet(goal, there, MUG, np.eye(4), hanging)
    free = next(g for g in goals_of(there, MUG, 0) if g.relation == FREE)
    near = se3.from_translation([0.02, 0.01, 0.0])
    assert "10 mm from another" in unmet(free, there, MUG, np.eye(4), near)


def test_phrasings_are_taken_in_turn_and_name_both_things() -> None:
    said = [next(goals_of(standing(), MUG, k)).language for k in range(4)]
    assert len(set(said[:3])) == 3
    assert said[3] == said[0]
    assert all("mug" in words and "bowl" in words for words in said)


def test_things_of_one_name_are_no_reference_to_each_other() -> None:
    there = standing()
    same = replace(there, names={MUG: "mug", BOWL: "mug"})
    assert [g.relation for g in goals_of(same, MUG, 0)] == [FREE]
    apart = standing(gap=0.1)
    assert FREE not in [g.relation for g in goals_of(apart, MUG, 0)]  # nothing is near it


def test_overlap_is_no_distance() -> None:
    assert distance(box(0, 0, 0.05), [box(0.02, 0, 0.01)]) == 0.0
    assert distance(box(0, 0, 0.05), [box(0.2, 0, 0.05)]) == pytest.approx(0.1, abs=1e-9)
    assert distance(box(0, 0, 0.05), []) == np.inf


@pytest.mark.slow
def test_an_object_is_carried_let_go_and_where_its_task_says(weak_school: Path) -> None:
    grasps, models = stored_grasps(weak_school)
    cameras = (FrontView(size_px=(64, 48)), wrist_camera(None, (64, 48)))
    source = PlacingSource(grasps, models, cameras=cameras, cache=weak_school / "grasps/cache")
    done = [source[k] for k in range(len(source))]
    good = [d for d in done if d.outcome.success]
    assert good
    assert len(good) < len(done)  # the weak hand loses some
    for d in done:
        place = d.goal.place
        assert place is not None
        assert d.outcome.success == (d.outcome.failure == "")
        instance = d.name.instance
        T0, T = source.scenery.Ts_table_obj[instance], d.motion.Ts_table_obj[-1]
        if d.outcome.success:
            assert unmet(place, source.standing, instance, T0, T) == ""
            phases = [ALL_PHASES[p] for p in np.unique(d.motion.phase)]
            assert phases[-4:] == ["carry", "lower", "release", "withdraw"]
            # What hangs askew in the weak hand comes down askew, and turns as it lands.
            np.testing.assert_allclose(T[:2, 3] - T0[:2, 3], place.shift_m, atol=0.05)
            # It rests, and the hand has gone.
            np.testing.assert_allclose(d.motion.Ts_table_obj[-3], T, atol=1e-3)
            assert not d.motion.held[-1]
            steps = np.abs(np.diff(d.motion.joints_rad, axis=0)).max()
            assert steps < 0.25  # nothing jumps [rad in 50 ms]
