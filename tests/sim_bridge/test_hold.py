"""p_hold: laws of the draws, of the calibration, and of how it is judged by real trials."""

from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh
from scipy.special import ndtr

from graspa_folders import DOWN, box_grasps, write_graspa
from held_boxes import held_box
from realsim.errors import InputError
from realsim.formats.grasps.graspa import read_graspa
from realsim.geometry import se3
from realsim.records import STAGES, Mesh
from realsim.records.grasps import MEASURES
from realsim.robots.hand import find_hand
from realsim.untrusted.own_json import read_own
from realsim_sim_bridge.grasping.surroundings import first_triangle_inside
from realsim_sim_bridge.hold.calibration import (
    SHIPPED,
    Calibration,
    evidence_of,
    fitted_curve,
    left_out,
    p_hold_columns,
    shipped,
)
from realsim_sim_bridge.hold.draws import (
    PALM_M,
    GraspedObject,
    HoldConfig,
    PoseSpread,
    chance_columns,
    covariance_root,
    draw_holds,
    moved_objects,
    nominal_factors,
)
from realsim_sim_bridge.hold.reality import (
    Judged,
    RealityConfig,
    calibrate,
    expected_calibration_error,
    judge_trials,
    reality_of,
)
from realsim_sim_bridge.slip.motion import SlipMotion, stage_loads, stage_wrenches
from realsim_sim_bridge.slip.slip_test import SlipConfig
from realsim_sim_bridge.validation.specimens import ready_trial
from trimesh_solids import solid

HAND, MASS, FORCE = find_hand(), 0.4, 70.0
STILL = PoseSpread(across_m=0.0, height_m=0.0, yaw_deg=0.0, tilt_deg=0.0)
CERTAIN = HoldConfig(
    draws=2, spread=STILL, friction=(0.5,), force_share=(0.999, 1.0), mass_spread=0.0,
    stiffness_spread=0.0,
)  # fmt: skip
BAR = solid(trimesh.creation.box((0.12, 0.05, 0.05)))


def bar_trial(off_m, hand=HAND, z=0.005, mass=MASS):
    """Return grasps of a bar from above, each `off_m` (N,) beside its middle."""
    pads = np.repeat(se3.from_rt(DOWN, [0.0, 0.0, z])[None], len(off_m), axis=0)
    pads[:, 0, 3] = off_m
    Ts = hand.grasps_of_pads(pads, 0.05)
    return ready_trial(held_box(mass, 0.12), Ts, Ts, hand.max_opening_m)


@pytest.fixture(scope="module")
def bar():
    return GraspedObject.of(BAR)


@pytest.fixture(scope="module")
def trial():
    return bar_trial(np.array([0.0, 0.02, 0.04, 0.05, 0.058, 0.065, 0.08, 0.12]))


@pytest.fixture(scope="module")
def loads(trial):
    return stage_loads(trial, SlipMotion())


@pytest.fixture(scope="module")
def drawn(bar, trial, loads):
    return draw_holds(bar, trial, loads, HAND, FORCE, stiffness_n_per_m=2e5)


def shares(drawn):
    names = ("blocked", "missed", "skewed", "overloaded")
    return np.stack([getattr(drawn, name) for name in names])


# --- draws ----------------------------------------------------------------------------------------


def test_shares_and_what_holds_are_one_and_a_centred_grasp_holds_best(drawn):
    parts = np.vstack([shares(drawn), drawn.share])
    np.testing.assert_allclose(parts.sum(axis=0), 1.0, atol=1e-12)
    assert parts.min() >= 0 and np.all((drawn.holds >= 0) & (drawn.holds <= 1))
    assert np.all(np.diff(drawn.share) <= 0.02) and drawn.share[0] > 0.7 > 0.1 > drawn.share[-1]
    assert drawn.missed[-1] == 1.0  # beside the bar


def test_the_same_seed_is_the_same_draw_in_any_order(bar, trial, drawn):
    again = draw_holds(
        bar, trial, stage_loads(trial, SlipMotion()), HAND, FORCE, stiffness_n_per_m=2e5
    )
    np.testing.assert_array_equal(again.holds, drawn.holds)
    back = trial.part(np.arange(len(trial))[::-1])
    turned = draw_holds(
        bar, back, stage_loads(back, SlipMotion()), HAND, FORCE, stiffness_n_per_m=2e5
    )
    np.testing.assert_allclose(turned.holds[::-1], drawn.holds, atol=1e-9)
    other = draw_holds(
        bar, trial, stage_loads(trial, SlipMotion()), HAND, FORCE, None, HoldConfig(seed=1), 2e5
    )
    assert not np.array_equal(other.holds, drawn.holds)


