"""p_hold: laws of the draws and of the loads that they are asked for."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.special import ndtr

from graspa_folders import DOWN
from held_boxes import held_box
from realsim.geometry import se3
from realsim.records import STAGES, Mesh
from realsim.records.grasps import MEASURES
from realsim.robots.hand import find_hand
from realsim_sim_bridge.grasping.surroundings import first_triangle_inside
from realsim_sim_bridge.hold.calibration import p_hold_columns
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
from realsim_sim_bridge.slip.motion import SlipMotion, stage_loads, stage_wrenches
from realsim_sim_bridge.slip.slip_test import SlipConfig
from realsim_sim_bridge.validation.specimens import ready_trial
from refusals import refused
from trimesh_solids import ball, box

HAND, MASS, FORCE = find_hand(), 0.4, 70.0
STILL = PoseSpread(across_m=0.0, height_m=0.0, yaw_deg=0.0, tilt_deg=0.0)
CERTAIN = HoldConfig(
    draws=2, spread=STILL, friction=(0.5,), force_share=(0.999, 1.0), mass_spread=0.0,
    stiffness_spread=0.0,
)  # fmt: skip
BAR = box((0.12, 0.05, 0.05))


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


def draws_of(
    grasped, trial, config=None, stiffness_n_per_m=2e5, hand=HAND, force_n=FORCE, covariance=None
):
    loads = stage_loads(trial, SlipMotion())
    return draw_holds(grasped, trial, loads, hand, force_n, covariance, config, stiffness_n_per_m)


@pytest.fixture(scope="module")
def drawn(bar, trial):
    return draws_of(bar, trial)


def shares(drawn):
    return np.stack([drawn.blocked, drawn.missed, drawn.skewed, drawn.overloaded])


# --- draws ----------------------------------------------------------------------------------------


def test_shares_and_what_holds_are_one_and_a_centred_grasp_holds_best(drawn):
    parts = np.vstack([shares(drawn), drawn.share])
    np.testing.assert_allclose(parts.sum(axis=0), 1.0, atol=1e-12)
    assert parts.min() >= 0 and np.all((drawn.holds >= 0) & (drawn.holds <= 1))
    assert np.all(np.diff(drawn.share) <= 0.02) and drawn.share[0] > 0.7 > 0.1 > drawn.share[-1]
    assert drawn.missed[-1] == 1.0  # beside the bar


def test_the_same_seed_is_the_same_draw_in_any_order(bar, trial, drawn):
    np.testing.assert_array_equal(draws_of(bar, trial).holds, drawn.holds)
    turned = draws_of(bar, trial.part(np.arange(len(trial))[::-1]))
    np.testing.assert_allclose(turned.holds[::-1], drawn.holds, atol=1e-9)
    assert not np.array_equal(draws_of(bar, trial, HoldConfig(seed=1)).holds, drawn.holds)


def test_more_spread_is_less_share_of_a_tight_grasp(bar):
    tight = bar_trial(np.array([0.0, 0.01]))
    found = []
    for times in (0.0, 1.0, 2.0, 4.0):
        spread = PoseSpread(**{name: times * x for name, x in asdict(PoseSpread()).items()})
        found.append(draws_of(bar, tight, HoldConfig(draws=32, spread=spread)).share)
    assert np.all(np.diff(found, axis=0) < 0) and np.all(found[0] > 0.98)


def test_the_error_tells_how_far_the_share_is_off_and_falls_with_the_root_of_the_draws(bar, trial):
    some = trial.part(np.array([0, 3, 5]))

    def draw(count, seed):
        return draws_of(bar, some, HoldConfig(draws=count, seed=seed))

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
        said = draws_of(bar, trial, CERTAIN, np.inf).share
        sure = np.abs(safety - 1.0) > 0.002
        np.testing.assert_array_equal(said[sure], safety[sure] > 1)
        spread = replace(CERTAIN, draws=64, mass_spread=0.3)
        said_of_masses = draws_of(bar, trial, spread, np.inf).share
        np.testing.assert_allclose(said_of_masses, ndtr((safety - 1.0) / 0.3), atol=0.03)
    assert 0 < said.mean() < 1


def test_point_contacts_on_a_ball_are_overloaded_by_a_torque_not_skewed():
    round_one = GraspedObject.of(ball(0.025, 3))
    trial = bar_trial(np.array([0.0, 0.004]), z=0.0)
    found = draws_of(round_one, trial, replace(CERTAIN, conformity_m=0.0), np.inf)
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
    refused(told, HoldConfig, **numbers)


@pytest.mark.parametrize(
    ("covariance", "told"),
    [
        (np.eye(3), r"found \(3, 3\)"),
        (np.full((6, 6), np.nan), "finite"),
        (np.eye(6) + np.eye(6, k=1), "symmetric"),
        (np.diag([1.0, 1, 1, 1, 1, -1]) * 1e-6, "negative variance"),
    ],
)
def test_a_covariance_that_is_none_is_named(bar, trial, covariance, told):
    refused(told, draws_of, bar, trial, covariance=covariance)


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
    on_arc = bar_trial(np.array([0.0, 0.03, 0.12]), arc)
    found = draws_of(bar, on_arc, hand=arc, force_n=arc.force_n)
    np.testing.assert_allclose(shares(found).sum(axis=0) + found.share, 1.0, atol=1e-12)
    assert found.share[0] > 0.6 and found.missed[2] == 1.0

    up = np.cross(*(BAR.vertices[BAR.faces][:, k] - BAR.vertices[BAR.faces][:, 0] for k in (1, 2)))
    lidless = GraspedObject.of(Mesh(vertices=BAR.vertices, faces=BAR.faces[up[:, 2] <= 0]))
    assert not lidless.rays.is_closed
    whole, opened = (draws_of(o, trial, CERTAIN, np.inf) for o in (bar, lidless))
    np.testing.assert_array_equal(opened.share, whole.share)


# --- loads ----------------------------------------------------------------------------------------


def turned_by(R, wrenches):
    """Return torques and forces as rows times R."""
    return np.concatenate([wrenches[..., :3] @ R, wrenches[..., 3:] @ R], axis=-1)


def start_of(trial):
    """Return where the bodies' principal frames are, the hands' middles being the origin."""
    start = np.tile(np.eye(4), (len(trial), 1, 1))
    T_grasp_body = se3.invert(trial.Ts_obj_grasp) @ trial.body.principal_frame()[0]
    start[:, :3] = trial.Ts_table_grasp[:, :3, :3] @ T_grasp_body[:, :3]
    return start


def test_loads_are_those_of_the_slip_test_in_the_hands_frame(trial):
    tilts = se3.random_transform(np.random.default_rng(2), len(trial))
    trial = replace(trial, Ts_table_grasp=tilts)
    motion, R = SlipMotion(), tilts[:, :3, :3]
    loads = stage_loads(trial, motion)
    turned = turned_by(np.swapaxes(R, 1, 2), loads.wrenches)
    weight = [0, 0, 0, 0, 0, -MASS * motion.gravity]
    np.testing.assert_allclose(turned[:, loads.stage == 0], [[weight]] * len(trial), atol=1e-12)
    centers = se3.transform(se3.invert(trial.Ts_obj_grasp), np.zeros((1, 3)))[:, 0]
    rest = loads.about_grasp(centers, np.zeros((len(trial), 1), dtype=np.int64))[:, 0]
    down = -MASS * motion.gravity * R[:, 2]  # the weight in the hand's axes, where the middle is
    np.testing.assert_allclose(rest, np.hstack([np.cross(centers, down), down]), atol=1e-12)
    for k in range(1, len(STAGES)):
        exact = stage_wrenches(k, trial, start_of(trial), motion, 1 / 240)
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
    told = nominal_factors(bar, trial, few, HAND, 0.5, FORCE, 0.0015)
    for k in range(1, len(STAGES)):
        fine = stage_wrenches(k, trial, start_of(trial), motion, 1 / 96)
        every = replace(few, wrenches=turned_by(R, fine), stage=np.full(fine.shape[1], k))
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
