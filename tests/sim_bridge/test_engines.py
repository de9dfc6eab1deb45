"""The engines behind one interface: by name, and alike where physics says that they must be.

Two engines' verdicts on the same grasps, and the interval of their agreement.
"""

import sys
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from held_boxes import DOWN, held_box, held_from_above
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim.robots.robot_files import names_of
from realsim_sim_bridge.school.cross_check import agreement, cross_check, wilson_interval
from realsim_sim_bridge.slip.bullet_pair import HULL
from realsim_sim_bridge.slip.bullet_world import BulletEngine
from realsim_sim_bridge.slip.engines import (
    ENGINES,
    BulletSettings,
    MujocoSettings,
    make_engine,
    settings_of,
)
from realsim_sim_bridge.slip.mujoco_approach import CLEARANCE_M, advanced_fingers, surface_triangles
from realsim_sim_bridge.slip.mujoco_model import lift_law
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import Closing, Grips, PadModel, Replay, SlipBody, SlipPhysics
from realsim_sim_bridge.validation.loads import hold, with_hand
from realsim_sim_bridge.validation.specimens import cube_trial
from refusals import refused
from trimesh_solids import box


@pytest.fixture(params=ENGINES)
def engine(request):
    """The name of each engine."""
    return request.param


def ellipsoid():
    """Return a convex body, curved everywhere, of half axes 30, 22 and 36 mm and 100 g."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3))
    points *= np.array([0.030, 0.022, 0.036]) / np.linalg.norm(points, axis=1, keepdims=True)
    inertia = 0.1 / 5 * np.diag([0.0018, 0.0022, 0.0014])
    return SlipBody(parts=(points,), mass_kg=0.1, center_of_mass=np.zeros(3), inertia=inertia)


def askew(n):
    """Return grasps of the ellipsoid beside its middle and turned."""
    turns = se3.exp_so3([[0.1 * k, 0.2, 0.0] for k in range(n)])
    Ts = se3.from_rt(DOWN @ turns, np.tile([0.006, 0.0, 0.012], (n, 1)))
    straight = held_from_above(ellipsoid(), np.zeros(n))
    return replace(straight, Ts_obj_grasp=Ts, Ts_table_grasp=Ts, openings_m=np.full(n, 0.06))


def crawl_mm(settings):
    """Return how far an object crawls in a second that is squeezed, and nothing else."""
    trial = askew(3)
    grips = trial.grips(headroom_m=1.0)
    with BulletEngine(settings).world(trial.met(SlipPhysics(), find_hand()), grips) as world:
        world.close(Closing())
        seen = world.play(np.zeros((3, 240, 6)), 60, 1.0).Ts_world_body[:, :, :3, 3]
    return 1e3 * np.linalg.norm(seen[:, -1] - seen[:, 0], axis=-1).max()


def test_an_engine_is_known_by_its_name_and_another_is_refused():
    for name in ENGINES:
        assert make_engine(settings_of(name)).name == name
        assert settings_of(name, reference=True).replay == Replay()
    refused("there is no engine 'bullet'; there are: pybullet, mujoco", settings_of, "bullet")


def test_without_mujoco_its_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)  # what Python itself does for `import` to fail
    refused(r"realsim\[mujoco\]", make_engine, MujocoSettings())


def test_what_is_squeezed_at_a_curved_place_does_not_crawl():
    anchored = crawl_mm(BulletSettings())
    assert anchored < 0.02
    assert crawl_mm(replace(BulletSettings(), friction_anchor=False)) > max(0.1, 10 * anchored)


@pytest.mark.parametrize("name", sorted(names_of("hand")))
def test_every_hand_carries_a_cube_through_all_stages(engine, name):
    """And while an arc closes the object goes no farther than its pads rise as they sink in."""
    hand = find_hand(name)
    config = replace(SlipConfig.of(hand), engine=settings_of(engine))
    assert config.physics.force_n == hand.force_n and config.physics.friction == hand.friction
    slips = run_slip_test(cube_trial(0.125, DOWN[None], hand), config, geometry=hand)
    assert slips.passed.all(), slips.failures
    assert slips.slip_m[0].max() < 0.2e-3 + 0.4e-3 * abs(hand.slope(0.025))
    assert slips.force_n[0, 0] == pytest.approx(hand.force_n, rel=0.02)


@pytest.mark.parametrize(("mass", "asked"), [(0.05, 6e4), (2.0, 2e5), (0.2, 5e5)])
def test_pads_are_as_stiff_as_they_are_told_whatever_they_hold(engine, mass, asked):
    trial, found = cube_trial(mass, DOWN[None], find_hand()), []
    engine = make_engine(settings_of(engine))
    for force_n in (20.0, 70.0):
        physics = SlipPhysics(force_n=force_n, pads=PadModel(pad_stiffness_n_per_m=asked))
        with engine.world(trial.met(physics, find_hand()), trial.grips(0.004)) as world:
            world.close(Closing())
            still = round(0.3 / world.dt)
            world.play(np.zeros((1, still, 6)), still, 1.0)
            found.append(world.states().fingers_m.mean())
            assert world.settings()["pad_stiffness_n_per_m"] == pytest.approx(asked)
    assert (70.0 - 20.0) / (found[0] - found[1]) == pytest.approx(asked, rel=0.1)


def test_a_stiffness_that_cannot_be_is_refused_with_what_can():
    for value in (0.0, -2e5, float("nan"), float("inf"), 2e6):
        refused("1000 to 500000 N/m is accepted", PadModel, pad_stiffness_n_per_m=value)
    soft = PadModel(pad_stiffness_n_per_m=2e4)
    refused(r"4\.667e\+04 N/m or more .* 30 N or less", SlipPhysics, force_n=70.0, pads=soft)
    trial, long = cube_trial(20.0, DOWN[None], find_hand()), MujocoSettings(step_s=0.1)
    met = trial.met(SlipPhysics(pads=PadModel(pad_stiffness_n_per_m=5e5)), find_hand())
    refused("shorter step_s", make_engine(long).world, met, trial.grips(0.004))


@pytest.mark.parametrize(
    ("name", "force_n", "friction", "direction", "within", "held_mm", "slipped_mm"),
    [
        ("pybullet", 2.0, 0.25, (1, 0, 0), 0.1, 1.0, 2.0),
        ("pybullet", 70.0, 1.0, (0.7071, 0, -0.7071), 0.1, 1.0, 2.0),
        ("pybullet", 20.0, 0.25, (0, 0, -1), 0.03, 1.0, 1.0),
        ("mujoco", 2.0, 0.25, (0, 0, -1), 0.03, 0.03, 1.0),
        ("mujoco", 20.0, 0.25, (0.7071, 0, -0.7071), 0.03, 0.03, 1.0),
    ],
)
def test_coulomb_s_limit_along_the_pad(
    name, force_n, friction, direction, within, held_mm, slipped_mm
):
    config = with_hand(SlipConfig(), force_n, friction)
    limit = 2 * friction * force_n * np.array([0, 0, 0, *direction])
    loads = np.outer([1 - within, 1 + within], limit)
    engine, body = make_engine(settings_of(name)), held_box(0.3)
    found = hold(engine, config, find_hand(), body, loads, ramp_s=0.125, hold_s=0.5)
    np.testing.assert_allclose(found.finger_n, force_n, rtol=0.02)
    below_mm, above_mm = 1e3 * found.shift_m
    assert below_mm < held_mm <= slipped_mm < above_mm


def test_pads_of_an_arc_are_where_it_has_them_while_they_close():
    hand = find_hand("robotiq_2f140")
    trial = cube_trial(0.125, DOWN[None], hand)
    y = np.linspace(0.0, hand.max_opening_m / 2, 50)
    law = np.polynomial.Polynomial(lift_law(hand))
    np.testing.assert_allclose(law(y), hand.z_pad(2 * y), atol=5e-5)
    grips = replace(trial.grips(0.004), openings_m=np.array([0.12]))
    bullet = BulletEngine(BulletSettings())
    with bullet.world(trial.met(SlipPhysics.of(hand), hand), grips) as world:
        pair = world._pair
        world._take(0)
        pair.drive(0.1)
        for step in range(90):
            pair.follow_arc()
            pair.engine.stepSimulation()
            lifts = [pair.engine.getJointState(pair.hand, lift)[0] for lift in pair._lifts]
            off = np.abs(lifts - hand.z_pad(2 * pair.fingers()[0])).max()
            assert off < (1e-4 if step > 5 else 1e-3)  # the fingers begin to move at once
        assert 0.0245 < pair.fingers()[0].min() < 0.0255  # it has arrived


# --- closing on a table ---------------------------------------------------------------------------


def block(side, low=0.0, off=(0.0, 0.0)):
    """Return corners of a box of sides (3,) [m] that stands at `low` on z, at `off` on x and y."""
    corners = np.array(list(product((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0)))) * side
    return corners + np.array([*off, low])


COLUMNS = tuple(block([0.02, 0.02, 0.04], 0.0, xy) for xy in product((-0.01, 0.01), repeat=2))


def gripped(off_m):
    Ts = se3.from_rt(DOWN, [0.0, off_m, 0.02])[None]
    return Grips(Ts_table_grasp=Ts, Ts_obj_grasp=Ts, openings_m=np.array([0.07]))


def body_of(parts, mass_kg, center):
    inertia = 1e-4 * np.eye(3)
    return SlipBody(parts=parts, mass_kg=mass_kg, center_of_mass=center, inertia=inertia)


def standing(engine, corners, stand, physics=None, closing=None, off_m=0.0, parts=None):
    """Return what a hand that closes from above at z = 2 cm does to a body of 100 g, in steps."""
    body = body_of(parts or (corners,), 0.1, corners.mean(axis=0))
    met = replace(askew(1), body=body, stand=stand).met(physics or SlipPhysics(), find_hand())
    with make_engine(settings_of(engine)).world(met, gripped(off_m)) as world:
        start = world.states().Ts_world_body[0]
        motion = world.close(closing or Closing())
    return start, motion.Ts_world_body[0], motion.finger_n[0]


CUBE = block([0.04] * 3)


def table(neighbours=(), gravity=9.81):
    return Stand.around([CUBE], neighbours, friction=0.4, gravity=gravity)


def test_a_table_far_below_and_no_weight_are_no_table(engine):
    free = Closing(drag_per_s=0.0, release_m=0.0)
    far = replace(table(gravity=0.0), height_m=-10.0)
    pushed, alone = (standing(engine, CUBE, s, None, free, 0.004)[1] for s in (far, None))
    np.testing.assert_allclose(pushed, alone, atol=1e-9)
    assert np.ptp(alone[:, 1, 3]) > 1e-3


def test_a_body_of_parts_is_pushed_over_the_table_as_one(engine):
    ends = []
    for parts in (None, COLUMNS):
        start, seen, forces = standing(engine, CUBE, table(), off_m=0.01, parts=parts)
        assert forces[-1].min() > 60.0
        ends.append(seen[-1])
    assert ends[0][1, 3] - start[1, 3] > 0.008
    np.testing.assert_allclose(ends[1][:3, 3], ends[0][:3, 3], atol=3e-4)
    np.testing.assert_allclose(ends[1][:3, :3], ends[0][:3, :3], atol=0.01)


def test_the_hull_alone_stands_on_the_table_of_bullet():
    body, bullet = body_of(COLUMNS, 0.5, np.array([0, 0, 0.02])), BulletEngine(BulletSettings())
    met = replace(askew(1), body=body, stand=table()).met(SlipPhysics(), find_hand())
    with bullet.world(met, gripped(0.2)) as world:
        pair, far = world._pair, se3.from_translation([0.0, 0.0, 1.0])
        pair.place_stand(world._Ts_hand_table[0])
        world._take(0)
        for _ in range(60):
            pair.push([0.0, 0.0, 0.0], [0.0, 0.0, pair.weights_n[0]])  # down is the hand's +z
            pair.engine.stepSimulation()
        points = pair.engine.getContactPoints(pair.object)
        assert len(points) <= 4 and {p[3] for p in points} == {HULL}
        assert sum(p[9] for p in points) == pytest.approx(0.5 * 9.81, rel=0.02)
        # In the air the link weighs nothing.
        pair.put(far, np.zeros(6), np.full(2, 0.04), np.zeros(2))
        pair.push([0.0, 0.0, 1e-3], [0.0, 0.0, 1.0])
        pair.engine.stepSimulation()
        np.testing.assert_allclose(pair.twist()[[2, 5]], pair.dt * np.array([10.0, 2.0]), rtol=1e-6)


def test_what_stands_stays_and_the_table_forbids_to_go_down(engine):
    start, seen, _ = standing(engine, CUBE, table(), off_m=0.2)
    assert np.abs(seen[:, :3, 3] - start[:3, 3]).max() < 3e-5
    # Bullet finds a box's points of contact one a step: it turns by 0.6 mrad, and back.
    turned = np.abs(seen[:, :3, :3] - start[:3, :3]).max(axis=(1, 2))
    assert turned.max() < 1e-3 and turned[-1] < 1e-4
    # A roof whose sides slope by 31 degrees: fingers that hardly rub squeeze it downwards.
    roof = np.concatenate([block([0.04, 0.05, 0.0]), block([0.04, 0.02, 0.0], 0.025)])
    slippery = SlipPhysics(friction=0.1, force_n=20.0)
    down = {}
    for name, stand in (("free", None), ("stands", table())):
        start, seen, forces = standing(engine, roof, stand, slippery, Closing(release_m=0.0))
        down[name] = start[2, 3] - seen[-1, 2, 3]
    assert down["stands"] < 1e-3 < 0.01 < down["free"] and forces[-1].min() > 1.0
    # It is squeezed out as soon as the table leaves it.
    start, seen, forces = standing(engine, roof, table(), slippery)
    assert start[2, 3] - np.nanmin(seen[:, 2, 3]) > 0.01 and forces[-1].min() < 1.0


def test_a_neighbour_blocks_and_its_overlap_throws_nothing(engine):
    beside = block([0.04] * 3, off=(0.0, -0.037))  # 3 mm in
    stand = table([beside, block([0.01] * 3, 0.01), block([0.04] * 3, off=(0.0, 0.2))])
    assert stand.moved_m == pytest.approx(0.003) and stand.left_out == 1
    assert len(stand.obstacles) == 1 and stand.height_m == 0.0
    start, seen, _ = standing(engine, CUBE, stand, off_m=-0.015)
    assert np.abs(seen[:, :3, 3] - start[:3, 3]).max() < 1e-3
    start, seen, forces = standing(engine, CUBE, table(), off_m=-0.015)
    assert start[1, 3] - seen[-1, 1, 3] > 0.01 and forces[-1].min() > 50.0


# --- Fingers are moved together in free air only.

HAND = find_hand()


def advanced(parts, Ts, opening=0.08):
    return advanced_fingers(surface_triangles(parts), Ts, np.full(len(Ts), opening), HAND)


def scattered(n, seed=0):
    rng = np.random.default_rng(seed)
    return se3.from_rt(se3.random_rotation(rng, n), rng.uniform(-0.03, 0.03, (n, 3)))


def test_no_point_of_the_surface_is_nearer_than_the_clearance_and_one_is_as_near():
    rng = np.random.default_rng(1)
    parts = (rng.uniform(-0.03, 0.03, (20, 3)), box([0.06, 0.01, 0.02], [0.02, 0.0, 0.0]).vertices)
    triangles, Ts = surface_triangles(parts), scattered(40)
    weights = rng.dirichlet(np.ones(3), size=(len(triangles), 3000))
    points = np.einsum("tnc,tcd->tnd", weights, triangles).reshape(-1, 3)
    _, _, (low, high) = HAND.boxes(0.0)[0]
    found, exact = advanced(parts, Ts), 0
    for T, y in zip(Ts, found, strict=True):
        p = se3.transform(se3.invert(T), points)
        across = p[:, [0, 2]]
        within = np.all((low[[0, 2]] < across) & (across < high[[0, 2]]), axis=1)
        between = np.abs(p[within & (np.abs(p[:, 1]) < 0.04), 1])
        if len(between) and between.max() + CLEARANCE_M < 0.04:
            assert between.max() <= y - CLEARANCE_M + 1e-12
            exact += y - CLEARANCE_M - between.max() < 0.5e-3
    assert exact > 10


def test_the_fingers_never_open_and_stay_where_nothing_is_between_them():
    small = (box([0.02, 0.02, 0.02]).vertices,)
    Ts = scattered(40, 3)
    assert (advanced(small, Ts, 0.03) <= 0.015).all()
    away = se3.from_translation([0.0, 0.0, -0.2])[None]
    assert advanced(small, away) == 0.04


def test_a_face_that_passes_through_the_sweep_counts_although_no_corner_is_inside():
    beam = (box([0.3, 0.03, 0.3]).vertices,)
    assert np.allclose(advanced(beam, np.eye(4)[None]), 0.015 + CLEARANCE_M)


# --- two engines' verdicts on the same grasps -----------------------------------------------------


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


def test_two_engines_agree_on_a_box_that_coulomb_s_law_decides():
    # 2 mu F against 2.9 N of weight: 28 N hold; with 0.4 N, and with all weight 6 cm beside the
    # pads, the box falls or turns.
    strong = checked([0.0, 0.02], force_n=70.0, friction=0.2)
    weak = checked([0.0, 0.055], force_n=1.0, friction=0.2)
    assert np.all(strong["second_score"] == 1.0) and np.all(strong["confidence"] == 1.0)
    assert np.all(weak["second_score"] < 0.5) and np.all(weak["confidence"] > 0.8)