def test_more_spread_is_less_share_of_a_tight_grasp(bar):
    tight = bar_trial(np.array([0.0, 0.01]))
    loads = stage_loads(tight, SlipMotion())
    found = []
    for times in (0.0, 1.0, 2.0, 4.0):
        spread = PoseSpread(
            **{f.name: times * getattr(PoseSpread(), f.name) for f in fields(PoseSpread)}
        )
        config = HoldConfig(draws=32, spread=spread)
        found.append(draw_holds(bar, tight, loads, HAND, FORCE, None, config, 2e5).share)
    assert np.all(np.diff(found, axis=0) < 0) and np.all(found[0] > 0.98)


def test_the_error_tells_how_far_the_share_is_off_and_falls_with_the_root_of_the_draws(bar, trial):
    some = trial.part(np.array([0, 3, 5]))
    loads = stage_loads(some, SlipMotion())

    def draw(count, seed):
        config = HoldConfig(draws=count, seed=seed)
        return draw_holds(bar, some, loads, HAND, FORCE, None, config, 2e5)

    truth = draw(256, 99)
    few = [draw(8, seed) for seed in range(8)]
    stated = np.sqrt(np.mean([d.error**2 for d in few], axis=0))
    off = np.sqrt(np.mean([(d.share - truth.share) ** 2 for d in few], axis=0))
    assert np.all(off < 1.2 * stated) and off.mean() > 0.3 * stated.mean()
    np.testing.assert_allclose(stated / truth.error, np.sqrt(256 / 8), rtol=0.35)
    alike = replace(few[0], holds=np.ones((3, 8)))
    np.testing.assert_allclose(alike.error, 1 / 9)


def test_a_draw_without_spread_says_what_the_nominal_safety_says(bar):
    """So the worst loads that draws are asked for are the worst of all loads."""
    for mass in (0.2, 0.9, 2.0):
        trial = bar_trial(np.linspace(0.0, 0.062, 12), mass=mass)
        loads = stage_loads(trial, SlipMotion())
        factors = nominal_factors(bar, trial, loads, HAND, 0.5, FORCE, 0.0015)
        safety = factors[:, 1:].min(axis=1)
        said = draw_holds(bar, trial, loads, HAND, FORCE, None, CERTAIN).share
        sure = np.abs(safety - 1.0) > 0.002
        np.testing.assert_array_equal(said[sure], safety[sure] > 1)
        spread = replace(CERTAIN, draws=64, mass_spread=0.3)
        said_of_masses = draw_holds(bar, trial, loads, HAND, FORCE, None, spread).share
        np.testing.assert_allclose(said_of_masses, ndtr((safety - 1.0) / 0.3), atol=0.03)
    assert 0 < said.mean() < 1


def test_point_contacts_on_a_ball_are_overloaded_by_a_torque_not_skewed():
    ball = GraspedObject.of(solid(trimesh.creation.icosphere(3, 0.025)))
    rigid = replace(CERTAIN, conformity_m=0.0)
    trial = bar_trial(np.array([0.0, 0.004]), z=0.0)
    found = draw_holds(ball, trial, stage_loads(trial, SlipMotion()), HAND, FORCE, None, rigid)
    assert found.skewed.sum() == 0 and found.overloaded[1] == 1.0


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ({"draws": 1}, "2 draws or more"),
        ({"draws": 10**6}, "up to 4096"),
        ({"mass_spread": -0.1}, "mass_spread is -0.1; 0 or more"),
        ({"stiffness_spread": np.nan}, "stiffness_spread is nan"),
        ({"conformity_m": -1e-3}, "conformity_m"),
        ({"touch_m": np.inf}, "touch_m is inf"),
        ({"spread": PoseSpread(yaw_deg=-1.0)}, "yaw_deg is -1"),
        ({"friction": ()}, "friction"),
        ({"friction": (0.5, 0.0)}, "positive numbers"),
        ({"force_share": (0.5, 0.5)}, "a range above 0"),
        ({"force_share": (0.0, 0.5)}, "a range above 0"),
        ({"force_share": (0.5, np.inf)}, "a range above 0"),
    ],
)
def test_numbers_that_cannot_be_are_named(numbers, told):
    with pytest.raises(InputError, match=told):
        HoldConfig(**numbers)


@pytest.mark.parametrize(
    ("covariance", "told"),
    [
        (np.eye(3), r"found \(3, 3\)"),
        (np.full((6, 6), np.nan), "finite"),
        (np.eye(6) + np.eye(6, k=1), "symmetric"),
        (np.diag([1.0, 1, 1, 1, 1, -1]) * 1e-6, "negative variance"),
    ],
)
def test_a_covariance_that_is_none_is_named(bar, trial, loads, covariance, told):
    with pytest.raises(InputError, match=told):
        draw_holds(bar, trial, loads, HAND, FORCE, covariance)


def test_a_covariance_moves_the_object_as_it_says():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * np.array([0.01] * 3 + [0.002] * 3)[:, None]
    C, count = A @ A.T, 2000
    np.testing.assert_allclose(covariance_root(C) @ covariance_root(C).T, C, atol=1e-12)
    trial = bar_trial(np.array([0.0, 0.03]))
    Ts = moved_objects(trial, C, STILL, rng.normal(size=(count, 14)))
    moved = trial.Ts_obj_grasp @ se3.invert(Ts)  # the object's new frame in its old one
    np.testing.assert_allclose(moved[:, 0], moved[:, 1], atol=1e-12)
    xi = np.stack([se3.log(T) for T in moved[:, 0]])
    off = np.cov(xi.T) - C
    error = np.sqrt((C**2 + np.outer(np.diag(C), np.diag(C))) / count)
    assert np.all(np.abs(off) < 5 * error)
    assert np.all(np.abs(xi.mean(axis=0)) < 5 * np.sqrt(np.diag(C) / count))


def test_the_cells_error_is_along_the_tables_axes_about_the_centre_of_mass():
    rng, spread = np.random.default_rng(1), PoseSpread(tilt_deg=1.0, yaw_deg=20.0)
    T_table_obj = se3.random_transform(rng)  # the object lies askew
    T_obj_grasp = se3.random_transform(rng, 2, spread=0.05)
    body = replace(held_box(MASS), center_of_mass=np.array([0.05, -0.02, 0.1]))
    trial = ready_trial(body, T_obj_grasp, T_table_obj @ T_obj_grasp, 0.08)
    Ts = moved_objects(trial, None, spread, rng.normal(size=(2000, 14)))
    moved = T_table_obj @ trial.Ts_obj_grasp[0] @ se3.invert(Ts[:, 0]) @ se3.invert(T_table_obj)
    c = se3.transform(T_table_obj, body.center_of_mass)
    shifts = se3.transform(moved, c[None])[:, 0] - c
    turns = np.degrees([se3.log_so3(T[:3, :3]) for T in moved])
    np.testing.assert_allclose(shifts.std(axis=0), [0.008, 0.008, 0.003], rtol=0.08)
    np.testing.assert_allclose(turns.std(axis=0), [1.0, 1.0, 20.0], rtol=0.08)


def test_a_hand_whose_palm_is_in_the_object_stops_outside(bar):
    deep = bar_trial(np.zeros(6))
    Ts = deep.Ts_obj_grasp.copy()
    Ts[:, 2, 3] -= np.array([0.0, 0.02, 0.03, 0.04, 0.05, 0.06])
    stopped, back = bar.stopped(Ts, HAND, PALM_M)
    palms = np.array(HAND.palm_boxes)[None].repeat(6, axis=0)
    assert np.all(first_triangle_inside(palms, stopped, bar.tree, -PALM_M) < 0)
    assert not back[0] and back[-1]
    np.testing.assert_array_equal(stopped[~back], Ts[~back])
    np.testing.assert_array_equal(stopped[:, :2], Ts[:, :2])  # up along the approach alone
    closer = Ts.copy()
    closer[:, 2, 3] = stopped[:, 2, 3] - 0.004
    inside = first_triangle_inside(palms, closer, bar.tree, -PALM_M) >= 0
    assert np.all(inside[back])  # and no farther than it must


def test_hands_on_an_arc_and_open_meshes_work(bar, trial):
    arc = find_hand("robotiq_2f85")
    force = arc.force_n
    on_arc = bar_trial(np.array([0.0, 0.03, 0.12]), arc)
    loads = stage_loads(on_arc, SlipMotion())
    found = draw_holds(bar, on_arc, loads, arc, force, stiffness_n_per_m=2e5)
    np.testing.assert_allclose(shares(found).sum(axis=0) + found.share, 1.0, atol=1e-12)
    assert found.share[0] > 0.6 and found.missed[2] == 1.0

    up = np.cross(*(BAR.vertices[BAR.faces][:, k] - BAR.vertices[BAR.faces][:, 0] for k in (1, 2)))
    lidless = GraspedObject.of(Mesh(vertices=BAR.vertices, faces=BAR.faces[up[:, 2] <= 0]))
    assert not lidless.rays.is_closed
    whole = draw_holds(bar, trial, stage_loads(trial, SlipMotion()), HAND, FORCE, None, CERTAIN)
    opened = draw_holds(
        lidless, trial, stage_loads(trial, SlipMotion()), HAND, FORCE, None, CERTAIN
    )
    np.testing.assert_array_equal(opened.share, whole.share)


# --- loads ----------------------------------------------------------------------------------------


def test_loads_are_those_of_the_slip_test_in_the_hands_frame(trial):
    tilts = se3.random_transform(np.random.default_rng(2), len(trial))
    trial = replace(trial, Ts_table_grasp=tilts)
    motion, R = SlipMotion(), tilts[:, :3, :3]
    loads = stage_loads(trial, motion)
    turned = np.concatenate(
        [loads.wrenches[..., :3] @ np.swapaxes(R, 1, 2),
         loads.wrenches[..., 3:] @ np.swapaxes(R, 1, 2)], axis=-1,
    )  # fmt: skip
    weight = [0, 0, 0, 0, 0, -MASS * motion.gravity]
    np.testing.assert_allclose(turned[:, loads.stage == 0], [[weight]] * len(trial), atol=1e-12)
    centers = se3.transform(se3.invert(trial.Ts_obj_grasp), np.zeros((1, 3)))[:, 0]
    rest = loads.about_grasp(centers, np.zeros((len(trial), 1), dtype=np.int64))[:, 0]
    down = -MASS * motion.gravity * R[:, 2]  # the weight in the hand's axes, where the middle is
    np.testing.assert_allclose(rest, np.hstack([np.cross(centers, down), down]), atol=1e-12)
    start = np.broadcast_to(np.eye(4), trial.Ts_obj_grasp.shape).copy()
    T_grasp_obj = se3.invert(trial.Ts_obj_grasp)
    T_obj_body = trial.body.principal_frame()[0]
    start[:, :3] = R @ (T_grasp_obj @ T_obj_body)[:, :3]
    for k in range(1, len(STAGES)):
        exact = stage_wrenches(k, trial, start, motion, 1 / 240)
        mine = turned[:, loads.stage == k]
        for part in (slice(0, 3), slice(3, 6)):  # every load is one of the stage's ...
            apart = np.linalg.norm(mine[:, :, None, part] - exact[:, None, :, part], axis=-1)
            assert apart.min(axis=2).max() < 0.02 * MASS
        peak = np.linalg.norm(exact[..., 3:], axis=-1).max(axis=1)  # ... and the worst is there
        assert np.all(np.linalg.norm(mine[..., 3:], axis=-1).max(axis=1) > 0.985 * peak)


def test_the_few_loads_are_the_worst_of_all(bar):
    """What a stage's few loads say of each grasp is what all of the stage's moments say."""
    trial, motion = bar_trial(np.linspace(0.0, 0.06, 5)), SlipMotion()
    turn = se3.exp_so3([0.4, 0.3, 0.2])  # so that no load is along an axis
    trial = replace(trial, Ts_table_grasp=se3.from_rt(turn, np.zeros(3)) @ trial.Ts_table_grasp)
    few = stage_loads(trial, motion)
    R = trial.Ts_table_grasp[:, :3, :3]
    start = np.broadcast_to(np.eye(4), (*R.shape[:1], 4, 4)).copy()
    start[:, :3] = R @ se3.invert(trial.Ts_obj_grasp)[:, :3] @ trial.body.principal_frame()[0]
    told = nominal_factors(bar, trial, few, HAND, 0.5, FORCE, 0.0015)
    for k in range(1, len(STAGES)):
        fine = stage_wrenches(k, trial, start, motion, 1 / 96)
        turned = np.concatenate([fine[..., :3] @ R, fine[..., 3:] @ R], axis=-1)
        every = replace(few, wrenches=turned, stage=np.full(turned.shape[1], k))
        factors = nominal_factors(bar, trial, every, HAND, 0.5, FORCE, 0.0015)
        np.testing.assert_allclose(
            told[:, few.stage == k].min(axis=1), factors.min(axis=1), rtol=0.02
        )


def test_the_columns_are_named_as_records_have_them(trial):
    columns = chance_columns(BAR, trial, SlipConfig(), HAND, HoldConfig(draws=2))
    known = columns | p_hold_columns(columns, np.ones(len(trial)), 2)
    assert set(known) <= set(MEASURES)
    assert np.all((known["p_hold"] > 0) & (known["p_hold"] < 1))
    untried = p_hold_columns(columns, np.full(len(trial), np.nan), 2)
    assert all(np.isnan(values).all() for values in untried.values())


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
        with pytest.raises(InputError, match="200 trials ended alike"):
            fitted_curve(evidence, alike)
    with pytest.raises(InputError, match="more evidence held less often"):
        fitted_curve(1 - evidence, held)
    with pytest.raises(InputError, match="of 2 objects; 3 or more"):
        calibrate(judged(held, evidence, kinds=2), "made up")
    fit = calibrate(judged(held, evidence, kinds=4), "made up")
    assert (fit.trials, len(fit.objects), fit.held_share) == (200, 4, held.mean())


# --- judged by trials -----------------------------------------------------------------------------


def judged(held, evidence, kinds=2, digest="none", **columns):
    n = len(held)
    return Judged(
        held=np.asarray(held, dtype=bool),
        objects=np.array([f"object {k % kinds}" for k in range(n)]),
        evidence=np.asarray(evidence, dtype=float),
        evidence_error=np.full(n, 0.1),
        columns={"score_old": np.asarray(evidence, dtype=float), **columns},
        shares={},
        digest=digest,
        engine="made up",
    )


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
        row = next(row for row in found.rows if row.name == "some")
        assert row.auc == pytest.approx(slow_auc(values, held))
        assert row.average_precision == pytest.approx(slow_precision(values, held))
    halves = [np.flatnonzero(np.arange(60) % 2 == k) for k in (0, 1)]  # the last order's objects
    v, h = values[order], held[order]
    weights = [h[rows].sum() * (~h[rows]).sum() for rows in halves]
    told = [
        slow_auc(v[rows], h[rows]) if w else 0.0 for rows, w in zip(halves, weights, strict=True)
    ]
    assert row.within == pytest.approx(np.average(told, weights=weights))
    always = next(row for row in found.rows if row.name == "always holds")
    assert always.auc == 0.5 and always.average_precision == pytest.approx(held.mean())
    assert np.isnan(always.within)


def test_the_identity_predictor_knows_an_objects_other_trials_alone():
    """Object 0 held in 3 of 4 trials, object 1 in 1 of 4: each trial is told by the other three."""
    held = np.array([1, 0, 1, 0, 1, 1, 0, 0], dtype=bool)  # objects by turns
    found = reality_of(judged(held, np.full(8, 0.5)))
    row = next(row for row in found.rows if row.name == "object")
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
    inside = reality_of(judged(held, evidence, kinds=6), own)
    assert inside.in_sample and not many.in_sample
    data = judged(held, evidence, kinds=6)
    np.testing.assert_array_equal(inside.p_hold, left_out(evidence, held, data.objects))


def test_good_and_bad_grasps_of_a_box_are_told_apart(tmp_path):
    write_graspa(tmp_path, "wooden_box", *box_grasps())
    objects, done = read_graspa(tmp_path), []
    found = judge_trials(
        objects, RealityConfig(hold=HoldConfig(draws=4)), progress=lambda k, n: done.append((k, n))
    )
    assert done == [(8, 8)] and found.engine == "pybullet"
    reality = reality_of(found)
    auc = {row.name: row.auc for row in reality.rows}
    assert {row.within for row in reality.rows if row.name == "score"} == {1.0}
    assert auc["p_hold"] == auc["score"] == auc["draws"] == auc["safety"] == 1.0
    assert np.isnan(reality.gain_low)
    told = found.evidence + 4 / 5 * sum(found.shares[f"share_{n}"] for n in
                                        ("blocked", "missed", "skewed", "overloaded"))  # fmt: skip
    np.testing.assert_allclose(told, (4 + found.columns["score"]) / 5)
    (note,) = found.notes
    assert "wooden_box was not weighed: 1000 kg/m^3 make 0.096 kg" in note and "--mass" in note

    flipped = [replace(objects[0], held=~objects[0].held)]
    config = RealityConfig(hold=HoldConfig(draws=2))
    assert judge_trials(flipped, config).digest != found.digest
    with pytest.raises(InputError, match="no trials to judge by"):
        judge_trials([], config)
